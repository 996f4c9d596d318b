"""Jumps of a recorded heading while the gyroscope shows no turn."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.calibration.aided.rotation import gaps, turns

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

LEAST = 3.0
"""Smallest jump in °."""

MOST = 8
"""Largest number of jumps; of more jumps the largest are reported."""

_CLEAR = 30.0
"""Smallest jump in robust scales of the difference of attitude and gyroscope between two samples."""

_LASTS = 1.0
"""Seconds within which a jump that is reversed is a glitch of the attitude, whose samples are outliers."""


_FEW = 5
"""Number of samples on each side of a gap whose medians are compared."""

_MOVED = 3.0
"""Change of the median field across a gap, in robust scales of the change between two samples, that is a turn."""


class HeadingJump(NamedTuple):
    """A jump of the heading between two samples.

    Attributes:
        after: number of the sample before the jump.
        size: size of the jump in °.
        turned: turn by the gyroscope in the same interval, in °.
    """

    after: int
    size: float
    turned: float


def heading_jumps(
    time: Float[Tensor, " N"],
    to_world: Float[Tensor, "N 3 3"],
    rate: Float[Tensor, "N 3"],
    measured: Float[Tensor, "N 3"],
) -> tuple[HeadingJump, ...]:
    """The intervals in which a recorded attitude turns about the vertical and the gyroscope clearly does not.

    Filters of autopilots reset their heading by the compass at arming or take-off: the attitude has an error before or
    after. A jump is larger than the turn by the gyroscope in the same interval and not reversed within a second; of
    more than eight jumps the largest are returned. Turns in gaps of the recording are not known: a jump in a gap is
    returned only if the magnetometer shows that the sensor did not turn.

    Args:
        time: (N,), in s, ascending.
        to_world: rotations from the sensor frame to a world frame whose third axis is vertical.
        rate: angular rate in the sensor frame, in rad/s; NaN where it is not known.
        measured: measurement of a magnetometer, in any unit.

    Example:
        >>> time = torch.arange(100.0)
        >>> heading = torch.where(time < 40.0, 0.0, 0.5)
        >>> cos, sin, o = heading.cos(), heading.sin(), torch.zeros(100)
        >>> to_world = torch.stack([cos, -sin, o, sin, cos, o, o, o, o + 1.0], -1).unflatten(-1, (3, 3))
        >>> still = torch.zeros(100, 3)
        >>> [(jump.after, round(jump.size, 1)) for jump in heading_jumps(time, to_world, still, still)]
        [(39, 28.6)]
    """
    if len(time) < 2:
        return ()
    apart = to_world[1:] @ (to_world[:-1] @ turns(time, rate)).mT
    # the heading of the nearest rotation about the vertical
    size = torch.rad2deg(torch.atan2(apart[:, 1, 0] - apart[:, 0, 1], apart[:, 0, 0] + apart[:, 1, 1]))
    turned = torch.rad2deg(0.5 * torch.linalg.vector_norm(rate[1:] + rate[:-1], dim=-1) * time.diff())
    known = size.isfinite() & ~_turned_in_a_gap(time, measured)
    if not bool(known.any()):
        return ()
    threshold = max(LEAST, _CLEAR * float(robust_scale(size[known].unsqueeze(-1))))
    clear = known & (size.abs() > threshold) & (size.abs() > turned)
    at = clear.nonzero().squeeze(-1)
    near = (time[at, None] - time[at]).abs() < _LASTS
    net = (near * size[at]).sum(-1).abs()
    at = at[net > 0.5 * size[at].abs()]
    at = at[size[at].abs().argsort(descending=True)[:MOST]].sort().values
    return tuple(HeadingJump(number, float(size[number]), float(turned[number])) for number in at.tolist())


def _turned_in_a_gap(time: Float[Tensor, " N"], measured: Float[Tensor, "N 3"]) -> Bool[Tensor, " n"]:
    """The mask of the intervals between samples that are gaps across which the field changes."""
    gap = gaps(time)
    noise = float(robust_scale(torch.linalg.vector_norm(measured.diff(dim=0), dim=-1, keepdim=True)))
    for k in gap.nonzero().flatten().tolist():
        before, after = measured[max(k + 1 - _FEW, 0) : k + 1], measured[k + 1 : k + 1 + _FEW]
        moved = float(torch.linalg.vector_norm(after.median(0).values - before.median(0).values))
        gap[k] = moved > _MOVED * noise
    return gap
