"""Which numbers of a verdict decide: `python -m tests.thresholds.deciding --gate DIR [--search NAME …]`.

A number of `mkc_torch.diagnosis.thresholds` decides if half or twice of it changes a verdict. The vetoes and the rules
on the whole diagnosis are replayed from the trails of the recordings in DIR, a folder of `python -m tests.gate`. With
`--search`, the recordings are diagnosed again with half and twice of each named number; the verdict, the effects found
and their grades are compared.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from mkc_torch import diagnose
from mkc_torch.cli.diagnosis_files import read_recording, simulation_of
from mkc_torch.diagnosis import thresholds
from mkc_torch.diagnosis.decisions import Decision, Trail
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.diagnosis.verdict import grades_of, verdict_of
from tests.gate.work import KNOWN, Job, diagnosed, known_answers

FACTORS = (0.5, 2.0)

Outcome = tuple[str, ...]
"""The verdict and the grades of the findings."""


@dataclass(frozen=True)
class Rule:
    """A rule of the trail.

    Attributes:
        threshold: name of the number it compares with.
        at_most: whether the value has to be at most the threshold; otherwise at least.
        scaled: the threshold of a decision with the number times a factor.
    """

    threshold: str
    at_most: bool
    scaled: Callable[[float, float], float] = lambda threshold, factor: threshold * factor


def _around_one(threshold: float, factor: float) -> float:
    return 1.0 + (threshold - 1.0) * factor


def _in_addition(threshold: float, factor: float) -> float:
    return threshold + (factor - 1.0) * thresholds.SHAPE_NATS


RULES = {
    "p_value": Rule("LEVEL", at_most=True),
    "open_loop": Rule("SMALL", True, _around_one),
    "size_plausible": Rule("IMPLAUSIBLE", at_most=True),
    "shape": Rule("SHAPE_NATS", True, _in_addition),
    "visible": Rule("VISIBLE", at_most=False),
    "residual_reduction": Rule("SMALL", at_most=False),
    "explained_share": Rule("USEFUL", at_most=False),
    "each_output": Rule("FOLLOWED", at_most=False),
    "simulation_explains_more": Rule("CORRECTION", at_most=True),
    "above_declared_noise": Rule("ABOVE_FLOOR", at_most=True),
    "above_estimated_noise": Rule("FAR_ABOVE_FLOOR", at_most=True),
}
"""The rules that compare a number of the trail with a threshold, by id."""

FIELDS = {
    "DISTURBANCE": ("noise", "disturbance_gain"),
    "SEPARABLE": ("naming", "separable"),
    "NAMELESS": ("naming", "nameless"),
    "GENERALISATION": ("naming", "is_generalisation"),
    "FOLLOWED": ("evidence", "followed"),
    "USEFUL": ("evidence", "useful"),
    "CORRECTION": ("evidence", "correction"),
    "ABOVE_FLOOR": ("evidence", "above_floor"),
    "FAR_ABOVE_FLOOR": ("evidence", "far_above_floor"),
    "SHAPE_LEVEL": ("evidence", "shape_level"),
    "SHAPE_NATS": ("evidence", "shape_nats"),
}
"""Stage and name of the thresholds that are settings."""


def numbers() -> dict[str, float]:
    """Return the thresholds by name."""
    return {name: value for name, value in vars(thresholds).items() if name.isupper()}


def replayed(trail: Trail, name: str, factor: float) -> Trail:
    """Return a trail with the decisions of one threshold made again with a multiple of it."""

    def again(decision: Decision) -> Decision:
        rule = RULES.get(decision.rule)
        if rule is None or rule.threshold != name or decision.value is None:
            return decision
        limit = rule.scaled(decision.threshold, factor)
        passed = decision.value <= limit if rule.at_most else decision.value >= limit
        return replace(decision, threshold=limit, passed=passed)

    return replace(trail, decisions=tuple(again(decision) for decision in trail.decisions))


def outcome_of(trail: Trail) -> Outcome:
    """Return the verdict and the grades of a trail."""
    return verdict_of(trail), *grades_of(trail)


def read_trail(file: Path) -> Trail:
    """Return the decisions that a `diagnosis.json` holds."""
    known = json.loads(file.read_text(encoding="utf-8"))["decisions"]["decisions"]
    return Trail((), tuple(Decision(**decision) for decision in known))


def changed_by_replay(trails: dict[str, Trail]) -> Iterator[tuple[str, list[str]]]:
    """Yield each threshold of a rule with the names of the recordings whose outcome half or twice of it changes."""
    for name in dict.fromkeys(rule.threshold for rule in RULES.values()):
        yield (
            name,
            [
                recording
                for recording, trail in trails.items()
                if any(outcome_of(replayed(trail, name, factor)) != outcome_of(trail) for factor in FACTORS)
            ],
        )


@contextmanager
def scaled(name: str, factor: float) -> Iterator[Settings]:
    """Multiply a threshold in all modules that use it; yields the settings with it.

    Raises:
        KeyError: there is no such threshold.
    """
    value = numbers()[name]
    other = type(value)(max(value * factor, 1)) if isinstance(value, int) else value * factor
    users = [m for key, m in sys.modules.items() if key.startswith("mkc_torch.") and vars(m).get(name) is value]
    settings = Settings()
    if name in FIELDS:
        stage, field = FIELDS[name]
        settings = replace(settings, **{stage: replace(getattr(settings, stage), **{field: other})})
    for module in users:
        setattr(module, name, other)
    try:
        yield settings
    finally:
        for module in users:
            setattr(module, name, value)


def diagnose_scaled(job: Job, folder: Path, name: str = "LEVEL", factor: float = 1.0) -> None:
    """Diagnose with a multiple of a threshold; write the outcome to ``row.json``."""
    request = job.request
    with scaled(name, factor) as settings:
        result = diagnose(
            simulation_of(request),
            read_recording(job.recording, request),
            seed=request.seed,
            level=thresholds.LEVEL,
            noise=dict(request.noise),
            input_hold=dict(request.input_hold),
            settings=settings,
        )
    outcome = [result.verdict, *(f"{finding.effect} {finding.grade}" for finding in result.findings)]
    (folder / "row.json").write_text(json.dumps({"outcome": outcome}), encoding="utf-8")


def changed_by_search(names: Sequence[str], gate: Path, match: str, workers: int) -> Iterator[tuple[str, list[str]]]:
    """Yield each threshold with the names of the recordings that come to another outcome with half or twice of it."""
    jobs = [Job(a.name, a.recording, a.request) for a in known_answers(KNOWN) if match in a.name]
    tasks = {("LEVEL", 1.0), *((name, factor) for name in names for factor in FACTORS)}
    outcomes = {}
    for name, factor in sorted(tasks, key=lambda task: (task[0] != "LEVEL", task)):
        task, folder = partial(diagnose_scaled, name=name, factor=factor), gate / "deciding" / f"{name}_{factor:g}"
        rows = diagnosed(jobs, folder, workers=workers, limit_s=1800.0, task=task)
        outcomes[name, factor] = {recording: row.get("outcome", row.get("failed")) for recording, row in rows}
    usual = outcomes["LEVEL", 1.0]
    for name in names:
        yield name, [job.name for job in jobs if any(outcomes[name, f][job.name] != usual[job.name] for f in FACTORS)]


def main() -> None:
    parser = argparse.ArgumentParser(description="Count the verdicts that half or twice of each threshold changes.")
    parser.add_argument("--gate", type=Path, required=True, help="output folder of the gate")
    parser.add_argument("--search", nargs="*", default=[], choices=sorted(numbers()), help="thresholds to search with")
    parser.add_argument("--match", default="", help="only recordings whose name contains this text")
    parser.add_argument("--workers", type=int, default=2, help="parallel processes")
    options = parser.parse_args()
    trails = {file.parent.name: read_trail(file) for file in sorted(options.gate.glob("*/diagnosis.json"))}
    print(f"{len(trails)} trails, each threshold halved and doubled: outcomes that change")
    found = list(changed_by_replay(trails))
    if options.search:
        found += changed_by_search(options.search, options.gate, options.match, options.workers)
    for name, recordings in found:
        print(f"{name:17} {len(recordings):3}  {', '.join(recordings)}")


if __name__ == "__main__":
    main()
