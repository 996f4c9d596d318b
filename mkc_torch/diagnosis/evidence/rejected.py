"""Evidence of few samples: rejected stretches, and effects whose evidence lies in one short stretch."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.recording.disturbance import RejectedInterval, disturbed_intervals

if TYPE_CHECKING:
    from jaxtyping import Float


def localised_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return the interval to which the first candidate is confined, in s; None if it is not confined."""
    located, time = case.first, case.prepared.time
    if located is None or located.stretch is None:
        return EvidenceResult("one_stretch")
    begin, end = (float(time[n]) for n in (located.stretch[0], located.stretch[1] - 1))
    return EvidenceResult("one_stretch", (begin, end))


class RejectedByFit(NamedTuple):
    """Intervals in which most samples are rejected.

    Attributes:
        final: by the fit with all findings.
        before: by the simulation without findings, which an unconfirmed finding may cover.
    """

    final: tuple[RejectedInterval, ...]
    before: tuple[RejectedInterval, ...]


def rejected_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return the intervals of rejected samples; None for a recording without times."""
    if case.prepared.recording.time is None:
        return EvidenceResult("rejected")
    intervals, before = (
        rejected_intervals(case.prepared.time, fit.weights, case.settings) for fit in (case.final.fit, case.base)
    )
    return EvidenceResult("rejected", RejectedByFit(intervals, before))


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
        >>> [(round(i.start, 1), round(i.end, 1)) for i in rejected_intervals(time, weights, Settings())]
        [(4.0, 7.0)]
    """
    intervals = disturbed_intervals(time, (weights < settings.noise.rejected_below).any(-1))
    return tuple(interval for interval in intervals if interval.end - interval.start >= settings.evidence.disturbed)
