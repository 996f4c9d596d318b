"""Work that the cores of this machine share, in a pool of copies of this process: they know all that it knows."""

from __future__ import annotations

import ctypes
import gc
import io
import multiprocessing
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, TypeVar

import torch

from mkc_torch._parallel.deadline import check_deadline, is_limited
from mkc_torch._parallel.processes import cores
from mkc_torch._parallel.progress import count, counted, silently

__all__ = ["Serializer", "allow_copies", "shared", "speculative"]

T = TypeVar("T")

_BEHIND = 5
"""Niceness of a copy that works meanwhile: against what is waited for it has a quarter of a core."""

_PARENT_DEATH = 1
"""PR_SET_PDEATHSIG of prctl.h."""

_BYTES = 4
"""Of the number of a work, which a pipe gives out whole."""

_ASKED_EVERY_S = 0.1
"""Seconds after which it is asked again whether to wait on for copies."""

_copies = 0
_ahead: list[Future[dict[int, bytes]]] = []


def allow_copies(most: int | None = None) -> None:
    """Have work be shared by all cores from now on, or by so many copies beside this process.

    For a command of our own, in which torch computes in one thread from the beginning: its threads, and a GPU, do not
    survive a fork. Nothing is forked elsewhere than on Linux.
    """
    global _copies
    _copies = (cores() - 1 if most is None else most) if sys.platform == "linux" else 0


def shared(works: Sequence[Callable[[], T]], known: Iterable[object] = (), thing: str = "") -> list[T]:
    """The results of all works, in their order; who works at which makes no difference to any.

    Args:
        works: none needs what another one leaves behind. What a copy could not do, or not send, is done here.
        known: objects that results may hold and that are not copied with them; the rest of a result can be pickled.
        thing: name of what each work is about, where progress counts them.

    Raises:
        Stopped: the deadline of what this is a part of is over; no copy is left.

    Example:
        >>> shared([lambda: 2 + 2, lambda: 3 + 3])
        [4, 6]
    """
    check_deadline()
    if len(works) < 2:
        return [work() for work in works]
    with _begun(works, min(_copies, len(works) - 1), known, thing=thing) as results:
        return results()


@contextmanager
def speculative(works: Sequence[Callable[[], T]], known: Iterable[object] = ()) -> Iterator[Callable[[], list[T]]]:
    """What copies begin with while this process goes on, the last one first; ``known`` as of :func:`shared`.

    Gives a function for all results, which takes part in what nobody has begun, and waits for the rest; where there is
    no core to spare it does all of it. What is shared goes before: the copies take what is left of the cores.
    """
    busy = sum(not copy.done() for copy in _ahead)
    with _begun(works, min(_copies - busy, len(works)), known, ahead=True) as results:
        yield results


class Serializer:
    """Results as bytes: with the numbers of objects that both sides know, and of a tensor what it shows.

    Whoever has worked at it, what is unpacked lies in memory alike, so that what follows rounds alike.
    """

    def __init__(self, known: Iterable[object] = ()) -> None:
        self._known = list(known)

    def packed(self, result: object) -> bytes:
        _Packer(file := io.BytesIO(), self._known).dump(result)
        return file.getvalue()

    def unpacked(self, parcel: bytes) -> Any:
        return _Unpacker(io.BytesIO(parcel), self._known).load()


class _Packer(pickle.Pickler):
    def __init__(self, file: io.BytesIO, known: list[object]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._numbers = {id(one): number for number, one in enumerate(known)}

    def persistent_id(self, obj: object) -> int | None:
        return self._numbers.get(id(obj))

    def reducer_override(self, obj: object) -> Any:
        if type(obj) is torch.Tensor:
            return _tensor, (obj.detach().numpy(),)
        return NotImplemented


def _tensor(array: Any) -> torch.Tensor:
    # in memory of torch's own, whose alignment its sums depend on
    return torch.from_numpy(array).clone()


class _Unpacker(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, known: list[object]) -> None:
        super().__init__(file)
        self._known = known

    def persistent_load(self, pid: int) -> object:
        return self._known[pid]


@contextmanager
def _begun(
    works: Sequence[Callable[[], T]], copies: int, known: Iterable[object], *, ahead: bool = False, thing: str = ""
) -> Iterator[Callable[[], list[T]]]:
    """Works that copies have begun with, as a function for all results; no copy is left in the end."""
    parcels = Serializer(known)
    if copies < 1:
        yield lambda: [_done(work, parcels, thing) for work in counted(works, len(works), thing)]
        return
    # whoever reads a number has that work
    todo, entry = os.pipe()
    # the last ones first: works are listed by how likely they are, and the fit of what does not fit takes longest
    os.write(entry, b"".join(number.to_bytes(_BYTES, "big") for number in reversed(range(len(works)))))
    os.close(entry)
    before = set(multiprocessing.active_children())
    task = works, todo, parcels, _BEHIND if ahead else 0
    pool = ProcessPoolExecutor(copies, multiprocessing.get_context("fork"), _begin, task)
    begun: list[Future[dict[int, bytes]]] = []
    try:
        begun += _forked(pool, copies)
        _ahead.extend(begun if ahead else ())
        yield lambda: _results(works, parcels, todo, begun, thing)
    finally:
        with _uninterrupted():
            _ahead[:] = [copy for copy in _ahead if copy not in begun]
            for child in set(multiprocessing.active_children()) - before:
                child.kill()
            pool.shutdown()
            os.close(todo)


def _forked(pool: ProcessPoolExecutor, copies: int) -> list[Future[dict[int, bytes]]]:
    """What copies will have done; nothing where there is no memory for another process."""
    # copies stay deaf to an interrupt: this process hears of it, and ends them
    with suppress(OSError), _uninterrupted(), warnings.catch_warnings():
        # a fork beside threads is deprecated; those of pools and progress bars hold nothing that a copy uses
        warnings.simplefilter("ignore", DeprecationWarning)
        return [pool.submit(_take_part) for _ in range(copies)]
    return []


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """An interrupt comes afterwards."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _results(
    works: Sequence[Callable[[], T]],
    parcels: Serializer,
    todo: int,
    copies: list[Future[dict[int, bytes]]],
    thing: str,
) -> list[T]:
    done = {}
    for number in _taken(todo):
        # the last ones are taken first, by whomever
        count(thing, len(works) - 1 - number, len(works))
        done[number] = _done(works[number], parcels, thing)
    for copy in copies:
        _waited_for(copy)
        with suppress(BrokenProcessPool):
            done |= {number: parcels.unpacked(parcel) for number, parcel in copy.result().items()}
    # what a copy could not do fails here as it would without copies
    return [done[number] if number in done else _done(work, parcels) for number, work in enumerate(works)]


def _waited_for(copy: Future[dict[int, bytes]]) -> None:
    """Wait until a copy is done, or until this process has to stop."""
    while is_limited() and not wait([copy], _ASKED_EVERY_S).done:
        check_deadline()


def _taken(todo: int) -> Iterator[int]:
    """Numbers that nobody else has taken, until there are none left."""
    while taken := os.read(todo, _BYTES):
        yield int.from_bytes(taken, "big")


def _done(work: Callable[[], T], parcels: Serializer, thing: str = "") -> T:
    """As a copy would send it; a work that is counted counts nothing itself."""
    check_deadline()
    with silently() if thing else nullcontext():
        result = work()
    try:
        return parcels.unpacked(parcels.packed(result))
    except Exception:  # what cannot be sent
        return result


_task: tuple[Sequence[Callable[[], object]], int, Serializer] = ((), 0, Serializer())
"""What a copy works at, where it takes a number from, and how it sends results."""


def _begin(works: Sequence[Callable[[], object]], todo: int, parcels: Serializer, niceness: int) -> None:
    global _task
    _task = works, todo, parcels
    allow_copies(0)
    _ahead.clear()
    ctypes.CDLL(None).prctl(_PARENT_DEATH, signal.SIGKILL)
    warnings.simplefilter("ignore")  # another thread may have held the lock of where they are written
    gc.disable()
    os.nice(niceness)


def _take_part() -> dict[int, bytes]:
    works, todo, parcels = _task
    done = {}
    with silently():
        for number in _taken(todo):
            with suppress(Exception):
                done[number] = parcels.packed(works[number]())
    return done
