"""The score: shares of diagnoses that are right, and the thresholds that hold, scenario by scenario."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import torch

from examples.blind_proof.aims import Threshold
from examples.blind_proof.binomial import Share, share, uniformity
from examples.blind_proof.key import Key, KeyEffect
from examples.blind_proof.proof import Proof, Scenario
from examples.blind_proof.scored_case import ScoredCase, scored
from examples.blind_proof.statements import ADEQUATE, FAILED, UNEXPLAINED, UNFIT, VERDICTS, covered, located_right

BINS = (0.0, 3.0, 5.0, 7.0, 10.0, 15.0, 30.0, math.inf)
"""Edges of the bins of z and z_sep."""

ONSET_TOLERANCE = 1.0
"""Largest error of an onset that counts as right, s."""

TOTAL = "all useful"
"""Name of the row of all scenarios with usable simulations, without those counted apart."""

Condition = Callable[[ScoredCase], bool]

SHARES: Mapping[str, tuple[Condition, Condition]] = MappingProxyType(
    {
        # without hidden physics
        "false_alarms": (lambda c: c.diagnosed and not c.hides, lambda c: c.stated.alarm),
        "adequate": (lambda c: not c.hides, lambda c: c.stated.verdict == ADEQUATE),
        "unfit": (lambda c: not c.hides, lambda c: c.stated.verdict == UNFIT),
        "useful_unfit": (lambda c: c.useful and (c.visible or not c.hides), lambda c: c.stated.verdict == UNFIT),
        "unexplained_located": (
            lambda c: c.disturbs(sensor=False),
            lambda c: c.stated.verdict == UNEXPLAINED and c.located,
        ),
        "located": (lambda c: c.disturbs(sensor=False), lambda c: c.located),
        "sensor_reported": (lambda c: c.disturbs(sensor=True), lambda c: c.sensor),
        # with and without
        "alone": (lambda c: c.useful and c.diagnosed, lambda c: c.alone),
        "undecided": (lambda c: c.useful, lambda c: c.undecided),
        # strong effects of the catalogue
        "named": (lambda c: c.strong, lambda c: c.named),
        "named_disturbed": (lambda c: c.strong and c.disturbed, lambda c: c.named),
        "named_undisturbed": (lambda c: c.strong and not c.disturbed, lambda c: c.named),
        "withheld_named": (lambda c: c.strong and bool(c.truth.withheld), lambda c: c.named),
        "driver": (lambda c: c.strong and not c.truth.at, lambda c: c.driver),
        "at_port": (lambda c: c.strong and bool(c.truth.at), lambda c: c.first(located_right)),
        "wrong": (lambda c: c.strong, lambda c: c.wrong),
        "nearest": (lambda c: c.strong, lambda c: c.nearest),
        "extra": (lambda c: c.strong, lambda c: len(c.stated.claims) > 1),
        "separable": (lambda c: c.answered, lambda c: not c.stated.claims[0].others),
        # steps of the offset
        "onsets_near": (
            lambda c: c.strong and c.own_name and c.truth.effect == "hard_iron_step",
            lambda c: c.onset_error <= ONSET_TOLERANCE,
        ),
        "onset_covered": (lambda c: c.own_name and c.truth.onset is not None, lambda c: c.onset_covered),
        # effects outside the catalogue
        "outside_wrong": (lambda c: c.outside, lambda c: c.wrong),
        "outside_nearest": (lambda c: c.outside, lambda c: c.stated.found and not c.wrong),
    }
)
"""Measures by name: the recordings that count, and the condition whose share is measured.

A failed diagnosis counts in every share but ``false_alarms`` and ``alone``.
"""


@dataclass(frozen=True)
class MeasuredThreshold:
    """A threshold and the measured value."""

    threshold: Threshold
    value: float

    @property
    def holds(self) -> bool:
        return self.threshold.holds(self.value)


@dataclass(frozen=True)
class Bin:
    """Single effects with ``low <= z < high``: the shares that were found and named right."""

    low: float
    high: float
    found: Share
    named: Share


@dataclass(frozen=True)
class Score:
    """The score of some cases. Every threshold names a share or another measure.

    Attributes:
        name: name of the scenario, or of the method.
        cases: the cases with their diagnoses.
        aims: the thresholds that should hold.
        scenario: the scenario; None for several together.
    """

    name: str
    cases: Sequence[ScoredCase]
    aims: Sequence[Threshold] = ()
    scenario: Scenario | None = None

    @cached_property
    def shares(self) -> dict[str, Share]:
        """The measures of ``SHARES`` with their intervals."""
        return {
            name: share_of([case for case in self.cases if counts(case)], holds)
            for name, (counts, holds) in SHARES.items()
        }

    @cached_property
    def without(self) -> list[ScoredCase]:
        """The cases without hidden physics, or with an unusable simulation."""
        return [case for case in self.cases if not case.hides]

    @property
    def empty(self) -> int:
        """Number of recordings without hidden physics."""
        return len(self.without)

    @property
    def hidden(self) -> int:
        """Number of recordings with hidden physics."""
        return len(self.cases) - self.empty

    @property
    def empty_cases(self) -> int:
        """Number of diagnosed recordings without hidden physics."""
        return self.shares["false_alarms"].total

    @property
    def strong(self) -> int:
        """Number of strong effects."""
        return self.shares["named"].total

    @property
    def verdicts(self) -> dict[str, int]:
        """Verdicts and failures without hidden physics."""
        return verdicts(self.without)

    @property
    def reasons(self) -> dict[str, dict[str, int]]:
        """Verdicts on unusable simulations, by the reason why they are unusable."""
        whys = sorted({case.key.useless for case in self.without} - {""})
        return {why: verdicts([case for case in self.without if case.key.useless == why]) for why in whys}

    @property
    def alarms(self) -> dict[str, int]:
        """The effects that false alarms claim."""
        return dict(Counter(case.stated.claims[0].named.effect for case in self.without if case.stated.alarm))

    @property
    def failed(self) -> list[str]:
        """Names of the recordings without a diagnosis."""
        return [case.key.name for case in self.cases if case.stated.verdict == FAILED]

    @property
    def candidates(self) -> float:
        """Mean number of effects that a claim leaves open, of effects that the data can separate from rivals."""
        numbers = [1.0 + len(case.stated.claims[0].others) for case in self.cases if case.answered]
        return sum(numbers) / len(numbers) if numbers else math.nan

    @property
    def p_values(self) -> list[float]:
        """The p-values without hidden physics."""
        return [case.stated.p_value for case in self.without if case.stated.p_value is not None]

    @property
    def p_distance(self) -> float:
        """Kolmogorov's distance of the p-values from uniform."""
        return uniformity(self.p_values)[0]

    @property
    def p_uniform(self) -> float:
        """The p-value of that distance."""
        return uniformity(self.p_values)[1]

    @property
    def confusion(self) -> dict[str, dict[str, int]]:
        """The first names by hidden effect; cases with two effects are left out."""
        counts: dict[str, Counter[str]] = {}
        for case in self.cases:
            if case.key.kind != "double":
                counts.setdefault(case.hidden_name, Counter())[case.stated.name] += 1
        return {hidden: dict(counter) for hidden, counter in sorted(counts.items())}

    @property
    def coverage(self) -> Share:
        """Parameters that lie in their 90 % intervals, of effects with the right name and drivers."""
        shares = self.coverage_by_effect.values()
        return share(sum(s.count for s in shares), sum(s.total for s in shares))

    @property
    def coverage_by_effect(self) -> dict[str, Share]:
        """The same, by effect."""
        inside: dict[str, list[bool]] = {}
        for effect, hits in self._covered:
            inside.setdefault(effect, []).extend(hits or [])
        return {effect: share(sum(hits), len(hits)) for effect, hits in sorted(inside.items())}

    @property
    def parameters_missing(self) -> int:
        """Number of parameters without a counterpart of the same unit and shape in the diagnosis."""
        return sum(hits is None for _, hits in self._covered)

    @property
    def power_z(self) -> list[Bin]:
        """The shares over z."""
        return self._power(lambda truth: truth.z)

    @property
    def power_z_sep(self) -> list[Bin]:
        """The shares over z_sep."""
        return self._power(lambda truth: truth.z_sep)

    @property
    def ratios(self) -> list[float]:
        """Residuals on second recordings relative to the oracle's, of strong effects."""
        return [case.ratio for case in self.cases if case.strong and case.ratio is not None]

    @property
    def second_ratio(self) -> float:
        """Median of these ratios."""
        return float(torch.tensor(self.ratios, dtype=torch.float64).median()) if self.ratios else math.nan

    @property
    def doubles(self) -> dict[int, int]:
        """The cases with two effects by the number of effects named right."""
        counts = Counter(case.named_effects for case in self.cases if case.key.kind == "double")
        return {number: counts[number] for number in (0, 1, 2)}

    @cached_property
    def measured(self) -> tuple[MeasuredThreshold, ...]:
        """The aims with their measured values."""
        found = []
        for aim in self.aims:
            value = self.shares[aim.measure] if aim.measure in SHARES else getattr(self, aim.measure)
            found.append(MeasuredThreshold(aim, value.value if isinstance(value, Share) else float(value)))
        return tuple(found)

    def numbers(self) -> dict[str, Any]:
        """Return the score as JSON data; infinite and undefined numbers become null, as do aims not measured."""
        lists = {"cases", "without", "shares", "measured"}
        own = [name for name, kind in vars(Score).items() if isinstance(kind, property) and name not in lists]
        holds = {m.threshold.measure: None if math.isnan(m.value) else m.holds for m in self.measured}
        measures = self.shares | {name: getattr(self, name) for name in own}
        return {"name": self.name, "holds": holds, **plain_numbers(measures)}

    @cached_property
    def _covered(self) -> list[tuple[str, list[bool] | None]]:
        return [
            (case.truth.effect, covered(case.stated.claims[0], parameter))
            for case in self.cases
            if case.own_name and case.driver
            for parameter in case.truth.parameters
            if parameter.scored
        ]

    def _power(self, measure: Callable[[KeyEffect], float]) -> list[Bin]:
        bins = []
        for low, high in pairwise(BINS):
            part = [case for case in self.cases if case.single and low <= measure(case.truth) < high]
            found = share_of(part, lambda case: case.stated.found)
            bins.append(Bin(low, high, found, share_of(part, lambda case: case.named)))
        return bins


@dataclass(frozen=True)
class ProofScore:
    """The scores of the scenarios of a proof, and of all usable recordings together."""

    scenarios: tuple[Score, ...]
    total: Score
    cases: tuple[ScoredCase, ...]

    @property
    def rows(self) -> tuple[Score, ...]:
        """The scores of the scenarios, and their total if there are thresholds for it."""
        return (*self.scenarios, self.total) if self.total not in self.scenarios else self.scenarios

    @property
    def failed(self) -> list[str]:
        return [name for scenario in self.scenarios for name in scenario.failed]

    def numbers(self) -> dict[str, Any]:
        """Return the score as JSON data."""
        return {
            "scenarios": [scenario.numbers() for scenario in self.scenarios],
            "total": self.total.numbers(),
            "cases": [plain_numbers(case.numbers()) for case in self.cases],
        }


def score_proof(
    proof: Proof,
    keys: Sequence[Key],
    diagnoses: Mapping[str, Mapping[str, Any] | None],
    ratios: Mapping[str, float] | None = None,
) -> ProofScore:
    """Compare diagnoses with keys, scenario by scenario.

    Args:
        proof: the kind of proof; scenarios without a key are left out.
        keys: keys of all cases.
        diagnoses: contents of ``diagnosis.json`` by the recording's name; a missing name counts as failed.
        ratios: residuals of the corrected second recordings relative to the oracle's, by name.
    """
    cases = [scored(key, diagnoses.get(key.name), (ratios or {}).get(key.name)) for key in keys]
    groups = [(item, [case for case in cases if case.key.scenario == item.name]) for item in proof.scenarios]
    scores = tuple(Score(item.name, own, item.aims, item) for item, own in groups if own)
    if not proof.totals and scores:
        return ProofScore(scores, scores[0], tuple(cases))
    apart = {scenario.name for scenario in proof.scenarios if scenario.apart}
    useful = [case for case in cases if not case.key.useless and case.key.scenario not in apart]
    return ProofScore(scores, Score(TOTAL, useful, proof.totals), tuple(cases))


def verdicts(cases: Sequence[ScoredCase]) -> dict[str, int]:
    """Count the verdicts and failures."""
    return {verdict: sum(case.stated.verdict == verdict for case in cases) for verdict in VERDICTS}


def share_of(cases: Sequence[ScoredCase], holds: Condition) -> Share:
    """Return the share of cases for which a condition holds, with its interval."""
    return share(sum(holds(case) for case in cases), len(cases))


def plain_numbers(value: Any) -> Any:
    """Return the value as JSON data: lists for tuples, null for numbers that are not finite.

    Example:
        >>> plain_numbers({"a": (1.0, math.inf)})
        {'a': [1.0, None]}
    """
    if isinstance(value, (Share, Bin)):
        return plain_numbers(asdict(value))
    if isinstance(value, Mapping):
        return {str(name): plain_numbers(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_numbers(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
