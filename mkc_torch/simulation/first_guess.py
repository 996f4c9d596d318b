"""A first guess of a system's states: what is measured, its rate of change, or a user's word."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from mkc_torch.simulation.dynamics import PreparedDynamics

__all__ = ["first_guess"]

_MEDIAN, _MEAN = 5, 5


def first_guess(
    prepared: PreparedDynamics, time: Float[Tensor, " G"], before: Int[Tensor, " G"], share: Float[Tensor, " G"]
) -> Float[Tensor, "G n"]:
    """Of the states at moments between samples.

    Args:
        prepared: the system; a state that is an output is as it was measured, outliers smoothed away, and one that is
            the rate of such a state is its slope.
        time, before, share: the moments, the sample before each, and how far it is from that one to the next.
    """
    system, known = prepared.system, {}
    for name in system.states:
        if name in prepared.channels:
            known[name] = _despiked(prepared.recording[name], prepared.begins)
    for name, rate in prepared._kinematic.items():
        if name in known and rate not in known:
            known[rate] = _slope(known[name], prepared.time, prepared.begins)
    columns = []
    for name in system.states:
        if name in known:
            columns.append(torch.lerp(known[name][:-1][before], known[name][1:][before], share))
        else:
            columns.append(time.new_full((len(time),), float(system.initial.get(name, 0.0))))
    return torch.stack(columns, -1)


def _windows(values: Float[Tensor, " N"], begins: Bool[Tensor, " N"], width: int) -> Float[Tensor, "N width"]:
    """Neighbours of each sample in its own run; beyond its ends the last ones again."""
    N = len(values)
    first = torch.where(begins, torch.arange(N), 0).cummax(0).values
    start = begins.nonzero().squeeze(-1)
    end = torch.cat([start[1:], start.new_tensor([N])]) - 1
    last = end[begins.long().cumsum(0) - 1]
    index = torch.arange(N).unsqueeze(-1) + torch.arange(-(width // 2), width // 2 + 1)
    return values[torch.minimum(torch.maximum(index, first.unsqueeze(-1)), last.unsqueeze(-1))]


def _despiked(values: Float[Tensor, " N"], begins: Bool[Tensor, " N"]) -> Float[Tensor, " N"]:
    """The values, and the median of five where they are far from it."""
    middle = _windows(values, begins, _MEDIAN).median(-1).values
    away = (values - middle).abs()
    return torch.where(away > 6.0 * away.mean() + 1e-300, middle, values)


def _slope(values: Float[Tensor, " N"], time: Float[Tensor, " N"], begins: Bool[Tensor, " N"]) -> Float[Tensor, " N"]:
    """By a straight line through five neighbours."""
    t, y = _windows(time, begins, _MEAN), _windows(values, begins, _MEAN)
    t, y = t - t.mean(-1, keepdim=True), y - y.mean(-1, keepdim=True)
    return (t * y).sum(-1) / t.square().sum(-1).clamp(min=1e-300)
