"""The proof from end to end: draw, seal, diagnose, open the key, score."""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from mkc_torch._parallel.processes import keep_memory, one_thread
from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.challenge.draws import generator
from mkc_torch.challenge.key import Key, canonical, digest
from mkc_torch.challenge.magnetometer.subject import magnetometer
from mkc_torch.challenge.page import challenge_page, summary
from mkc_torch.challenge.score import Score, score
from mkc_torch.challenge.subject import Subject
from mkc_torch.recording.recording import Recording, write_table

Diagnose = Callable[[list[Path], Path], object]
"""Writes ``<folder>/<stem>/diagnosis.json`` and ``model.json`` for each recording."""

Apply = Callable[[Path, Path], Mapping[str, Tensor]]
"""From ``model.json`` and a recording the corrected columns, a row for a row."""

Progress = Callable[[str, int, int], None]

SEED = 1

SIMULATIONS = "simulations.py"
"""Name of the file with the simulations in the proof's folder."""

_BATCH = 4
"""Recordings in one call of the diagnosis."""

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class _Work:
    """What a worker needs to know; it has no key in it."""

    subject: Subject
    seed: int
    output: Path


def run_challenge(
    diagnose: Diagnose,
    apply: Apply,
    *,
    subject: Subject | None = None,
    cases: int | None = None,
    empty: int | None = None,
    seed: int = SEED,
    output: Path,
    workers: int = 1,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Score:
    """Draw recordings, have them diagnosed, and only then compare with what was hidden.

    Into ``output`` go ``recordings/`` and ``second/`` (CSV), ``key_hash.txt`` before the first diagnosis,
    ``diagnoses/``, then ``key.json``, ``score.json``, ``challenge.html`` and ``summary.md``; of differential equations
    also ``simulations.py`` beside the recordings, what a user would have written.

    Args:
        diagnose: as a user would run it. A recording for which it writes nothing, or raises, counts as failed. With
            more than one worker it has to be picklable, and so has ``apply``.
        apply: corrects a second recording.
        subject: what the proof is about; default the magnetometer.
        cases: recordings with something hidden; default the subject's own number.
        empty: recordings with nothing hidden; default in the subject's own proportion to the cases.
        seed: of everything that is drawn.
        output: a folder that is empty or does not exist.
        workers: processes.
        overwrite: accept a folder with files in it.
        progress: called with a stage, how many are done, and of how many.
    """
    subject = magnetometer() if subject is None else subject
    cases = subject.cases if cases is None else cases
    empty = round(cases * subject.empty / subject.cases) if empty is None else empty
    started = time.perf_counter()
    output = claim_folder(output, overwrite=overwrite)
    for name in ("recordings", "second", "diagnoses"):
        claim_folder(output / name, overwrite=overwrite)
    if subject.simulations is not None:
        source = subject.simulations.read_text(encoding="utf-8")
        write_atomically(output / SIMULATIONS, source, overwrite=overwrite)
    work = _Work(subject, seed, output)
    tell = progress or _silent
    addresses = list(enumerate(_which_are_empty(seed, cases, empty)))
    with _Pool(workers) as pool:
        keys = _all(pool, partial(_write_case, work), addresses, partial(tell, "draw"))
        text = canonical(keys)
        write_atomically(output / "key_hash.txt", f"{digest(text)}\n", overwrite=overwrite)
        paths = [output / "recordings" / f"{key.name}.csv" for key in keys]
        batches = [paths[k : k + _BATCH] for k in range(0, len(paths), _BATCH)]
        _all(pool, partial(_diagnose_batch, diagnose, output / "diagnoses"), batches, partial(tell, "diagnose"))
        write_atomically(output / "key.json", f"{text}\n", overwrite=overwrite)
        hidden = [key for key in keys if key.kind != "empty"]
        ratios = _all(pool, partial(_second_ratio, apply, work), hidden, partial(tell, "second recordings"))
        naive = {
            name: _all(pool, competitor, paths, partial(tell, "baseline"))
            for name, competitor in subject.baselines.items()
        }
    names = [key.name for key in keys]
    diagnoses = {name: _read(output / "diagnoses" / name / "diagnosis.json") for name in names}
    found = {key.name: ratio for key, ratio in zip(hidden, ratios, strict=True)}
    result = score(keys, diagnoses, found, subject.thresholds)
    baselines = {
        name: score(keys, dict(zip(names, told, strict=True)), thresholds=subject.thresholds)
        for name, told in naive.items()
    }
    settings = {
        "family": subject.name,
        "seed": seed,
        "hidden": cases,
        "empty": empty,
        **subject.settings,
        "workers": workers,
        "key_sha256": digest(text),
        "seconds": round(time.perf_counter() - started, 1),
    }
    record = {"settings": settings, "score": result.numbers()} | {name: b.numbers() for name, b in baselines.items()}
    write_atomically(output / "score.json", json.dumps(record, indent=1, allow_nan=False), overwrite=overwrite)
    write_atomically(output / "challenge.html", challenge_page(result, baselines, keys, settings), overwrite=overwrite)
    write_atomically(output / "summary.md", summary(result, baselines, settings), overwrite=overwrite)
    return result


def _which_are_empty(seed: int, cases: int, empty: int) -> list[bool]:
    order = torch.randperm(cases + empty, generator=generator(seed, "order")).tolist()
    return [k >= cases for k in order]


def _write_case(work: _Work, address: tuple[int, bool]) -> Key:
    index, empty = address
    case = work.subject.draw(work.seed, index, empty)
    name = case.key.name
    write_table(work.output / "recordings" / f"{name}.csv", case.recording.columns, overwrite=True)
    if case.second is not None:
        write_table(work.output / "second" / f"{name}.csv", case.second.columns, overwrite=True)
    return case.key


def _diagnose_batch(diagnose: Diagnose, folder: Path, paths: list[Path]) -> None:
    try:
        diagnose(paths, folder)
    except Exception as error:
        # what is missing afterwards is scored as failed
        (folder / f"{paths[0].stem}.error.txt").write_text(f"{type(error).__name__}: {error}\n", encoding="utf-8")


def _second_ratio(apply: Apply, work: _Work, key: Key) -> float:
    model = work.output / "diagnoses" / key.name / "model.json"
    if not model.is_file():
        return math.inf
    try:
        path = work.output / "second" / f"{key.name}.csv"
        return work.subject.ratio(apply(model, path), Recording.read(path), key)
    except Exception as error:
        (model.parent / "apply.error.txt").write_text(f"{type(error).__name__}: {error}\n", encoding="utf-8")
        return math.inf


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


class _Pool:
    """Processes, or for one worker none."""

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


def _all(
    run: Callable[[Callable[[T], R], Sequence[T]], Iterable[R]],
    job: Callable[[T], R],
    items: Sequence[T],
    tell: Callable[[int, int], None],
) -> list[R]:
    return list(_told(run(job, items), len(items), tell))


def _told(results: Iterable[R], total: int, tell: Callable[[int, int], None]) -> Iterator[R]:
    for done, result in enumerate(results, start=1):
        tell(done, total)
        yield result


def _silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""
