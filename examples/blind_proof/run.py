"""Run a proof: draw, seal the key, diagnose, open the key, score."""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from examples.blind_proof.key import Key, canonical, digest
from examples.blind_proof.page import proof_page, summary
from examples.blind_proof.proof import Address, Case, Proof, Ratio
from examples.blind_proof.score import ProofScore, Score, score_proof
from mkc_torch._parallel.processes import keep_memory, one_thread
from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.recording.recording import Recording, write_table

Diagnose = Callable[[list[Path], Path], object]
"""Writes ``<folder>/<stem>/diagnosis.json`` and ``model.json`` for each recording."""

Apply = Callable[[Path, Path], Mapping[str, Tensor]]
"""Returns the corrected columns, row by row, given ``model.json`` and a recording."""

Progress = Callable[[str, int, int], None]

SEED = 1

BATCH = 4
"""Recordings in one call of the diagnosis."""

SIMULATIONS = "simulations"
"""Folder of the simulation files, in the folder of the results."""

T = TypeVar("T")
R = TypeVar("R")


def run_proof(
    proof: Proof,
    diagnose: Diagnose,
    apply: Apply,
    *,
    cases: int | None = None,
    empty: int | None = None,
    seed: int = SEED,
    output: Path,
    workers: int = 1,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ProofScore:
    """Draw recordings, diagnose them, and then compare the diagnoses with the keys.

    Into ``output`` go ``recordings/``, ``second/`` and ``simulations/``, ``key_hash.txt`` before the first diagnosis,
    ``diagnoses/``, then ``key.json``, ``score.json``, ``proof.html`` and ``summary.md``. A case depends only on the
    seed and its address, so that a larger run of scenarios contains a smaller one.

    Args:
        proof: the kind of proof.
        diagnose: diagnoses recordings as a user would. A recording without a written diagnosis counts as failed. With
            several workers, ``diagnose`` and ``apply`` have to be picklable.
        apply: corrects a second recording.
        cases: recordings with hidden physics, in each scenario; default: in proportion to those without.
        empty: recordings without hidden physics, in each scenario; default: set by the proof.
        seed: seed of all draws.
        output: a folder that is empty or does not exist.
        workers: number of processes.
        overwrite: accept a folder with files in it.
        progress: called with the stage, the number done and the total.

    Raises:
        ValueError: no recordings.
    """
    addresses = proof.addresses(seed, cases, empty)
    if not addresses:
        raise ValueError("--cases and --empty are both 0; at least one recording is needed.")
    started = time.perf_counter()
    output = claim_folder(output, overwrite=overwrite)
    for name in ("recordings", "second", SIMULATIONS, "diagnoses"):
        claim_folder(output / name, overwrite=overwrite)
    report = progress or (lambda *_: None)
    with Pool(workers) as pool:
        keys = every(pool, partial(_draw, seed, output), addresses, partial(report, "draw"))
        text = canonical(keys)
        write_atomically(output / "key_hash.txt", f"{digest(text)}\n", overwrite=overwrite)
        paths = [output / "recordings" / f"{key.name}.csv" for key in keys]
        batches = [paths[k : k + BATCH] for k in range(0, len(paths), BATCH)]
        every(pool, partial(diagnose_batch, diagnose, output / "diagnoses"), batches, partial(report, "diagnose"))
        write_atomically(output / "key.json", f"{text}\n", overwrite=overwrite)
        seconds = [key for key in keys if (output / "second" / f"{key.name}.csv").is_file()]
        job = partial(_second_ratio, apply, proof.ratio, output)
        ratios = every(pool, job, seconds, partial(report, "second recordings"))
        answers = {
            name: every(pool, method, paths, partial(report, "baseline")) for name, method in proof.baselines.items()
        }
    names = [key.name for key in keys]
    diagnoses = {name: content_of(output / "diagnoses" / name / "diagnosis.json") for name in names}
    found = {key.name: ratio for key, ratio in zip(seconds, ratios, strict=True)}
    result = score_proof(proof, keys, diagnoses, found)
    baselines = {
        name: score_proof(proof, keys, dict(zip(names, own, strict=True))).total for name, own in answers.items()
    }
    settings = {
        "proof": proof.name,
        "scenarios": ", ".join(scenario.name for scenario in proof.scenarios),
        "seed": seed,
        "hidden": _numbers(hidden for _, hidden, _ in proof.sizes(cases, empty)),
        "empty": _numbers(without for _, _, without in proof.sizes(cases, empty)),
        **proof.settings,
        "workers": workers,
        "key_sha256": digest(text),
        "seconds": round(time.perf_counter() - started, 1),
    }
    _write(output, result, baselines, settings, overwrite=overwrite)
    return result


def _write(
    output: Path, result: ProofScore, baselines: Mapping[str, Score], settings: Mapping[str, Any], *, overwrite: bool
) -> None:
    record = {
        "settings": settings,
        **result.numbers(),
        "baselines": {name: baseline.numbers() for name, baseline in baselines.items()},
        "failed": {name: _why(output / "diagnoses" / f"{name}.error.txt") for name in result.failed},
    }
    write_atomically(output / "score.json", json.dumps(record, indent=1, allow_nan=False), overwrite=overwrite)
    write_atomically(output / "proof.html", proof_page(result, baselines, settings), overwrite=overwrite)
    write_atomically(output / "summary.md", summary(result, baselines, settings), overwrite=overwrite)


def _numbers(values: Iterable[int]) -> int | str:
    """Return the number of recordings in a scenario; "20 or 60" if scenarios differ."""
    found = sorted({*values} - {0} or {0})
    return found[0] if len(found) == 1 else " or ".join(map(str, found))


def _why(path: Path) -> str:
    """Return the message of a failed diagnosis, "" without a message."""
    return path.read_text(encoding="utf-8").strip() if path.is_file() else ""


def _draw(seed: int, output: Path, address: Address) -> Key:
    case = address.scenario.draw(seed, address.index, address.hidden, address.number)
    write_case(output, case)
    return case.key


def write_case(output: Path, case: Case) -> None:
    """Write the recordings of a case and its simulation, in place of those of an earlier run."""
    name = case.key.name
    write_table(output / "recordings" / f"{name}.csv", case.recording.columns, overwrite=True)
    second, files = output / "second" / f"{name}.csv", output / SIMULATIONS
    for old in (second, files / f"{name}.py", files / f"{name}.xml"):
        old.unlink(missing_ok=True)
    if case.second is not None:
        write_table(second, case.second.columns)
    if case.simulation:
        write_atomically(files / f"{name}{suffix_of(case.simulation)}", case.simulation)


def suffix_of(simulation: str) -> str:
    """Return the suffix of a simulation's file, a model of MuJoCo or Python.

    Example:
        >>> suffix_of("<mujoco/>"), suffix_of("import torch")
        ('.xml', '.py')
    """
    return ".xml" if simulation.lstrip().startswith("<") else ".py"


def diagnose_batch(diagnose: Diagnose, folder: Path, paths: list[Path]) -> None:
    """Diagnose recordings into a folder. A failed diagnosis writes a text file with the error."""
    try:
        diagnose(paths, folder)
    except Exception as error:
        # a missing diagnosis is scored as failed
        (folder / f"{paths[0].stem}.error.txt").write_text(f"{type(error).__name__}: {error}\n", encoding="utf-8")


def _second_ratio(apply: Apply, ratio: Ratio | None, output: Path, key: Key) -> float:
    model, path = output / "diagnoses" / key.name / "model.json", output / "second" / f"{key.name}.csv"
    if ratio is None or not model.is_file():
        return math.inf
    try:
        return ratio(apply(model, path), Recording.read(path), key)
    except Exception as error:
        (model.parent / "apply.error.txt").write_text(f"{type(error).__name__}: {error}\n", encoding="utf-8")
        return math.inf


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
    results: list[R] = []
    for result in run(job, items):
        results.append(result)
        report(len(results), len(items))
    return results
