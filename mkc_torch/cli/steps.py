"""Progress of a command: its items, the stages of each, what was found so far, and the remaining time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock
from time import monotonic

from rich.progress import Progress

from mkc_torch.cli.remaining import Durations, range_text

drawing = RLock()
"""Held while drawing and while forking, so that a forked process inherits no locked console."""

if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=drawing.acquire, after_in_parent=drawing.release, after_in_child=drawing.release)

_SHORT_S = 1.0
"""Seconds of the shortest finished stage that is listed."""


class Steps:
    """Progress of a command, shown as a bar on a terminal.

    Attributes:
        name: the current item.
        done, total: number of finished items, and of all.
        found: what was found so far in the current item; empty if nothing is known.
    """

    def __init__(self, bar: Progress | None, total: int, clock: Callable[[], float] = monotonic) -> None:
        self.name, self.done, self.total, self.found = "", 0, total, ""
        self._bar, self._clock = bar, clock
        self._task = None if bar is None else bar.add_task("", total=total)
        self._part: tuple[str, int, int] | None = None
        self._most: tuple[str, int, int] | None = None
        self._bound: tuple[str, int, int] | None = None
        self._durations: dict[tuple[str, bool], Durations] = {}
        self._begin = clock()
        self._stage = ""
        self._finished: list[tuple[str, float]] = []

    def __call__(self, name: str | None) -> None:
        """Report the name of an item that begins, or None when it is done."""
        if name is None:
            self.done += 1
            self.found, self._finished = "", []
        else:
            self.name = name
        self._next_stage("")
        if self._bar is None or self._task is None:
            return
        if name is None:
            self._bar.advance(self._task)
        else:
            self._bar.update(self._task, description=name)

    def stage(self, subject: str, stage: str) -> None:
        """Report a stage of an item that begins.

        Args:
            subject: the item, such as ``diagnosing a.csv``.
            stage: its stage.
        """
        before, seconds = self._stage, self._clock() - self._begin
        if not self.name.startswith(f"{subject}: "):
            self.found, self._finished = "", []
        elif before and seconds >= _SHORT_S:
            self._finished.append((before, seconds))
        kept = self._finished
        self(f"{subject}: {stage}")
        self._finished = kept
        self._next_stage(stage)

    def _next_stage(self, stage: str) -> None:
        self._stage, self._begin = stage, self._clock()
        self._part = self._most = self._bound = None
        self._durations = {}

    def part(self, thing: str, done: int, total: int) -> None:
        """Report how many parts of the current stage are done."""
        known, now = self._part, self._clock()
        begins = known is None or (known[0], known[2]) != (thing, total) or done < known[1]
        if begins:
            self._most = self._bound if self._bound is not None and self._bound[0] == thing else None
            self._bound = None
        durations = self._durations.setdefault((thing, self._most is not None), Durations(now))
        if begins:
            durations.begin(now)
        durations.reached(done, now)
        self._part = thing, done, total

    def bound(self, thing: str, done: int, most: int) -> None:
        """Report how many parts of the current stage are done before those that follow, and their largest number."""
        self._bound = thing, done, most

    @property
    def on_a_terminal(self) -> bool:
        """Whether a progress bar is shown."""
        return self._bar is not None

    @property
    def part_done(self) -> str:
        """Return the current part, the number of parts, and the remaining time once durations of parts are known."""
        if self._part is None or self._part[1] >= self._part[2]:
            return ""
        thing, done, total = self._part
        left, before, most = total - done, 0, total
        if self._most is not None:
            _, before, most = self._most
        span = self._durations[thing, self._most is not None].left(left, most - before - done, self._clock())
        if self._most is None:
            return f"{thing} {done + 1} of {total}" + (f", {range_text(*span)} for these" if span else "")
        text = f"{thing} {before + done + 1} of at most {most}"
        return text + (f", {range_text(*span)} left in this stage" if span else "")

    @property
    def finished(self) -> str:
        """Return the finished stages of the item with their durations; empty before the first."""
        return ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in self._finished)

    @property
    def lines(self) -> list[str]:
        """Return what is shown below the bar: the part, what was found so far, and the finished stages."""
        found = self.found and f"so far: {self.found}"
        return [line for line in (self.part_done, found, self.finished and f"done: {self.finished}") if line]

    def count(self, name: str, done: int, total: int) -> None:
        """Report the current item and the number of finished items."""
        self.name, self.done, self.total = name, done, total
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, description=name, completed=done, total=total)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Hide the bar while other text is printed."""
        if self._bar is None:
            yield
            return
        with drawing:
            self._bar.stop()
            yield
            self._bar.start()
