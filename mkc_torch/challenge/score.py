"""The score: diagnoses compared with keys."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, TypeVar

import torch

from mkc_torch.challenge.binomial import Share, share, uniformity
from mkc_torch.challenge.key import Key, KeyEffect
from mkc_torch.challenge.thresholds import INSEPARABLE_BELOW, STRONG_Z, THRESHOLDS, Threshold
from mkc_torch.challenge.verdict import (
    FAILED,
    NOTHING,
    VERDICTS,
    StatedDiagnosis,
    covered,
    driver_right,
    located_right,
    named_right,
    stated_diagnosis,
)

BINS = (0.0, 3.0, 5.0, 7.0, 10.0, 15.0, 30.0, math.inf)
"""Edges of the bins of z and z_sep."""

T = TypeVar("T")

ONSET_TOLERANCE = 1.0
"""Largest error of an onset that counts as right, s."""


@dataclass(frozen=True)
class Bin:
    """Single effects with ``low <= z < high``: the shares that were found and named right."""

    low: float
    high: float
    found: Share
    named: Share


@dataclass(frozen=True)
class MeasuredThreshold:
    """A threshold and the measured value."""

    threshold: Threshold
    value: float

    @property
    def holds(self) -> bool:
        return self.threshold.holds(self.value)


@dataclass(frozen=True)
class Score:
    """The result of a proof. Single effects with z and z_sep of at least ten are called strong.

    A false alarm is a claim of missing physics in an empty recording that was diagnosed. ``verdicts`` counts the
    verdicts and failures of all empty recordings.
    ``confusion`` counts hidden effects (an effect, ``nothing``, or an effect with its driver withheld) by the effect
    named first. ``located`` is the share of strong effects found at the right port. ``doubles`` counts how many of two
    hidden effects were named. ``ratios`` are residuals on second recordings relative to the oracle's.
    """

    false_alarms: Share
    verdicts: Mapping[str, int]
    p_values: tuple[float, ...]
    p_distance: float
    p_uniform: float
    confusion: Mapping[str, Mapping[str, int]]
    strong: int
    named: Share
    driver: Share
    located: Share
    withheld_named: Share
    extra: Share
    separable: Share
    candidates: float
    onset_errors: tuple[float, ...]
    onset_covered: Share
    coverage: Share
    coverage_by_effect: Mapping[str, Share]
    parameters_missing: int
    power_z: tuple[Bin, ...]
    power_z_sep: tuple[Bin, ...]
    ratios: tuple[float, ...]
    doubles: Mapping[int, int]
    failed: tuple[str, ...]
    measured: tuple[MeasuredThreshold, ...]

    def numbers(self) -> dict[str, Any]:
        """Return the score as JSON data; infinite and undefined numbers become null."""
        return plain_numbers(asdict(self) | {"holds": {m.threshold.measure: m.holds for m in self.measured}})


@dataclass(frozen=True)
class _Single:
    """A recording with one hidden effect of the catalogue, and its diagnosis."""

    truth: KeyEffect
    stated: StatedDiagnosis

    @property
    def strong(self) -> bool:
        return min(self.truth.z, self.truth.z_sep) >= STRONG_Z

    @property
    def named(self) -> bool:
        return bool(self.stated.claims) and named_right(self.stated.claims[0].named, self.truth)

    @property
    def driver(self) -> bool:
        return bool(self.stated.claims) and driver_right(self.stated.claims[0].named, self.truth)

    @property
    def located(self) -> bool:
        return bool(self.stated.claims) and located_right(self.stated.claims[0].named, self.truth)


def score(
    keys: Sequence[Key],
    diagnoses: Mapping[str, Mapping[str, Any] | None],
    ratios: Mapping[str, float] | None = None,
    thresholds: Sequence[Threshold] = THRESHOLDS,
) -> Score:
    """Compare diagnoses with keys.

    Args:
        keys: keys of all cases.
        diagnoses: contents of ``diagnosis.json`` by the recording's name; a missing name counts as failed.
        ratios: residuals of the corrected second recordings relative to the oracle's, by name.
        thresholds: thresholds of the proof.
    """
    stated = {key.name: stated_diagnosis(diagnoses.get(key.name)) for key in keys}
    singles = [_Single(key.effects[0], stated[key.name]) for key in keys if key.kind == "single"]
    strong = [case for case in singles if case.strong]
    empty = [stated[key.name] for key in keys if key.kind == "empty"]
    p_values = tuple(a.p_value for a in empty if a.p_value is not None)
    distance, p_uniform = uniformity(p_values)
    separable = [case for case in singles if case.truth.z_sep >= INSEPARABLE_BELOW and case.stated.claims]
    by_effect, missing = coverage(singles)
    strong_names = {k.name for k in keys if k.kind == "single" and min(k.effects[0].z, k.effects[0].z_sep) >= STRONG_Z}
    results: dict[str, Any] = {
        "false_alarms": share_of([a for a in empty if a.verdict != FAILED], lambda a: a.alarm),
        "verdicts": {verdict: sum(a.verdict == verdict for a in empty) for verdict in VERDICTS},
        "p_values": p_values,
        "p_distance": distance,
        "p_uniform": p_uniform,
        "confusion": confusion(keys, stated),
        "strong": len(strong),
        "named": share_of(strong, lambda case: case.named),
        "driver": share_of([case for case in strong if not case.truth.at], lambda case: case.driver),
        "located": share_of([case for case in strong if case.truth.at], lambda case: case.located),
        "withheld_named": share_of([case for case in strong if case.truth.withheld], lambda case: case.named),
        "extra": share_of(strong, lambda case: len(case.stated.claims) > 1),
        "separable": share_of(separable, lambda case: not case.stated.claims[0].others),
        "candidates": _mean([1.0 + len(case.stated.claims[0].others) for case in separable]),
        "onset_errors": onset_errors(strong),
        "onset_covered": onset_covered(singles),
        "coverage": share(sum(s.count for s in by_effect.values()), sum(s.total for s in by_effect.values())),
        "coverage_by_effect": by_effect,
        "parameters_missing": missing,
        "power_z": power(singles, lambda truth: truth.z),
        "power_z_sep": power(singles, lambda truth: truth.z_sep),
        "ratios": tuple(ratio for name, ratio in (ratios or {}).items() if name in strong_names),
        "doubles": doubles(keys, stated),
        "failed": tuple(name for name, a in stated.items() if a.verdict == FAILED),
    }
    return Score(**results, measured=_measured(results, thresholds))


def confusion(keys: Sequence[Key], stated: Mapping[str, StatedDiagnosis]) -> dict[str, dict[str, int]]:
    """Count the first names by hidden effect; cases with two effects are left out."""
    counts: dict[str, Counter[str]] = {}
    for key in keys:
        if key.kind != "double":
            counts.setdefault(hidden_name(key), Counter())[stated[key.name].name] += 1
    return {hidden: dict(counter) for hidden, counter in sorted(counts.items())}


def hidden_name(key: Key) -> str:
    """Return the row of a case in the confusion matrix."""
    if not key.effects:
        return NOTHING
    effect = key.effects[0]
    return f"{effect.effect}, driver withheld" if effect.withheld else effect.effect


def onset_errors(cases: Sequence[_Single]) -> tuple[float, ...]:
    """Return the onset errors of named steps, s; infinite if no onset was reported."""
    errors = []
    for case in cases:
        truth, findings = case.truth, case.stated.claims
        if truth.effect == "hard_iron_step" and findings and findings[0].named.effect == truth.effect:
            onset = findings[0].onset
            errors.append(math.inf if onset is None or truth.onset is None else abs(onset - truth.onset))
    return tuple(errors)


def onset_covered(cases: Sequence[_Single]) -> Share:
    """Return the share of named steps whose onset lies in the reported interval."""
    onsets = [
        (case.truth.onset, case.stated.claims[0].onset_interval)
        for case in cases
        if case.named and case.stated.claims[0].named.effect == case.truth.effect and case.truth.onset is not None
    ]
    inside = [
        onset is not None and interval is not None and interval[0] <= onset <= interval[1] for onset, interval in onsets
    ]
    return share(sum(inside), len(inside))


def coverage(cases: Sequence[_Single]) -> tuple[dict[str, Share], int]:
    """Return the coverage of intervals by effect, for right names, and the number of missing parameters."""
    inside: dict[str, list[bool]] = {}
    missing = 0
    for case in cases:
        if not (case.named and case.driver) or case.stated.claims[0].named.effect != case.truth.effect:
            continue
        for parameter in case.truth.parameters:
            if not parameter.scored:
                continue
            found = covered(case.stated.claims[0], parameter)
            missing += found is None
            inside.setdefault(case.truth.effect, []).extend(found or [])
    return {effect: share(sum(hits), len(hits)) for effect, hits in sorted(inside.items())}, missing


def power(cases: Sequence[_Single], measure: Callable[[KeyEffect], float]) -> tuple[Bin, ...]:
    """Return the shares found and named right, in bins of z or z_sep."""
    bins = []
    for low, high in pairwise(BINS):
        part = [case for case in cases if low <= measure(case.truth) < high]
        found = share_of(part, lambda case: case.stated.found)
        bins.append(Bin(low, high, found, share_of(part, lambda case: case.named)))
    return tuple(bins)


def doubles(keys: Sequence[Key], stated: Mapping[str, StatedDiagnosis]) -> dict[int, int]:
    """Count the cases with two effects by the number of effects named right."""
    counts = {0: 0, 1: 0, 2: 0}
    for key in keys:
        if key.kind == "double":
            left = [finding.named for finding in stated[key.name].claims]
            right = 0
            for truth in key.effects:
                match = next((k for k, named in enumerate(left) if named_right(named, truth)), None)
                if match is not None:
                    left.pop(match)
                    right += 1
            counts[right] += 1
    return counts


def _measured(results: Mapping[str, Any], thresholds: Sequence[Threshold]) -> tuple[MeasuredThreshold, ...]:
    onsets, ratios = results["onset_errors"], results["ratios"]
    values = {
        "empty_cases": float(results["false_alarms"].total),
        "false_alarms": results["false_alarms"].value,
        "p_uniform": results["p_uniform"],
        "strong_cases": float(results["strong"]),
        "named_right": results["named"].value,
        "driver_right": results["driver"].value,
        "located_right": results["located"].value,
        "separable_share": results["separable"].value,
        "candidates_named": results["candidates"],
        "step_within": _mean([float(error <= ONSET_TOLERANCE) for error in onsets]),
        "coverage": results["coverage"].value,
        "second_ratio": float(torch.tensor(ratios, dtype=torch.float64).median()) if ratios else math.nan,
    }
    return tuple(MeasuredThreshold(threshold, values[threshold.measure]) for threshold in thresholds)


def share_of(cases: Sequence[T], holds: Callable[[T], bool]) -> Share:
    """Return the share of cases for which a condition holds, with its interval.

    Example:
        >>> share_of([1, 2, 3], lambda number: number > 2).count
        1
    """
    return share(sum(bool(holds(case)) for case in cases), len(cases))


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def plain_numbers(value: Any) -> Any:
    """Return the value as JSON data: lists for tuples, null for numbers that are not finite.

    Example:
        >>> plain_numbers({"a": (1.0, math.inf)})
        {'a': [1.0, None]}
    """
    if isinstance(value, Mapping):
        return {str(name): plain_numbers(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_numbers(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
