"""Run diagnoses, each in its own process with a time limit, and count their CPU seconds."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from examples.concealed_physics import known
from mkc_torch.cli.diagnosis_request import Request

_PRELOADED = "mkc_torch.cli.diagnosis_files"
"""Imported once in the process that the others are forked from: no worker has to import torch."""


KNOWN = ("real", "cases", "strangers")
"""Parts of the gate whose recordings have right answers: functions of `examples.concealed_physics.known`."""


@dataclass(frozen=True)
class Job:
    """A recording to diagnose, with the options of ``mkc diagnose``."""

    name: str
    recording: Path
    request: Request


def gate_folder(output: Path, name: str) -> Path:
    """Return the folder of a recording's results."""
    return output / name.replace(" ", "_").replace("/", "_")


def known_answers(parts: Collection[str]) -> Iterator[known.Known]:
    """Yield the recordings of some parts of the gate, and print the names of absent files."""
    for part in KNOWN:
        recordings: Callable[[], Iterator[known.Known]] = getattr(known, part)
        for answer in recordings() if part in parts else ():
            absent = [str(file) for file in (answer.recording, answer.file) if not file.exists()]
            if absent:
                print(f"left out: {', '.join(absent)} is absent")
            else:
                yield answer


def known_jobs(parts: Collection[str], match: str, names: Collection[str]) -> list[Job]:
    """Return the jobs of recordings with these names, whose name contains a text."""
    answers = [answer for answer in known_answers(parts) if match in answer.name and answer.name in names]
    return [Job(answer.name, answer.recording, answer.request) for answer in answers]


def add_options(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add the options of a command on the results of a gate."""
    parser.add_argument("--gate", type=Path, required=True, help="output folder of the gate")
    parser.add_argument("--workers", type=int, default=2, help="parallel processes")
    parser.add_argument("--only", nargs="+", choices=KNOWN, default=KNOWN, help="parts of the gate")
    parser.add_argument("--match", default="", help="only recordings whose name contains this text")
    parser.add_argument("--limit", type=float, default=900.0, help="time limit of a recording in wall seconds")
    return parser


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
        folder = gate_folder(output, job.name)
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
