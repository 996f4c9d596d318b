"""Import torch only after a command's options are checked, because the import takes seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

_callbacks: list[Callable[[], None]] = []


def when_loaded(callback: Callable[[], None]) -> None:
    """Register a function that is called once, when the command of this process has imported its modules."""
    _callbacks.append(callback)


@contextmanager
def loading() -> Iterator[None]:
    """Wrap the imports of a command. Enter it once, before any file is opened or written."""
    yield
    while _callbacks:
        _callbacks.pop()()
