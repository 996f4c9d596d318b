"""How far long work is: its stage, and how many of the things that a stage is made of are done."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol, TypeVar, runtime_checkable

__all__ = ["Counter", "count", "counted", "counting", "silently"]

T = TypeVar("T")


@runtime_checkable
class Counter(Protocol):
    """What is told of the things that a stage is made of."""

    def count(self, thing: str, done: int, total: int) -> object:
        """So many of so many are done; ``thing`` is the name of one, such as "candidate"."""


_counter: ContextVar[Counter | None] = ContextVar("counter", default=None)


@contextmanager
def counting(counter: object) -> Iterator[None]:
    """What is counted within the block is told to ``counter``, where it is a :class:`Counter`; to nobody otherwise."""
    token = _counter.set(counter if isinstance(counter, Counter) else None)
    try:
        yield
    finally:
        _counter.reset(token)


@contextmanager
def silently() -> Iterator[None]:
    """Nothing is counted within the block: it is a part of something that is."""
    with counting(None):
        yield


def count(thing: str, done: int, total: int) -> None:
    """So many of so many are done; nothing is told of a ``thing`` without a name, or of a single one."""
    counter = _counter.get()
    if counter is not None and thing and total > 1:
        counter.count(thing, done, total)


def counted(things: Iterable[T], total: int, thing: str) -> Iterator[T]:
    """The things, each counted as done when the next one is asked for.

    Example:
        >>> class Told:
        ...     def count(self, thing, done, total):
        ...         print(f"{thing}: {done} of {total}")
        >>> with counting(Told()):
        ...     list(counted("ab", 2, "letter"))
        letter: 0 of 2
        letter: 1 of 2
        letter: 2 of 2
        ['a', 'b']
    """
    done = 0
    for one in things:
        count(thing, done, total)
        yield one
        done += 1
    count(thing, done, total)
