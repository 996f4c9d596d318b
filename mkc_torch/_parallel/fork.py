"""Work shared with forked copies of this process: they know all that it knows, and nothing has to be sent to them."""

from __future__ import annotations

import gc
import io
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from typing import Any, BinaryIO, TypeVar

import torch

from mkc_torch._parallel.processes import cores

__all__ = ["allow_copies", "meanwhile", "shared"]

T = TypeVar("T")

_copies = 0
_working: list[_Copy] = []
_BYTES = 4

_BEHIND = 5
"""Niceness of a copy that works meanwhile: against what is waited for it has a quarter of a core."""


def allow_copies(most: int | None = None) -> None:
    """Have work be shared by all cores from now on, or by so many copies beside this process.

    For a command of our own, in which torch computes in one thread from the beginning: its threads, and a GPU, do not
    survive a fork. Nothing is forked elsewhere than on Linux.
    """
    global _copies
    _copies = (cores() - 1 if most is None else most) if sys.platform == "linux" else 0


def shared(works: Sequence[Callable[[], T]], known: Iterable[object] = ()) -> list[T]:
    """The results of all works, in their order; who works at which makes no difference to any.

    Args:
        works: none needs what another one leaves behind. What a copy could not do, or not send, is done here.
        known: objects that results may hold and that copies need not send, as this process has them; the rest of a
            result can be pickled.

    Example:
        >>> shared([lambda: 2 + 2, lambda: 3 + 3])
        [4, 6]
    """
    if min(_copies, len(works) - 1) < 1:
        return [work() for work in works]
    with _todo(len(works)) as todo, _crew(works, todo, known) as crew:
        return _together(works, todo, crew, _foremost)


@contextmanager
def meanwhile(works: Sequence[Callable[[], T]], known: Iterable[object] = ()) -> Iterator[Callable[[], list[T]]]:
    """What a copy begins with while this process goes on, the last one first; ``known`` as of :func:`shared`.

    Gives a function for all results, which takes part in what nobody has begun, and waits for the rest; where there is
    no core to spare it does all of it. What is shared goes before: the copy takes what is left of the cores.
    """
    if _copies <= _at_work() or not works:
        yield lambda: [work() for work in works]
        return
    with _todo(len(works) - 1) as todo, _crew(works, todo, known) as crew:
        crew.fill(1, _at_work, [len(works) - 1])
        yield lambda: _together(works, todo, crew, _at_work)


def _together(works: Sequence[Callable[[], T]], todo: int, crew: _Crew, busy: Callable[[], int]) -> list[T]:
    done: dict[int, T] = {}
    for number in _taken(todo):
        # also a core that has become free since
        crew.fill(len(works) - len(done) - 1, busy)
        done[number] = works[number]()
    for copy in crew.copies:
        done |= copy.done()
    return [done[number] if number in done else work() for number, work in enumerate(works)]


def _at_work() -> int:
    """Copies that have a core."""
    return sum(copy.at_work for copy in _working)


def _foremost() -> int:
    """Those of them that leave it to nobody."""
    return sum(copy.at_work for copy in _working if not copy.behind)


@dataclass(frozen=True)
class _Copy:
    """A copy of this process, and where it writes what it has done in the end.

    One that is ``behind`` leaves its core to others.
    """

    process: int
    answer: BinaryIO
    known: dict[int, object]
    behind: bool

    @property
    def at_work(self) -> bool:
        return os.waitid(os.P_PID, self.process, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None

    def done(self) -> dict[int, Any]:
        """The results by the numbers of the works."""
        os.waitid(os.P_PID, self.process, os.WEXITED | os.WNOWAIT)
        self.answer.seek(0)
        try:
            sent: dict[int, bytes] = pickle.load(self.answer)
        except (EOFError, pickle.UnpicklingError):
            return {}
        return {number: _Receiver(io.BytesIO(result), self.known).load() for number, result in sent.items()}

    def end(self) -> None:
        self.answer.close()
        with suppress(ProcessLookupError):
            os.kill(self.process, signal.SIGKILL)
        os.waitpid(self.process, 0)


class _Sender(pickle.Pickler):
    """Pickles all but what both processes have at the same address; of a tensor its own numbers, not its storage."""

    def __init__(self, file: io.BytesIO, known: dict[int, object]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self.known = known

    def persistent_id(self, obj: object) -> int | None:
        return id(obj) if id(obj) in self.known else None

    def reducer_override(self, obj: object) -> Any:
        if type(obj) is torch.Tensor:
            return torch.from_numpy, (obj.detach().numpy(),)
        return NotImplemented


class _Receiver(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, known: dict[int, object]) -> None:
        super().__init__(file)
        self.known = known

    def persistent_load(self, pid: int) -> object:
        return self.known[pid]


@contextmanager
def _todo(count: int) -> Iterator[int]:
    """Where the numbers of works are taken from: whoever reads one has it."""
    todo, entry = os.pipe()
    # the last ones first: works are listed by how likely they are, and the fit of what does not fit takes longest
    os.write(entry, b"".join(number.to_bytes(_BYTES, "big") for number in reversed(range(count))))
    os.close(entry)
    try:
        yield todo
    finally:
        os.close(todo)


def _taken(todo: int) -> Iterator[int]:
    """Numbers that nobody else has taken, until there are none left."""
    while taken := os.read(todo, _BYTES):
        yield int.from_bytes(taken, "big")


@dataclass(frozen=True)
class _Crew:
    """Copies that take part."""

    works: Sequence[Callable[[], object]]
    todo: int
    known: dict[int, object]
    copies: list[_Copy]

    def fill(self, most: int, busy: Callable[[], int], first: Sequence[int] = ()) -> None:
        """Start copies on all cores but the busy ones; with works of their own to begin with, behind others."""
        with suppress(OSError):  # no memory for another process: those that there are do it
            while len(self.copies) < most and busy() < _copies:
                self.copies.append(_copy(self.works, self.todo, self.known, first))
                _working.append(self.copies[-1])


@contextmanager
def _crew(works: Sequence[Callable[[], object]], todo: int, known: Iterable[object]) -> Iterator[_Crew]:
    """Copies that are gone in the end."""
    crew = _Crew(works, todo, {id(one): one for one in known}, [])
    try:
        yield crew
    finally:
        for copy in crew.copies:
            _working.remove(copy)
            copy.end()


def _copy(works: Sequence[Callable[[], object]], todo: int, known: dict[int, object], first: Sequence[int]) -> _Copy:
    # a file, for a copy that waits until it is read would keep its core
    answer = os.fdopen(os.memfd_create("answer"), "w+b")
    parent = os.getpid()
    with warnings.catch_warnings():
        # that other threads may hold locks: those that there are, of progress bars and tables, do nothing that is used
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            process = os.fork()
        except OSError:
            answer.close()
            raise
    behind = len(first) > 0
    if process:
        return _Copy(process, answer, known, behind)
    try:
        if behind:
            os.nice(_BEHIND)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        warnings.simplefilter("ignore")  # another thread may have held the lock of where they are written
        allow_copies(0)
        _working.clear()
        gc.disable()
        done = {}
        for number in chain(first, _taken(todo)):
            if os.getppid() != parent:
                break
            with suppress(Exception):
                _Sender(result := io.BytesIO(), known).dump(works[number]())
                done[number] = result.getvalue()
        pickle.dump(done, answer)
        answer.flush()
    finally:
        os._exit(0)
