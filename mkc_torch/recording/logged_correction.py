"""Undo the correction that an autopilot applied to a magnetometer before it logged the field."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import LoggedCorrection, Topic

_MAG = ("mag_x", "mag_y", "mag_z")

_CORRECTED_BY = "The logged field is corrected already by "
"""Begin of the note on a correction that cannot be undone."""


def raw_readings(
    topic: Topic, columns: Mapping[str, str], values: Mapping[str, Tensor], factor: float, unit: str
) -> tuple[dict[str, Tensor], list[str]]:
    """The raw readings of an autopilot's magnetometer, and a note on what was undone or could not be.

    Args:
        topic: the table that was read.
        columns: new name to the name in the topic.
        values: the columns as read, in their final unit.
        factor: from the unit of the topic to that of the values.
        unit: the final unit.

    Returns:
        ``mag_x``, ``mag_y`` and ``mag_z`` before the correction; empty without a known correction.
    """
    source = tuple(columns.get(name, name) for name in _MAG)
    known = topic.correction
    if known is None and source == ("MagX", "MagY", "MagZ") and "OfsX" in topic.table.names:
        known = LoggedCorrection(source, "COMPASS_OFS, DIA, ODI and SCALE", unknown="which the file does not contain")
    if known is None or source != known.columns:
        return {}, []
    singular = known.matrix is not None and not abs(np.linalg.det(known.matrix)) > 0.0
    if known.offsets is None or known.matrix is None or singular:
        why = known.unknown or "whose matrix cannot be inverted"
        sentence = f"{_CORRECTED_BY}{known.names}, {why}. The calibration applies to the field as logged."
        return {}, [Note(sentence)]
    offsets = torch.tensor(factor * known.offsets)
    if not bool(offsets.any()) and np.array_equal(known.matrix, np.eye(3)):
        return {}, []
    field = torch.stack([values[name] for name in _MAG], -1)
    readings = field @ torch.tensor(np.linalg.inv(known.matrix)).mT - offsets
    last = ", ".join(f"{value:.4g}" for value in offsets[-1].tolist())
    shown = "added" if "COMPASS" in known.names else "removed"
    sentence = (
        f"{known.names}, with which the field was corrected before it was logged, are undone (offsets {shown} by the "
        f"autopilot: {last} {unit}): `mag_x`, `mag_y`, `mag_z` are raw readings, and a calibration replaces these "
        "parameters."
    )
    return dict(zip(_MAG, readings.unbind(-1), strict=True)), [Note(sentence)]


def corrected_already(notes: Iterable[str]) -> str:
    """The note on a correction before logging that is not undone; empty without such a note.

    Example:
        >>> corrected_already(["`mag_x`: converted from mGauss, as the file says, to µT."])
        ''
    """
    return next((str(note) for note in notes if note.startswith(_CORRECTED_BY)), "")
