"""Where a recorded heading jumps and the gyroscope says that nothing turned."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.calibration.aided.rotation import gaps, turns

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["HeadingJump", "heading_jumps"]

LEAST = 3.0
"""A smaller jump, in °, is not told of."""

MOST = 8
"""Of more jumps the largest are told of."""

_CLEAR = 30.0
"""Times the robust scale of how far attitude and gyroscope are apart from one sample to the next."""

_LASTS = 1.0
"""A jump that others take back within so many s is a glitch of the attitude, whose samples are outliers."""


_FEW, _MOVED = 5, 3.0
"""Samples to either side of a gap, and the robust scales of how far the field goes from one sample to the next, beyond
which their medians are another field."""


class HeadingJump(NamedTuple):
    """Between two samples, the first ``after`` which the heading is another; by how much, in °; and the gyroscope's."""

    after: int
    size: float
    turned: float


def heading_jumps(
    time: Float[Tensor, " N"],
    to_world: Float[Tensor, "N 3 3"],
    rate: Float[Tensor, "N 3"],
    measured: Float[Tensor, "N 3"],
) -> tuple[HeadingJump, ...]:
    """The intervals in which a recorded attitude turns about the vertical, and the gyroscope clearly does not.

    Filters of autopilots set their heading anew by the compass, at arming or take-off: the attitude is recorded with an
    error until then, or from then on. A jump counts that is larger than the turn of the gyroscope in the same interval
    and is not taken back within a second; of more than eight the largest. What a gyroscope did in a gap of the
    recording is not known: there a jump counts only where the magnetometer shows that the sensor did not turn.

    Args:
        time: in s, ascending.
        to_world: rotations from the body to a world whose third axis is vertical.
        rate: angular rate in the body's axes, in rad/s; NaN where it is not known.
        measured: by a magnetometer, in any unit.

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
    # the heading of the rotation that is nearest
    size = torch.rad2deg(torch.atan2(apart[:, 1, 0] - apart[:, 0, 1], apart[:, 0, 0] + apart[:, 1, 1]))
    turned = torch.rad2deg(0.5 * torch.linalg.vector_norm(rate[1:] + rate[:-1], dim=-1) * time.diff())
    known = size.isfinite() & ~_turned_in_a_gap(time, measured)
    if not bool(known.any()):
        return ()
    least = max(LEAST, _CLEAR * float(robust_scale(size[known].unsqueeze(-1))))
    clear = known & (size.abs() > least) & (size.abs() > turned)
    at = clear.nonzero().squeeze(-1)
    near = (time[at, None] - time[at]).abs() < _LASTS
    left = (near * size[at]).sum(-1).abs()
    at = at[left > 0.5 * size[at].abs()]
    at = at[size[at].abs().argsort(descending=True)[:MOST]].sort().values
    return tuple(HeadingJump(number, float(size[number]), float(turned[number])) for number in at.tolist())


def _turned_in_a_gap(time: Float[Tensor, " N"], measured: Float[Tensor, "N 3"]) -> Bool[Tensor, " n"]:
    """Of the intervals between samples those that are gaps, with another field after them than before."""
    gap = gaps(time)
    noise = float(robust_scale(torch.linalg.vector_norm(measured.diff(dim=0), dim=-1, keepdim=True)))
    for k in gap.nonzero().flatten().tolist():
        before, after = measured[max(k + 1 - _FEW, 0) : k + 1], measured[k + 1 : k + 1 + _FEW]
        moved = float(torch.linalg.vector_norm(after.median(0).values - before.median(0).values))
        gap[k] = moved > _MOVED * noise
    return gap
