"""What is said, and kept, of files that are cut off or damaged: whole rows stay, and what was lost is told."""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from mkc_torch.recording.formats.base import RecordingError, Topic, counted

__all__ = ["guarded", "lost_warning", "no_rows", "quiet_terminal", "with_warnings"]


@contextlib.contextmanager
def guarded(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a library raises over a damaged file into a :class:`RecordingError`, and keep it from printing.

    The libraries raise what comes (``struct.error``, ``KeyError``, ``AssertionError``, …) where bytes are not as their
    formats say, and warn or print on the way; none of it tells the user what to do. What is missing (a package, a file)
    is passed on.
    """
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    except (RecordingError, ImportError, FileNotFoundError, IsADirectoryError, PermissionError):
        raise
    except Exception as error:  # what each library raises over bytes that are damaged
        lines = str(error).strip().splitlines()
        said = f" ({lines[0][:120]})" if lines else ""
        raise RecordingError(
            f"{path}: the {what} cannot be read: it is damaged, or of a variant that is not known{said}; "
            "copy it anew from where it was recorded, or export it as CSV."
        ) from error


@contextlib.contextmanager
def quiet_terminal() -> Iterator[None]:
    """Keep compiled code, which writes past Python, from telling the terminal of damage that is told here otherwise."""
    try:
        kept = os.dup(2)
    except OSError:  # there is no terminal
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:  # noqa: PTH123 - a device, not a path
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def lost_warning(lost: int, of: int, where: str, why: str = "hold no whole message") -> str:
    """A sentence about bytes left out.

    Example:
        >>> lost_warning(12, 100, "the end")
        'The file is damaged or cut off: 12 of its 100 bytes, at the end, hold no whole message and are left out.'
    """
    return f"The file is damaged or cut off: {lost:,} of its {counted(of, 'byte')}, at {where}, {why} and are left out."


def no_rows(path: Path, what: str, warnings: Sequence[str] = ()) -> RecordingError:
    """The error about a file in which there is nothing to read."""
    told = " ".join(["", *warnings[:3]])
    return RecordingError(f"{path}: the {what} holds no rows of numbers; record it anew, or copy it whole.{told}")


def with_warnings(topics: Sequence[Topic], sentences: Sequence[str]) -> list[Topic]:
    """The topics, each with what is to be said of the whole file."""
    return [topic._replace(warnings=(*sentences, *topic.warnings)) for topic in topics]
