"""Read HDF5 files (``.h5``, ``.hdf5``) by h5py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mkc_torch.recording.formats.base import FileFormat, Topic, optional
from mkc_torch.recording.formats.damage import guarded, no_rows
from mkc_torch.recording.formats.groups import Group, group_topics
from mkc_torch.recording.formats.hdf5_objects import hdf5_group
from mkc_torch.recording.formats.magic_numbers import wrong_format_error
from mkc_torch.recording.formats.sandbox import broken, reads_without_crash

_TRIAL = Path(__file__).with_name("hdf5_objects.py").read_text(encoding="utf-8")
"""Source that a separate process runs first, because a damaged file can crash the process that reads it."""


def read(path: Path) -> list[Topic]:
    """Read the topics of a file: each group, and each dataset of named fields (a compound), is a topic.

    Columns have the names of the datasets; see :mod:`mkc_torch.recording.formats.groups` for arrays. Units come from
    the attributes ``units`` or ``unit``. All numbers of the file are read into memory, once.

    Raises:
        RecordingError: the file is not an HDF5 file, is damaged, or has no table of two rows.
        ImportError: h5py is not installed.
    """
    package = optional("h5py", "HDF5 files", "hdf5")
    if not package.is_hdf5(str(path)):
        raise wrong_format_error(path, "HDF5 file")
    topics = group_topics(hdf5_root(path, package, "HDF5 file", upright=True))
    if not topics:
        raise no_rows(path, "HDF5 file")
    return topics


def hdf5_root(path: Path, package: Any, what: str, *, upright: bool) -> Group:
    """Read all groups of a file.

    Args:
        path: the file.
        package: h5py.
        what: name of the format for messages.
        upright: True if rows are along the first axis; MATLAB writes them along the last axis.

    Raises:
        RecordingError: the file is damaged.
    """
    if not reads_without_crash(path, _TRIAL):
        raise broken(path, what)
    with guarded(path, what), package.File(str(path), "r") as file:
        root: Group = hdf5_group(package, Group, file, "", upright=upright, count=[0])
        return root


HDF5 = FileFormat((".h5", ".hdf5"), read)
