"""Waveforms along a recording that several effects share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.runs import clamped_recurrence, first_of_runs, limited_recurrence, linear_recurrence, run_numbers

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_MIN_RATIO = 1e-12
"""Lower limit of a sampling interval over the lag, a divisor."""


def outer_product(waveform: Float[Tensor, " N"], gain: Float[Tensor, " c"]) -> Float[Tensor, "N c"]:
    """A waveform times a gain for each channel, (N, c)."""
    return waveform.unsqueeze(-1) @ gain.unsqueeze(0)


def per(unit: str, other: str) -> str:
    """The unit of a quotient, with K for a difference in °C.

    Example:
        >>> per("µT", "A"), per("µT", ""), per("µT", "°C")
        ('µT/A', 'µT', 'µT/K')
    """
    return f"{unit}/{'K' if other == '°C' else other}" if other else unit


def unit_step(time: Float[Tensor, " N"], onset: float) -> Float[Tensor, " N"]:
    """A unit step: 0 before the onset, 1 from the onset on."""
    return (time >= onset).to(time.dtype)


def apply_basis(basis: Float[Tensor, "N c q"], gamma: Float[Tensor, " q"]) -> Float[Tensor, "N c"]:
    """The change ``basis @ γ``, (N, c)."""
    # as one matrix: a batch of γ would otherwise copy the basis of each sample for each γ
    return (basis.flatten(0, 1) @ gamma).unflatten(0, basis.shape[:2])


def lagged(
    values: Float[Tensor, " N"], time: Float[Tensor, " N"], lag: float, run: Int[Tensor, " N"] | None = None
) -> Float[Tensor, " N"]:
    """Values behind a first-order lag, in steady state before the first sample of each run.

    Solves ``lag ẏ = x − y`` exactly for x linear between samples, at any sampling intervals.

    Args:
        values: x at the samples.
        time: times of the samples in s.
        lag: time constant in s; if not positive, the values are returned unchanged.
        run: number of each sample's run; None: a run begins only where time goes back.

    Example:
        >>> time = torch.arange(0.0, 5.0, 0.01, dtype=torch.float64)
        >>> float(lagged((time - 1.0).clamp(min=0.0), time, 1.0)[200])  # a ramp: 1 - (1 - 1 / e)
        0.367...
    """
    if lag <= 0:
        return values
    first = first_of_runs(run_numbers(time) if run is None else run)
    ratio = torch.cat([time.new_zeros(1), time.diff()]).clamp(min=0.0) / lag
    keep = torch.where(first, 0.0, torch.exp(-ratio))
    ratio = ratio.clamp(min=_MIN_RATIO)
    late = torch.where(first, 0.0, -torch.expm1(-ratio) / ratio)
    away = values - values[0]
    before = torch.cat([away[:1], away[:-1]])
    return values[0] + linear_recurrence(keep, (late - keep) * before + (1.0 - late) * away)


def played(
    values: Float[Tensor, " N"],
    time: Float[Tensor, " N"],
    half_gap: float | Tensor,
    run: Int[Tensor, " N"] | None = None,
) -> Float[Tensor, " N"]:
    """Values behind backlash, in the middle of the gap at the first sample of each run.

    Args:
        values: values of the drive at the samples.
        time: times of the samples in s.
        half_gap: half the width of the gap, in the values' unit; at least 0.
        run: number of each sample's run; None: a run begins only where time goes back.

    Example:
        >>> there_and_back = torch.tensor([0.0, 1.0, 3.0, 2.0, 1.0, 0.0])
        >>> played(there_and_back, torch.arange(6.0), 1.0)
        tensor([0., 0., 2., 2., 2., 1.])
    """
    first = first_of_runs(run_numbers(time) if run is None else run)
    gap = torch.where(first, torch.zeros_like(values), half_gap)
    touched, side = in_contact(values.detach(), gap.detach())
    return values[touched] + side * gap


def rate_limited(
    values: Float[Tensor, " N"],
    time: Float[Tensor, " N"],
    rate: float | Tensor,
    run: Int[Tensor, " N"] | None = None,
) -> Float[Tensor, " N"]:
    """Values that are followed no faster than at a rate, from the first sample of each run.

    Args:
        values: values of the command at the samples.
        time: times of the samples in s.
        rate: fastest change, in the values' unit per s; above 0.
        run: number of each sample's run; None: a run begins only where time goes back.

    Example:
        >>> step = torch.tensor([0.0, 3.0, 3.0, 3.0, 0.0])
        >>> rate_limited(step, torch.arange(5.0), 2.0)
        tensor([0., 2., 3., 3., 1.])
    """
    first = first_of_runs(run_numbers(time) if run is None else run)
    step = torch.cat([time.new_zeros(1), time.diff()]).clamp(min=0.0)
    reach = torch.where(first, torch.inf, rate * step).to(values.dtype)
    followed = limited_recurrence(values.detach(), reach.detach())
    # differentiable in the values and the rate, without differentiating through the recursion
    reached = followed == values.detach()
    number = torch.arange(len(values), device=values.device)
    touched = torch.where(reached, number, torch.zeros_like(number)).cummax(0).values
    signed = torch.where(reached, 0.0, torch.sign(values.detach() - followed) * step)
    return values[touched] + rate * linear_recurrence((~reached).to(values.dtype), signed)


def in_contact(values: Float[Tensor, " N"], gap: Float[Tensor, " N"]) -> tuple[Int[Tensor, " N"], Float[Tensor, " N"]]:
    """The samples at which a load behind backlash was last in contact with its drive, and the sides, 0 without a gap.

    With them the backlash is differentiated without differentiating through the recursion over the samples.

    Args:
        values: values of the drive.
        gap: half the width of the gap at each sample; 0 at the first sample of each run.

    Example:
        >>> in_contact(torch.tensor([0.0, 1.0, 3.0, 2.0]), torch.tensor([0.0, 1.0, 1.0, 1.0]))
        (tensor([0, 1, 2, 2]), tensor([ 0., -1., -1., -1.]))
    """
    low, high = values - gap, values + gap
    load = clamped_recurrence(low, high)
    below, above = load == low, load == high
    number = torch.arange(len(values), device=values.device)
    touched = torch.where(below | above, number, torch.zeros_like(number)).cummax(0).values
    return touched, (above.to(values.dtype) - below.to(values.dtype))[touched]
