"""Independent work shared with forked copies of this process: they know all it knows, and nothing is sent to them."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import BinaryIO, TypeVar

from mkc_torch._processes import cores

__all__ = ["allow_copies", "shared"]

T = TypeVar("T")

_copies = 0
_BYTES = 4


def allow_copies(most: int | None = None) -> None:
    """Have :func:`shared` use all cores from now on, or so many copies beside this process.

    For a command of our own, in which torch computes in one thread from the beginning: its threads, and a GPU, do not
    survive a fork. Nothing is forked elsewhere than on Linux.
    """
    global _copies
    _copies = (cores() - 1 if most is None else most) if sys.platform == "linux" else 0


def shared(works: Sequence[Callable[[], T]]) -> list[T]:
    """The results of all works, in their order; who works at which makes no difference to any.

    Args:
        works: none needs what another one leaves behind, and the results can be pickled. What a copy could not do, or
            not send, is done here.

    Example:
        >>> shared([lambda: 2 + 2, lambda: 3 + 3])
        [4, 6]
    """
    copies = min(_copies, len(works) - 1)
    if copies < 1:
        return [work() for work in works]
    todo, entry = os.pipe()
    os.write(entry, b"".join(number.to_bytes(_BYTES, "big") for number in range(len(works))))
    os.close(entry)
    started: list[tuple[int, BinaryIO]] = []
    try:
        started.extend(_copy(works, todo) for _ in range(copies))
        done = {number: works[number]() for number in _taken(todo)}
        for _, answer in started:
            with suppress(EOFError, pickle.UnpicklingError):
                done |= {number: pickle.loads(result) for number, result in pickle.load(answer).items()}
    finally:
        os.close(todo)
        for process, answer in started:
            answer.close()
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
    return [done[number] if number in done else work() for number, work in enumerate(works)]


def _taken(todo: int) -> Iterator[int]:
    """Numbers that nobody else has taken, until there are none left."""
    while taken := os.read(todo, _BYTES):
        yield int.from_bytes(taken, "big")


def _copy(works: Sequence[Callable[[], object]], todo: int) -> tuple[int, BinaryIO]:
    """A copy of this process that takes part: its number, and where it writes what it has done in the end."""
    answer, entry = os.pipe()
    parent = os.getpid()
    with warnings.catch_warnings():
        # that other threads may hold locks: those that there are, of the progress and of tables, are not used here
        warnings.simplefilter("ignore", DeprecationWarning)
        process = os.fork()
    if process:
        os.close(entry)
        return process, os.fdopen(answer, "rb")
    try:
        os.close(answer)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        allow_copies(0)
        gc.disable()
        done = {}
        for number in _taken(todo):
            if os.getppid() != parent:
                break
            with suppress(Exception):
                done[number] = pickle.dumps(works[number]())
        with os.fdopen(entry, "wb") as file:
            pickle.dump(done, file)
    finally:
        os._exit(0)
