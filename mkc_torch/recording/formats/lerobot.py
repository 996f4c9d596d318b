"""Robots' recordings in the Parquet files of LeRobot data sets, versions 2 and 3 (huggingface.co/docs/lerobot)."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mkc_torch.recording.formats.base import RecordingError, polars

STATE, ACTION = "observation.state", "action"
_NEEDED = (STATE, ACTION, "timestamp", "episode_index")

_FOLDERS = 4
"""Folders above a file in which its data set's description is searched."""


def is_of_lerobot(frame: Any) -> bool:
    """Whether a table has the columns of such a data set."""
    return all(name in frame.columns for name in _NEEDED)


def joints_and_commands(path: Path, frame: Any) -> Any:
    """Return a table with a column for each joint and for each command, episodes as runs.

    A joint's column has the joint's name in ``meta/info.json`` of the data set, without ".pos"; a command of the same
    name is ``NAME_ctrl``, as in a model of MuJoCo. Without names they are ``state_0`` … and ``action_0`` ….

    Args:
        path: of the file.
        frame: polars frame.

    Raises:
        RecordingError: the vectors of a column have different lengths, or hold no numbers.
    """
    described = _described(path)
    columns: dict[str, Any] = {"time": frame["timestamp"], "experiment": frame["episode_index"]}
    for feature, prefix in ((STATE, "state"), (ACTION, "action")):
        table = _table(path, feature, frame[feature].to_list())
        names = _names(described.get(feature), prefix, table.shape[1])
        for name, values in zip(names, table.T, strict=True):
            columns[f"{name}_ctrl" if feature == ACTION and name in columns else name] = values
    return polars().DataFrame(columns)


def _table(path: Path, feature: str, rows: Sequence[Any]) -> np.ndarray:
    vectors = [row if isinstance(row, list) else [row] for row in rows]
    widths = sorted({len(row) for row in vectors})
    if len(widths) != 1:
        raise RecordingError(
            f"{path}: the vectors of `{feature}` have {widths[0]} to {widths[-1]} values; expected a single length."
        )
    try:
        return np.array(vectors, np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}: `{feature}` holds values that are no numbers.") from error


def _described(path: Path) -> dict[str, Any]:
    """The features of the file's data set, from its description; empty without one."""
    for folder in list(path.resolve().parents)[:_FOLDERS]:
        file = folder / "meta" / "info.json"
        try:
            features = json.loads(file.read_text(encoding="utf-8")).get("features")
        except (OSError, ValueError, AttributeError):
            continue
        if isinstance(features, dict):
            return features
    return {}


def _names(feature: Any, prefix: str, count: int) -> list[str]:
    """Names of the values of a vector.

    Example:
        >>> (
        ...     _names({"names": ["pan.pos", "lift.pos"]}, "state", 2),
        ...     _names({"names": {"motors": ["a", "b"]}}, "state", 2),
        ... )
        (['pan', 'lift'], ['a', 'b'])
        >>> _names({"names": ["motors"]}, "action", 2)
        ['action_0', 'action_1']
    """
    given = feature.get("names") if isinstance(feature, Mapping) else None
    if isinstance(given, Mapping):
        given = [name for part in given.values() for name in (part if isinstance(part, list) else [part])]
    names = [re.sub(r"\W", "_", str(name).removesuffix(".pos")) for name in given or ()]
    if len(names) == count == len(set(names)) and all(names):
        return names
    return [f"{prefix}_{k}" for k in range(count)]
