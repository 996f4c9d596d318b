"""Deadlines of long work: a time limit, and interrupts by the user; checked between the steps of the work."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from time import monotonic
from types import FrameType
from typing import Literal, TypeVar

T = TypeVar("T")

Reason = Literal["time limit", "interrupt"]
"""The reason for which work was stopped."""

_SAME_INTERRUPT_S = 0.3
"""Seconds within which a second SIGINT is a duplicate of the first: from the terminal and the parent process."""


class Stopped(BaseException):
    """Work was stopped before its end. Not an Exception, so that handlers of failures do not catch it.

    Attributes:
        reason: "time limit" or "interrupt".
    """

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass
class Deadline:
    """A time limit of work, and an event that stops it earlier.

    Attributes:
        limit: seconds from ``begin``; infinite for no limit.
        interrupted: event that the first interrupt sets; None for work that interrupts do not stop.
        begin: start of the work by :func:`time.monotonic`, which forked processes share.
    """

    limit: float = math.inf
    interrupted: threading.Event | None = None
    begin: float = field(default_factory=monotonic)

    @property
    def elapsed(self) -> float:
        """Seconds since the work began."""
        return monotonic() - self.begin

    def check(self) -> None:
        """Raise if the work has to stop.

        Raises:
            Stopped: the time limit is over, or the user interrupted.
        """
        if self.interrupted is not None and self.interrupted.is_set():
            raise Stopped("interrupt")
        if self.elapsed >= self.limit:
            raise Stopped("time limit")


_deadline: ContextVar[Deadline | None] = ContextVar("deadline", default=None)
_interrupted: ContextVar[threading.Event | None] = ContextVar("interrupted", default=None)


def check_deadline() -> None:
    """Raise if the current work has to stop; call it between steps of less than a second.

    Raises:
        Stopped: the time limit is over, or the user interrupted.
    """
    deadline = _deadline.get()
    if deadline is not None:
        deadline.check()


def is_limited() -> bool:
    """Whether the current work has a deadline."""
    return _deadline.get() is not None


@contextmanager
def limited(limit: float = math.inf, *, interruptible: bool = True, begin: float | None = None) -> Iterator[Deadline]:
    """Set the deadline of all work within the block, in place of an outer deadline.

    Args:
        limit: seconds; infinite for no limit.
        interruptible: also stop at an interrupt, within :func:`stopped_by_interrupt`.
        begin: start of the time limit by :func:`time.monotonic`; None for now.

    Example:
        >>> with limited(0.0):
        ...     check_deadline()
        Traceback (most recent call last):
        mkc_torch._parallel.deadline.Stopped: time limit
    """
    event = _interrupted.get() if interruptible else None
    deadline = Deadline(limit, event, monotonic() if begin is None else begin)
    token = _deadline.set(deadline)
    try:
        yield deadline
    finally:
        _deadline.reset(token)


def within(seconds: float, work: Callable[[], T]) -> T | None:
    """The result of ``work`` if it ends within ``seconds``; otherwise None.

    Example:
        >>> within(60.0, lambda: 1), within(0.0, check_deadline)
        (1, None)
    """
    with limited(seconds, interruptible=False):
        try:
            return work()
        except Stopped:
            return None


@contextmanager
def stopped_by_interrupt() -> Iterator[None]:
    """Let the first interrupt stop :func:`limited` work at its next step; a second raises KeyboardInterrupt as usual.

    It has an effect only in the main thread of a process with Python's default handler of SIGINT.
    """
    usual = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or usual is not signal.default_int_handler:
        yield
        return
    event, first = threading.Event(), [-math.inf]

    def stop(number: int, frame: FrameType | None) -> None:
        if not event.is_set():
            first[0] = monotonic()
            event.set()
        elif monotonic() - first[0] > _SAME_INTERRUPT_S:
            signal.default_int_handler(number, frame)

    token = _interrupted.set(event)
    signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
        _interrupted.reset(token)
