"""HDF5 (``.h5``, ``.hdf5``), by h5py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mkc_torch.recording.formats.base import FileFormat, Topic
from mkc_torch.recording.formats.begins import foreign
from mkc_torch.recording.formats.damage import guarded, no_rows
from mkc_torch.recording.formats.groups import Group, group_topics

__all__ = ["HDF5", "h5py", "hdf5_group"]

_UNITS = ("units", "unit", "UNITS", "Units", "Unit")
_DEEPEST = 32
_MOST_OBJECTS = 4096
_MOST_EXPANSION = 1100
"""Bytes that deflate can make of one (zlib's technical notes); what is said to hold more was never written."""


def h5py(extra: str) -> Any:
    """The package h5py."""
    try:
        import h5py as package
    except ImportError as error:
        raise ImportError(
            f'HDF5 files are read with h5py; install it with `pip install "mkc-torch[{extra}]"`.'
        ) from error
    return package


def read(path: Path) -> list[Topic]:
    """The topics of a file: each group is one, and so is each dataset of named fields (a compound).

    Columns are named as the datasets are; see :mod:`mkc_torch.recording.formats.groups` for arrays. Units are those of
    the attributes ``units`` or ``unit``. All numbers of the file are read into memory, once.

    Raises:
        RecordingError: no HDF5 file, a damaged one, or one without a table of two rows.
        ImportError: h5py is not installed.
    """
    package = h5py("hdf5")
    if not package.is_hdf5(str(path)):
        raise foreign(path, "HDF5 file")
    with guarded(path, "HDF5 file"), package.File(str(path), "r") as file:
        topics = group_topics(hdf5_group(package, file, "", upright=True, count=[0]))
    if not topics:
        raise no_rows(path, "HDF5 file")
    return topics


def hdf5_group(package: Any, group: Any, name: str, *, upright: bool, count: list[int], depth: int = 0) -> Group:
    """A group and all in it.

    Args:
        upright: whether rows lie along the first axis; MATLAB writes them along the last.
        count: of the objects so far; a file can link to itself.
    """
    found = Group(name, {}, {}, {}, [])
    for key in group:
        count[0] += 1
        if count[0] > _MOST_OBJECTS or depth > _DEEPEST or key.startswith("#"):
            continue
        link = group.get(key, getlink=True)
        if not isinstance(link, package.HardLink):
            found.told.append(f"`{key}` is a link to elsewhere, left out.")
            continue
        path = f"{name}/{key}" if name else key
        try:
            one = group[key]
            if isinstance(one, package.Group):
                found.groups[key] = hdf5_group(package, one, path, upright=upright, count=count, depth=depth + 1)
            elif isinstance(one, package.Dataset):
                _add(package, found, key, path, one, upright)
        except Exception as error:  # the library raises what comes over a damaged object; the others stay
            found.told.append(f"`{path}` cannot be read and is left out ({str(error).splitlines()[0][:80]}).")
    return found


def _add(package: Any, group: Group, key: str, path: str, dataset: Any, upright: bool) -> None:
    """A dataset's values; one with named fields is a group of its own."""
    size = dataset.file.id.get_filesize()
    if dataset.shape is None or (dataset.dtype.hasobject and not package.check_string_dtype(dataset.dtype)):
        group.told.append(f"`{path}` holds references and is left out.")
        return
    if dataset.nbytes > _MOST_EXPANSION * size + 10**6:
        group.told.append(
            f"`{path}` is said to hold {dataset.nbytes:,} bytes, more than the file can, and is left out."
        )
        return
    unit = next((_text(dataset.attrs[name]) for name in _UNITS if name in dataset.attrs), "")
    if package.check_string_dtype(dataset.dtype):
        values = np.asarray(dataset.asstr(errors="replace")[()], dtype=object)
    else:
        values = np.asarray(dataset[()])
    if values.dtype.names:
        fields = {name: values[name] for name in values.dtype.names}
        group.groups[key] = Group(path, fields, {}, {}, [])
        return
    if not upright and values.ndim > 1:
        values = values.T
    group.arrays[key] = values
    if unit:
        group.units[key] = unit


def _text(value: Any) -> str:
    """An attribute as text, which it is, or an array of one, or of one a column that are all the same."""
    cells = {
        cell.decode("utf-8", "replace") if isinstance(cell, bytes) else str(cell) for cell in np.ravel(value).tolist()
    }
    return cells.pop().strip() if len(cells) == 1 else ""


HDF5 = FileFormat((".h5", ".hdf5"), read)
