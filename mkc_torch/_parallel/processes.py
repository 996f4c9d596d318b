"""Work on several files at once: one process a core, quiet when interrupted."""

from __future__ import annotations

import atexit
import ctypes
import gc
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from typing import Protocol, TypeVar

import torch

__all__ = ["cores", "in_processes", "keep_memory", "keep_modules", "one_thread"]

T = TypeVar("T")
R = TypeVar("R")


def cores() -> int:
    """Cores that this process may use.

    Example:
        >>> cores() >= 1
        True
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def one_thread() -> None:
    """Have torch, and the linear algebra of NumPy, compute in one thread in this process.

    What a recording asks for is too small to share: with a second one, a diagnosis takes a sixth longer.
    """
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1, user_api="blas")


def keep_memory() -> None:
    """Have the C library keep the memory of tensors that are gone, where it is glibc.

    It gives that of each large tensor back to the system at once, which clears its pages for the next one: 1 to 7 % of
    the CPU time of a diagnosis.
    """
    with suppress(OSError, AttributeError, TypeError):
        library = ctypes.CDLL(None)
        for parameter, value in _KEPT:
            library.mallopt(parameter, value)


# M_MMAP_THRESHOLD, M_TRIM_THRESHOLD and M_TOP_PAD of malloc.h
_KEPT = ((-3, 1 << 28), (-1, 1 << 30), (-2, 1 << 26))


def keep_modules() -> None:
    """Have the collector of a process that is ours pass over what has been imported, also when the process ends.

    It would look at all of torch's objects several times over, which takes 0.5 s of CPU: a quarter of a short command.
    """
    gc.freeze()
    gc.set_threshold(50_000)
    atexit.register(gc.freeze)


@contextmanager
def in_processes(work: Callable[[T], R], items: Sequence[T]) -> Iterator[Iterator[Callable[[], R]]]:
    """For each item, in order, a function that waits for its result.

    A single item is worked on in this process. A function raises what ``work`` raised, and :class:`BrokenProcessPool`
    for an item whose process died.
    """
    workers = min(len(items), cores())
    if workers < 2:
        yield (lambda item=item: work(item) for item in items)  # type: ignore[misc]
        return
    before = set(multiprocessing.active_children())
    # spawned, for torch's threads do not survive a fork
    context = multiprocessing.get_context("spawn")
    # without a lock: an interrupt can come between its taking and its giving back, and all would wait for it for ever
    stop = context.RawValue(ctypes.c_bool, False)
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start, initargs=(stop,)) as pool:
        try:
            with _not_interrupted():  # processes that start inherit it, and say nothing when they are interrupted
                futures: list[Future[R]] = [pool.submit(_interruptible, work, item) for item in items]
            yield (future.result for future in futures)
        except BaseException:
            stop.value = True  # an item that a process has taken already cannot be cancelled
            for child in set(multiprocessing.active_children()) - before:
                with suppress(ProcessLookupError, TypeError):
                    os.kill(child.pid, signal.SIGINT)  # type: ignore[arg-type]
            pool.shutdown(cancel_futures=True)
            raise


class _Stop(Protocol):
    """Whether to stop, as all processes know it."""

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
    """Work that an interrupt ends as it would here: what is half-written is cleared away."""
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
