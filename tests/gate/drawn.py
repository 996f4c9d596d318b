"""Draw the recordings of the gate, of each scenario and of both proofs; every run draws the same recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from examples.blind_proof.diagnose import request_for
from examples.blind_proof.equations.cases import equations
from examples.blind_proof.equations.scenarios import equations_scenarios
from examples.blind_proof.key import Key
from examples.blind_proof.magnetometer.cases import magnetometer
from examples.blind_proof.magnetometer.scenarios import magnetometer_scenarios
from examples.blind_proof.mujoco.cases import mujoco_steps
from examples.blind_proof.proof import Case, Proof
from examples.blind_proof.run import Pool, every, suffix_of
from examples.blind_proof.score import ProofScore, Score, score_proof
from examples.blind_proof.scored_case import ScoredCase, scored
from mkc_torch._support.files import write_atomically
from mkc_torch.recording.recording import write_table
from tests.gate.work import Job

SEED = 7

EMPTY_PER_SCENARIO = 6
HIDDEN_PER_SCENARIO = 2

PER_PROOF = {"magnetometer": 40, "dynamics": 20, "mujoco": 5}
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
    draw: Callable[[], Case]


def all_scenarios(
    output: Path,
    *,
    match: str = "",
    workers: int = 1,
    empty: int = EMPTY_PER_SCENARIO,
    hidden: int = HIDDEN_PER_SCENARIO,
) -> Iterator[Drawn]:
    """Draw the scenarios of both families; only recordings whose name contains ``match``."""
    for family, proof in (("dynamics", equations_scenarios()), ("magnetometer", magnetometer_scenarios())):
        addresses = [
            # a unique number for each recording, part of its file name
            _Address(name, partial(scenario.draw, SEED, index, hides, 1000 * place + 100 * hides + index))
            for place, scenario in enumerate(proof.scenarios)
            for hides, total in ((False, empty), (True, scenario.hidden(empty, hidden)))
            for index in range(total)
            if match in (name := f"scenario {family} {scenario.name} {'hidden' if hides else 'empty'} {index}")
        ]
        yield _of_scenarios(proof, *_written(addresses, output / "drawn" / f"scenarios_{family}", workers))


def all_proofs(
    output: Path, *, match: str = "", workers: int = 1, sizes: Mapping[str, int] = PER_PROOF
) -> Iterator[Drawn]:
    """Draw the proofs; only recordings whose name contains ``match``."""
    for family, proof in (("magnetometer", magnetometer()), ("dynamics", equations()), ("mujoco", mujoco_steps())):
        (scenario,), size = proof.scenarios, sizes[family]
        addresses = [
            _Address(name, partial(scenario.draw, SEED, index, index < size, index))
            for index in range(2 * size)
            if match in (name := f"proof {family} {'hidden' if index < size else 'empty'} {index}")
        ]
        yield _of_proof(*_written(addresses, output / "drawn" / f"proof_{family}", workers))


def _written(addresses: Sequence[_Address], folder: Path, workers: int) -> tuple[list[Job], dict[str, Any]]:
    """Draw and write the recordings. Returns their jobs, and their keys by the names in the run."""
    folder.mkdir(parents=True, exist_ok=True)
    with Pool(workers) as pool:
        drawn = every(pool, partial(_write, folder), addresses, lambda *_: None)
    return [job for job, _ in drawn], {job.name: key for job, key in drawn}


def _write(folder: Path, address: _Address) -> tuple[Job, Key]:
    case = address.draw()
    recording = folder / f"{case.key.name}.csv"
    write_table(recording, case.recording.columns, overwrite=True)
    simulation = recording.with_suffix(suffix_of(case.simulation))
    if case.simulation:
        write_atomically(simulation, case.simulation, overwrite=True)
    return Job(address.name, recording, request_for(recording, simulation)), case.key


def _of_scenarios(proof: Proof, jobs: Sequence[Job], keys: Mapping[str, Key]) -> Drawn:
    def scored_rows(rows: Rows) -> ProofScore:
        return score_proof(proof, list(keys.values()), _by_key(rows, {n: key.name for n, key in keys.items()}))

    def counts(rows: Rows) -> dict[str, str]:
        found = scored_rows(rows)
        shares, cases = found.total.shares, found.cases
        apart = {scenario.name for scenario in proof.scenarios if scenario.apart}
        together = [case for case in cases if case.key.scenario not in apart]
        empty, useless = [case for case in together if not case.hides], [case for case in cases if case.key.useless]
        of_apart = [case for case in cases if case.key.scenario in apart]
        counted_apart = f"{sum(case.alone for case in of_apart)}/{len(of_apart)}"
        return {
            "false alarms": f"{sum(case.stated.alarm for case in empty)}/{len(empty)}",
            **({"a wrong single name in one run": counted_apart} if of_apart else {}),
            "strong named": f"{shares['named'].count}/{shares['named'].total}",
            "strong named wrong": f"{shares['wrong'].count}/{shares['wrong'].total}",
            "useless unfit": f"{sum(case.stated.verdict == 'unfit' for case in useless)}/{len(useless)}",
            "useful unfit": f"{shares['useful_unfit'].count}/{shares['useful_unfit'].total}",
            "failed": str(sum(case.stated.verdict == "failed" for case in cases)),
        }

    def outcomes(rows: Rows) -> dict[str, dict[str, Any]]:
        cases = {case.key.name: case for case in scored_rows(rows).cases}
        found = {name: cases[key.name] for name, key in keys.items()}
        return {
            name: {"named": case.named} if case.hides else {"false_alarm": case.stated.alarm}
            for name, case in found.items()
        }

    return Drawn(jobs, {name: _truth(key) | _environment(key) for name, key in keys.items()}, counts, outcomes)


def _of_proof(jobs: Sequence[Job], keys: Mapping[str, Key]) -> Drawn:
    names = {name: key.name for name, key in keys.items()}

    def scored_rows(rows: Rows) -> Score:
        found = _by_key(rows, names)
        return Score("proof", [scored(key, found[key.name]) for key in keys.values()])

    def counts(rows: Rows) -> dict[str, str]:
        found = scored_rows(rows)
        shares = found.shares
        return {
            "false alarms": f"{shares['false_alarms'].count}/{shares['false_alarms'].total}",
            "strong named": f"{shares['named'].count}/{shares['named'].total}",
            "failed": str(len(found.failed)),
        }

    def outcomes(rows: Rows) -> dict[str, dict[str, Any]]:
        cases = dict(zip(keys, scored_rows(rows).cases, strict=True))
        return {
            name: {"named": _named(case)} if case.hides else {"false_alarm": case.stated.alarm}
            for name, case in cases.items()
        }

    return Drawn(jobs, {name: _truth(key) for name, key in keys.items()}, counts, outcomes)


def _named(case: ScoredCase) -> bool:
    """Whether a single effect, or both of two, are named right; an effect outside the catalogue has no name."""
    return case.named if case.single else case.named_effects == 2


def _by_key(rows: Rows, names: Mapping[str, str]) -> dict[str, Mapping[str, Any] | None]:
    """Rows by the names of their keys, as the scores expect them; None where a diagnosis failed."""
    return {key: rows[name] if name in rows and rows[name]["verdict"] else None for name, key in names.items()}


def _truth(key: Key) -> dict[str, Any]:
    effects = [{"effect": e.effect, "z": e.z, "z_sep": e.z_sep, "drivers": list(e.drivers)} for e in key.effects]
    return {"kind": key.kind, "hidden": effects}


def _environment(key: Key) -> dict[str, Any]:
    return {"disturbance": asdict(key.disturbance) if key.disturbance else None, "useless": key.useless}
