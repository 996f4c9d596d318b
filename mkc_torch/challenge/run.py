"""Run the proof: draw, seal the key, diagnose, open the key, score."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.challenge.draws import generator
from mkc_torch.challenge.key import Key, canonical, digest
from mkc_torch.challenge.magnetometer.subject import magnetometer
from mkc_torch.challenge.page import challenge_page, summary
from mkc_torch.challenge.pool import BATCH, Diagnose, Pool, Progress, content_of, diagnose_batch, every, silent
from mkc_torch.challenge.score import Score, score
from mkc_torch.challenge.subject import Subject
from mkc_torch.recording.recording import Recording, write_table

Apply = Callable[[Path, Path], Mapping[str, Tensor]]
"""Returns the corrected columns, row by row, given ``model.json`` and a recording."""

SEED = 1

SIMULATIONS = "simulations.py"
"""File of the nominal simulations in the proof's folder."""


@dataclass(frozen=True)
class _Work:
    """The task of a worker; it does not contain the key."""

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
    """Draw recordings, diagnose them, and then compare the diagnoses with the keys.

    Into ``output`` go ``recordings/`` and ``second/`` (CSV), ``key_hash.txt`` before the first diagnosis,
    ``diagnoses/``, then ``key.json``, ``score.json``, ``challenge.html`` and ``summary.md``; for
    differential equations also ``simulations.py``, the simulations that a user would have written.

    Args:
        diagnose: diagnoses recordings as a user would. A recording without a written diagnosis counts as failed. With
            several workers, ``diagnose`` and ``apply`` have to be picklable.
        apply: corrects a second recording.
        subject: family of recordings; default: the magnetometer.
        cases: recordings with hidden physics; default: that of the subject.
        empty: recordings without hidden physics; default: in the proportion of the subject.
        seed: seed of all draws.
        output: a folder that is empty or does not exist.
        workers: number of processes.
        overwrite: accept a folder with files in it.
        progress: called with the stage, the number done and the total.
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
    report = progress or silent
    addresses = list(enumerate(_which_are_empty(seed, cases, empty)))
    with Pool(workers) as pool:
        keys = every(pool, partial(_write_case, work), addresses, partial(report, "draw"))
        text = canonical(keys)
        write_atomically(output / "key_hash.txt", f"{digest(text)}\n", overwrite=overwrite)
        paths = [output / "recordings" / f"{key.name}.csv" for key in keys]
        batches = [paths[k : k + BATCH] for k in range(0, len(paths), BATCH)]
        every(pool, partial(diagnose_batch, diagnose, output / "diagnoses"), batches, partial(report, "diagnose"))
        write_atomically(output / "key.json", f"{text}\n", overwrite=overwrite)
        hidden = [key for key in keys if key.kind != "empty"]
        ratios = every(pool, partial(_second_ratio, apply, work), hidden, partial(report, "second recordings"))
        baseline_results = {
            name: every(pool, competitor, paths, partial(report, "baseline"))
            for name, competitor in subject.baselines.items()
        }
    names = [key.name for key in keys]
    diagnoses = {name: content_of(output / "diagnoses" / name / "diagnosis.json") for name in names}
    found = {key.name: ratio for key, ratio in zip(hidden, ratios, strict=True)}
    result = score(keys, diagnoses, found, subject.thresholds)
    baselines = {
        name: score(keys, dict(zip(names, results, strict=True)), thresholds=subject.thresholds)
        for name, results in baseline_results.items()
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
