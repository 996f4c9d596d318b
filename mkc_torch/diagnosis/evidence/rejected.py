"""Evidence of few samples: rejected stretches, and effects whose evidence lies in one short stretch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.recording.disturbance import RejectedInterval, disturbed_intervals

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "RejectedByFit",
    "called",
    "localised_evidence",
    "rejected_evidence",
    "rejected_intervals",
    "rejected_warning",
]


def localised_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return a warning with the interval."""
    located, time = case.first, case.prepared.time
    if located is None or located.stretch is None:
        return EvidenceResult("one_stretch")
    begin, end = (float(time[n]) for n in (located.stretch[0], located.stretch[1] - 1))
    sentence = (
        f"From {begin:.1f} to {end:.1f} s the residual fits {called(located.term)}, but hardly elsewhere. Other "
        f"intervals "
        "misfit too and no effect explains them, so this interval counts as a burst of outliers. Record again, for "
        "longer."
    )
    return EvidenceResult("one_stretch", (begin, end), warnings=(sentence,))


def called(term: Term) -> str:
    """Return the name of a candidate in a sentence."""
    if term.effect.unrecorded:
        return "an unrecorded cause"
    along = "a curve along" if term.effect.is_curve else f"{term.effect.id} by"
    if term.columns:
        return f"{along} {', '.join(term.columns)}"
    return "an unnamed curve" if term.effect.is_curve else term.effect.id


_MOST_LISTED = 3
"""Largest number of intervals that are listed, the longest."""


class RejectedByFit(NamedTuple):
    """Intervals in which most samples are rejected.

    Attributes:
        final: by the fit with all findings.
        before: by the simulation without findings, which an unconfirmed finding may cover.
    """

    final: tuple[RejectedInterval, ...]
    before: tuple[RejectedInterval, ...]


def rejected_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return a warning with the intervals; none for a recording without times."""
    if case.prepared.recording.time is None:
        return EvidenceResult("rejected")
    intervals, before = (
        rejected_intervals(case.prepared.time, fit.weights, case.settings) for fit in (case.final.fit, case.base)
    )
    return EvidenceResult(
        "rejected",
        RejectedByFit(intervals, before),
        warnings=rejected_warning(intervals),
    )


def rejected_intervals(
    time: Float[Tensor, " N"], weights: Float[Tensor, "N m"], settings: Settings
) -> tuple[RejectedInterval, ...]:
    """Return the intervals in which most samples are rejected, without short bursts.

    Args:
        time: in s.
        weights: of the residuals in the final fit, in [0, 1].
        settings: weight below which a sample is rejected, and minimum length of an interval.

    Example:
        >>> import torch
        >>> time = torch.arange(1000) / 50.0
        >>> weights = torch.where((time > 4.0) & (time < 7.0), 0.0, 1.0).unsqueeze(-1)
        >>> rejected_warning(rejected_intervals(time, weights, Settings()))
        ('Most samples were rejected from 4.0 to 7.0 s. ...',)
    """
    intervals = disturbed_intervals(time, (weights < settings.noise.rejected_below).any(-1))
    return tuple(interval for interval in intervals if _length(interval) >= settings.evidence.disturbed)


def rejected_warning(intervals: Sequence[RejectedInterval]) -> tuple[str, ...]:
    """Return a warning with the longest intervals of rejected samples; empty if there are none."""
    found = sorted(intervals, key=_length, reverse=True)
    if not found:
        return ()
    text = ", ".join(f"from {interval.start:.1f} to {interval.end:.1f} s" for interval in sorted(found[:_MOST_LISTED]))
    more = f" and in {len(found) - _MOST_LISTED} shorter intervals" if len(found) > _MOST_LISTED else ""
    return (
        f"Most samples were rejected {text}{more}. A disturbance of the measurement that no effect explains, such as a "
        "passing object or a burst of outliers.",
    )


def _length(interval: RejectedInterval) -> float:
    return interval.end - interval.start
