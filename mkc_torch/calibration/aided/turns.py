"""Turns of a sensor by a gyroscope or an attitude, in windows in which the field is constant."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.rotation import from_quaternion, gaps, rotation_since

if TYPE_CHECKING:
    from jaxtyping import Float, Int

WINDOW = 10.0
"""Longest window of integrated rates, in s; the gyroscope's noise causes an error of 0.1° in it."""

HALF_A_TURN = math.pi
"""Largest turn of a window, in rad; a gain error of 1 % causes 2°, half of which the window's mean absorbs."""

_FEWEST = 5
"""Fewest samples of a window."""


@dataclass(frozen=True)
class Turns:
    """Rotations of N samples.

    Attributes:
        to_frame: rotations from the body at each sample to axes that are fixed within its window, (N, 3, 3).
        window: index of each sample's window, ascending, (N,).
        summed: rotation in rad since the window's first sample, in its axes, per unit of each error of the rates: the
            bias of each axis in rad/s, and the nine entries, row by row, of the errors of gains and axes, (N, 3, 12);
            None for an attitude.
        vertical: upward direction in axes that are common to all windows, (3,); None for a gyroscope.
    """

    to_frame: Float[Tensor, "N 3 3"]
    window: Int[Tensor, " N"]
    summed: Float[Tensor, "N 3 12"] | None
    vertical: Float[Tensor, " 3"] | None

    @property
    def count(self) -> int:
        """Number of windows."""
        return int(self.window[-1]) + 1

    def rows(self, chosen: Int[Tensor, " n"]) -> Turns:
        """Turns of the chosen samples; empty windows are dropped."""
        _, window = torch.unique_consecutive(self.window[chosen], return_inverse=True)
        summed = None if self.summed is None else self.summed[chosen]
        return Turns(self.to_frame[chosen], window, summed, self.vertical)


def turns_of_gyroscope(
    time: Float[Tensor, " N"], rate: Float[Tensor, "N 3"], runs: tuple[slice, ...], errors: Float[Tensor, " 12"]
) -> Turns:
    """Integrate angular rates from the first sample of each window of ten seconds or half a turn.

    Args:
        time: in s, ascending within each run.
        rate: in rad/s, in the body's axes.
        runs: rows of each run.
        errors: bias in rad/s and, row by row, the matrix of gains and axes minus the identity, subtracted from the
            rates.

    Example:
        >>> time = torch.linspace(0.0, 1.0, 101).double()
        >>> rate = torch.tensor([0.0, 0.0, torch.pi / 2]).double().expand(101, 3)
        >>> turns = turns_of_gyroscope(time, rate, (slice(0, 101),), torch.zeros(12).double())
        >>> turns.count, (turns.to_frame[-1] @ torch.tensor([1.0, 0.0, 0.0]).double()).round(decimals=3) + 0.0
        (1, tensor([0., 1., 0.], dtype=torch.float64))
    """
    bias, gains = errors[:3], errors[3:].unflatten(0, (3, 3))
    frames, windows, sums, count = [], [], [], 0
    for run in runs:
        t, w = time[run], rate[run] - bias
        w = w - w @ gains.mT
        window, first = _stretches(t, w)
        turned = rotation_since(t, w, first)
        # effect of the gain error (i, j): the rotated axis i times the rate about j
        by = torch.cat([turned, torch.einsum("kai,kj->kaij", turned, w).flatten(2)], -1)
        step = 0.5 * (by[1:] + by[:-1]) * t.diff()[:, None, None]
        total = torch.cat([torch.zeros_like(by[:1]), step.cumsum(0)])
        frames.append(turned)
        windows.append(window + count)
        # the axes differ between windows, but the sum before the window's first sample is subtracted
        sums.append(total - total[first])
        count += int(window[-1]) + 1
    return Turns(torch.cat(frames), torch.cat(windows), torch.cat(sums), None)


def turns_of_attitude(quaternion: Float[Tensor, "N 4"]) -> Turns:
    """Turns into the world frame by a recorded attitude, in a single window.

    Args:
        quaternion: w, x, y, z of nonzero length, from the body to a world frame whose third axis points upwards.
    """
    to_world = from_quaternion(quaternion)
    window = torch.zeros(len(quaternion), dtype=torch.int64)
    return Turns(to_world, window, None, to_world.new_tensor([0.0, 0.0, 1.0]))


def still(count: int) -> Turns:
    """Identity rotations of ``count`` samples, for unknown turns.

    Example:
        >>> still(2).to_frame[1].tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    identity = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    return Turns(identity, torch.zeros(count, dtype=torch.int64), None, None)


def _stretches(time: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
    """The window of each sample, and the first sample of that window; a gap starts a new window."""
    if len(time) == 1:
        zero = torch.zeros(1, dtype=torch.int64)
        return zero, zero
    turn = torch.linalg.vector_norm(0.5 * (rate[1:] + rate[:-1]), dim=-1) * time.diff()
    angle = torch.cat([turn.new_zeros(1), turn.cumsum(0)]).tolist()
    times, broken = time.tolist(), [*(gaps(time).nonzero().flatten() + 1).tolist(), len(time)]
    begins = [0]
    while begins[-1] < len(times):
        begin = begins[-1]
        far = min(_first_beyond(times, begin, WINDOW), _first_beyond(angle, begin, HALF_A_TURN))
        # a gap ends a window of any length
        begins.append(min(max(far, begin + _FEWEST), broken[bisect_right(broken, begin)]))
    first = torch.tensor(begins[:-1])
    count = torch.tensor(begins).diff()
    return torch.arange(len(first)).repeat_interleave(count), first.repeat_interleave(count)


def _first_beyond(values: list[float], begin: int, reach: float) -> int:
    """The first index from ``begin`` at which ascending values exceed the value at ``begin`` by more than ``reach``.

    Example:
        >>> _first_beyond([0.0, 1.0, 2.0, 3.0], 1, 1.5)
        3
    """
    return bisect_right(values, reach, begin, key=lambda value: value - values[begin])
