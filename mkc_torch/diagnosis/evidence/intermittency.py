"""Whether a step is intermittent after its onset, as of a switched cause."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, gain_of
from mkc_torch.diagnosis.settings import EvidenceSettings

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["as_result", "comes_and_goes", "memory_of", "test"]

_FREQUENCIES = 4001
"""Number of frequencies of the spectrum."""


def test(case: EvidenceContext) -> EvidenceResult:
    """Test whether the finding is an intermittent step."""
    onset = case.term.shape.get("onset")
    if onset is None:
        return as_result(False)
    memory = memory_of(case.final.spectrum.coefficients)
    gain = gain_of(case.final, case.number)
    return as_result(comes_and_goes(gain, case.prepared.time, onset, case.settings.evidence, memory))


def as_result(switched: bool) -> EvidenceResult:
    return EvidenceResult("switched", switched, keys={"comes_and_goes": True} if switched else {})


def comes_and_goes(
    gain: Float[Tensor, " N"],
    time: Float[Tensor, " N"],
    onset: float,
    settings: EvidenceSettings,
    memory: float = 1.0,
) -> bool:
    """Whether the step makes the recording much less likely in some interval after its onset.

    For a permanent step, an interval of independent samples loses c nats with probability below exp(−c); for coloured
    noise in a white-noise model, below exp(−c / memory).

    Args:
        gain: log-likelihood gain of the step per sample, in nats.
        time: of the samples, ascending.
        onset: of the step.
        settings: thresholds of the loss.
        memory: number of samples per independent sample; see :func:`memory_of`.

    Example:
        >>> time = torch.arange(100.0)
        >>> lasts = torch.where(time < 20.0, 0.0, 1.0)
        >>> switched = torch.where(time < 20.0, 0.0, torch.sign(torch.sin(0.1 * (time - 20.0) + 0.01)))
        >>> usual = EvidenceSettings()
        >>> comes_and_goes(lasts, time, 20.0, usual), comes_and_goes(switched, time, 20.0, usual)
        (False, True)
    """
    running = torch.cat([gain.new_zeros(1), gain[time >= onset].cumsum(0)])
    fall = float((running.cummax(0).values - running).max())
    return fall > max(settings.switched * memory, settings.switched_share * float(gain.sum()))


def memory_of(coefficients: Sequence[Float[Tensor, " order"]]) -> float:
    """Return the largest ratio of long-run variance to variance over the channels; at least 1.

    Example:
        >>> round(memory_of([torch.tensor([0.5]), torch.zeros(0)]), 3)
        3.0
    """
    return max([1.0, *(_memory(phi.double()) for phi in coefficients if len(phi))])


def _memory(phi: Float[Tensor, " order"]) -> float:
    omega = torch.linspace(0.0, torch.pi, _FREQUENCIES, dtype=phi.dtype)
    lag = torch.arange(1, len(phi) + 1, dtype=phi.dtype)
    turned = torch.exp(-1j * omega.unsqueeze(-1) * lag) @ phi.to(torch.complex128)
    power = (1.0 - turned).abs().square().reciprocal()
    return float(power[0] / torch.trapezoid(power, omega) * torch.pi)
