"""What the commands share: where they write, how they name columns, and how failures become one sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from mkc_torch.recording import Recording

FAILURES = (ValueError, OSError, ImportError, RuntimeError)
"""What bad input, a full disk or a numerical breakdown raises."""

_WIDTH_IN_A_PIPE = 100


def out() -> Console:
    """Standard output: coloured on a terminal, plain text of a fixed width in a pipe."""
    return _console(sys.stdout.isatty(), stderr=False)


def err() -> Console:
    """Standard error, likewise."""
    return _console(sys.stderr.isatty(), stderr=True)


def _console(terminal: bool, *, stderr: bool) -> Console:
    return Console(
        stderr=stderr, highlight=False, soft_wrap=False,
        force_terminal=terminal, no_color=None if terminal else True, width=None if terminal else _WIDTH_IN_A_PIPE,
    )  # fmt: skip


def complain(subject: str | Path, error: BaseException) -> None:
    """One line on standard error: which file, and why."""
    sentence = sentence_of(error)
    if not sentence.startswith(str(subject)):
        sentence = f"{subject}: {sentence}"
    err().print(f"mkc: {sentence}", markup=False, soft_wrap=True)


def sentence_of(error: BaseException) -> str:
    """What an error says, on one line; the system's own errors name the file.

    Example:
        >>> sentence_of(PermissionError(13, "Permission denied", "report.html"))
        'report.html cannot be written or read: permission denied; choose another place.'
    """
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename} " if error.filename else ""
        return f"{where}cannot be written or read: {error.strerror.lower()}; choose another place."
    return " ".join(str(error).split())


def parsed_columns(text: str | None) -> dict[str, str]:
    """``mag_x=mx,mag_y=my`` as names and the names they have in the file.

    Raises:
        typer.BadParameter: a part that is no such pair, or a name given twice.

    Example:
        >>> parsed_columns("mag_x=mx, mag_y=my")
        {'mag_x': 'mx', 'mag_y': 'my'}
    """
    pairs: dict[str, str] = {}
    for part in (text or "").split(","):
        name, equals, source = (piece.strip() for piece in part.partition("="))
        if not part.strip() and not text:
            continue
        if not (name and equals and source):
            raise typer.BadParameter(f'"{part}" is no pair; write name=column, such as mag_x=mx,mag_y=my,mag_z=mz.')
        if name in pairs:
            raise typer.BadParameter(f'"{name}" is given twice.')
        pairs[name] = source
    return pairs


def with_unit(recording: Recording, unit: str) -> Recording:
    """The recording with its magnetometer in a unit of the user's own."""
    own = {name: unit for name in ("mag_x", "mag_y", "mag_z") if name in recording}
    return Recording(
        recording.columns,
        name=recording.name,
        units=dict(recording.units) | own,
        warnings=recording.warnings,
        labels=recording.labels,
    )


@contextmanager
def progress(names: Sequence[str]) -> Iterator[Callable[[str | None], None]]:
    """A bar over several files on a terminal; nothing for one file or in a pipe.

    Gives a function to call with the name of each file begun, and with None when one is done.
    """
    console = err()
    if len(names) < 2 or not console.is_terminal:
        yield lambda _: None
        return
    parts = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    both = sys.stdout.isatty()  # else what is printed would go where the bar is, not into the user's file
    with Progress(*parts, console=console, transient=True, redirect_stdout=both) as bar:
        task = bar.add_task("", total=len(names))

        def step(name: str | None) -> None:
            if name is None:
                bar.advance(task)
            else:
                bar.update(task, description=name)

        yield step


@contextmanager
def folder_removed_on_failure(folder: Path) -> Iterator[None]:
    """Leaves no empty folder behind when what was to be written into it failed."""
    try:
        yield
    except BaseException:
        with suppress(OSError):
            folder.rmdir()
        raise
