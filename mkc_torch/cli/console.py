"""What the commands share: where they write, how they name columns, and how failures become one sentence."""

from __future__ import annotations

import io
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from threading import Event, RLock, Thread
from time import monotonic

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from mkc_torch._support.files import folder_held
from mkc_torch._words.terms import term

FAILURES = (ValueError, OSError, ImportError, RuntimeError)
"""What bad input, a full disk or a numerical breakdown raises."""

_WIDTH_IN_A_PIPE = 100


@dataclass(frozen=True)
class ConsoleStyle:
    """How text is set for where it goes; another process can set it too, and this one print it."""

    terminal: bool
    width: int

    @classmethod
    def of(cls, console: Console) -> ConsoleStyle:
        return cls(console.is_terminal, console.width)

    def set(self, show: Callable[[Console], None]) -> str:
        """What ``show`` prints."""
        text = io.StringIO()
        show(_console(self.terminal, width=self.width, file=text))
        return text.getvalue()


def out() -> Console:
    """Standard output: coloured on a terminal, plain text of a fixed width in a pipe."""
    return _console(sys.stdout.isatty())


def err() -> Console:
    """Standard error, likewise."""
    return _console(sys.stderr.isatty(), stderr=True)


def _console(
    terminal: bool, *, stderr: bool = False, width: int | None = None, file: io.StringIO | None = None
) -> Console:
    return Console(
        file=file, stderr=stderr, soft_wrap=False,
        highlight=False, markup=False, emoji=False,  # what a user wrote is printed as it is
        force_terminal=terminal, no_color=None if terminal else True,
        width=width if terminal else width or _WIDTH_IN_A_PIPE,
    )  # fmt: skip


def complain(subject: str | Path, error: BaseException) -> None:
    """One line on standard error: which file, and why."""
    sentence = sentence_of(error)
    sentence = sentence.removeprefix(f"{Path(subject).stem}: ")  # a recording is called so in Python
    if not sentence.startswith(str(subject)):
        sentence = f"{subject}: {sentence}"
    err().print(term("command.failed", sentence=sentence), soft_wrap=True)


def sentence_of(error: BaseException) -> str:
    """What an error says, on one line but for the code that a user's own file raised it in.

    The system's own errors name the file.

    Example:
        >>> sentence_of(PermissionError(13, "Permission denied", "report.html"))
        'report.html cannot be written or read: permission denied; choose another place.'
    """
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename} " if error.filename else ""
        return term("command.no_file", file=where, reason=error.strerror.lower())
    from mkc_torch.simulation.load import SimulationFileError

    if isinstance(error, SimulationFileError):
        return str(error)
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
            raise typer.BadParameter(term("command.no_pair", part=part))
        if name in pairs:
            raise typer.BadParameter(term("command.twice", name=name))
        pairs[name] = source
    return pairs


def parsed_pairs(option: str, texts: Sequence[str], example: str) -> dict[str, str]:
    """Pairs of an option that can be given several times, each time with several pairs.

    Raises:
        typer.BadParameter: a part that is no pair, or a name given twice.

    Example:
        >>> parsed_pairs("--noise", ["angle=0.005", "rate=0.1, level=2"], "angle=0.005")
        {'angle': '0.005', 'rate': '0.1', 'level': '2'}
    """
    pairs: dict[str, str] = {}
    for part in (part for text in texts for part in text.split(",")):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not (name and equals and value):
            raise typer.BadParameter(term("command.no_option_pair", option=option, part=part, example=example))
        if name in pairs:
            raise typer.BadParameter(term("command.twice", name=name))
        pairs[name] = value
    return pairs


def refuse_same_names(recordings: Sequence[Path]) -> None:
    """Refuses recordings whose results would go to one place, or to one outside of ``--output``.

    Raises:
        typer.BadParameter: two have the same name, but for the ending and for capitals; or one has no name but dots.
    """
    taken: dict[str, Path] = {}
    for path in recordings:
        if not path.stem.strip("."):
            raise typer.BadParameter(term("command.no_folder", one=path))
        other = taken.setdefault(path.stem.casefold(), path)
        if other is not path:
            raise typer.BadParameter(term("command.same_folder", one=other, other=path, folder=path.stem))


def folder_names(labels: list[str]) -> list[str]:
    """A folder's name for each label, no two alike on any file system.

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


class Steps:
    """What is being done, how much of it is, and for how long.

    Attributes:
        name: of what is being done.
        done, total: how many things are done, and how many there are.
    """

    def __init__(self, bar: Progress | None, total: int) -> None:
        self.name, self.done, self.total = "", 0, total
        self._bar = bar
        self._task = None if bar is None else bar.add_task("", total=total)
        self._part: tuple[str, int, int] | None = None
        self._timed = None if bar is None else bar.add_task("", total=None, visible=False)

    def __call__(self, name: str | None) -> None:
        """To be called with the name of each thing begun, and with None when one is done."""
        if name is None:
            self.done += 1
        else:
            self.name = name
        self._part = None
        if self._bar is None or self._task is None:
            return
        if name is None:
            self._bar.advance(self._task)
        else:
            self._bar.update(self._task, description=name)

    def part(self, thing: str, done: int, total: int) -> None:
        """How many of the things that the stage is made of are done."""
        known = self._part
        self._part = thing, done, total
        if self._bar is None or self._timed is None:
            return
        if known is None or (known[0], known[2]) != (thing, total) or done < known[1]:
            self._bar.reset(self._timed, total=total, completed=done, visible=False)
        else:
            self._bar.update(self._timed, completed=done)

    @property
    def on_a_terminal(self) -> bool:
        """Whether a bar shows it."""
        return self._bar is not None

    @property
    def part_done(self) -> str:
        """The thing that is being done, of how many, and how long the rest takes at the rate so far."""
        if self._part is None or self._part[1] >= self._part[2]:
            return ""
        thing, done, total = self._part
        task = None if self._bar is None else next(one for one in self._bar.tasks if one.id == self._timed)
        if task is None or task.time_remaining is None:
            return term("command.part", thing=thing, number=done + 1, total=total)
        return term(
            "command.part_and_time", thing=thing, number=done + 1, total=total, seconds=math.ceil(task.time_remaining)
        )

    def count(self, name: str, done: int, total: int) -> None:
        """Name what is being done, and how much of it is."""
        self.name, self.done, self.total = name, done, total
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, description=name, completed=done, total=total)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """The bar is out of the way of what is printed meanwhile."""
        if self._bar is None:
            yield
            return
        with drawing:
            self._bar.stop()
            yield
            self._bar.start()


drawing = RLock()
"""Held while something is drawn, and while this process is forked: a copy finds none of the locks of others taken."""

if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=drawing.acquire, after_in_parent=drawing.release, after_in_child=drawing.release)

_EVERY = 0.2  # s

_LINE_EVERY = 10.0
"""Seconds between lines on standard error where it is no terminal."""

_NOTED_EVERY = 60.0
"""Seconds after which a line on long work is added to a file."""


@contextmanager
def progress(total: int, folder: Path | None = None, *, lines: bool = False) -> Iterator[Steps]:
    """What is being done and for how long, on a terminal, with a bar over several things.

    Work of more than a minute adds a line a minute to ``progress.txt`` in the folder, if there is one to write into.

    Args:
        total: how many things are done one after the other.
        folder: for ``progress.txt``.
        lines: where standard error is no terminal, write the stage to it every ten seconds; nothing otherwise.
    """
    begin = monotonic()
    with _shown(total) as steps, ExitStack() as threads:
        if folder is not None:
            threads.enter_context(_repeated(lambda: _note(steps, folder, monotonic() - begin), _NOTED_EVERY))
        if lines and not steps.on_a_terminal:
            threads.enter_context(_repeated(lambda: _write_line(steps, monotonic() - begin), _LINE_EVERY))
        yield steps


def _write_line(steps: Steps, elapsed: float) -> None:
    """Write the stage and the seconds so far to standard error."""
    text = term("command.progress", seconds=f"{elapsed:.0f}", stage=_stage(steps))
    err().print(text, soft_wrap=True)


def _stage(steps: Steps) -> str:
    """How many things are done, of several, and what is being done."""
    count = f"{steps.done} of {steps.total} done, " if steps.total > 1 else ""
    return count + "; ".join(filter(None, [steps.name, steps.part_done]))


def _note(steps: Steps, folder: Path, elapsed: float) -> None:
    """Add a line on what is being done."""
    with suppress(OSError):  # no place for it is no reason to end the work
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
    part = _PartColumn()
    parts = (SpinnerColumn(), TextColumn("{task.description}", markup=False), part, *over, TimeElapsedColumn())
    with (
        Progress(
            *parts, console=console, transient=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
        ) as bar,
        _repeated(lambda: bar.refresh() if bar.live.is_started else None, _EVERY),
    ):
        part.steps = Steps(bar, total)
        yield part.steps


class _PartColumn(ProgressColumn):
    """How much of a stage is done."""

    steps: Steps | None = None

    def render(self, task: Task) -> Text:  # noqa: ARG002
        """The words, as of now."""
        return Text("" if self.steps is None else self.steps.part_done)


@contextmanager
def _repeated(work: Callable[[], None], every: float) -> Iterator[None]:
    """Something that is done from time to time; a thread of its own does it, for the main work gives it no moment."""
    over = Event()

    def repeat() -> None:
        while not over.wait(every):
            with drawing:
                work()

    thread = Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def interrupts_told(left: Callable[[], str]) -> Iterator[None]:
    """One line on standard error when the user interrupts, with what ``left`` says of what there is and is not."""
    try:
        yield
    except KeyboardInterrupt:
        err().print(term("command.interrupted", left=left()), soft_wrap=True)
        raise


def not_written(recordings: Iterable[Path], output: Path) -> str:
    """Which recordings were not begun or left nothing behind, and for which something is there.

    Example:
        >>> not_written([Path("a.csv"), Path("b.csv")], Path("results"))
        'nothing was written for a.csv, b.csv.'
    """
    paths = list(recordings)
    stopped = [path for path in paths if _holds_a_stopped_one(output / path.stem)]
    there = [path for path in paths if path not in stopped and (output / path.stem).is_dir()]
    absent = ", ".join(str(path) for path in paths if path not in there and path not in stopped)
    known = ", ".join(str(path) for path in stopped)
    told = [term("command.stopped", recordings=known)] if known else []
    told += [term("command.nothing_written", recordings=absent)] if absent else []
    folders = ", ".join(str(output / path.stem) for path in there)
    told += [term("command.incomplete", folders=folders)] if there else []
    return f"{'; '.join(told)}." if told else term("command.all_written")


def _holds_a_stopped_one(folder: Path) -> bool:
    """Whether a folder has a diagnosis in it, of a recording or an experiment of it, that was stopped by the user."""
    for file in folder.rglob("diagnosis.json"):
        with suppress(OSError, ValueError, KeyError, TypeError):
            if json.loads(file.read_text(encoding="utf-8"))["search"]["stopped"]["reason"] == "interrupt":
                return True
    return False


def remove_if_empty(folder: Path) -> None:
    """Remove a folder with nothing in it."""
    with suppress(OSError):
        folder.rmdir()


@contextmanager
def folder_written(folder: Path) -> Iterator[None]:
    """No other process writes into a folder meanwhile; an empty one is removed when what was to be written failed.

    Raises:
        FileExistsError: another process writes into it.
    """
    with folder_held(folder):
        try:
            yield
        except BaseException:
            with suppress(OSError):
                folder.rmdir()
            raise
