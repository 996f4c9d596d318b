"""Warnings of a diagnosis about the results of the tests of evidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from mkc_torch.diagnosis.evidence.base import EvidenceContext
from mkc_torch.diagnosis.evidence.residual_noise import RejectedByFit
from mkc_torch.diagnosis.evidence.run import EvidenceReport
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import DensityCheck, DriverShift, Extrapolation, SmoothCorrection
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.recording.disturbance import RejectedInterval

_MOST_LISTED = 3
"""Largest number of intervals that are listed, the longest."""


def evidence_warnings(answers: EvidenceReport) -> tuple[str, ...]:
    """Return the warnings of all tests, in the order of the tests."""
    found: list[str] = []
    for number, result in answers.results:
        words = _WARNINGS.get(result.test)
        if words is not None and result.value is not None:
            found += words(result.value, replace(answers.case, number=number or 0))
    return tuple(found)


def called(term: Term) -> str:
    """Return the name of a candidate in a sentence."""
    if term.effect.unrecorded:
        return "an unrecorded cause"
    along = "a curve along" if term.effect.is_curve else f"{term.effect.id} by"
    if term.columns:
        return f"{along} {', '.join(term.columns)}"
    return "an unnamed curve" if term.effect.is_curve else term.effect.id


def localised_warnings(stretch: tuple[float, float], candidate: Term) -> tuple[str, ...]:
    """Return the warning of a candidate that fits in one interval only."""
    begin, end = stretch
    return (
        f"From {begin:.1f} to {end:.1f} s the residual fits {called(candidate)}, but hardly elsewhere. Other intervals "
        "misfit too and no effect explains them, so this interval counts as a burst of outliers. Record again, for "
        "longer.",
    )


def rejected_warnings(intervals: Sequence[RejectedInterval]) -> tuple[str, ...]:
    """Return a warning with the longest intervals of rejected samples; empty if there are none."""
    found = sorted(intervals, key=_length, reverse=True)
    if not found:
        return ()
    times = [f"from {interval.start:.1f} to {interval.end:.1f} s" for interval in sorted(found[:_MOST_LISTED])]
    if len(found) > _MOST_LISTED:
        more = len(found) - _MOST_LISTED
        times.append(f"in {more} shorter interval{'' if more == 1 else 's'}")
    where = " and ".join([", ".join(times[:-1]), times[-1]] if times[1:] else times)
    return (
        f"Most samples were rejected {where}. No effect explains them. They may be a disturbance of the measurement, "
        "such as a passing object, or physics that the catalogue lacks.",
    )


def _length(interval: RejectedInterval) -> float:
    return interval.end - interval.start


def remaining_warnings(columns: Sequence[str]) -> tuple[str, ...]:
    """Return the warning of a smooth trend.

    Example:
        >>> remaining_warnings(["temperature"])
        ('The residual has a smooth trend along temperature that no effect of the catalogue explains: ...',)
        >>> remaining_warnings([])
        ()
    """
    if not columns:
        return ()
    return (
        f"The residual has a smooth trend along {', '.join(columns)} that no effect of the catalogue explains: a "
        "smooth correction by recorded columns is clearly better on held-out blocks.",
    )


def proxy_driver_warnings(columns: Sequence[str]) -> tuple[str, ...]:
    """Return the warning of a column that may be a proxy of an unrecorded cause."""
    name = ", ".join(columns)
    return (
        f"With {name} as driver, the offset still drifts along the same direction: {name} may be a proxy of an "
        "unrecorded cause. Find the cause and record it.",
    )


def driver_shift_warnings(shift: DriverShift, term: Term, settings: EvidenceSettings) -> tuple[str, ...]:
    """Return the warning of a driver of which many shifted copies gain as much."""
    if shift.as_good <= settings.shift_many * shift.copies:
        return ()
    return (
        f"{shift.as_good} of {shift.copies} copies of {', '.join(term.columns)}, shifted by up to {shift.reach:.3g} s, "
        f"gain as much for {term.effect.id} as the column itself: its timing does not distinguish it from other "
        "quantities that change as slowly.",
    )


def extrapolation_warnings(extrapolation: Extrapolation, term: Term, settings: EvidenceSettings) -> tuple[str, ...]:
    """Return the warning of an effect that makes the prediction worse at high values of its driver."""
    if extrapolation.confidence_interval[1] >= 0.0:
        return ()
    return (
        f"{term.effect.id} does not extrapolate: fitted to the {100.0 * settings.low_share:.0f} % of samples where "
        f"{', '.join(term.columns)} is lowest, it predicts the others worse than the model without it. Do not use it "
        "beyond the range recorded.",
    )


def density_warnings(checks: Sequence[DensityCheck]) -> tuple[str, ...]:
    """Return a warning for channels whose residuals a Student-t describes clearly better than the density.

    Outliers that neither describes cause no warning.

    Example:
        >>> density_warnings([DensityCheck("norm", 0.12, 0.01, 2.0, 0.05, True)])[0].partition(":")[0]
        'The density does not describe the residuals of norm'
    """
    misfit = [check for check in checks if check.closer]
    if not misfit:
        return ()
    worst = max(misfit, key=lambda check: check.distance)
    return (
        f"The density does not describe the residuals of {', '.join(check.channel for check in misfit)}: its "
        f"Kolmogorov distance is {worst.distance:.2g}, that of a Student-t with {worst.degrees_of_freedom:g} degrees "
        f"of freedom {worst.student_distance:.2g}. A misfit of the tail is not evidence of physics.",
    )


def _localised(stretch: tuple[float, float], case: EvidenceContext) -> tuple[str, ...]:
    return () if case.first is None else localised_warnings(stretch, case.first.term)


def _rejected(rejected: RejectedByFit, _: EvidenceContext) -> tuple[str, ...]:
    return rejected_warnings(rejected.final)


def _remaining(smooth: SmoothCorrection, _: EvidenceContext) -> tuple[str, ...]:
    return remaining_warnings(smooth.columns)


def _proxy_driver(is_proxy: bool, case: EvidenceContext) -> tuple[str, ...]:
    return proxy_driver_warnings(case.fit.model.terms[-1].columns) if is_proxy else ()


def _driver_shift(shift: DriverShift, case: EvidenceContext) -> tuple[str, ...]:
    return driver_shift_warnings(shift, case.term, case.settings.evidence)


def _extrapolation(extrapolation: Extrapolation, case: EvidenceContext) -> tuple[str, ...]:
    return extrapolation_warnings(extrapolation, case.term, case.settings.evidence)


def _density(checks: Sequence[DensityCheck], _: EvidenceContext) -> tuple[str, ...]:
    return density_warnings(checks)


_WARNINGS: Mapping[str, Callable[..., tuple[str, ...]]] = MappingProxyType(
    {
        "one_stretch": _localised,
        "rejected": _rejected,
        "remaining": _remaining,
        "stand_in": _proxy_driver,
        "driver_shift": _driver_shift,
        "extrapolation": _extrapolation,
        "density": _density,
    }
)
"""By the id of the test."""
