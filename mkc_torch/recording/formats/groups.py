"""Convert a tree of named arrays, such as MATLAB structs or HDF5 groups, to topics.

Each group is a topic. Arrays (N, 3) become the columns ``name_x``, ``name_y``, ``name_z``; arrays of another width
become ``name[0]``, ``name[1]``, …; (3, N) is transposed. Arrays of different lengths in a group become separate topics,
each with the time of its length. A subgroup with the length of its parent and without a time of its own is merged into
the parent, with a dot in the names of its columns. Time comes first. Single numbers are left out.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from typing import NamedTuple

import numpy as np

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import Topic, listed
from mkc_torch.recording.formats.topics import MOST_ELEMENTS, spread, topic_of

_TIME = re.compile(r"(?i)(^|[._])(t|tout|time|times|timestamp|timestamps|time_?stamp|stamp)([._].*)?$|^time")


class Group(NamedTuple):
    """A node of the tree.

    Attributes:
        name: its full path in the format's notation; empty for the root.
        arrays: arrays of any shape and type, by name.
        units: units of the arrays if the format states them, by name.
        groups: subgroups by name.
        warnings: what was left out while the group was read.
    """

    name: str
    arrays: dict[str, np.ndarray]
    units: dict[str, str]
    groups: dict[str, Group]
    warnings: list[str]


def group_topics(root: Group) -> list[Topic]:
    """The topics of a tree, its root first.

    Example:
        >>> mag = Group("mag", {"t": np.arange(4.0), "field": np.zeros((4, 3))}, {"t": "s"}, {}, [])
        >>> [(topic.name, topic.table.names) for topic in group_topics(Group("", {}, {}, {"mag": mag}, []))]
        [('mag', ['t', 'field_x', 'field_y', 'field_z'])]
    """
    joined = _joined(root)
    topics = _own_topics(joined)
    for group in joined.groups.values():
        topics += group_topics(group)
    return topics


def _joined(group: Group) -> Group:
    """Merge the columns of subgroups that share the group's length and have no time of their own."""
    arrays, units, warnings, apart = dict(group.arrays), dict(group.units), list(group.warnings), {}
    lengths = {_rows(values) for name, values in arrays.items() if _TIME.search(name)}
    for name, inner in group.groups.items():
        inner = _joined(inner)
        own = [_length(values, lengths) for values in inner.arrays.values()]
        timed = any(_TIME.search(key) and _rows(values) > 1 for key, values in inner.arrays.items())
        if own and not timed and not inner.groups and set(own) & (lengths - {1}):
            arrays |= {f"{name}.{key}": values for key, values in inner.arrays.items()}
            units |= {f"{name}.{key}": unit for key, unit in inner.units.items()}
            warnings += inner.warnings
        else:
            apart[name] = inner
    return Group(group.name, arrays, units, apart, warnings)


def _own_topics(group: Group) -> list[Topic]:
    """A topic for each length of the group's arrays; the length with most columns comes first."""
    times = {_rows(values) for name, values in group.arrays.items() if _TIME.search(name)}
    lengths = {name: _length(values, times | _vectors(group)) for name, values in group.arrays.items()}
    single = [name for name, length in lengths.items() if length < 2]
    sizes = Counter(length for length in lengths.values() if length >= 2)
    topics: list[Topic] = []
    wide = []
    for length, _ in sizes.most_common():
        columns: dict[str, np.ndarray] = {}
        units: dict[str, str] = {}
        for name, values in group.arrays.items():
            if lengths[name] != length:
                continue
            rows = _upright(values, length)
            if math.prod(rows.shape[1:]) > MOST_ELEMENTS:
                wide.append(name)
                continue
            parts = spread(name, rows)
            columns |= parts
            if name in group.units:
                units |= dict.fromkeys(parts, group.units[name])
        name = group.name if not topics else f"{group.name}[{length} rows]"
        columns = dict(sorted(columns.items(), key=lambda item: not _TIME.search(item[0])))
        if columns and (topic := topic_of(name, columns, units)):
            topics.append(topic)
    warnings = list(group.warnings)
    if single:
        others = " and others" if len(single) > 8 else ""
        warnings.append(Note(f"{listed(single[:8])}{others}: single values, left out."))
    if wide:
        warnings.append(Note(f"{listed(wide[:8])}: more than {MOST_ELEMENTS} numbers per row, left out."))
    if len(topics) > 1:
        warnings.append(Note(f"Columns of different lengths were split into {len(topics)} tables."))
    if warnings and topics:
        topics[0] = topics[0]._replace(warnings=(*warnings, *topics[0].warnings))
    return topics


def _vectors(group: Group) -> set[int]:
    """The lengths of the group's vectors; they determine the orientation of its matrices."""
    return {_rows(values) for values in group.arrays.values() if _is_vector(values)} - {0, 1, 3}


def _is_vector(values: np.ndarray) -> bool:
    return values.size > 1 and values.ndim >= 1 and max(values.shape) == values.size


def _rows(values: np.ndarray) -> int:
    return int(values.size) if _is_vector(values) else (int(values.shape[0]) if values.ndim and values.size else 0)


def _length(values: np.ndarray, known: set[int]) -> int:
    """The number of rows of an array, along the axis of known length or else the longer of two axes."""
    if values.ndim == 0 or values.size == 0:
        return min(values.size, 1)
    if _is_vector(values) or values.size == 1:
        return int(values.size)
    for length in (values.shape[0], values.shape[-1]):
        if length in known:
            return int(length)
    return int(max(values.shape)) if values.ndim == 2 else int(values.shape[0])


def _upright(values: np.ndarray, length: int) -> np.ndarray:
    """Transpose an array so that its rows are along the first axis."""
    if _is_vector(values):
        return values.reshape(-1)
    return values if values.shape[0] == length else np.moveaxis(values, -1, 0)
