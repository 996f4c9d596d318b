"""Shared by the commands: consoles, options of name=value pairs, progress, and messages of failures."""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from threading import Event, Thread
from time import monotonic

import typer
from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from mkc_torch._support.files import folder_held
from mkc_torch.cli.steps import Steps, drawing

FAILURES = (ValueError, OSError, ImportError, RuntimeError)
"""Errors of bad input, a full disk or a numerical breakdown."""

DOUBTFUL = 3
"""Exit code of a result that was written, but must be looked at before it is used."""

_PIPE_WIDTH = 100
"""Columns of text that is not printed on a terminal."""


@dataclass(frozen=True)
class ConsoleStyle:
    """Style and width of a console. Another process can render text in it for this one to print."""

    terminal: bool
    width: int

    @classmethod
    def of(cls, console: Console) -> ConsoleStyle:
        return cls(console.is_terminal, console.width)

    def set(self, show: Callable[[Console], None]) -> str:
        """Return the text that ``show`` prints."""
        text = io.StringIO()
        show(_console(self.terminal, width=self.width, file=text))
        return text.getvalue()


def out() -> Console:
    """Return standard output: coloured on a terminal, plain text of a fixed width in a pipe."""
    return _console(sys.stdout.isatty())


def err() -> Console:
    """Return standard error, in the same style."""
    return _console(sys.stderr.isatty(), stderr=True)


def _console(
    terminal: bool, *, stderr: bool = False, width: int | None = None, file: io.StringIO | None = None
) -> Console:
    return Console(
        file=file, stderr=stderr, soft_wrap=False,
        highlight=False, markup=False, emoji=False,  # print the user's text unchanged
        force_terminal=terminal, no_color=None if terminal else True,
        width=width if terminal else width or _PIPE_WIDTH,
    )  # fmt: skip


def complain(subject: str | Path, error: BaseException) -> None:
    """Print one line on standard error: the file and the error."""
    sentence = sentence_of(error)
    sentence = sentence.removeprefix(f"{Path(subject).stem}: ")  # the name of a recording in Python
    if not sentence.startswith(str(subject)):
        sentence = f"{subject}: {sentence}"
    err().print(f"mkc: {sentence}", soft_wrap=True)


def sentence_of(error: BaseException) -> str:
    """Return the message of an error on one line. An error in the user's simulation file keeps its code lines.

    Errors of the operating system name the file.

    Example:
        >>> sentence_of(PermissionError(13, "Permission denied", "report.html"))
        'report.html cannot be written or read: permission denied; choose another place.'
    """
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename} " if error.filename else ""
        return f"{where}cannot be written or read: {error.strerror.lower()}; choose another place."
    loaded = sys.modules.get("mkc_torch.simulation.load")  # its import takes seconds

    if loaded is not None and isinstance(error, loaded.SimulationFileError):
        return str(error)
    return " ".join(str(error).split())


def parsed_columns(text: str | None) -> dict[str, str]:
    """Parse ``mag_x=mx,mag_y=my`` into names and the columns' names in the file.

    Raises:
        typer.BadParameter: a part is not a pair, or a name is given twice.

    Example:
        >>> parsed_columns("mag_x=mx, mag_y=my")
        {'mag_x': 'mx', 'mag_y': 'my'}
    """
    return parsed_pairs("--columns", [text] if text else [], "mag_x=mx,mag_y=my,mag_z=mz")


def parsed_pairs(option: str, texts: Sequence[str], example: str) -> dict[str, str]:
    """Parse the pairs of a repeatable option; each value holds one or more pairs.

    Raises:
        typer.BadParameter: a part is not a pair, or a name is given twice.

    Example:
        >>> parsed_pairs("--noise", ["angle=0.005", "rate=0.1, level=2"], "angle=0.005")
        {'angle': '0.005', 'rate': '0.1', 'level': '2'}
    """
    pairs: dict[str, str] = {}
    for part in (part for text in texts for part in text.split(",")):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not (name and equals and value):
            raise typer.BadParameter(f'{option} "{part}" is not a pair; write name=value, such as {example}.')
        if name in pairs:
            raise typer.BadParameter(f'{option} gives "{name}" twice; keep one of them.')
        pairs[name] = value
    return pairs


def refuse_same_names(recordings: Sequence[Path]) -> None:
    """Raise if two recordings would share a folder of results, or if a folder would lie outside ``--output``.

    Raises:
        typer.BadParameter: two names differ only in suffix or case, or a name consists of dots.
    """
    taken: dict[str, Path] = {}
    for path in recordings:
        if not path.stem.strip("."):
            raise typer.BadParameter(f"{path} is not a valid name for a results folder; rename it.")
        other = taken.setdefault(path.stem.casefold(), path)
        if other is not path:
            raise typer.BadParameter(
                f"{other} and {path} would both write into {path.stem}; rename one, or use two --output."
            )


def folder_names(labels: list[str]) -> list[str]:
    """Return a folder name for each label, distinct on every file system.

    Example:
        >>> folder_names(["run 1", "a/b", "A:B", "..", ""])
        ['run 1', 'a_b', 'A_B_2', '_', '__2']
    """
    names: list[str] = []
    taken: set[str] = set()
    for label in labels:
        plain = re.sub(r"[^\w .+-]", "_", label).strip(" .")[:100] or "_"
        name, count = plain, 1
        while name.casefold() in taken:
            count += 1
            name = f"{plain}_{count}"
        taken.add(name.casefold())
        names.append(name)
    return names


_REFRESH_S = 0.2
"""Seconds between refreshes of the bar."""

_LINE_S = 10.0
"""Seconds between the first lines of progress in a pipe."""

_SPARSE = 0.25
"""Pause between later lines in a pipe, over the time since the start: ten minutes have about 20 lines."""

_FIRST_LINE_S = 3.0
"""Seconds until the first line of progress in a pipe."""

_FILE_LINE_S = 60.0
"""Seconds between lines in ``progress.txt``."""


@contextmanager
def progress(total: int, folder: Path | None = None, *, lines: bool = False) -> Iterator[Steps]:
    """Show progress on a terminal, with a bar over several items.

    Every minute, a line is added to ``progress.txt`` in the folder, if one is given and can be written.

    Args:
        total: number of items.
        folder: folder of ``progress.txt``.
        lines: if standard error is not a terminal, write the stage to it after three seconds, then after ten, and
            more rarely later.
    """
    begin = monotonic()
    with _shown(total) as steps, ExitStack() as threads:
        if folder is not None:
            threads.enter_context(_repeated(lambda: _note(steps, folder, monotonic() - begin), _FILE_LINE_S))
        if lines and not steps.on_a_terminal:
            pause = partial(_pause_between_lines, begin)
            threads.enter_context(
                _repeated(lambda: _write_line(steps, monotonic() - begin), _LINE_S, _FIRST_LINE_S, pause)
            )
        yield steps


def _pause_between_lines(begin: float) -> float:
    """Return the pause in s until the next line, for work that began at ``begin``."""
    return max(_LINE_S, _SPARSE * (monotonic() - begin))


def _write_line(steps: Steps, elapsed: float) -> None:
    """Write the stage and the elapsed seconds to standard error."""
    text = f"mkc: after {elapsed:.0f} s: {_stage(steps)}"
    err().print(text, soft_wrap=True)


def _stage(steps: Steps) -> str:
    """Return the number of finished items, the current item, what was found so far, and the current part."""
    count = f"{steps.done} of {steps.total} done, " if steps.total > 1 else ""
    found = steps.found and f"so far: {steps.found}"
    return count + "; ".join(filter(None, [steps.name, found, steps.part_done]))


def _note(steps: Steps, folder: Path, elapsed: float) -> None:
    """Add a line on the current stage to ``progress.txt``."""
    with suppress(OSError):  # the command continues without the file
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "progress.txt").open("a", encoding="utf-8") as file:
            file.write(f"{datetime.now():%Y-%m-%d %H:%M:%S}  after {elapsed / 60:.0f} min: {_stage(steps)}\n")


@contextmanager
def _shown(total: int) -> Iterator[Steps]:
    console = err()
    if not console.is_terminal:
        yield Steps(None, total)
        return
    over = (BarColumn(), MofNCompleteColumn()) if total > 1 else ()
    parts = (SpinnerColumn(), TextColumn("{task.description}", markup=False), *over, TimeElapsedColumn())
    with (
        _BarWithLines(
            *parts, console=console, transient=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
        ) as bar,
        _repeated(lambda: bar.refresh() if bar.live.is_started else None, _REFRESH_S),
    ):
        bar.steps = Steps(bar, total)
        yield bar.steps


class _BarWithLines(Progress):
    """A progress bar with lines of text below it."""

    steps: Steps | None = None

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield the bar and the lines."""
        yield from super().get_renderables()
        if self.steps is not None:
            yield from (Text(f"  {line}", no_wrap=True, overflow="ellipsis") for line in self.steps.lines)


@contextmanager
def _repeated(
    work: Callable[[], None], every: float, first: float | None = None, later: Callable[[], float] | None = None
) -> Iterator[None]:
    """Call ``work`` repeatedly in a thread.

    Args:
        work: the function.
        every: pause in s.
        first: pause in s before the first call, if it is another.
        later: returns the pauses in s after the first call; None for ``every``.
    """
    over = Event()

    def repeat() -> None:
        pause = every if first is None else first
        while not over.wait(pause):
            with drawing:
                work()
            pause = every if later is None else later()

    thread = Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def interrupts_reported(left: Callable[[], str]) -> Iterator[None]:
    """Print one line on standard error when the user interrupts; ``left`` returns what was written."""
    try:
        yield
    except KeyboardInterrupt:
        err().print(f"mkc: interrupted; {left()}", soft_wrap=True)
        raise


def not_written(recordings: Iterable[Path], output: Path) -> str:
    """Return a sentence on which recordings have no results, partial results or those of a stopped search.

    Example:
        >>> not_written([Path("a.csv"), Path("b.csv")], Path("results"))
        'nothing was written for a.csv, b.csv.'
    """
    paths = list(recordings)
    stopped = [path for path in paths if _holds_stopped_diagnosis(output / path.stem)]
    there = [path for path in paths if path not in stopped and (output / path.stem).is_dir()]
    absent = ", ".join(str(path) for path in paths if path not in there and path not in stopped)
    known = ", ".join(str(path) for path in stopped)
    sentences = [f"results so far were written for {known}"] if known else []
    sentences += [f"nothing was written for {absent}"] if absent else []
    folders = ", ".join(str(output / path.stem) for path in there)
    sentences += [f"{folders} may be incomplete"] if there else []
    return f"{'; '.join(sentences)}." if sentences else "all results were written."


def _holds_stopped_diagnosis(folder: Path) -> bool:
    """Whether a folder holds a diagnosis of a recording, or of one of its runs, that the user stopped."""
    for file in folder.rglob("diagnosis.json"):
        with suppress(OSError, ValueError, KeyError, TypeError):
            if json.loads(file.read_text(encoding="utf-8"))["search"]["stopped"]["reason"] == "interrupt":
                return True
    return False


def remove_if_empty(folder: Path) -> None:
    """Remove a folder if it is empty."""
    with suppress(OSError):
        folder.rmdir()


@contextmanager
def folder_written(folder: Path) -> Iterator[None]:
    """Lock a folder for writing. If the block fails, the folder is removed when it is empty.

    Raises:
        FileExistsError: another process is writing into the folder.
    """
    with folder_held(folder):
        try:
            yield
        except BaseException:
            with suppress(OSError):
                folder.rmdir()
            raise
