"""Shared by the proofs: processes, progress of stages, and diagnoses that may fail."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from mkc_torch._parallel.processes import keep_memory, one_thread

Diagnose = Callable[[list[Path], Path], object]
"""Writes ``<folder>/<stem>/diagnosis.json`` and ``model.json`` for each recording."""

Progress = Callable[[str, int, int], None]

BATCH = 4
"""Recordings in one call of the diagnosis."""

T = TypeVar("T")
R = TypeVar("R")


def diagnose_batch(diagnose: Diagnose, folder: Path, paths: list[Path]) -> None:
    """Diagnose recordings into a folder. A failed diagnosis writes a text file with the error."""
    try:
        diagnose(paths, folder)
    except Exception as error:
        # a missing diagnosis is scored as failed
        (folder / f"{paths[0].stem}.error.txt").write_text(f"{type(error).__name__}: {error}\n", encoding="utf-8")


def content_of(path: Path) -> dict[str, Any] | None:
    """Return the content of a JSON file; None if there is no such file.

    Example:
        >>> content_of(Path("nowhere.json"))
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


class Pool:
    """A pool of processes; a single worker runs in this process."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> Callable[[Callable[[T], R], Sequence[T]], Iterable[R]]:
        if self._workers <= 1:
            return map
        # torch's threads do not survive a fork
        context = multiprocessing.get_context("spawn")
        self._executor = ProcessPoolExecutor(self._workers, mp_context=context, initializer=_alone_on_its_core)
        return self._executor.map

    def __exit__(self, *_: object) -> None:
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)


def _alone_on_its_core() -> None:
    one_thread()
    keep_memory()


def every(
    run: Callable[[Callable[[T], R], Sequence[T]], Iterable[R]],
    job: Callable[[T], R],
    items: Sequence[T],
    report: Callable[[int, int], None],
) -> list[R]:
    """Return the results of a job for all items. ``report`` is called with the number done."""
    return list(_reported(run(job, items), len(items), report))


def _reported(results: Iterable[R], total: int, report: Callable[[int, int], None]) -> Iterator[R]:
    for done, result in enumerate(results, start=1):
        report(done, total)
        yield result


def silent(stage: str, done: int, total: int) -> None:
    """Ignore progress."""
