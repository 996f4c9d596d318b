"""The score of each world: what was said there against what the keys know, and which of its aims hold."""

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
    answer,
    named_right,
)

TOTAL = "all useful"
"""Name of the row of all worlds in which the simulation is of use, but for those that are counted apart."""

LEAST_PUSH = 2.0
"""From this share of the sensor's noise on, a push has to be seen and located."""


@dataclass(frozen=True)
class ScoredCase:
    """A case and what was said of it.

    ``state`` is the one that the diagnosis says is driven; ``sensor`` whether it says that a sensor errs slowly.
    """

    key: ScenarioKey
    said: StatedDiagnosis
    state: str | None
    sensor: bool = False

    @property
    def hides(self) -> bool:
        return bool(self.key.key.effects)

    @property
    def visible(self) -> bool:
        """An effect is hidden that the best test would see at ten standard deviations."""
        return self.hides and self.key.key.effects[0].z >= STRONG_Z

    @property
    def strong(self) -> bool:
        """One of the catalogue, told from its rivals as well as from nothing."""
        inside = self.key.key.kind == "single"
        return self.visible and inside and self.key.key.effects[0].z_sep >= STRONG_Z

    @property
    def pushed(self) -> bool:
        """Something pushes a state, or the sensor's offset wanders, beyond the noise."""
        return self.key.push is not None and self.key.push.over_noise > 0.0

    @property
    def named(self) -> bool:
        """The first claim is right."""
        return bool(self.said.claims) and self._right(self.said.claims[0].named)

    @property
    def wrong(self) -> bool:
        """The first claim has a name, and it is the wrong one."""
        return bool(self.said.claims) and self.said.claims[0].named.effect != UNKNOWN and not self.named

    @property
    def alone(self) -> bool:
        """The first claim has a name, beside which no other is possible, and which is not the hidden one's."""
        first = self.said.claims[0] if self.said.claims else None
        if first is None or first.others or first.named.effect == UNKNOWN:
            return False
        return not (self.hides and self.named)

    @property
    def undecided(self) -> bool:
        """It is said that it cannot be told: unexplained without a claim, or a claim with alternatives."""
        if self.said.claims:
            return bool(self.said.claims[0].others)
        return self.said.verdict == UNEXPLAINED

    @property
    def nearest(self) -> bool:
        """Nothing is claimed, but something is said to be the nearest in the catalogue."""
        return not self.said.claims and bool(self.said.nearest)

    @property
    def located(self) -> bool:
        return self.key.push is not None and self.state == self.key.push.at

    def _right(self, named: Any) -> bool:
        return named_right(named, self.key.key.effects[0])

    def numbers(self) -> dict[str, Any]:
        """One row of the result's list of cases."""
        effect = self.key.key.effects[0] if self.hides else None
        return {
            "name": self.key.name,
            "world": self.key.world,
            "index": self.key.index,
            "kind": self.key.key.kind,
            "hidden": effect.effect if effect else "",
            "z": effect.z if effect else None,
            "z_sep": effect.z_sep if effect else None,
            "push": asdict(self.key.push) if self.key.push else None,
            "useless": self.key.useless,
            "verdict": self.said.verdict,
            "driven": self.state,
            "sensor_errs": self.sensor,
            "findings": [{"effect": f.named.effect, "grade": f.grade} for f in self.said.findings],
        }


@dataclass(frozen=True)
class ScenarioScore:
    """One world. Shares are of recordings with nothing hidden, or of useless ones, but for those after ``hidden``.

    Attributes:
        name, sentence, right_to_say, wrong_to_say, apart: of the world.
        empty: how many of those there were.
        verdicts: what was said of them, and what failed.
        false_alarms: physics claimed to be missing, of those that were diagnosed.
        alarms: what was claimed.
        adequate, unfit: that verdict, of all.
        unexplained_located: that verdict at the pushed state, of those with a push of at least twice the noise.
        located: the pushed state, whatever the verdict, of the same.
        sensor_told: said that a sensor errs slowly, of those whose sensor does so by at least twice its white noise.
        alone: a name beside which no other is possible and which is not the hidden one's, of all, hidden or not.
        undecided: "it cannot be told", unexplained or with alternatives, of the same.
        useful_unfit: that verdict, of those of use with nothing hidden, or an effect at z of at least ten.
        reasons: of useless ones, why to what was said.
        hidden: how many recordings had something hidden, ``strong`` of them an effect of the catalogue with z and z_sep
            of at least ten.
        named: of the strong; ``named_pushed`` with a push beside it, ``named_quiet`` without.
        wrong: of the strong, those with a wrong name claimed first; ``nearest`` with nothing but a nearest name.
        outside_wrong: of the effects outside the catalogue at z of at least ten, those with a wrong name claimed;
            ``outside_nearest`` with nothing but a nearest name or none.
        failed: names of recordings without a diagnosis.
        measured: the aims.
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
    sensor_told: Share
    alone: Share
    undecided: Share
    useful_unfit: Share
    reasons: Mapping[str, Mapping[str, int]]
    hidden: int
    strong: int
    named: Share
    named_pushed: Share
    named_quiet: Share
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
    """All worlds, the row of all useful ones, and the cases."""

    worlds: tuple[ScenarioScore, ...]
    total: ScenarioScore
    cases: tuple[ScoredCase, ...]

    def numbers(self) -> dict[str, Any]:
        """As JSON has it; infinite and undefined numbers become null."""
        return plain_numbers(
            {
                "worlds": [_with_holds(world) for world in self.worlds],
                "total": _with_holds(self.total),
                "cases": [case.numbers() for case in self.cases],
            }
        )


def score_worlds(
    worlds: Scenarios, keys: Sequence[ScenarioKey], diagnoses: Mapping[str, Mapping[str, Any] | None]
) -> ScenariosScore:
    """Compare diagnoses with keys, world by world.

    Args:
        worlds: of the family; those without a key are left out.
        keys: of all cases.
        diagnoses: name of a recording to the content of its ``diagnosis.json``; a name that is missing failed.
    """
    told = [_told(key, diagnoses.get(key.name)) for key in keys]
    drawn = [world for world in worlds.worlds if any(case.key.world == world.name for case in told)]
    scores = tuple(
        replace(
            score_of(world.name, world.sentence, [case for case in told if case.key.world == world.name], world.aims),
            right_to_say=world.right_to_say,
            wrong_to_say=world.wrong_to_say,
            apart=world.apart,
        )
        for world in drawn
    )
    apart = {world.name for world in drawn if world.apart}
    useful = [case for case in told if not case.key.useless and case.key.world not in apart]
    total = score_of(
        TOTAL, "every world in which the simulation is of use, but for those counted apart", useful, worlds.totals
    )
    return ScenariosScore(scores, total, tuple(told))


def _told(key: ScenarioKey, diagnosis: Mapping[str, Any] | None) -> ScoredCase:
    return ScoredCase(key, answer(diagnosis), driven_state(diagnosis), sensor_errs(diagnosis))


def score_of(name: str, sentence: str, cases: Sequence[ScoredCase], asked: Sequence[Threshold]) -> ScenarioScore:
    """The score of some cases.

    A recording that was refused is no false alarm and leaves that share alone; every other share counts it.
    """
    empty, hidden = [case for case in cases if not case.hides], [case for case in cases if case.hides]
    strong = [case for case in hidden if case.strong]
    outside = [case for case in hidden if case.visible and case.key.key.kind == "outside"]
    pushed = [case for case in empty if _to_be_located(case)]
    useless = [case for case in empty if case.key.useless]
    useful = [case for case in cases if not case.key.useless and (case.visible or not case.hides)]
    diagnosed = [case for case in empty if case.said.verdict != FAILED]
    results: dict[str, Any] = {
        "empty": len(empty),
        "verdicts": _verdicts(empty),
        "false_alarms": share_of(diagnosed, lambda case: case.said.alarm),
        "alarms": dict(Counter(case.said.claims[0].named.effect for case in diagnosed if case.said.alarm)),
        "adequate": share_of(empty, lambda case: case.said.verdict == ADEQUATE),
        "unfit": share_of(empty, lambda case: case.said.verdict == UNFIT),
        "unexplained_located": share_of(pushed, lambda case: case.said.verdict == UNEXPLAINED and case.located),
        "located": share_of(pushed, lambda case: case.located),
        "sensor_told": share_of([case for case in empty if _sensor_to_be_told(case)], lambda case: case.sensor),
        "alone": share_of(
            [case for case in cases if case.said.verdict != FAILED and not case.key.useless], lambda case: case.alone
        ),
        "undecided": share_of([case for case in cases if not case.key.useless], lambda case: case.undecided),
        "useful_unfit": share_of(useful, lambda case: case.said.verdict == UNFIT),
        "reasons": {
            why: _verdicts([case for case in useless if case.key.useless == why])
            for why in sorted({case.key.useless for case in useless})
        },
        "hidden": len(hidden),
        "strong": len(strong),
        "named": share_of(strong, lambda case: case.named),
        "named_pushed": share_of([case for case in strong if case.pushed], lambda case: case.named),
        "named_quiet": share_of([case for case in strong if not case.pushed], lambda case: case.named),
        "wrong": share_of(strong, lambda case: case.wrong),
        "nearest": share_of(strong, lambda case: case.nearest),
        "outside_wrong": share_of(outside, lambda case: case.wrong),
        "outside_nearest": share_of(outside, lambda case: case.said.found and not case.wrong),
        "failed": tuple(case.key.name for case in cases if case.said.verdict == FAILED),
    }
    measured = tuple(MeasuredThreshold(threshold, _value(results[threshold.measure])) for threshold in asked)
    return ScenarioScore(name=name, sentence=sentence, **results, measured=measured)


def _to_be_located(case: ScoredCase) -> bool:
    """A state is pushed, and by enough; a sensor that is disturbed has none."""
    push = case.key.push
    return push is not None and push.at != "sensor" and push.over_noise >= LEAST_PUSH


def _sensor_to_be_told(case: ScoredCase) -> bool:
    push = case.key.push
    return push is not None and push.at == "sensor" and push.over_noise >= LEAST_PUSH


def _verdicts(cases: Sequence[ScoredCase]) -> dict[str, int]:
    return {verdict: sum(case.said.verdict == verdict for case in cases) for verdict in VERDICTS}


def _value(measured: Share | int) -> float:
    return measured.value if isinstance(measured, Share) else float(measured)


def _with_holds(world: ScenarioScore) -> dict[str, Any]:
    """With what holds of its aims, None for what could not be measured."""
    holds = {m.threshold.measure: None if math.isnan(m.value) else m.holds for m in world.measured}
    return asdict(world) | {"holds": holds}
