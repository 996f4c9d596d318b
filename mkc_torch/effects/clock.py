"""Signals read by a clock of another rate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.runs import run_numbers

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def resampled(
    values: Float[Tensor, " N"],
    time: Float[Tensor, " N"],
    rate: float | Tensor,
    run: Int[Tensor, " N"] | None = None,
    *,
    later: float | Tensor = 0.0,
) -> Float[Tensor, " N"]:
    """Values at the moments at which a clock of another rate shows the times of the samples.

    A clock that runs fast by ``rate`` shows ``t₀ + (1 + rate) (t − t₀)`` at t, where t₀ is the start of the run.
    Between samples the values follow cubic polynomials with the slopes of parabolas through three samples; beyond the
    ends of a run, as a slow clock reads it, they continue with the slope there.

    Args:
        values: values at the samples.
        time: times of the samples in s, ascending within each run.
        rate: share by which the clock runs fast; negative for a slow clock; above -1.
        run: number of each sample's run, ascending; None: a run begins only where time goes back.
        later: shift of all moments in s; negative for earlier moments.

    Example:
        >>> time = torch.arange(5.0)
        >>> resampled(time**2, time, 0.25)
        tensor([ 0.0000,  0.6400,  2.5600,  5.7600, 10.2400])
    """
    run = run_numbers(time) if run is None else run
    first = torch.searchsorted(run, run)
    last = torch.searchsorted(run, run, right=True) - 1
    start = time[first]
    at = (time - start) / (1.0 + rate) + later
    span = time.max() - time.min() + 1.0
    # times of the runs one after the other
    left = (
        torch.searchsorted(run * span + time - start, run * span + at.detach().clamp(0.0, float(span)), right=True) - 1
    )
    left = torch.minimum(torch.maximum(left, first), torch.maximum(last - 1, first))
    right = torch.minimum(left + 1, last)
    slope = _slopes(values, time, run)
    step = (time[right] - time[left]).clamp(min=1e-300)
    share = (at - (time[left] - start)) / step
    inside = share.clamp(0.0, 1.0)
    a, b, square = step * slope[left], step * slope[right], inside * inside
    rise = values[right] - values[left]
    cubic = values[left] + inside * a + square * (3.0 * rise - 2.0 * a - b) + square * inside * (a + b - 2.0 * rise)
    return cubic + (share - inside) * torch.where(share < 0.0, a, b)


def _slopes(values: Float[Tensor, " N"], time: Float[Tensor, " N"], run: Int[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Slope at each sample of the parabola through it and its neighbours in the run; of a line through two samples."""
    if len(time) < 2:
        return torch.zeros_like(values)
    joined, none, apart = run.diff() == 0, torch.zeros_like(values[:1]), torch.zeros_like(time[:1])
    nearness = torch.where(joined, 1.0 / time.diff().abs().clamp(min=1e-300), 0.0)
    each = nearness * values.diff()
    before, after = torch.cat([none, each]), torch.cat([each, none])
    w_before, w_after = torch.cat([apart, nearness]), torch.cat([nearness, apart])
    total = w_before + w_after
    inner = (w_before * before + w_after * after) / torch.where(total > 0.0, total, 1.0)
    # an end continues the parabola of its neighbour, if there are three samples
    follows, leads = torch.cat([inner[1:], none]), torch.cat([none, inner[:-1]])
    several = _three_in_run(run)
    starts, ends = (w_before == 0.0) & several, (w_after == 0.0) & several
    inner = torch.where(starts, 2.0 * after - follows, inner)
    return torch.where(ends, 2.0 * before - leads, inner)


def _three_in_run(run: Int[Tensor, " N"]) -> Tensor:
    """Whether each sample's run has at least three samples."""
    return torch.searchsorted(run, run, right=True) - torch.searchsorted(run, run) >= 3
