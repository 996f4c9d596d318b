"""The verdict and all that follows from it: doubts, exit status, status of the headline, first advice.

Each is a pure function of the trail of decisions, so that two statements on a diagnosis never contradict each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

from mkc_torch.diagnosis.decisions import Decision, Trail
from mkc_torch.diagnosis.environment import GoodnessOfFit, Grade, Verdict
from mkc_torch.diagnosis.goodness_of_fit import pooled, poor_fits
from mkc_torch.diagnosis.result import Diagnosis, Stop
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.diagnosis.thresholds import LOST, MUCH_REJECTED
from mkc_torch.diagnosis.vetoes import grade, is_dropped
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise

Answer = Literal["usable", "look", "unusable"]
"""``usable``: the simulation can be used, corrected by the findings. ``look``: a person has to look at the doubts.
``unusable``: the simulation does not fit the recording.
"""

DiagnosisDoubt = Literal["unfit", "unexplained", "unconfirmed", "not_better", "much_rejected"]
"""``unfit``: the simulation does not fit the recording.
``unexplained``: structure remains that no finding explains, or the search was stopped; not where only a disturbance
remains and the open-loop residual is near the noise.
``unconfirmed``: every finding is unconfirmed.
``not_better``: the residual on held-out blocks is not smaller with the findings than without.
``much_rejected``: a third or more of the samples of an output were rejected.
"""

_REJECTED = 0.5
"""Weight below which a sample counts as rejected, as in the reports."""

UNFIT = "explained_share"
"""Rule that a simulation has to pass for any verdict but unfit."""

EACH_OUTPUT = "each_output"
"""Rule that a simulation without findings follows every output."""

EXPLAINS_MORE = "simulation_explains_more"
"""Rule that the simulation explains more of the outputs' variation than the correction by its findings."""

TOO_FEW = "enough_samples"
"""Rule that the samples suffice for a test."""

DISTURBED, DRIFTING = "disturbed_state", "drifting_output"
"""Rules that no disturbance acts on a rate, and that no slow error is in an output."""

ABOVE_DECLARED, ABOVE_SEEN = "above_declared_noise", "above_estimated_noise"
"""Rules that the open-loop residual is near the noise that is declared, or seen in the samples."""

_NOISE = {
    "declared": "declared noise of the sensor",
    "samples": "noise of its samples",
    "quantisation": "resolution of its samples",
}
"""What a residual is compared with, by the source of the noise floor."""

_RESERVATIONS: Mapping[str, DiagnosisDoubt] = {"smaller_residual": "not_better", "few_rejected": "much_rejected"}
"""Doubt of each rule that leaves the verdict unchanged."""

NAMED: tuple[Grade, ...] = ("left_out", "small")
"""Grades of findings that explain the residual."""


@dataclass(frozen=True)
class FitAssessment:
    """Goodness of fit without and with the findings, and the remaining noise.

    Attributes:
        follows: goodness of fit of the simulation without findings, by output.
        corrected: goodness of fit with the findings, by output.
        noise: the remaining noise of differential equations; None for other simulations.
        lost: True if no finding can make the fit good: the recorded rotations are wrong.
        column: the column whose other sign or unit explains more than any effect, in a sentence; empty if none does.
    """

    follows: tuple[GoodnessOfFit, ...]
    corrected: tuple[GoodnessOfFit, ...]
    noise: StateSpaceNoise | None
    lost: bool = False
    column: str = ""

    @property
    def explained(self) -> float | None:
        """The larger explained share of the variation, without or with the findings; None if unknown.

        An output that runs away counts against the others: an effect can tie one output to an input, and lose another.
        """
        shares = [pooled(fits, LOST) for fits in (self.follows, self.corrected) if fits]
        return max(shares, default=None)

    def unfit(self, settings: EvidenceSettings) -> bool:
        """Whether the simulation explains too little of the variation, both without and with its findings."""
        if self.lost or self.column:
            return True
        if not poor_fits(self.follows, settings.followed):
            return False
        return self.explained is None or self.explained < settings.useful

    def unfit_with(self, grades: Sequence[Grade], settings: EvidenceSettings) -> bool:
        """Whether findings of these grades leave differential equations unfit that are unfit without them.

        They make them usable if the first is named, since the others are built on it, and if every output then follows.
        """
        if self.noise is None or not replace(self, corrected=()).unfit(settings):
            return False
        return not any(found in NAMED for found in grades[:1]) or bool(poor_fits(self.corrected, settings.followed))


@dataclass(frozen=True)
class Remainder:
    """Structure that the findings leave.

    Attributes:
        structure: each kind of it in a sentence, such as a significant candidate or a smooth trend.
        lag: largest lag in samples at which the residual is correlated; 0 if it is white, or if the noise model
            includes its correlation.
        stop: why the search was stopped before its end.
        few: number of samples, and the number that a test needs, if these are too few; otherwise None.
    """

    structure: tuple[str, ...] = ()
    lag: float = 0.0
    stop: Stop | None = None
    few: tuple[int, int] | None = None


def decisions_on_all(
    known: FitAssessment, left: Remainder, settings: EvidenceSettings, *, findings: bool, flexible: bool
) -> tuple[Decision, ...]:
    """Return the decisions on the whole diagnosis that the verdict needs.

    Args:
        known: the assessed fits.
        left: the remaining structure.
        settings: thresholds.
        findings: whether there are findings.
        flexible: whether a finding has a form that can bend a wrong simulation near to any recording.
    """
    return tuple(_on_all(known, left, settings, findings=findings, flexible=flexible))


def _on_all(
    known: FitAssessment, left: Remainder, settings: EvidenceSettings, *, findings: bool, flexible: bool
) -> Iterator[Decision]:
    if left.few is not None:
        count, fewest = left.few
        text = f"{count} samples are too few for a test of missing physics; it needs {fewest}."
        yield _decision(TOO_FEW, count, fewest, passed=False, sentence=text)
    yield _explained_share(known, settings)
    if not findings:
        worst = min(known.follows, key=lambda fit: fit.explained, default=None)
        passed = not poor_fits(known.follows, settings.followed)
        text = (
            "No output has a goodness of fit."
            if worst is None
            else f"The simulation explains {_percent(worst.explained)} of the variation of `{worst.output}`, the least "
            "of all outputs."
        )
        value = None if worst is None else worst.explained
        yield _decision(EACH_OUTPUT, value, settings.followed, passed=passed, sentence=text)
    elif flexible and known.corrected:
        yield _explains_more(known, settings)
    text = f"The residual is correlated up to a lag of {left.lag:g} samples." if left.lag else "The residual is white."
    if known.noise is not None:
        text = "The noise model includes the residual's correlation."
    yield _decision("white_residual", left.lag, 0.0, passed=left.lag == 0, sentence=text)
    yield from _disturbed_states(known, findings=findings)
    text = " ".join(left.structure) or "The findings leave no structure."
    yield _decision("structure_left", len(left.structure), 0.0, passed=not left.structure, sentence=text)
    yield from _above_noise(known, settings, findings=findings)
    if left.stop is not None:
        text = "The search was stopped: the rest of it might have found more."
        yield _decision("stopped", left.stop.seconds, 0.0, passed=False, sentence=text)


def _explained_share(known: FitAssessment, settings: EvidenceSettings) -> Decision:
    share = known.explained
    if known.lost:
        text = "The recorded rotations are impossible, so no finding can make the fit good."
    elif known.column:
        text = known.column
    elif share is None:
        text = "No open-loop simulation with a finite trajectory is known."
    else:
        text = f"The simulation, with or without its findings, explains {_percent(share)} of the outputs' variation."
    return _decision(UNFIT, share, settings.useful, passed=not known.unfit(settings), sentence=text)


def _explains_more(known: FitAssessment, settings: EvidenceSettings) -> Decision:
    """Compare the correction with the simulation, by the explained shares of the variation, each 0 at least."""
    alone = pooled(known.follows)
    more = max(pooled(known.corrected) - alone, 0.0)
    ratio = more / alone if alone > 0.0 else math.inf
    text = f"The simulation explains {_percent(alone)}, the correction {_percent(more)}"
    passed = more <= settings.correction * alone
    end = " of the outputs' variation." if passed else ": check signs and units first."
    return _decision(EXPLAINS_MORE, ratio, settings.correction, passed=passed, sentence=text + end)


def _disturbed_states(known: FitAssessment, *, findings: bool) -> Iterator[Decision]:
    """Count the disturbances; with a finding, a sensor's own slow error counts as noise."""
    all_of_them = () if known.noise is None else known.noise.selected.disturbances
    rates = [disturbance.place for disturbance in all_of_them if disturbance.at_rate]
    drifting = [disturbance.place for disturbance in all_of_them if not disturbance.at_rate and not findings]
    kinds = ((DISTURBED, rates, "unrecorded disturbance acts on"), (DRIFTING, drifting, "unexplained drift is in"))
    for rule, places, what in kinds:
        names = ", ".join(dict.fromkeys(f"`{place}`" for place in places))
        text = f"An {what} {names}." if places else f"No {what} {'any rate' if rule == DISTURBED else 'any output'}."
        yield _decision(rule, len(places), 0.0, passed=not places, sentence=text)


def _above_noise(known: FitAssessment, settings: EvidenceSettings, *, findings: bool) -> Iterator[Decision]:
    """Compare the residuals with the outputs' noise: declared, and, for differential equations, seen in the samples.

    The noise seen in the samples is known less well. With a finding, a sensor's own slow error is noise too.
    """
    fits = known.corrected if findings else known.follows
    floors = [fit for fit in fits if math.isfinite(fit.noise_floor)]
    declared = [(fit, fit.noise_floor) for fit in floors if fit.floor_source == "declared"]
    yield from _worst(ABOVE_DECLARED, declared, settings.above_floor)
    if known.noise is not None:
        slow = [error for error in known.noise.selected.disturbances if findings and not error.at_rate]
        seen = [
            (fit, math.hypot(fit.seen_noise, *(error.size for error in slow if error.place == fit.output)))
            for fit in floors
            if fit.floor_source != "declared"
        ]
        yield from _worst(ABOVE_SEEN, seen, settings.far_above_floor)


def _worst(rule: str, noise: Sequence[tuple[GoodnessOfFit, float]], most: float) -> Iterator[Decision]:
    """Compare the largest ratio of a residual to its noise with the largest allowed."""
    ratios = [(fit.residual / size if size > 0.0 else math.inf, fit) for fit, size in noise]
    if ratios:
        ratio, worst = max(ratios, key=lambda pair: pair[0])
        text = f"The open-loop residual of `{worst.output}` is {ratio:.3g} times the {_NOISE[worst.floor_source]}."
        yield _decision(rule, ratio, most, passed=ratio <= most, sentence=text)


def reservations_of(diagnosis: Diagnosis) -> tuple[Decision, ...]:
    """Return the decisions that make a result doubtful whatever its verdict."""
    share = rejected_share(diagnosis)
    text = f"{_percent(share)} of the samples of an output were rejected."
    rejected = _decision("few_rejected", share, MUCH_REJECTED, passed=share < MUCH_REJECTED, sentence=text)
    if not any(finding.grade == "left_out" for finding in diagnosis.findings):
        return (rejected,)
    ratio = _residual_ratio(diagnosis)
    text = f"The residual on held-out blocks is {ratio:.3g} of that without the findings."
    if not math.isfinite(ratio):
        text = "The residual on held-out blocks is not known."
    better = not ratio >= 1.0
    return rejected, _decision("smaller_residual", ratio, 1.0, passed=better, sentence=text)


def rejected_share(diagnosis: Diagnosis) -> float:
    """Return the share of rejected samples of the output with the most."""
    weight = diagnosis.traces.weight
    return float((weight < _REJECTED).double().mean(0).max()) if weight.numel() else 0.0


def _residual_ratio(diagnosis: Diagnosis) -> float:
    """Return the smallest ratio of an output's residuals with and without the findings that count; NaN if unknown."""
    d = diagnosis
    before, after = d.baseline.outputs, d.corrected.outputs
    pairs = [(before[name].rmse, after[name].rmse) for name in before if name in after]
    pairs = pairs or [(d.baseline.rmse, d.corrected.rmse)]
    if any(not math.isfinite(before) for before, _ in pairs):
        return math.nan
    return min((after / before if before > 0.0 else math.inf for before, after in pairs), default=math.inf)


def grades_of(trail: Trail) -> tuple[Grade, ...]:
    """Return the grade of each finding, in their order, without those whose size is 0; none if the fit is poor."""
    if UNFIT in failed_rules(trail):
        return ()
    ordered = sorted((d for d in trail.decisions if d.finding > 0), key=lambda decision: decision.finding)
    groups = [list(group) for _, group in groupby(ordered, key=lambda decision: decision.finding)]
    return tuple(grade(group) for group in groups if not is_dropped(group))


def failed_rules(trail: Trail) -> dict[str, str]:
    """Return the sentence of each failed rule on the whole diagnosis, by its id."""
    return {d.rule: d.sentence for d in trail.decisions if not d.subject and d.finding == 0 and not d.passed}


def verdict_of(trail: Trail) -> Verdict:
    """Return the verdict.

    ``unfit``: the explained share is too small. ``unexplained``: another rule on the whole diagnosis fails, or a
    finding is not named. Otherwise ``explained`` with findings, and ``adequate`` without.

    Example:
        >>> verdict_of(Trail()), verdict_of(Trail((), (Decision("structure_left", "", 1.0, 0.0, False, ""),)))
        ('adequate', 'unexplained')
    """
    failed, grades = failed_rules(trail), grades_of(trail)
    if UNFIT in failed:
        return "unfit"
    if set(failed) - set(_RESERVATIONS) or any(found not in NAMED for found in grades):
        return "unexplained"
    return "explained" if grades else "adequate"


def doubted_signs(trail: Trail) -> str:
    """Return that the correction explains more than the simulation, if nothing else is unexplained; else empty."""
    failed = failed_rules(trail)
    alone = set(failed) - set(_RESERVATIONS) == {EXPLAINS_MORE}
    return failed[EXPLAINS_MORE] if alone and all(found in NAMED for found in grades_of(trail)) else ""


@dataclass(frozen=True)
class Conclusion:
    """What a diagnosis comes to.

    Attributes:
        verdict: of the diagnosis.
        grades: of the findings.
        doubts: reasons for doubt; empty for a result that can be used unseen.
        stopped: whether the search was stopped before its end.
        check: what to check before anything else; empty if there is nothing.
    """

    verdict: Verdict
    grades: tuple[Grade, ...]
    doubts: tuple[DiagnosisDoubt, ...]
    stopped: bool
    check: str

    @property
    def answer(self) -> Answer:
        """Whether the simulation can be used."""
        if self.verdict == "unfit":
            return "unusable"
        return "look" if self.doubts else "usable"

    @property
    def doubtful(self) -> bool:
        """Whether a command ends with the exit status of a doubtful result."""
        return self.answer != "usable"

    def first_advice(self, *, quick: bool = False, reasons: bool = False) -> str:
        """Return the first sentence of the advice; empty if it follows from the findings and the remaining structure.

        Args:
            quick: whether this is a quick look.
            reasons: whether reasons for a poor fit are known.
        """
        if self.stopped:
            return "Complete the search: these results are incomplete."
        if self.verdict == "unfit":
            known = "the reasons" if reasons else "signs, units, delays and start values"
            return f"Do not rely on this simulation yet: check {known}, then diagnose again."
        if self.check:
            return self.check
        if quick and self.grades:
            return "Confirm this by a full diagnosis."  # a quick look leaves tests out
        if self.verdict != "adequate":
            return ""
        if self.doubts:
            return "Find out why so many samples were rejected before the simulation is used."
        return "The simulation can be used within the range of this recording."


def conclude(
    verdict: Verdict, grades: Sequence[Grade], failed: Mapping[str, str], *, near_noise: bool = False
) -> Conclusion:
    """Return what follows from a verdict.

    Args:
        verdict: of the diagnosis.
        grades: of the findings.
        failed: the sentence of each failed rule on the whole diagnosis, by its id.
        near_noise: whether the open-loop residual is known to be near the noise of the samples.
    """
    left = set(failed) - set(_RESERVATIONS)
    named = bool(grades) and set(grades) <= set(NAMED)
    small = near_noise and left == ({DISTURBED} if named else {DRIFTING}) and (named or not grades)
    doubts: list[DiagnosisDoubt] = [verdict] if verdict in ("unfit", "unexplained") and not small else []
    if grades and all(found == "unconfirmed" for found in grades):
        doubts.append("unconfirmed")
    doubts += [doubt for rule, doubt in _RESERVATIONS.items() if rule in failed]
    check = failed.get(EXPLAINS_MORE, "") if verdict == "unexplained" else ""
    check = f"Record longer, or more runs: {failed[TOO_FEW]}" if TOO_FEW in failed else check
    return Conclusion(verdict, tuple(grades), tuple(doubts), "stopped" in failed, check)


def is_near_noise(trail: Trail) -> bool:
    """Whether the open-loop residual was compared with noise, and is near it."""
    compared = [decision.passed for decision in trail.decisions if decision.rule in (ABOVE_DECLARED, ABOVE_SEEN)]
    return bool(compared) and all(compared)


def conclusion_of(trail: Trail) -> Conclusion:
    """Return the conclusion of a trail.

    Example:
        >>> found = conclusion_of(Trail())
        >>> found.verdict, found.answer, found.doubtful
        ('adequate', 'usable', False)
    """
    return conclude(verdict_of(trail), grades_of(trail), failed_rules(trail), near_noise=is_near_noise(trail))


def conclusion(diagnosis: Diagnosis) -> Conclusion:
    """Return the conclusion of a diagnosis: that of its trail."""
    d = diagnosis
    failed = failed_rules(d.decisions) | failed_rules(Trail(decisions=reservations_of(d)))
    if d.stop is not None:
        failed["stopped"] = str(d.stop)
    grades = [finding.grade for finding in d.findings]
    return conclude(d.verdict, grades, failed, near_noise=is_near_noise(d.decisions))


def _decision(rule: str, value: float | None, threshold: float, *, passed: bool, sentence: str) -> Decision:
    known = float(value) if value is not None and math.isfinite(value) else None
    return Decision(rule, "", known, threshold, passed, sentence)


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"
