"""Writing results so that a failure leaves nothing half-written and nothing of the user's is lost."""

from __future__ import annotations

import os
import re
import secrets
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

if sys.platform != "win32":
    import fcntl

__all__ = ["claim_folder", "folder_held", "write_atomically"]


def write_atomically(path: str | os.PathLike[str], data: str | bytes, *, overwrite: bool = False) -> None:
    """Write a whole file or none of it.

    The data go to a temporary file in the same folder, which then takes the target's name in one step.

    Args:
        path: the target, in a folder that exists.
        data: its content; text is written as UTF-8, line ends as they are.
        overwrite: replace an existing file.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is False, or it is a folder or a device.
        FileNotFoundError: the folder does not exist.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_atomically(Path(folder) / "a.txt", "text")
        ...     (Path(folder) / "a.txt").read_text()
        'text'
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise FileExistsError(f"{path} exists and is not a regular file; choose another name.")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists; use `--force` (in Python `overwrite=True`) to replace it.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written: there is no folder {path.parent}; create it first.")
    temporary = path.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:  # not tempfile, whose files nobody but the owner can read
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())
        _take_name(temporary, path, overwrite)
    except OSError as error:
        if error.errno is None:  # our own sentence
            raise
        # a write to a full disk does not name the file, and the temporary's name tells a user nothing
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def _take_name(temporary: Path, path: Path, overwrite: bool) -> None:
    """Give a file its name; a file that another process gave that name meanwhile is not replaced unasked."""
    if not overwrite:
        try:
            os.link(temporary, path)  # fails where the name is taken
        except FileExistsError:
            raise FileExistsError(f"{path} exists; use `--force` (in Python `overwrite=True`) to replace it.") from None
        except OSError:  # a file system without hard links
            pass
        else:
            return
    os.replace(temporary, path)  # noqa: PTH105 - one name for the step that tests make fail


_LEFT = re.compile(r"\.[0-9a-f]{16}\.tmp")
"""What a process that was killed while it wrote leaves behind."""


@contextmanager
def folder_held(path: str | os.PathLike[str]) -> Iterator[None]:
    """No other process holds the folder meanwhile; whichever way this one ends, it is free again.

    What a process that was killed left half-written is removed. Where the system has no locks, nothing is held.

    Raises:
        FileExistsError: another process holds it.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, folder_held(folder):
        ...     write_atomically(Path(folder) / "a.txt", "text")
    """
    path = Path(path)
    if sys.platform == "win32":  # which has no such locks
        yield
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FileExistsError(
                f"{path} is being written by another mkc; wait for it, or choose another output folder."
            ) from None
        except OSError:  # a file system without locks
            pass
        for left in path.iterdir():
            if _LEFT.fullmatch(left.name):
                left.unlink(missing_ok=True)
        yield
    finally:
        os.close(handle)


_MADE = b"Made by mkc_torch"
_MARKS = {".html": _MADE, ".json": b'"schema": "mkc-', ".py": b"`mkc diagnose`"}
_MARKS |= dict.fromkeys((".params", ".param", ".h", ".yaml"), _MADE)
"""By which files of a kind are known as written here."""


def claim_folder(path: str | os.PathLike[str], *, overwrite: bool = False, files: Iterable[str] = ()) -> Path:
    """Create an output folder, its parents too, or take an existing one that is empty.

    Args:
        path: the folder.
        overwrite: accept a folder with files in it. None of them is removed.
        files: names of those that will be written: a file of the user's own under such a name is not to be lost.

    Returns:
        The folder.

    Raises:
        FileExistsError: ``path`` is a file, or a folder with something in it and ``overwrite`` is False, or it has a
            file to be written that was not written here.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     claim_folder(Path(folder) / "results" / "first").is_dir()
        True
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file, not a folder; choose another output folder.")
    if path.is_dir() and not overwrite and _something_in(path):
        raise FileExistsError(
            f"{path} exists and is not empty; use `--force` (in Python `overwrite=True`) to write into it, "
            "or choose another output folder."
        )
    for name in _foreign(path, list(files)):
        raise FileExistsError(
            f"{path / name} exists and was not written by mkc, so it is not replaced; move it away, or choose another "
            "output folder."
        )
    path.mkdir(parents=True, exist_ok=True)
    return path


def _something_in(folder: Path) -> bool:
    return any(not _LEFT.fullmatch(path.name) for path in folder.iterdir())


def _foreign(folder: Path, names: Sequence[str]) -> list[str]:
    """Files that are there and were not written here; one of a kind without a mark goes with those that have one."""
    there = [name for name in names if (folder / name).is_file()]
    marked = {name: _MARKS[Path(name).suffix] for name in there if Path(name).suffix in _MARKS}
    own = {name for name, mark in marked.items() if mark in (folder / name).read_bytes()}
    return [name for name in there if name not in own and (name in marked or not own)]
