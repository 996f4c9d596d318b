"""Draw the recordings of the gate, of each scenario and of both proofs; every run draws the same recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mkc_torch._support.files import write_atomically
from mkc_torch.challenge.dynamics.scenarios import dynamics_scenarios
from mkc_torch.challenge.dynamics.subject import dynamics, simulation_class
from mkc_torch.challenge.key import Key
from mkc_torch.challenge.magnetometer.scenarios import magnetometer_scenarios
from mkc_torch.challenge.magnetometer.subject import magnetometer
from mkc_torch.challenge.pool import Pool, every, silent
from mkc_torch.challenge.scenario import ScenarioCase, ScenarioKey, Scenarios
from mkc_torch.challenge.scenarios.score import score_scenarios
from mkc_torch.challenge.score import score
from mkc_torch.challenge.subject import Case
from mkc_torch.cli.diagnosis_request import MAGNETOMETER, Request
from mkc_torch.recording.recording import write_table
from tests.gate.work import Job

SEED = 7

EMPTY_PER_SCENARIO = 6
HIDDEN_PER_SCENARIO = 2

PER_PROOF = {"magnetometer": 40, "dynamics": 20}
"""Recordings with a hidden effect in each proof; as many again have none."""

Rows = Mapping[str, Mapping[str, Any]]
"""Name of a recording to its row."""


@dataclass(frozen=True)
class Drawn:
    """The recordings of a family's scenarios, or of a proof.

    Attributes:
        jobs: their names are those of the recordings in the run.
        truths: the hidden effects of each recording.
        counts: returns the name of each measure with its count and total, from the rows.
        outcomes: returns for each recording whether it is a false alarm, or was named, from the rows.
    """

    jobs: Sequence[Job]
    truths: Mapping[str, Mapping[str, Any]]
    counts: Callable[[Rows], dict[str, str]]
    outcomes: Callable[[Rows], dict[str, dict[str, Any]]]


@dataclass(frozen=True)
class _Address:
    """A recording to be drawn: its name in the run, and the function that draws it."""

    name: str
    draw: Callable[[], Case | ScenarioCase]
    simulation: str = ""


def all_scenarios(
    output: Path,
    *,
    match: str = "",
    workers: int = 1,
    empty: int = EMPTY_PER_SCENARIO,
    hidden: int = HIDDEN_PER_SCENARIO,
) -> Iterator[Drawn]:
    """Draw the scenarios of both families; only recordings whose name contains ``match``."""
    for family in (dynamics_scenarios(), magnetometer_scenarios()):
        addresses = [
            # a unique number for each recording, part of its file name
            _Address(name, partial(scenario.draw, SEED, index, hides, 1000 * place + 100 * hides + index))
            for place, scenario in enumerate(family.scenarios)
            for hides, total in ((False, empty), (True, scenario.hidden(empty, hidden)))
            for index in range(total)
            if match in (name := f"scenario {family.family} {scenario.name} {'hidden' if hides else 'empty'} {index}")
        ]
        yield _of_scenarios(family, *_written(addresses, output / "drawn" / f"scenarios_{family.family}", workers))


def both_proofs(
    output: Path, *, match: str = "", workers: int = 1, sizes: Mapping[str, int] = PER_PROOF
) -> Iterator[Drawn]:
    """Draw both proofs; only recordings whose name contains ``match``."""
    for subject in (magnetometer(), dynamics()):
        size, text = sizes[subject.name], subject.simulations.read_text(encoding="utf-8") if subject.simulations else ""
        addresses = [
            _Address(name, partial(subject.draw, SEED, index, index >= size), text)
            for index in range(2 * size)
            if match in (name := f"proof {subject.name} {'hidden' if index < size else 'empty'} {index}")
        ]
        yield _of_proof(*_written(addresses, output / "drawn" / f"proof_{subject.name}", workers))


def _written(addresses: Sequence[_Address], folder: Path, workers: int) -> tuple[list[Job], dict[str, Any]]:
    """Draw and write the recordings. Returns their jobs, and their keys by the names in the run."""
    folder.mkdir(parents=True, exist_ok=True)
    with Pool(workers) as pool:
        drawn = every(pool, partial(_write, folder), addresses, partial(silent, "draw"))
    return [job for job, _ in drawn], {job.name: key for job, key in drawn}


def _write(folder: Path, address: _Address) -> tuple[Job, Key | ScenarioKey]:
    case = address.draw()
    recording = folder / f"{case.key.name}.csv"
    write_table(recording, case.recording.columns, overwrite=True)
    simulation = case.simulation if isinstance(case, ScenarioCase) else address.simulation
    return Job(address.name, recording, _request(recording, simulation)), case.key


def _of_scenarios(family: Scenarios, jobs: Sequence[Job], keys: Mapping[str, ScenarioKey]) -> Drawn:
    def scored(rows: Rows) -> Any:
        return score_scenarios(family, list(keys.values()), _by_key(rows, {n: key.name for n, key in keys.items()}))

    def counts(rows: Rows) -> dict[str, str]:
        found = scored(rows)
        total, cases = found.total, found.cases
        apart = {scenario.name for scenario in family.scenarios if scenario.apart}
        together = [case for case in cases if case.key.scenario not in apart]
        empty, useless = [case for case in together if not case.hides], [case for case in cases if case.key.useless]
        of_apart = [case for case in cases if case.key.scenario in apart]
        counted_apart = f"{sum(case.alone for case in of_apart)}/{len(of_apart)}"
        return {
            "false alarms": f"{sum(case.stated.alarm for case in empty)}/{len(empty)}",
            **({"a wrong single name in one run": counted_apart} if of_apart else {}),
            "strong named": f"{total.named.count}/{total.named.total}",
            "strong named wrong": f"{total.wrong.count}/{total.wrong.total}",
            "useless unfit": f"{sum(case.stated.verdict == 'unfit' for case in useless)}/{len(useless)}",
            "useful unfit": f"{total.useful_unfit.count}/{total.useful_unfit.total}",
            "failed": str(sum(case.stated.verdict == "failed" for case in cases)),
        }

    def outcomes(rows: Rows) -> dict[str, dict[str, Any]]:
        cases = scored(rows).cases
        return {
            name: {"named": case.named} if case.hides else {"false_alarm": case.stated.alarm}
            for name, case in zip(keys, cases, strict=True)
        }

    return Drawn(jobs, {name: _truth(key.key) | _environment(key) for name, key in keys.items()}, counts, outcomes)


def _of_proof(jobs: Sequence[Job], keys: Mapping[str, Key]) -> Drawn:
    names = {name: key.name for name, key in keys.items()}

    def scored(rows: Rows, among: Sequence[str]) -> Any:
        return score([keys[name] for name in among], _by_key(rows, names), thresholds=())

    def counts(rows: Rows) -> dict[str, str]:
        found = scored(rows, list(keys))
        return {
            "false alarms": f"{found.false_alarms.count}/{found.false_alarms.total}",
            "strong named": f"{found.named.count}/{found.named.total}",
            "failed": str(len(found.failed)),
        }

    def outcomes(rows: Rows) -> dict[str, dict[str, Any]]:
        outcomes = {}
        for name, key in keys.items():
            own = scored(rows, [name])
            if key.kind == "empty":
                outcomes[name] = {"false_alarm": bool(own.false_alarms.count)}
            else:
                outcomes[name] = {"named": bool(sum(part.named.count for part in own.power_z) or own.doubles[2])}
        return outcomes

    return Drawn(jobs, {name: _truth(key) for name, key in keys.items()}, counts, outcomes)


def _request(recording: Path, simulation: str) -> Request:
    """The request with ``simulation``, a source text written next to the recording; empty for the magnetometer."""
    if not simulation:
        return Request(simulation=MAGNETOMETER, force=True, report=False)
    file = recording.with_suffix(".py")
    write_atomically(file, simulation, overwrite=True)
    of_a_sensor = recording.stem.startswith("case_")
    name = "sensor" if of_a_sensor else simulation_class(recording)
    return Request(simulation=f"{file}:{name}", force=True, report=False)


def _by_key(rows: Rows, names: Mapping[str, str]) -> dict[str, Mapping[str, Any] | None]:
    """Rows by the names of their keys, as the scores expect them; None where a diagnosis failed."""
    return {key: rows[name] if name in rows and rows[name]["verdict"] else None for name, key in names.items()}


def _truth(key: Key) -> dict[str, Any]:
    effects = [{"effect": e.effect, "z": e.z, "z_sep": e.z_sep, "drivers": list(e.drivers)} for e in key.effects]
    return {"kind": key.kind, "hidden": effects}


def _environment(key: ScenarioKey) -> dict[str, Any]:
    return {"disturbance": asdict(key.disturbance) if key.disturbance else None, "useless": key.useless}
