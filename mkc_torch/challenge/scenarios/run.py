"""Run the proof in scenarios: draw, seal the key, diagnose, open the key, score each scenario."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.challenge.draws import generator
from mkc_torch.challenge.key import canonical, digest
from mkc_torch.challenge.pool import BATCH, Diagnose, Pool, Progress, content_of, diagnose_batch, every, silent
from mkc_torch.challenge.scenario import Scenario, ScenarioKey, Scenarios
from mkc_torch.challenge.scenarios.page import scenarios_page, scenarios_summary
from mkc_torch.challenge.scenarios.score import ScenariosScore, score_scenarios
from mkc_torch.recording.recording import write_table

PER_SCENARIO = 60
"""Recordings without hidden physics, or with an unusable simulation, in each scenario."""

SIMULATIONS = "simulations"
"""Folder of the simulation files, for recordings that need their own."""


@dataclass(frozen=True)
class _Address:
    """Address of a case. ``number`` is part of the recording's name, and reveals nothing."""

    scenario: Scenario
    index: int
    hidden: bool
    number: int


def run_scenarios(
    diagnose: Diagnose,
    scenarios: Scenarios,
    *,
    only: Sequence[str] = (),
    per_scenario: int = PER_SCENARIO,
    hidden: int | None = None,
    seed: int = 1,
    output: Path,
    workers: int = 1,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ScenariosScore:
    """Draw recordings of each scenario, diagnose them, and then compare the diagnoses with the keys.

    Into ``output`` go ``recordings/`` and ``simulations/``, ``key_hash.txt`` before the first diagnosis,
    ``diagnoses/``, then ``key.json``, ``score.json``, ``challenge.html`` and ``summary.md``. A case depends
    only on the seed, its scenario and its index there, so that a larger run contains a smaller one.

    Args:
        diagnose: diagnoses recordings as a user would. A recording without a written diagnosis counts as failed. With
            several workers it has to be picklable.
        scenarios: the scenarios of a family.
        only: names of scenarios; default: all.
        per_scenario: recordings in each scenario without hidden physics, or with an unusable simulation.
        hidden: recordings in each scenario with hidden physics; default: set by the scenario.
        seed: seed of all draws.
        output: a folder that is empty or does not exist.
        workers: number of processes.
        overwrite: accept a folder with files in it.
        progress: called with the stage, the number done and the total.

    Raises:
        ValueError: an unknown scenario, or no recordings.
    """
    selected = chosen(scenarios, only)
    addresses = _addresses(selected, seed, per_scenario, hidden)
    if not addresses:
        raise ValueError("Expected per_scenario or hidden to be at least 1 but both are 0.")
    started = time.perf_counter()
    output = claim_folder(output, overwrite=overwrite)
    for name in ("recordings", SIMULATIONS, "diagnoses"):
        claim_folder(output / name, overwrite=overwrite)
    report = progress or silent
    with Pool(workers) as pool:
        keys = every(pool, partial(_write_case, output, seed), addresses, partial(report, "draw"))
        text = canonical(keys)
        write_atomically(output / "key_hash.txt", f"{digest(text)}\n", overwrite=overwrite)
        paths = [output / "recordings" / f"{key.name}.csv" for key in keys]
        batches = [paths[k : k + BATCH] for k in range(0, len(paths), BATCH)]
        every(pool, partial(diagnose_batch, diagnose, output / "diagnoses"), batches, partial(report, "diagnose"))
    write_atomically(output / "key.json", f"{text}\n", overwrite=overwrite)
    diagnoses = {key.name: content_of(output / "diagnoses" / key.name / "diagnosis.json") for key in keys}
    result = score_scenarios(scenarios, keys, diagnoses)
    settings = {
        "family": scenarios.family,
        "scenarios": ", ".join(scenario.name for scenario in selected),
        "seed": seed,
        "empty_per_scenario": per_scenario,
        "hidden_per_scenario": _hidden_text(selected, per_scenario, hidden),
        **scenarios.settings,
        "workers": workers,
        "key_sha256": digest(text),
        "seconds": round(time.perf_counter() - started, 1),
    }
    reasons = {name: _why(output / "diagnoses" / f"{name}.error.txt") for name in _failed(result)}
    record = {"settings": settings, **result.numbers(), "failed": reasons}
    write_atomically(output / "score.json", json.dumps(record, indent=1, allow_nan=False), overwrite=overwrite)
    write_atomically(output / "challenge.html", scenarios_page(result, settings), overwrite=overwrite)
    write_atomically(output / "summary.md", scenarios_summary(result, settings), overwrite=overwrite)
    return result


def chosen(scenarios: Scenarios, only: Sequence[str]) -> list[Scenario]:
    """Return the scenarios of these names, or all without names.

    Raises:
        ValueError: a name is unknown.
    """
    known = [scenario.name for scenario in scenarios.scenarios]
    for name in only:
        if name not in known:
            raise ValueError(
                f"Expected a scenario of {scenarios.family} to be one of {', '.join(known)} but got {name!r}."
            )
    return [scenario for scenario in scenarios.scenarios if not only or scenario.name in only]


def count(scenarios: Scenarios, only: Sequence[str], per_scenario: int, hidden: int | None) -> int:
    """Return the number of recordings of a run."""
    selected = chosen(scenarios, only)
    return sum(per_scenario + scenario.hidden(per_scenario, hidden) for scenario in selected)


def _hidden_text(selected: Sequence[Scenario], per_scenario: int, hidden: int | None) -> int | str:
    """Return the number of recordings with hidden physics in a scenario; "20 or 60" if scenarios differ."""
    numbers = sorted({scenario.hidden(per_scenario, hidden) for scenario in selected if scenario.hides} or {0})
    return numbers[0] if len(numbers) == 1 else " or ".join(map(str, numbers))


def _addresses(selected: Sequence[Scenario], seed: int, per_scenario: int, hidden: int | None) -> list[_Address]:
    """Return all cases in a random order, so that names reveal nothing."""
    plain = [
        (scenario, index, hides)
        for scenario in selected
        for hides, total in ((False, per_scenario), (True, scenario.hidden(per_scenario, hidden)))
        for index in range(total)
    ]
    order = torch.randperm(len(plain), generator=generator(seed, "worlds", "order")).tolist()
    shuffled = enumerate(plain[place] for place in order)
    return [_Address(scenario, index, hides, number) for number, (scenario, index, hides) in shuffled]


def _failed(result: ScenariosScore) -> list[str]:
    return [name for scenario in result.scenarios for name in scenario.failed]


def _why(path: Path) -> str:
    """Return the message of a failed diagnosis, "" without a message."""
    return path.read_text(encoding="utf-8").strip() if path.is_file() else ""


def _write_case(output: Path, seed: int, address: _Address) -> ScenarioKey:
    case = address.scenario.draw(seed, address.index, address.hidden, address.number)
    name = case.key.name
    write_table(output / "recordings" / f"{name}.csv", case.recording.columns, overwrite=True)
    simulation = output / SIMULATIONS / f"{name}.py"
    if case.simulation:
        write_atomically(simulation, case.simulation, overwrite=True)
    else:
        simulation.unlink(missing_ok=True)  # a file of an earlier run
    return case.key
