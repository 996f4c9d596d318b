"""The score of each scenario: diagnoses compared with keys, and the aims that hold."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from mkc_torch.challenge.binomial import Share
from mkc_torch.challenge.scenario import ScenarioKey, Scenarios
from mkc_torch.challenge.scenarios.reader import driven_state, sensor_errs
from mkc_torch.challenge.score import MeasuredThreshold, plain_numbers, share_of
from mkc_torch.challenge.thresholds import STRONG_Z, Threshold
from mkc_torch.challenge.verdict import (
    ADEQUATE,
    FAILED,
    UNEXPLAINED,
    UNFIT,
    UNKNOWN,
    VERDICTS,
    StatedDiagnosis,
    named_right,
    stated_diagnosis,
)

TOTAL = "all useful"
"""Name of the row of all scenarios with usable simulations, without those counted apart."""

LEAST_DISTURBANCE = 2.0
"""A disturbance of at least this multiple of the sensor's noise has to be found and located."""


@dataclass(frozen=True)
class ScoredCase:
    """A case and its diagnosis.

    ``state`` is the state reported as disturbed; ``sensor`` whether a drift of a sensor is reported.
    """

    key: ScenarioKey
    stated: StatedDiagnosis
    state: str | None
    sensor: bool = False

    @property
    def hides(self) -> bool:
        return bool(self.key.key.effects)

    @property
    def visible(self) -> bool:
        """Whether an effect is hidden that the best test detects at ten standard errors."""
        return self.hides and self.key.key.effects[0].z >= STRONG_Z

    @property
    def strong(self) -> bool:
        """Whether the hidden effect is of the catalogue, and z and z_sep are at least ten."""
        inside = self.key.key.kind == "single"
        return self.visible and inside and self.key.key.effects[0].z_sep >= STRONG_Z

    @property
    def disturbed(self) -> bool:
        """Whether a state is disturbed, or the sensor drifts, beyond the noise."""
        return self.key.disturbance is not None and self.key.disturbance.over_noise > 0.0

    @property
    def named(self) -> bool:
        """Whether the first claim is right."""
        return bool(self.stated.claims) and self._right(self.stated.claims[0].named)

    @property
    def wrong(self) -> bool:
        """Whether the first claim has a wrong name."""
        return bool(self.stated.claims) and self.stated.claims[0].named.effect != UNKNOWN and not self.named

    @property
    def alone(self) -> bool:
        """Whether the first claim has a wrong name without alternatives."""
        first = self.stated.claims[0] if self.stated.claims else None
        if first is None or first.others or first.named.effect == UNKNOWN:
            return False
        return not (self.hides and self.named)

    @property
    def undecided(self) -> bool:
        """Whether the diagnosis is undecided: unexplained without a claim, or a claim with alternatives."""
        if self.stated.claims:
            return bool(self.stated.claims[0].others)
        return self.stated.verdict == UNEXPLAINED

    @property
    def nearest(self) -> bool:
        """Whether nothing is claimed, but a nearest effect of the catalogue is reported."""
        return not self.stated.claims and bool(self.stated.nearest)

    @property
    def located(self) -> bool:
        return self.key.disturbance is not None and self.state == self.key.disturbance.at

    def _right(self, named: Any) -> bool:
        return named_right(named, self.key.key.effects[0])

    def numbers(self) -> dict[str, Any]:
        """Return the case as a row of the result."""
        effect = self.key.key.effects[0] if self.hides else None
        return {
            "name": self.key.name,
            "scenario": self.key.scenario,
            "index": self.key.index,
            "kind": self.key.key.kind,
            "hidden": effect.effect if effect else "",
            "z": effect.z if effect else None,
            "z_sep": effect.z_sep if effect else None,
            "disturbance": asdict(self.key.disturbance) if self.key.disturbance else None,
            "useless": self.key.useless,
            "verdict": self.stated.verdict,
            "driven": self.state,
            "sensor_errs": self.sensor,
            "findings": [{"effect": f.named.effect, "grade": f.grade} for f in self.stated.findings],
        }


@dataclass(frozen=True)
class ScenarioScore:
    """The score of a scenario. Shares before ``hidden`` are of recordings without hidden physics or usable simulation.

    Attributes:
        name, sentence, right_to_say, wrong_to_say, apart: those of the scenario.
        empty: number of recordings without hidden physics.
        verdicts: their verdicts and failures.
        false_alarms: share with claims of missing physics, of the diagnosed recordings.
        alarms: the claimed effects.
        adequate, unfit: shares of these verdicts.
        unexplained_located: share of ``unexplained`` at the disturbed state, of recordings with a disturbance of at
            least twice the noise.
        located: share of the right state with any verdict, of the same recordings.
        sensor_reported: share of reported drifts, of recordings whose sensor drifts by at least twice its white noise.
        alone: share of a wrong name without alternatives, of all recordings.
        undecided: share of ``unexplained`` or of names with alternatives, of all recordings.
        useful_unfit: share of ``unfit``, of usable simulations without hidden physics, or with z of at least ten.
        reasons: verdicts of unusable simulations, by the reason why they are unusable.
        hidden: number of recordings with hidden physics; ``strong`` of them have an effect of the catalogue with z and
            z_sep of at least ten.
        named: share of right names of the strong; ``named_disturbed`` with, ``named_undisturbed`` without disturbance.
        wrong: share of a wrong first name of the strong; ``nearest`` share with only a nearest name.
        outside_wrong: share of a wrong name, of effects outside the catalogue with z of at least ten;
            ``outside_nearest`` share with only a nearest name or none.
        failed: names of recordings without a diagnosis.
        measured: the aims with their measured values.
    """

    name: str
    sentence: str
    empty: int
    verdicts: Mapping[str, int]
    false_alarms: Share
    alarms: Mapping[str, int]
    adequate: Share
    unfit: Share
    unexplained_located: Share
    located: Share
    sensor_reported: Share
    alone: Share
    undecided: Share
    useful_unfit: Share
    reasons: Mapping[str, Mapping[str, int]]
    hidden: int
    strong: int
    named: Share
    named_disturbed: Share
    named_undisturbed: Share
    wrong: Share
    nearest: Share
    outside_wrong: Share
    outside_nearest: Share
    failed: tuple[str, ...]
    measured: tuple[MeasuredThreshold, ...]
    right_to_say: str = ""
    wrong_to_say: str = ""
    apart: bool = False


@dataclass(frozen=True)
class ScenariosScore:
    """The scores of all scenarios, their total, and the cases."""

    scenarios: tuple[ScenarioScore, ...]
    total: ScenarioScore
    cases: tuple[ScoredCase, ...]

    def numbers(self) -> dict[str, Any]:
        """Return the score as JSON data; infinite and undefined numbers become null."""
        return plain_numbers(
            {
                "scenarios": [_with_holds(scenario) for scenario in self.scenarios],
                "total": _with_holds(self.total),
                "cases": [case.numbers() for case in self.cases],
            }
        )


def score_scenarios(
    scenarios: Scenarios, keys: Sequence[ScenarioKey], diagnoses: Mapping[str, Mapping[str, Any] | None]
) -> ScenariosScore:
    """Compare diagnoses with keys, scenario by scenario.

    Args:
        scenarios: those of the family; scenarios without a key are left out.
        keys: keys of all cases.
        diagnoses: contents of ``diagnosis.json`` by the recording's name; a missing name counts as failed.
    """
    cases = [_scored(key, diagnoses.get(key.name)) for key in keys]
    drawn = [scenario for scenario in scenarios.scenarios if any(case.key.scenario == scenario.name for case in cases)]
    scores = tuple(
        replace(
            score_of(
                scenario.name,
                scenario.sentence,
                [case for case in cases if case.key.scenario == scenario.name],
                scenario.aims,
            ),
            right_to_say=scenario.right_to_say,
            wrong_to_say=scenario.wrong_to_say,
            apart=scenario.apart,
        )
        for scenario in drawn
    )
    apart = {scenario.name for scenario in drawn if scenario.apart}
    useful = [case for case in cases if not case.key.useless and case.key.scenario not in apart]
    total = score_of(
        TOTAL, "all scenarios with usable simulations, without those counted apart", useful, scenarios.totals
    )
    return ScenariosScore(scores, total, tuple(cases))


def _scored(key: ScenarioKey, diagnosis: Mapping[str, Any] | None) -> ScoredCase:
    return ScoredCase(key, stated_diagnosis(diagnosis), driven_state(diagnosis), sensor_errs(diagnosis))


def score_of(name: str, sentence: str, cases: Sequence[ScoredCase], asked: Sequence[Threshold]) -> ScenarioScore:
    """Return the score of some cases.

    A refused recording is not counted among the false alarms or their total; all other shares count it.
    """
    empty, hidden = [case for case in cases if not case.hides], [case for case in cases if case.hides]
    strong = [case for case in hidden if case.strong]
    outside = [case for case in hidden if case.visible and case.key.key.kind == "outside"]
    disturbed = [case for case in empty if _to_be_located(case)]
    useless = [case for case in empty if case.key.useless]
    useful = [case for case in cases if not case.key.useless and (case.visible or not case.hides)]
    diagnosed = [case for case in empty if case.stated.verdict != FAILED]
    results: dict[str, Any] = {
        "empty": len(empty),
        "verdicts": _verdicts(empty),
        "false_alarms": share_of(diagnosed, lambda case: case.stated.alarm),
        "alarms": dict(Counter(case.stated.claims[0].named.effect for case in diagnosed if case.stated.alarm)),
        "adequate": share_of(empty, lambda case: case.stated.verdict == ADEQUATE),
        "unfit": share_of(empty, lambda case: case.stated.verdict == UNFIT),
        "unexplained_located": share_of(disturbed, lambda case: case.stated.verdict == UNEXPLAINED and case.located),
        "located": share_of(disturbed, lambda case: case.located),
        "sensor_reported": share_of([case for case in empty if _drift_to_be_reported(case)], lambda case: case.sensor),
        "alone": share_of(
            [case for case in cases if case.stated.verdict != FAILED and not case.key.useless], lambda case: case.alone
        ),
        "undecided": share_of([case for case in cases if not case.key.useless], lambda case: case.undecided),
        "useful_unfit": share_of(useful, lambda case: case.stated.verdict == UNFIT),
        "reasons": {
            why: _verdicts([case for case in useless if case.key.useless == why])
            for why in sorted({case.key.useless for case in useless})
        },
        "hidden": len(hidden),
        "strong": len(strong),
        "named": share_of(strong, lambda case: case.named),
        "named_disturbed": share_of([case for case in strong if case.disturbed], lambda case: case.named),
        "named_undisturbed": share_of([case for case in strong if not case.disturbed], lambda case: case.named),
        "wrong": share_of(strong, lambda case: case.wrong),
        "nearest": share_of(strong, lambda case: case.nearest),
        "outside_wrong": share_of(outside, lambda case: case.wrong),
        "outside_nearest": share_of(outside, lambda case: case.stated.found and not case.wrong),
        "failed": tuple(case.key.name for case in cases if case.stated.verdict == FAILED),
    }
    measured = tuple(MeasuredThreshold(threshold, _value(results[threshold.measure])) for threshold in asked)
    return ScenarioScore(name=name, sentence=sentence, **results, measured=measured)


def _to_be_located(case: ScoredCase) -> bool:
    """Whether a state is disturbed enough to be located; a drift of a sensor has no state."""
    disturbance = case.key.disturbance
    return disturbance is not None and disturbance.at != "sensor" and disturbance.over_noise >= LEAST_DISTURBANCE


def _drift_to_be_reported(case: ScoredCase) -> bool:
    disturbance = case.key.disturbance
    return disturbance is not None and disturbance.at == "sensor" and disturbance.over_noise >= LEAST_DISTURBANCE


def _verdicts(cases: Sequence[ScoredCase]) -> dict[str, int]:
    return {verdict: sum(case.stated.verdict == verdict for case in cases) for verdict in VERDICTS}


def _value(measured: Share | int) -> float:
    return measured.value if isinstance(measured, Share) else float(measured)


def _with_holds(scenario: ScenarioScore) -> dict[str, Any]:
    """Return the score with the aims that hold; None for an aim that could not be measured."""
    holds = {m.threshold.measure: None if math.isnan(m.value) else m.holds for m in scenario.measured}
    return asdict(scenario) | {"holds": holds}
