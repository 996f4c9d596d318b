"""Writing of results without half-written files after a failure and without loss of the user's files."""

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


def write_atomically(path: str | os.PathLike[str], data: str | bytes, *, overwrite: bool = False) -> None:
    """Write a file atomically.

    The data are written to a temporary file in the same folder, which is then renamed.

    Args:
        path: the target, in an existing folder.
        data: its content; text is written as UTF-8 with unchanged line ends.
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
        with temporary.open("xb") as file:  # not tempfile, whose files only the owner can read
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())
        _take_name(temporary, path, overwrite)
    except OSError as error:
        if error.errno is None:  # raised above
            raise
        # the error of a full disk names no file, and the temporary name is meaningless to a user
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def _take_name(temporary: Path, path: Path, overwrite: bool) -> None:
    """Rename a file; without ``overwrite`` a target that another process has created meanwhile is kept."""
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


_LEFTOVER = re.compile(r"\.[0-9a-f]{16}\.tmp")
"""Names of temporary files that a killed process leaves behind."""


@contextmanager
def folder_held(path: str | os.PathLike[str]) -> Iterator[None]:
    """Lock a folder against other processes within the block; the lock ends with the process at the latest.

    Temporary files of killed processes are removed. On a system without file locks nothing is locked.

    Raises:
        FileExistsError: another process has locked the folder.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, folder_held(folder):
        ...     write_atomically(Path(folder) / "a.txt", "text")
    """
    path = Path(path)
    if sys.platform == "win32":  # it has no such locks
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
        for leftover in path.iterdir():
            if _LEFTOVER.fullmatch(leftover.name):
                leftover.unlink(missing_ok=True)
        yield
    finally:
        os.close(handle)


_MADE = b"Made by mkc_torch"
_MARKS = {".html": _MADE, ".json": b'"schema": "mkc-', ".py": b"`mkc diagnose`"}
_MARKS |= dict.fromkeys((".params", ".param", ".h", ".yaml"), _MADE)
"""Text by which a file of this suffix is recognised as written by mkc_torch."""


def claim_folder(path: str | os.PathLike[str], *, overwrite: bool = False, files: Iterable[str] = ()) -> Path:
    """Create an output folder and its parents, or accept an existing empty folder.

    Args:
        path: the folder.
        overwrite: accept a folder with files in it. No file is removed.
        files: names of the files that will be written; a user's own file with such a name is refused.

    Returns:
        The folder.

    Raises:
        FileExistsError: ``path`` is a file, or a folder that is not empty and ``overwrite`` is False, or one of
            ``files`` exists and was not written by mkc_torch.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     claim_folder(Path(folder) / "results" / "first").is_dir()
        True
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file, not a folder; choose another output folder.")
    if path.is_dir() and not overwrite and not all(_LEFTOVER.fullmatch(inner.name) for inner in path.iterdir()):
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


def _foreign(folder: Path, names: Sequence[str]) -> list[str]:
    """Existing files that mkc_torch has not written; a file without a mark counts as written if a marked file does."""
    existing = [name for name in names if (folder / name).is_file()]
    marked = {name: _MARKS[Path(name).suffix] for name in existing if Path(name).suffix in _MARKS}
    own = {name for name, mark in marked.items() if mark in (folder / name).read_bytes()}
    return [name for name in existing if name not in own and (name in marked or not own)]
