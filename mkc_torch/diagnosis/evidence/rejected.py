"""Stretches of a recording in which a final fit rejects most samples: what no effect follows is not to go unseen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.recording.disturbance import RejectedInterval, disturbed_intervals

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["rejected_warning", "test"]

_TOLD = 3
"""Stretches that are told by their times, the longest ones."""


def test(case: EvidenceContext) -> EvidenceResult:
    """A warning that names them; of a recording without times there is none."""
    if case.prepared.recording.time is None:
        return EvidenceResult("rejected")
    return EvidenceResult(
        "rejected", warnings=rejected_warning(case.prepared.time, case.final.fit.weights, case.settings)
    )


def rejected_warning(time: Float[Tensor, " N"], weights: Float[Tensor, "N m"], settings: Settings) -> tuple[str, ...]:
    """A sentence that names the longest stretches of rejected samples; none where there are none.

    Args:
        time: in s.
        weights: of the residuals in the final fit, in [0, 1].
        settings: below which weight a sample is rejected, and how long a stretch has to be.

    Example:
        >>> import torch
        >>> time = torch.arange(1000) / 50.0
        >>> weights = torch.where((time > 4.0) & (time < 7.0), 0.0, 1.0).unsqueeze(-1)
        >>> rejected_warning(time, weights, Settings())
        ('Most samples were rejected from 4.0 to 7.0 s. ...',)
    """
    stretches = disturbed_intervals(time, (weights < settings.noise.rejected_below).any(-1))
    long = [interval for interval in stretches if _length(interval) >= settings.evidence.disturbed]
    found = sorted(long, key=_length, reverse=True)
    if not found:
        return ()
    text = ", ".join(f"from {item.start:.1f} to {item.end:.1f} s" for item in sorted(found[:_TOLD]))
    more = f" and in {len(found) - _TOLD} shorter stretches" if len(found) > _TOLD else ""
    return (
        f"Most samples were rejected {text}{more}. Something disturbed the measurement there that no effect follows: "
        "something that passed by, say, or a burst of outliers.",
    )


def _length(interval: RejectedInterval) -> float:
    return interval.end - interval.start
