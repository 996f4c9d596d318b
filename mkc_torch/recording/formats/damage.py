"""Errors and warnings about truncated or damaged files: complete rows are kept, and lost bytes are reported."""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from mkc_torch.recording.formats.base import RecordingError, Topic, counted


@contextlib.contextmanager
def guarded(path: Path, what: str) -> Iterator[None]:
    """Convert any error of a library over a damaged file to a :class:`RecordingError`, and suppress its output.

    Libraries raise arbitrary errors (``struct.error``, ``KeyError``, ``AssertionError``, …) over invalid bytes, and
    warn or print without a remedy. Errors about a missing package or file are passed on.
    """
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    except (RecordingError, ImportError, FileNotFoundError, IsADirectoryError, PermissionError):
        raise
    except Exception as error:  # each library raises its own errors over damaged bytes
        lines = str(error).strip().splitlines()
        reason = f" ({lines[0][:120]})" if lines else ""
        raise RecordingError(
            f"{path}: the {what} cannot be read: it is damaged, or of an unknown variant{reason}; "
            "copy it again from where it was recorded, or export it as CSV."
        ) from error


@contextlib.contextmanager
def quiet_terminal() -> Iterator[None]:
    """Suppress the messages that compiled code writes to stderr; the damage is reported by other means."""
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
    """A warning about bytes that are left out.

    Example:
        >>> lost_warning(12, 100, "the end")
        'The file is damaged or cut off: 12 of its 100 bytes, at the end, hold no whole message and are left out.'
    """
    return f"The file is damaged or cut off: {lost:,} of its {counted(of, 'byte')}, at {where}, {why} and are left out."


def no_rows(path: Path, what: str, warnings: Sequence[str] = ()) -> RecordingError:
    """The error about a file without any rows of numbers."""
    reasons = " ".join(["", *warnings[:3]])
    return RecordingError(
        f"{path}: the {what} holds no rows of numbers; record it again, or copy the whole file.{reasons}"
    )


def with_warnings(topics: Sequence[Topic], sentences: Sequence[str]) -> list[Topic]:
    """Add the warnings of the whole file to each topic."""
    return [topic._replace(warnings=(*sentences, *topic.warnings)) for topic in topics]
