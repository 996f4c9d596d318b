"""Read MATLAB files (``.mat``): up to version 7 by scipy, version 7.3 (HDF5) by h5py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import FileFormat, Topic, optional
from mkc_torch.recording.formats.damage import guarded, no_rows
from mkc_torch.recording.formats.groups import Group, group_topics
from mkc_torch.recording.formats.hdf5 import hdf5_root
from mkc_torch.recording.formats.magic_numbers import begins_with, wrong_format_error

_TABLES = (
    "tables, timetables, timeseries and other objects of MATLAB are not read: save `table2struct(T, 'ToScalar', true)` "
    "or plain arrays instead"
)


def read(path: Path) -> list[Topic]:
    """Read the topics of a file: the variables, each struct (``log.mag``), each element of a struct array (``S[0]``).

    Columns have the names of the variables; see :mod:`mkc_torch.recording.formats.groups` for arrays. MATLAB files have
    no units. All numbers are read into memory once; for the compressed version 7, twice for a moment.

    Raises:
        RecordingError: the file is not a MATLAB file, is damaged, or has no table of two rows.
        ImportError: scipy, or h5py for version 7.3, is not installed.
    """
    root = _of_hdf5(path) if _is_hdf5(path) else _of_scipy(path)
    topics = group_topics(root)
    if not topics:
        raise no_rows(path, "MATLAB file", _all_warnings(root))
    return topics


def _is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(520)
    return head[512:520] == b"\x89HDF\r\n\x1a\n" or begins_with(path, b"\x89HDF")


def _all_warnings(group: Group) -> list[str]:
    return group.warnings + [sentence for inner in group.groups.values() for sentence in _all_warnings(inner)]


def _of_hdf5(path: Path) -> Group:
    return _dotted(hdf5_root(path, optional("h5py", "HDF5 files", "mat"), "MATLAB file of version 7.3", upright=False))


def _dotted(group: Group) -> Group:
    return Group(
        group.name.replace("/", "."),
        group.arrays,
        group.units,
        {name: _dotted(inner) for name, inner in group.groups.items()},
        [
            sentence.replace("holds references", f"is a cell array or an object ({_TABLES})")
            for sentence in group.warnings
        ],
    )


def _of_scipy(path: Path) -> Group:
    package = optional("scipy.io.matlab", "MATLAB files", "mat")
    with path.open("rb") as file:
        head = file.read(128)
    if head[124:128] not in (b"\x00\x01IM", b"\x01\x00MI") and not _is_version_4(head):
        raise wrong_format_error(path, "MATLAB file")
    with guarded(path, "MATLAB file"):
        try:
            package.matfile_version(str(path))
        except Exception as error:  # ValueError, MatReadError, …
            raise wrong_format_error(path, "MATLAB file") from error
        found = package.loadmat(str(path), chars_as_strings=True, struct_as_record=True)
        return _group("", {name: value for name, value in found.items() if not name.startswith("__")}, 0)


def _is_version_4(head: bytes) -> bool:
    """Whether a head is of version 4, which has no magic number but begins with a number MOPT below 5000."""
    numbers = {int.from_bytes(head[:4], order) for order in ("little", "big")}
    return len(head) > 20 and any(number < 5000 and number % 10 < 3 for number in numbers)


def _group(name: str, variables: dict[str, Any], depth: int) -> Group:
    group = Group(name, {}, {}, {}, [])
    for key, value in variables.items():
        path = f"{name}.{key}" if name else key
        fields = value.dtype.names if isinstance(value, np.ndarray) else None
        if (
            not isinstance(value, np.ndarray)
            or type(value) is not np.ndarray
            or (value.dtype.kind == "V" and not fields)
        ):
            group.warnings.append(Note(f"`{path}` is an object; {_TABLES}."))
        elif fields:
            _add_struct(group, key, path, value, depth)
        elif value.dtype == object:
            texts = _texts(value)
            if texts is None:
                group.warnings.append(Note(f"`{path}` is a cell array and is left out."))
            else:
                group.arrays[key] = texts
        else:
            group.arrays[key] = value
    return group


def _add_struct(group: Group, key: str, path: str, value: np.ndarray, depth: int) -> None:
    elements = value.reshape(-1)
    for place, element in enumerate(elements[:64] if depth < 16 else ()):
        name = key if len(elements) == 1 else f"{key}[{place}]"
        whole = path if len(elements) == 1 else f"{path}[{place}]"
        group.groups[name] = _group(whole, {field: element[field] for field in value.dtype.names or ()}, depth + 1)


def _texts(cells: np.ndarray) -> np.ndarray | None:
    """The texts of a cell array, such as time stamps; None if a cell holds anything else."""
    texts = []
    for cell in cells.reshape(-1):
        if not isinstance(cell, np.ndarray) or cell.dtype.kind != "U" or cell.size > 1:
            return None
        texts.append(str(cell.reshape(-1)[0]) if cell.size else "")
    return np.array(texts, dtype=object) if texts else None


MAT = FileFormat((".mat",), read)
