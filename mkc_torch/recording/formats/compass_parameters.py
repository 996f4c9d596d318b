"""The correction that ArduPilot applied to the readings in ``MAG``, from the parameters in the log.

ArduPilot logs the corrected field (ardupilot, ``libraries/AP_Compass/AP_Compass_Backend.cpp``, ``correct_field``)::

    logged = [DIA, ODI] * (SCALE * (reading + OFS)) + MOT * current

The columns ``OfsX`` … hold the offsets of each row; ``DIA``, ``ODI`` and ``SCALE`` are only in the parameters (PARM).
``MOT`` stays in the reading: an export leaves it set on the vehicle, and a change of the matrix changes it to second
order only.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from mkc_torch.recording.formats.base import LoggedCorrection

_SCALE = (1.0 / 1.5, 1.5)
"""Range in which ``COMPASS_SCALE`` acts (``Compass::have_scale_factor``)."""

_WHOLE = 1.0
"""Old firmware logs offsets as whole numbers of mG; a parameter that differs by less is the exact offset."""

_NAMES = "COMPASS_OFS, DIA, ODI and SCALE"


def compass_correction(
    topic: str, columns: Mapping[str, np.ndarray], parameters: Mapping[str, Sequence[float]]
) -> LoggedCorrection | None:
    """The correction of a topic ``MAG``, ``MAG2`` or ``MAG[1]``; None for other topics.

    Args:
        topic: name of the topic.
        columns: its columns, name to values.
        parameters: the log's parameters, each with its different values in the order of the log.

    Example:
        >>> known = {f"COMPASS_OFS_{axis}": [value] for axis, value in zip("XYZ", (-97.0, 118.0, 213.0))}
        >>> compass_correction("MAG", {f"Mag{axis}": np.zeros(2) for axis in "XYZ"}, known).offsets[0]
        array([-97., 118., 213.])
    """
    axes = ("MagX", "MagY", "MagZ")
    found = re.fullmatch(r"MAG(\d?)(?:\[(\d+)\])?", topic)
    if found is None or not set(axes) <= set(columns):
        return None
    priority = int(found[2]) if found[2] else max(int(found[1] or 1) - 1, 0)
    which = _parameter_suffix(priority, parameters)
    offsets = _per_axis(f"COMPASS_OFS{which}", parameters)
    names = [f"COMPASS_{what}{which}" for what in ("OFS", "DIA", "ODI", "SCALE")]
    if offsets is None:
        return LoggedCorrection(axes, _NAMES, unknown="which the log does not contain")
    rows = _row_offsets(columns)
    varying = {name for name in parameters if name.startswith(tuple(names)) and len(parameters[name]) > 1}
    if rows is not None:
        varying = {name for name in varying if not name.startswith(names[0])}
    if varying:
        return LoggedCorrection(axes, _NAMES, unknown=f"of which {', '.join(sorted(varying))} changed during the log")
    if rows is None:
        rows = np.broadcast_to(offsets, (len(columns[axes[0]]), 3))
    else:
        rows = np.where(np.abs(rows - offsets) < _WHOLE, offsets, rows)
    return LoggedCorrection(axes, f"{names[0]}, DIA, ODI and SCALE", rows, _matrix(which, parameters))


def _parameter_suffix(priority: int, parameters: Mapping[str, Sequence[float]]) -> str:
    """The number in the parameters' names of a compass: its place among ``DEV_ID``, by its id in ``PRIO``."""
    ids = [parameters.get(f"COMPASS_DEV_ID{suffix}", (math.nan,))[-1] for suffix in ("", "2", "3")]
    wanted = parameters.get(f"COMPASS_PRIO{priority + 1}_ID", (0.0,))[-1]
    place = ids.index(wanted) if wanted and wanted in ids else priority
    return "" if place == 0 else str(place + 1)


def _per_axis(name: str, parameters: Mapping[str, Sequence[float]]) -> np.ndarray | None:
    keys = [f"{name}_{axis}" for axis in "XYZ"]
    return np.array([parameters[key][-1] for key in keys]) if set(keys) <= set(parameters) else None


def _row_offsets(columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
    names = ("OfsX", "OfsY", "OfsZ")
    return np.stack([columns[name].astype(float) for name in names], -1) if set(names) <= set(columns) else None


def _matrix(which: str, parameters: Mapping[str, Sequence[float]]) -> np.ndarray:
    """``[DIA, ODI] * SCALE``, (3, 3); parts that are not set do not act."""
    diagonal = _per_axis(f"COMPASS_DIA{which}", parameters)
    matrix = np.eye(3)
    if diagonal is not None and diagonal.any():
        odd = _per_axis(f"COMPASS_ODI{which}", parameters)
        xy, xz, yz = np.zeros(3) if odd is None else odd
        matrix = np.array([[diagonal[0], xy, xz], [xy, diagonal[1], yz], [xz, yz, diagonal[2]]])
    scale = parameters.get(f"COMPASS_SCALE{which}", (1.0,))[-1]
    return matrix * (scale if _SCALE[0] <= scale <= _SCALE[1] else 1.0)
