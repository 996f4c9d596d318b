"""The proof in worlds from end to end: draw, seal, diagnose, open the key, score each world."""

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
from mkc_torch.challenge.scenarios.page import worlds_page, worlds_summary
from mkc_torch.challenge.scenarios.score import ScenariosScore, score_worlds
from mkc_torch.recording.recording import write_table

PER_WORLD = 60
"""Recordings with nothing hidden, or with a useless simulation, in each world."""

SIMULATIONS = "simulations"
"""Folder of the files of simulations, one for a recording that needs one."""


@dataclass(frozen=True)
class _Address:
    """Of a case: ``number`` is in the recording's name, and tells nothing."""

    world: Scenario
    index: int
    hidden: bool
    number: int


def run_worlds(
    diagnose: Diagnose,
    worlds: Scenarios,
    *,
    only: Sequence[str] = (),
    per_world: int = PER_WORLD,
    hidden: int | None = None,
    seed: int = 1,
    output: Path,
    workers: int = 1,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ScenariosScore:
    """Draw recordings of each world, have them diagnosed, and only then compare with what was in them.

    Into ``output`` go ``recordings/`` and ``simulations/``, ``key_hash.txt`` before the first diagnosis,
    ``diagnoses/``, then ``key.json``, ``score.json``, ``challenge.html`` and ``summary.md``. A case depends on the
    seed, its world and its index there alone, so that a larger run contains a smaller one.

    Args:
        diagnose: as a user would run it. A recording for which it writes nothing, or raises, counts as failed. With
            more than one worker it has to be picklable.
        worlds: of a family.
        only: names of worlds; default all.
        per_world: recordings with nothing hidden in each world, or with a useless simulation.
        hidden: recordings with something hidden in each world but the useless; default what each world says.
        seed: of everything that is drawn.
        output: a folder that is empty or does not exist.
        workers: processes.
        overwrite: accept a folder with files in it.
        progress: called with a stage, how many are done, and of how many.

    Raises:
        ValueError: a world that is not there, or no recording asked for.
    """
    asked = chosen(worlds, only)
    addresses = _addresses(asked, seed, per_world, hidden)
    if not addresses:
        raise ValueError("Expected per_world and hidden to ask for one recording at least but both are 0.")
    started = time.perf_counter()
    output = claim_folder(output, overwrite=overwrite)
    for name in ("recordings", SIMULATIONS, "diagnoses"):
        claim_folder(output / name, overwrite=overwrite)
    tell = progress or silent
    with Pool(workers) as pool:
        keys = every(pool, partial(_write_case, output, seed), addresses, partial(tell, "draw"))
        text = canonical(keys)
        write_atomically(output / "key_hash.txt", f"{digest(text)}\n", overwrite=overwrite)
        paths = [output / "recordings" / f"{key.name}.csv" for key in keys]
        batches = [paths[k : k + BATCH] for k in range(0, len(paths), BATCH)]
        every(pool, partial(diagnose_batch, diagnose, output / "diagnoses"), batches, partial(tell, "diagnose"))
    write_atomically(output / "key.json", f"{text}\n", overwrite=overwrite)
    diagnoses = {key.name: content_of(output / "diagnoses" / key.name / "diagnosis.json") for key in keys}
    result = score_worlds(worlds, keys, diagnoses)
    settings = {
        "family": worlds.family,
        "worlds": ", ".join(world.name for world in asked),
        "seed": seed,
        "empty_per_world": per_world,
        "hidden_per_world": _hidden_told(asked, per_world, hidden),
        **worlds.settings,
        "workers": workers,
        "key_sha256": digest(text),
        "seconds": round(time.perf_counter() - started, 1),
    }
    reasons = {name: _why(output / "diagnoses" / f"{name}.error.txt") for name in _failed(result)}
    record = {"settings": settings, **result.numbers(), "failed": reasons}
    write_atomically(output / "score.json", json.dumps(record, indent=1, allow_nan=False), overwrite=overwrite)
    write_atomically(output / "challenge.html", worlds_page(result, settings), overwrite=overwrite)
    write_atomically(output / "summary.md", worlds_summary(result, settings), overwrite=overwrite)
    return result


def chosen(worlds: Scenarios, only: Sequence[str]) -> list[Scenario]:
    """The worlds of those names, all for none.

    Raises:
        ValueError: there is none of a name.
    """
    known = [world.name for world in worlds.worlds]
    for name in only:
        if name not in known:
            raise ValueError(f"Expected a world of {worlds.family} to be one of {', '.join(known)} but got {name!r}.")
    return [world for world in worlds.worlds if not only or world.name in only]


def count(worlds: Scenarios, only: Sequence[str], per_world: int, hidden: int | None) -> int:
    """How many recordings a run has."""
    asked = chosen(worlds, only)
    return sum(per_world + world.hidden(per_world, hidden) for world in asked)


def _hidden_told(asked: Sequence[Scenario], per_world: int, hidden: int | None) -> int | str:
    """How many recordings of a world have something hidden, "20 or 60" where worlds differ."""
    numbers = sorted({world.hidden(per_world, hidden) for world in asked if world.hides} or {0})
    return numbers[0] if len(numbers) == 1 else " or ".join(map(str, numbers))


def _addresses(asked: Sequence[Scenario], seed: int, per_world: int, hidden: int | None) -> list[_Address]:
    """All cases in a random order, so that names tell nothing."""
    plain = [
        (world, index, hides)
        for world in asked
        for hides, total in ((False, per_world), (True, world.hidden(per_world, hidden)))
        for index in range(total)
    ]
    order = torch.randperm(len(plain), generator=generator(seed, "worlds", "order")).tolist()
    shuffled = enumerate(plain[place] for place in order)
    return [_Address(world, index, hides, number) for number, (world, index, hides) in shuffled]


def _failed(result: ScenariosScore) -> list[str]:
    return [name for world in result.worlds for name in world.failed]


def _why(path: Path) -> str:
    """What was said instead of a diagnosis, "" where nothing was."""
    return path.read_text(encoding="utf-8").strip() if path.is_file() else ""


def _write_case(output: Path, seed: int, address: _Address) -> ScenarioKey:
    case = address.world.draw(seed, address.index, address.hidden, address.number)
    name = case.key.name
    write_table(output / "recordings" / f"{name}.csv", case.recording.columns, overwrite=True)
    simulation = output / SIMULATIONS / f"{name}.py"
    if case.simulation:
        write_atomically(simulation, case.simulation, overwrite=True)
    else:
        simulation.unlink(missing_ok=True)  # of an earlier run
    return case.key
