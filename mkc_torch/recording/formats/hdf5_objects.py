"""The groups and datasets of an HDF5 file, by h5py; run as a program, it reads a file to its end.

HDF5's compiled code goes round in a circle over some damaged files, and ends the process over others.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

__all__ = ["hdf5_group"]

Make = Callable[[str, dict[str, Any], dict[str, Any], dict[str, Any], list[str]], Any]

_UNITS = ("units", "unit", "UNITS", "Units", "Unit")
_DEEPEST = 32
_MOST_OBJECTS = 4096
_MOST_EXPANSION = 1100
"""Bytes that deflate can make of one (zlib's technical notes); what is said to hold more was never written."""


def hdf5_group(
    package: Any, make: Make, group: Any, name: str, *, upright: bool, count: list[int], depth: int = 0
) -> Any:
    """A group and all in it.

    Args:
        package: h5py.
        make: makes a group of its name, arrays, units, groups and what is to be told of it.
        group: of h5py.
        name: of the group.
        upright: whether rows lie along the first axis; MATLAB writes them along the last.
        count: of the objects so far; a file can link to itself.
    """
    found = make(name, {}, {}, {}, [])
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
                found.groups[key] = hdf5_group(package, make, one, path, upright=upright, count=count, depth=depth + 1)
            elif isinstance(one, package.Dataset):
                _add(package, make, found, key, path, one, upright)
        except Exception as error:  # the library raises what comes over a damaged object; the others stay
            found.told.append(f"`{path}` cannot be read and is left out ({str(error).splitlines()[0][:80]}).")
    return found


def _add(package: Any, make: Make, group: Any, key: str, path: str, dataset: Any, upright: bool) -> None:
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
        group.groups[key] = make(path, fields, {}, {}, [])
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


def _plain(
    name: str, arrays: dict[str, Any], units: dict[str, Any], groups: dict[str, Any], told: list[str]
) -> SimpleNamespace:
    return SimpleNamespace(name=name, arrays=arrays, units=units, groups=groups, told=told)


if __name__ == "__main__":
    import h5py

    with h5py.File(sys.argv[1], "r") as opened:
        hdf5_group(h5py, _plain, opened, "", upright=True, count=[0])
