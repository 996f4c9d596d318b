"""Progress of long work: how many items of a stage are done, and what was found so far."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol, TypeVar, runtime_checkable

T = TypeVar("T")


@runtime_checkable
class Counter(Protocol):
    """A receiver of progress."""

    def count(self, thing: str, done: int, total: int) -> object:
        """Receive that ``done`` of ``total`` items are done; ``thing`` is the name of an item, such as "candidate"."""


@runtime_checkable
class BoundReceiver(Protocol):
    """A receiver of the largest number of items of a stage."""

    def bound(self, thing: str, done: int, most: int) -> object:
        """Receive that ``done`` items of at most ``most`` are done before the items that are counted next."""


@runtime_checkable
class FindingReceiver(Protocol):
    """A receiver of what was found so far."""

    def found(self, text: str) -> object:
        """Receive what was found so far, in words."""


_counter: ContextVar[object] = ContextVar("counter", default=None)


@contextmanager
def counting(counter: object) -> Iterator[None]:
    """Send the progress within the block to the methods that ``counter`` has, of the protocols of this module."""
    token = _counter.set(counter)
    try:
        yield
    finally:
        _counter.reset(token)


@contextmanager
def silently() -> Iterator[None]:
    """Discard the counts within the block, which is a part of a counted item."""
    with counting(None):
        yield


def count(thing: str, done: int, total: int) -> None:
    """Report that ``done`` of ``total`` items are done, unless ``thing`` is empty or there is only one item."""
    counter = _counter.get()
    if isinstance(counter, Counter) and thing and total > 1:
        counter.count(thing, done, total)


def report_bound(thing: str, done: int, most: int) -> None:
    """Report that ``done`` items of at most ``most`` are done before the items that are counted next."""
    receiver = _counter.get()
    if isinstance(receiver, BoundReceiver):
        receiver.bound(thing, done, most)


def report_found(text: str) -> None:
    """Report what was found so far, in words."""
    receiver = _counter.get()
    if isinstance(receiver, FindingReceiver):
        receiver.found(text)


def counted(things: Iterable[T], total: int, thing: str, done: int = 0) -> Iterator[T]:
    """Iterate over the things; each is counted as done when the next is requested. ``done`` were done before.

    Example:
        >>> class Printer:
        ...     def count(self, thing, done, total):
        ...         print(f"{thing}: {done} of {total}")
        >>> with counting(Printer()):
        ...     list(counted("ab", 2, "letter"))
        letter: 0 of 2
        letter: 1 of 2
        letter: 2 of 2
        ['a', 'b']
    """
    for item in things:
        count(thing, done, total)
        yield item
        done += 1
    count(thing, done, total)
