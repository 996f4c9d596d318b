"""The grid of a system's trajectories, laid out over the rows of a recording that have inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.trajectory import Grid
from mkc_torch.simulation.ports import SignalTimes

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class InputRows:
    """The R rows of a recording between the first and the last sample of each trajectory; N of them are samples.

    Attributes:
        time: (R,), in s.
        inputs: (R, u).
        begins: (R,), True where a trajectory begins.
        samples: (N,), the rows with an output.
    """

    time: Float[Tensor, " R"]
    inputs: Float[Tensor, "R u"]
    begins: Bool[Tensor, " R"]
    samples: Int[Tensor, " N"]

    @classmethod
    def of(
        cls, recording: Recording, inputs: tuple[str, ...], sampled: Bool[Tensor, " R"], begins: Bool[Tensor, " N"]
    ) -> InputRows:
        """Select the rows between the samples of each trajectory.

        Args:
            recording: all rows with a finite time and finite inputs, in the order of time.
            inputs: names of the inputs; without any, rows that are no samples are of no use.
            sampled: True for rows with an output.
            begins: True for samples where a trajectory begins.
        """
        sample = sampled.long().cumsum(0) - 1  # the sample at or before each row
        inside = (sample >= 0) & (sample < len(begins) - 1)
        inside = inside & ~begins[(sample + 1).clamp(0, len(begins) - 1)]
        kept = (sampled | (inside & bool(inputs))).nonzero().squeeze(-1)
        starts = torch.zeros(len(recording), dtype=torch.bool)
        starts[sampled.nonzero().squeeze(-1)[begins]] = True
        values = recording.stack(*inputs) if inputs else recording["time"].new_zeros(len(recording), 0)
        return cls(recording["time"][kept], values[kept], starts[kept], sampled[kept].nonzero().squeeze(-1))


@dataclass(frozen=True)
class Layout:
    """Grid times, and the stations of their intervals, see :class:`..trajectory.Grid`.

    Attributes:
        grid: the G grid times.
        rows: (N,), grid index of each sample.
        input_clock: the stations among the rows with inputs.
        clock: the stations among the samples.
        before, share: (G,) each, the sample before each grid time, and its position from there to the next, 0 to 1.
    """

    grid: Grid
    rows: Int[Tensor, " N"]
    input_clock: SignalTimes
    clock: SignalTimes
    before: Int[Tensor, " G"]
    share: Float[Tensor, " G"]


def lay_out(known: InputRows, parts: int, map_step: float | None = None) -> Layout:
    """Divide each interval between rows with inputs into a number of equal parts.

    Args:
        known: the rows.
        parts: number of parts.
        map_step: for a simulation that steps, the length of its step in s: the parts of an interval are the nearest
            number of steps, at least one.

    Example:
        Outputs at the first and the last of three rows:

        >>> time = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
        >>> known = InputRows(time, time.unsqueeze(-1), time == 0.0, torch.tensor([0, 2]))
        >>> found = lay_out(known, 2)
        >>> found.grid.time.tolist(), found.rows.tolist(), found.share.tolist()
        ([0.0, 0.5, 1.0, 1.5, 2.0], [0, 4], [0.0, 0.25, 0.5, 0.75, 1.0])
    """
    R = len(known.time)
    inside = ~known.begins[1:]
    if map_step is not None:
        within = (known.time.diff() / map_step).round().clamp(min=1).long()
    else:
        within = torch.full((R - 1,), parts)
    count = torch.where(inside, within, 1)
    before = torch.arange(R - 1).repeat_interleave(count)
    part = torch.arange(len(before)) - (count.cumsum(0) - count).repeat_interleave(count)
    step = 1.0 / count.repeat_interleave(count).double()
    share = (part.unsqueeze(-1) + torch.tensor([0.0, 0.5, 1.0], dtype=step.dtype)) * step.unsqueeze(-1)
    # the interval between two runs is empty: time and inputs stay at the end of the first
    share = torch.where(inside.repeat_interleave(count).unsqueeze(-1), share, 0.0).flatten()
    early = before.repeat_interleave(3)
    at = torch.lerp(known.time[early], known.time[early + 1], share)
    first = torch.cat([count.cumsum(0) - count, torch.tensor([len(before)])])
    time = torch.cat([at[::3], at[-1:]])
    begins = torch.zeros(len(time), dtype=torch.bool)
    begins[first[known.begins]] = True

    def clocks(at: Tensor, share: Tensor) -> tuple[SignalTimes, SignalTimes]:
        among_rows = SignalTimes(at, early, early + 1, share)
        return among_rows, among_rows if len(known.samples) == R else _among_samples(known, among_rows)

    clock = clocks(at, share)[1]
    nodes = torch.cat([clock.before[::3], clock.before[-1:]]), torch.cat([clock.share[::3], clock.share[-1:]])
    if map_step is not None:
        at, share, early = at[::3], share[::3], before
    grid, found = Grid(time, begins, map_step), clocks(at, share)
    return Layout(grid, first[known.samples], *found, *nodes)


def _among_samples(known: InputRows, clock: SignalTimes) -> SignalTimes:
    """The stations among the samples instead of among all rows."""
    place = torch.zeros(len(known.time), dtype=torch.int64)
    place[known.samples] = 1
    before = (place.cumsum(0) - 1)[clock.before]
    time, begins = known.time[known.samples], known.begins[known.samples]
    gap = time[before + 1] - time[before]
    share = torch.where(begins[before + 1], 0.0, (clock.time - time[before]) / gap)
    return SignalTimes(clock.time, before, before + 1, share)
