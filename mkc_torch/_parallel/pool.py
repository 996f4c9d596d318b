"""Parallel work in forked copies of this process, which share its memory and so need no arguments."""

from __future__ import annotations

import ctypes
import gc
import io
import math
import multiprocessing
import os
import pickle
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from typing import Any, TypeVar

import torch

from mkc_torch._parallel.deadline import check_deadline, is_limited
from mkc_torch._parallel.processes import cores
from mkc_torch._parallel.progress import count, counted, silently

T = TypeVar("T")

_PARENT_DEATH = 1
"""The constant PR_SET_PDEATHSIG of prctl.h."""

_BYTES = 4
"""Bytes of a task number in the pipe; a read of so few bytes is atomic."""

_CHECK_INTERVAL_S = 0.1
"""Seconds between two checks of the deadline while waiting for a copy."""

_WORTH_S = 0.05
"""Seconds that copies have to save.

A fork takes 0.02 s, and after it the system copies each page of memory that either process writes: about 5,000 pages,
0.03 to 0.1 s in each process.
"""

_copies = 0

_costs: dict[object, float] = {}
"""CPU seconds of a work by its function: a mean with more weight on the last works."""


def allow_copies(most: int | None = None) -> None:
    """Share work among all cores from now on, or among this process and ``most`` forked copies.

    Only for commands in which torch uses one thread from the start: torch's threads and a GPU do not survive a fork.
    Nothing is forked on systems other than Linux.
    """
    global _copies
    _costs.clear()
    _copies = (cores() - 1 if most is None else most) if sys.platform == "linux" else 0


def shared(works: Sequence[Callable[[], T]], known: Iterable[object] = (), thing: str = "") -> list[T]:
    """The results of all works, in order; they do not depend on which process does which work.

    Args:
        works: independent tasks. A task that fails in a copy, or whose result cannot be pickled, is done here.
        known: objects that results may refer to and that are not copied; the rest of a result must be picklable.
        thing: name of the subject of each work, for the progress counter; empty for no counter.

    Raises:
        Stopped: the deadline of the current work is over; all copies have been ended.

    Example:
        >>> shared([lambda: 2 + 2, lambda: 3 + 3])
        [4, 6]
    """
    check_deadline()
    if len(works) < 2:
        return [work() for work in works]
    parcels, total, left = Serializer(known), len(works), list(works)
    last: list[T] = []
    # the last works first, as in copies; of two works, trying one leaves nothing to share
    while _copies and len(left) > 2 and _seconds(left) == math.inf:
        count(thing, len(last), total)
        last.insert(0, _do(left.pop(), parcels, thing))
    copies = min(_copies, len(left) - 1)
    if copies and _seconds(left) * copies / (copies + 1) > _WORTH_S:
        return [*_shared_by_copies(left, copies, parcels, thing, total), *last]
    return [*(_do(work, parcels, thing) for work in counted(left, total, thing, len(last))), *last]


def _seconds(works: Sequence[Callable[[], object]]) -> float:
    """CPU seconds that works will take; infinite if the cost of a function is unknown."""
    return sum(_costs.get(_function_of(work), math.inf) for work in works)


def _function_of(work: Callable[[], object]) -> object:
    """What identifies the function of a work, without its arguments."""
    while isinstance(work, partial):
        work = work.func
    return getattr(work, "__code__", type(work))


class Serializer:
    """Pickles results: known objects by their number, tensors by their values without the rest of their storage.

    Unpacked tensors have the same memory layout in whichever process they were computed, so that later results are
    rounded alike.
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
        self._numbers = {id(item): number for number, item in enumerate(known)}

    def persistent_id(self, obj: object) -> int | None:
        return self._numbers.get(id(obj))

    def reducer_override(self, obj: object) -> Any:
        if type(obj) is torch.Tensor:
            return _tensor, (obj.detach().numpy(),)
        return NotImplemented


def _tensor(array: Any) -> torch.Tensor:
    # in memory that torch allocates: the rounding of its sums depends on the alignment
    return torch.from_numpy(array).clone()


class _Unpacker(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, known: list[object]) -> None:
        super().__init__(file)
        self._known = known

    def persistent_load(self, pid: int) -> object:
        return self._known[pid]


def _shared_by_copies(
    works: Sequence[Callable[[], T]], copies: int, parcels: Serializer, thing: str, total: int
) -> list[T]:
    """Do works in this process and in forked copies, which are all ended on return; ``total`` counts those before."""
    # the process that reads a number does that work
    todo, entry = os.pipe()
    # in reverse order: works are sorted by likelihood, and the fit of an unlikely candidate takes longest
    os.write(entry, b"".join(number.to_bytes(_BYTES, "big") for number in reversed(range(len(works)))))
    os.close(entry)
    before = set(multiprocessing.active_children())
    task = works, todo, parcels
    pool = ProcessPoolExecutor(copies, multiprocessing.get_context("fork"), _initialise_copy, task)
    try:
        return _results(works, parcels, todo, _fork_copies(pool, copies), thing, total)
    finally:
        with _uninterrupted():
            for child in set(multiprocessing.active_children()) - before:
                child.kill()
            pool.shutdown()
            os.close(todo)


def _fork_copies(pool: ProcessPoolExecutor, copies: int) -> list[Future[dict[int, bytes]]]:
    """The future results of each copy; empty where there is not enough memory for another process."""
    # copies inherit the blocked SIGINT: this process receives it, and ends them
    with suppress(OSError), _uninterrupted(), warnings.catch_warnings():
        # a fork with threads is deprecated; the threads of pools and progress bars hold no lock that a copy needs
        warnings.simplefilter("ignore", DeprecationWarning)
        return [pool.submit(_do_works) for _ in range(copies)]
    return []


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Delay an interrupt until the end of the block."""
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
    total: int,
) -> list[T]:
    done = {}
    for number in _take_numbers(todo):
        # all processes take the works in reverse order
        count(thing, total - 1 - number, total)
        done[number] = _do(works[number], parcels, thing)
    for copy in copies:
        _wait_for(copy)
        with suppress(BrokenProcessPool):
            done |= {number: parcels.unpacked(parcel) for number, parcel in copy.result().items()}
    # a work that failed in a copy raises its error here
    return [done[number] if number in done else _do(work, parcels) for number, work in enumerate(works)]


def _wait_for(copy: Future[dict[int, bytes]]) -> None:
    """Wait until a copy is done, or until the deadline."""
    while is_limited() and not wait([copy], _CHECK_INTERVAL_S).done:
        check_deadline()


def _take_numbers(todo: int) -> Iterator[int]:
    """Numbers of works that no other process has taken, until all are taken."""
    while number := os.read(todo, _BYTES):
        yield int.from_bytes(number, "big")


def _do(work: Callable[[], T], parcels: Serializer, thing: str = "") -> T:
    """The result of a work as if sent by a copy; a counted work does not count its own steps."""
    check_deadline()
    begin, function = time.process_time(), _function_of(work)
    with silently() if thing else nullcontext():
        result = work()
    seconds = time.process_time() - begin
    _costs[function] = 0.5 * (_costs.get(function, seconds) + seconds)
    try:
        return parcels.unpacked(parcels.packed(result))
    except Exception:  # it cannot be pickled
        return result


_task: tuple[Sequence[Callable[[], object]], int, Serializer] = ((), 0, Serializer())
"""In a copy: the works, the pipe of their numbers, and the serializer of results."""


def _initialise_copy(works: Sequence[Callable[[], object]], todo: int, parcels: Serializer) -> None:
    global _task
    _task = works, todo, parcels
    allow_copies(0)
    ctypes.CDLL(None).prctl(_PARENT_DEATH, signal.SIGKILL)
    warnings.simplefilter("ignore")  # another thread may have held the lock of their stream
    gc.disable()


def _do_works() -> dict[int, bytes]:
    works, todo, parcels = _task
    done = {}
    with silently():
        for number in _take_numbers(todo):
            with suppress(Exception):
                done[number] = parcels.packed(works[number]())
    return done
