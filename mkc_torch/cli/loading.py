"""When what computes is loaded: not before a command's options are understood, for torch takes seconds to import."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["loading", "when_loaded"]

_then: list[Callable[[], None]] = []


def when_loaded(then: Callable[[], None]) -> None:
    """Have ``then`` be called once, when the command of this process has loaded what it needs."""
    _then.append(then)


@contextmanager
def loading() -> Iterator[None]:
    """To be entered once a command, around the imports that bring torch in, before anything is opened or written."""
    yield
    while _then:
        _then.pop()()
