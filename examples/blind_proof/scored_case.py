"""A diagnosis compared with the key of its recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from examples.blind_proof.aims import INSEPARABLE_BELOW, STRONG_Z
from examples.blind_proof.key import Key, KeyEffect
from examples.blind_proof.statements import (
    FAILED,
    NOTHING,
    UNEXPLAINED,
    UNKNOWN,
    StatedCandidate,
    StatedDiagnosis,
    driven_state,
    driver_right,
    named_right,
    sensor_errs,
    stated_diagnosis,
)

LEAST_DISTURBANCE = 2.0
"""A disturbance of at least this multiple of the sensor's noise has to be found and located."""


@dataclass(frozen=True)
class ScoredCase:
    """A case and its diagnosis.

    Attributes:
        key: the key.
        stated: the statements of the diagnosis.
        state: the state that is reported as disturbed.
        sensor: whether a drift of a sensor is reported.
        ratio: residual on the second recording relative to the oracle's; None without a second recording.
    """

    key: Key
    stated: StatedDiagnosis
    state: str | None = None
    sensor: bool = False
    ratio: float | None = None

    @property
    def hides(self) -> bool:
        return bool(self.key.effects)

    @property
    def diagnosed(self) -> bool:
        return self.stated.verdict != FAILED

    @property
    def useful(self) -> bool:
        """Whether the simulation is usable."""
        return not self.key.useless

    @property
    def truth(self) -> KeyEffect:
        """The first hidden effect."""
        return self.key.effects[0]

    @property
    def single(self) -> bool:
        """Whether a single effect of the catalogue is hidden."""
        return self.key.kind == "single"

    @property
    def visible(self) -> bool:
        """Whether an effect is hidden that the best test detects at ten standard errors."""
        return self.hides and self.truth.z >= STRONG_Z

    @property
    def strong(self) -> bool:
        """Whether the hidden effect is of the catalogue, and z and z_sep are at least ten."""
        return self.single and self.visible and self.truth.z_sep >= STRONG_Z

    @property
    def disturbed(self) -> bool:
        """Whether a state is disturbed, or the sensor drifts, beyond the noise."""
        return self.key.disturbance is not None and self.key.disturbance.over_noise > 0.0

    @property
    def named(self) -> bool:
        """Whether the first claim has the right name."""
        return self.first(named_right)

    @property
    def own_name(self) -> bool:
        """Whether a single effect has its own name, not that of an inseparable rival."""
        return self.single and self.named and self.stated.claims[0].named.effect == self.truth.effect

    @property
    def driver(self) -> bool:
        """Whether the first claim has the right drivers."""
        return self.first(driver_right)

    @property
    def located(self) -> bool:
        """Whether the disturbed state is reported."""
        return self.key.disturbance is not None and self.state == self.key.disturbance.at

    @property
    def wrong(self) -> bool:
        """Whether the first claim has a wrong name."""
        return bool(self.stated.claims) and self.stated.claims[0].named.effect != UNKNOWN and not self.named

    @property
    def alone(self) -> bool:
        """Whether the first claim has a wrong name without alternatives."""
        return self.wrong and not self.stated.claims[0].others

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
    def outside(self) -> bool:
        """Whether a visible effect outside the catalogue is hidden."""
        return self.visible and self.key.kind == "outside"

    @property
    def answered(self) -> bool:
        """Whether something is claimed of a single effect that the data can distinguish from its rivals."""
        return self.single and self.truth.z_sep >= INSEPARABLE_BELOW and bool(self.stated.claims)

    @property
    def onset_error(self) -> float:
        """Error of the onset, s; infinite if the diagnosis reports none."""
        onset, truth = self.stated.claims[0].onset, self.truth.onset
        return math.inf if onset is None or truth is None else abs(onset - truth)

    @property
    def onset_covered(self) -> bool:
        """Whether the reported interval contains the onset."""
        span, onset = self.stated.claims[0].onset_interval, self.truth.onset
        return span is not None and onset is not None and span[0] <= onset <= span[1]

    def disturbs(self, *, sensor: bool) -> bool:
        """Whether nothing but a disturbance of a state, or a drift of a sensor, has to be reported."""
        disturbance = self.key.disturbance
        if self.hides or disturbance is None or disturbance.over_noise < LEAST_DISTURBANCE:
            return False
        return (disturbance.at == "sensor") is sensor

    @property
    def named_effects(self) -> int:
        """Number of the hidden effects that are named right, by a claim each."""
        left = [finding.named for finding in self.stated.claims]
        right = 0
        for truth in self.key.effects:
            match = next((k for k, named in enumerate(left) if named_right(named, truth)), None)
            if match is not None:
                left.pop(match)
                right += 1
        return right

    @property
    def hidden_name(self) -> str:
        """The hidden effect, as a row of the confusion matrix."""
        if not self.hides:
            return NOTHING
        return f"{self.truth.effect}, driver withheld" if self.truth.withheld else self.truth.effect

    def numbers(self) -> dict[str, Any]:
        """Return the case as a row of the result."""
        return {
            "name": self.key.name,
            "scenario": self.key.scenario,
            "index": self.key.index,
            "kind": self.key.kind,
            "hidden": self.truth.effect if self.hides else "",
            "z": self.truth.z if self.hides else None,
            "z_sep": self.truth.z_sep if self.hides else None,
            "disturbance": asdict(self.key.disturbance) if self.key.disturbance else None,
            "useless": self.key.useless,
            "verdict": self.stated.verdict,
            "driven": self.state,
            "sensor_errs": self.sensor,
            "findings": [{"effect": f.named.effect, "grade": f.grade} for f in self.stated.findings],
        }

    def first(self, right: Callable[[StatedCandidate, KeyEffect], bool]) -> bool:
        """Whether the first claim is right in the sense of a function of the claim and the truth."""
        return self.hides and bool(self.stated.claims) and right(self.stated.claims[0].named, self.truth)


def scored(key: Key, diagnosis: Mapping[str, Any] | None, ratio: float | None = None) -> ScoredCase:
    """Compare a diagnosis, the content of ``diagnosis.json`` or None, with its key."""
    return ScoredCase(key, stated_diagnosis(diagnosis), driven_state(diagnosis), sensor_errs(diagnosis), ratio)
