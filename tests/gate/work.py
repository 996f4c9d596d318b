"""Run diagnoses, each in its own process with a time limit, and count their CPU seconds."""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mkc_torch.cli.diagnosis_request import Request

_PRELOADED = "mkc_torch.cli.diagnosis_files"
"""Imported once in the process that the others are forked from: no worker has to import torch."""


@dataclass(frozen=True)
class Job:
    """A recording to diagnose, with the options of ``mkc diagnose``."""

    name: str
    recording: Path
    request: Request


def diagnosed(
    jobs: Sequence[Job], output: Path, *, workers: int, limit_s: float, task: Callable[[Job, Path], None] | None = None
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name and the row of each job as it is completed.

    Args:
        jobs: in the order in which they are started.
        output: parent of the folders of the recordings.
        workers: parallel processes.
        limit_s: wall seconds after which a diagnosis is killed and counts as failed.
        task: writes ``row.json`` into its folder argument; default :func:`diagnose_job`.
    """
    # Any: the base class of contexts has no Process in its type
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_PRELOADED])
    # read by the preloaded process: threads of OpenMP do not survive a fork
    os.environ["OMP_NUM_THREADS"] = "1"

    def diagnosed_row(job: Job) -> dict[str, Any]:
        folder = output / job.name.replace(" ", "_").replace("/", "_")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "row.json").unlink(missing_ok=True)
        started = time.perf_counter()
        process = context.Process(target=task or diagnose_job, args=(job, folder))
        process.start()
        process.join(limit_s)
        late = process.is_alive()
        if late:
            process.kill()
            process.join()
        return _row_of(folder, f"over the limit of {limit_s:g} s" if late else "", time.perf_counter() - started)

    with ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(diagnosed_row, job): job.name for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _row_of(folder: Path, failed: str, wall_seconds: float) -> dict[str, Any]:
    file = folder / "row.json"
    if file.is_file() and not failed:
        found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return found
    empty: dict[str, Any] = {"verdict": "", "p_value": None, "findings": [], "residual_before": {}}
    seconds = {"cpu_seconds": None, "wall_seconds": round(wall_seconds, 2)}
    return empty | {"residual_after": {}, "sentences": [], "failed": failed or "the process ended"} | seconds


def diagnose_job(job: Job, folder: Path) -> None:
    """Diagnose in this process; write ``row.json``, ``diagnosis.json`` and ``model.json``."""
    from examples.concealed_physics.row import write_row

    write_row(job.recording, job.request, folder)
