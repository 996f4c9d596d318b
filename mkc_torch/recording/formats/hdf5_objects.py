"""Read the groups and datasets of an HDF5 file by h5py; as a program, this module reads a whole file.

HDF5's compiled code loops forever over some damaged files, and crashes the process over others.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

Make = Callable[[str, dict[str, Any], dict[str, Any], dict[str, Any], list[str]], Any]

_UNITS = ("units", "unit", "UNITS", "Units", "Unit")
_DEEPEST = 32
"""Deepest nesting of groups."""

_MOST_OBJECTS = 4096
"""Most objects that are read from a file."""

_MOST_EXPANSION = 1100
"""Largest expansion by deflate (zlib's technical notes); a dataset that claims more was never written."""


def hdf5_group(
    package: Any, make: Make, group: Any, name: str, *, upright: bool, count: list[int], depth: int = 0
) -> Any:
    """Read a group with its datasets and subgroups.

    Args:
        package: h5py.
        make: constructs a group from its name, arrays, units, groups and warnings.
        group: a group of h5py.
        name: path of the group.
        upright: True if rows are along the first axis; MATLAB writes them along the last axis.
        count: number of objects read so far, in a list of length 1; a file can link to itself.
        depth: nesting depth of the group.
    """
    found = make(name, {}, {}, {}, [])
    for key in group:
        count[0] += 1
        if count[0] > _MOST_OBJECTS or depth > _DEEPEST or key.startswith("#"):
            continue
        link = group.get(key, getlink=True)
        if not isinstance(link, package.HardLink):
            found.warnings.append(f"`{key}` is a link to elsewhere, left out.")
            continue
        path = f"{name}/{key}" if name else key
        try:
            member = group[key]
            if isinstance(member, package.Group):
                found.groups[key] = hdf5_group(
                    package, make, member, path, upright=upright, count=count, depth=depth + 1
                )
            elif isinstance(member, package.Dataset):
                _add(package, make, found, key, path, member, upright)
        except Exception as error:  # h5py raises arbitrary errors over a damaged object; the other objects are kept
            found.warnings.append(f"`{path}` cannot be read and is left out ({str(error).splitlines()[0][:80]}).")
    return found


def _add(package: Any, make: Make, group: Any, key: str, path: str, dataset: Any, upright: bool) -> None:
    """Add a dataset's values to a group; a dataset with named fields becomes a subgroup."""
    size = dataset.file.id.get_filesize()
    if dataset.shape is None or (dataset.dtype.hasobject and not package.check_string_dtype(dataset.dtype)):
        group.warnings.append(f"`{path}` holds references and is left out.")
        return
    if dataset.nbytes > _MOST_EXPANSION * size + 10**6:
        group.warnings.append(
            f"`{path}` claims {dataset.nbytes:,} bytes, more than the file can hold, and is left out."
        )
        return
    unit = next((_text(dataset.attrs[name]) for name in _UNITS if name in dataset.attrs), "")
    if package.check_string_dtype(dataset.dtype):
        values = np.asarray(dataset.asstr(errors="replace")[()], dtype=object)
    else:
        values = np.asarray(dataset[()])
    if values.dtype.names:
        fields = {name: values[name] for name in values.dtype.names}
        group.groups[key] = make(path, fields, {}, {}, [])
        return
    if not upright and values.ndim > 1:
        values = values.T
    group.arrays[key] = values
    if unit:
        group.units[key] = unit


def _text(value: Any) -> str:
    """An attribute as text; an array counts if all its elements are equal, else the result is empty."""
    cells = {
        cell.decode("utf-8", "replace") if isinstance(cell, bytes) else str(cell) for cell in np.ravel(value).tolist()
    }
    return cells.pop().strip() if len(cells) == 1 else ""


def _plain(
    name: str, arrays: dict[str, Any], units: dict[str, Any], groups: dict[str, Any], warnings: list[str]
) -> SimpleNamespace:
    return SimpleNamespace(name=name, arrays=arrays, units=units, groups=groups, warnings=warnings)


if __name__ == "__main__":
    import h5py

    with h5py.File(sys.argv[1], "r") as opened:
        hdf5_group(h5py, _plain, opened, "", upright=True, count=[0])
