"""Work on several files in parallel: one process a core, without tracebacks at an interrupt."""

from __future__ import annotations

import atexit
import ctypes
import gc
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")


def cores() -> int:
    """The number of cores that this process may use.

    Example:
        >>> cores() >= 1
        True
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def one_thread() -> None:
    """Limit torch and the linear algebra of NumPy to one thread in this process.

    The problems of a recording are too small for several threads: a second thread makes a diagnosis a sixth slower.
    """
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1, user_api="blas")


def keep_memory() -> None:
    """Let glibc keep freed memory instead of returning it to the system.

    By default glibc returns the memory of each large tensor at once, and the system clears its pages before the next
    use, which takes 1 to 7 % of the CPU time of a diagnosis. With other C libraries this does nothing.
    """
    with suppress(OSError, AttributeError, TypeError):
        library = ctypes.CDLL(None)
        for parameter, value in _KEPT:
            library.mallopt(parameter, value)


# M_MMAP_THRESHOLD, M_TRIM_THRESHOLD and M_TOP_PAD of malloc.h
_KEPT = ((-3, 1 << 28), (-1, 1 << 30), (-2, 1 << 26))


def keep_modules() -> None:
    """Exclude imported modules from garbage collection, also at exit; for commands of this package.

    The collector would otherwise scan all objects of torch several times: 0.5 s of CPU, a quarter of a short command.
    """
    gc.freeze()
    gc.set_threshold(50_000)
    atexit.register(_at_exit)


def _at_exit() -> None:
    """Skip the last collection, unless triton is loaded: it reports every object that is kept as a leak."""
    if "triton" in sys.modules:
        gc.unfreeze()
    else:
        gc.freeze()


@contextmanager
def in_processes(
    work: Callable[[T], R], items: Sequence[T], workers: int | None = None
) -> Iterator[Iterator[Callable[[], R]]]:
    """Start ``work`` on all items; yield for each item, in order, a function that waits for its result.

    A single item, and all items of a single worker, are processed in this process. ``workers`` is the largest number of
    processes, by default one a core. If a process dies, the items that it and the others were working on are processed
    once more. The function raises the error of ``work``, or :class:`BrokenProcessPool` if the process of the item died
    twice.
    """
    workers = min(len(items), cores() if workers is None else workers)
    if workers < 2:
        yield (lambda item=item: work(item) for item in items)  # type: ignore[misc]
        return
    before = set(multiprocessing.active_children())
    # without a lock: an interrupt between its acquisition and its release would block all processes
    stop = _CONTEXT.RawValue(ctypes.c_bool, False)
    with ExitStack() as pools:
        pool = _Pool(work, items, workers, partial(_new_pool, pools, stop))
        try:
            pool.submit(0)
            yield (partial(pool.result, number) for number in range(len(items)))
        except BaseException:
            stop.value = True  # a started item cannot be cancelled
            for child in set(multiprocessing.active_children()) - before:
                with suppress(ProcessLookupError, TypeError):
                    os.kill(child.pid, signal.SIGINT)  # type: ignore[arg-type]
            for future in pool.futures:
                future.cancel()
            raise


# torch's threads do not survive a fork
_CONTEXT = multiprocessing.get_context("spawn")


def _new_pool(pools: ExitStack, stop: Any, workers: int) -> ProcessPoolExecutor:
    return pools.enter_context(ProcessPoolExecutor(workers, mp_context=_CONTEXT, initializer=_start, initargs=(stop,)))


class _Pool(Generic[T, R]):
    """Items in processes, which are replaced if one of them dies."""

    def __init__(
        self, work: Callable[[T], R], items: Sequence[T], workers: int, start: Callable[[int], ProcessPoolExecutor]
    ) -> None:
        self._work, self._items, self._workers, self._start = work, items, workers, start
        self.futures: list[Future[R]] = []

    def submit(self, first: int) -> None:
        """Submit all items from a number on that have no result."""
        with _not_interrupted():  # new processes inherit it, and print no traceback at an interrupt
            pool, known = self._start(self._workers), self.futures[first:]
            kept = [future if _has_ended(future) else None for future in known] or [None] * len(self._items)
            self.futures[first:] = [
                pool.submit(_interruptible, self._work, item) if future is None else future
                for item, future in zip(self._items[first:], kept, strict=True)
            ]

    def result(self, number: int) -> R:
        """Wait for the result of an item."""
        with suppress(BrokenProcessPool):
            return self.futures[number].result()
        # whose process died is not known: this item is processed again alone, then the others in new processes
        with _not_interrupted():
            again = self._start(1).submit(_interruptible, self._work, self._items[number])
        try:
            return again.result()
        finally:
            if again.done() and number + 1 < len(self._items):
                self.submit(number + 1)


def _has_ended(future: Future[Any]) -> bool:
    """Whether an item has a result or an error of its own."""
    return future.done() and not future.cancelled() and not isinstance(future.exception(), BrokenProcessPool)


class _Stop(Protocol):
    """A flag in shared memory: whether to stop."""

    value: bool


_stop: _Stop | None = None


def _start(stop: _Stop) -> None:
    global _stop
    _stop = stop
    keep_memory()
    keep_modules()
    one_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _stopped() -> bool:
    return _stop is not None and _stop.value


def _interruptible(work: Callable[[T], R], item: T) -> R:
    """Run ``work`` with the default handler of interrupts, so that it removes its half-written files."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        if _stopped():
            raise KeyboardInterrupt
        return work(item)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _not_interrupted() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    known = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, known)
