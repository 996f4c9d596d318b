"""When long work has to stop: after so many seconds, or when a user interrupts it; asked for between its steps."""

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

__all__ = ["Deadline", "Reason", "Stopped", "check_deadline", "is_limited", "limited", "stopped_by_interrupt", "within"]

T = TypeVar("T")

Reason = Literal["time limit", "interrupt"]
"""Why work was stopped."""

_SAME_INTERRUPT_S = 0.3
"""Seconds within which a second interrupt is the first again: a terminal's and a parent process's."""


class Stopped(BaseException):
    """Work was stopped before its end. No Exception, so that code that deals with failures does not take it for one.

    Attributes:
        reason: why.
    """

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass
class Deadline:
    """A moment until which work may go on, and an interrupt that ends it before.

    Attributes:
        limit: seconds from now; infinite for none.
        interrupted: set by the first interrupt.
        begin: of the work, by :func:`time.monotonic`, which forked processes share.
    """

    limit: float = math.inf
    interrupted: threading.Event | None = None
    begin: float = field(default_factory=monotonic)

    @property
    def elapsed(self) -> float:
        """Seconds since the work began."""
        return monotonic() - self.begin

    def check(self) -> None:
        """Stop here if it is time.

        Raises:
            Stopped: the time is over, or the user interrupted.
        """
        if self.interrupted is not None and self.interrupted.is_set():
            raise Stopped("interrupt")
        if self.elapsed >= self.limit:
            raise Stopped("time limit")


_deadline: ContextVar[Deadline | None] = ContextVar("deadline", default=None)
_interrupted: ContextVar[threading.Event | None] = ContextVar("interrupted", default=None)


def check_deadline() -> None:
    """Stop here if the work that this is a step of has to; called between steps of less than a second.

    Raises:
        Stopped: so it is.
    """
    deadline = _deadline.get()
    if deadline is not None:
        deadline.check()


def is_limited() -> bool:
    """Whether anything may stop the work that this is a step of."""
    return _deadline.get() is not None


@contextmanager
def limited(limit: float = math.inf, *, interruptible: bool = True, begin: float | None = None) -> Iterator[Deadline]:
    """A deadline for all work within the block, in the place of one that there was.

    Args:
        limit: seconds; infinite for none.
        interruptible: also stop at an interrupt, where :func:`stopped_by_interrupt` asks for that.
        begin: moment from which the seconds count, by :func:`time.monotonic`; None for now.

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
    """The result of a work that is of use only if it ends in so many seconds; None where it does not.

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
    """The first interrupt stops :func:`limited` work at its next step; a second one is a KeyboardInterrupt as usual.

    Only in the main thread of a process that does not ignore interrupts; elsewhere nothing changes.
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
