"""A first guess of a system's states: measured, differentiated, or given by the user."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.equations import Equations

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_WIDTH = 5
"""Samples of the window for local lines."""

_FAR = 6.0
"""Median absolute deviations from the local line beyond which a sample is an outlier."""


def first_guess(
    system: Equations,
    recording: Recording,
    channels: tuple[str, ...],
    begins: Bool[Tensor, " N"],
    kinematic: Mapping[str, str],
    time: Float[Tensor, " G"],
    before: Int[Tensor, " G"],
    share: Float[Tensor, " G"],
) -> Float[Tensor, "G n"]:
    """Guess the states at G times between samples.

    A state that is an output is taken from the recording, with outliers replaced. The rate of such a state is its
    slope. Every other state has its value in ``initial``, or 0.

    Args:
        system: the equations.
        recording: the measured columns.
        channels: the columns that are outputs.
        begins: (N,), True where a trajectory begins.
        kinematic: state whose rate is another state, to that state.
        time: (G,), the times in s.
        before: (G,), the sample before each time.
        share: (G,), how far each time is from that sample to the next, from 0 to 1.
    """
    known, at = {}, recording["time"]
    for name in system.states:
        if name in channels:
            known[name] = despiked(recording[name], at, begins)
    for name, rate in kinematic.items():
        if name in known and rate not in known:
            known[rate] = slope_of(known[name], at, begins)
    columns = []
    for name in system.states:
        if name in known:
            columns.append(torch.lerp(known[name][:-1][before], known[name][1:][before], share))
        else:
            columns.append(time.new_full((len(time),), float(system.initial.get(name, 0.0))))
    return torch.stack(columns, -1)


def _windows(values: Float[Tensor, " N"], begins: Bool[Tensor, " N"]) -> Float[Tensor, "N width"]:
    """The samples nearest to each sample in its run, (N, width); shorter runs repeat their last sample."""
    N = len(values)
    first = torch.where(begins, torch.arange(N), 0).cummax(0).values
    start = begins.nonzero().squeeze(-1)
    end = torch.cat([start[1:], start.new_tensor([N])]) - 1
    last = end[begins.long().cumsum(0) - 1]
    lowest = torch.maximum(torch.minimum(torch.arange(N) - _WIDTH // 2, last - _WIDTH + 1), first)
    return values[torch.minimum(lowest.unsqueeze(-1) + torch.arange(_WIDTH), last.unsqueeze(-1))]


def despiked(values: Float[Tensor, " N"], time: Float[Tensor, " N"], begins: Bool[Tensor, " N"]) -> Float[Tensor, " N"]:
    """The values with outliers replaced by the local line.

    The line is fitted by repeated medians, which two outliers among five samples cannot move: Siegel, Biometrika 69
    (1982), 242.
    """
    t, y = _windows(time, begins), _windows(values, begins)
    run, rise = t.unsqueeze(-1) - t.unsqueeze(-2), y.unsqueeze(-1) - y.unsqueeze(-2)
    slopes = torch.where(run == 0, torch.nan, rise / torch.where(run == 0, 1.0, run))
    slope = slopes.nanmedian(-1).values.nanmedian(-1).values
    level = y - slope.unsqueeze(-1) * (t - time.unsqueeze(-1))
    line = level.median(-1).values
    away = (values - line).abs()
    # in strongly curved windows all samples are far from the line
    usual = torch.maximum((level - line.unsqueeze(-1)).abs().median(-1).values, away.median())
    return torch.where(away > _FAR * usual + 1e-9 * values.abs().amax(), line, values)


def slope_of(values: Float[Tensor, " N"], time: Float[Tensor, " N"], begins: Bool[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Slope of the least-squares line through the window around each sample, per s."""
    t, y = _windows(time, begins), _windows(values, begins)
    t, y = t - t.mean(-1, keepdim=True), y - y.mean(-1, keepdim=True)
    return (t * y).sum(-1) / t.square().sum(-1).clamp(min=1e-300)
