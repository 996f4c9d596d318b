"""Motions of a sensor that is turned by hand, standing or walking."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from examples.blind_proof.draws import choose, direction, happens, normal, smooth, uniform, whole
from examples.blind_proof.magnetometer import rotation

if TYPE_CHECKING:
    from jaxtyping import Float, Int


RATE = 50.0
"""Samples per second."""

DURATION = 90.0
"""Seconds."""

WALKING_SHARE = 0.3
"""Share of motions in which the sensor is carried a few metres."""

STIFF_SHARE = 0.1
"""Share of motions with little rotation about a body axis, which cover directions poorly."""

REST_SHARE, LONGEST_REST = 0.15, 0.4
"""Share of the motions in which the sensor lies still for a while, and the longest such while, as a share of the
recording."""

_GRAVITY = torch.tensor([0.0, 0.0, 9.81], dtype=torch.float64)


@dataclass(frozen=True)
class Motion:
    """Positions and orientations of a sensor: time in s, position in m, rates in rad/s."""

    time: Float[Tensor, " N"]
    attitude: Float[Tensor, "N 4"]  # unit quaternion, world from body
    position: Float[Tensor, "N 3"]  # world axes
    gyro: Float[Tensor, "N 3"]  # body axes
    walks: bool

    @property
    def rotation(self) -> Float[Tensor, "N 3 3"]:
        """World from body."""
        return rotation.matrix(self.attitude)

    @property
    def accel(self) -> Float[Tensor, "N 3"]:
        """Specific force in body axes, m/s²; g upwards at rest."""
        step = float(self.time[1] - self.time[0])
        velocity = torch.gradient(self.position, spacing=step, dim=0)[0]
        return self.into_body(torch.gradient(velocity, spacing=step, dim=0)[0] + _GRAVITY)

    def into_body(self, vectors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Return world vectors in body axes."""
        return torch.einsum("nij,ni->nj", self.rotation, vectors)


def tumble(g: Generator, *, duration: float = DURATION, rate: float = RATE, start: float = 0.0) -> Motion:
    """Draw a motion: rotation at 1-3 rad/s (RMS), positions within about half a metre, walking or not.

    Args:
        duration: length in s.
        rate: samples per second.
        start: time of the first sample in s.
    """
    count, step = round(duration * rate), 1.0 / rate
    time = start + torch.arange(count, dtype=torch.float64) * step
    size = torch.ones(3, dtype=torch.float64)
    if happens(g, STIFF_SHARE):
        size[int(uniform(g, 0.0, 3.0)) % 3] = 0.3
    moves = _moves(g, count)
    gyro = uniform(g, 1.0, 3.0) * size / size.square().mean().sqrt() / 3.0**0.5 * smooth(g, count, 3, step, 2.0)
    gyro = gyro * moves[:, None]
    turns = rotation.from_vector(gyro * step)
    first = torch.nn.functional.normalize(normal(g, 4), dim=0)
    attitude = rotation.running_product(torch.cat([first[None], turns[:-1]]))
    walks = happens(g, WALKING_SHARE)
    hand = 0.5 * torch.tanh(0.5 * smooth(g, count, 3, step, 3.0))
    body = smooth(g, count, 3, step, 25.0) * torch.tensor([2.0, 2.0, 0.05]) if walks else torch.zeros(count, 3)
    # a resting sensor does not move
    position = (hand + body)[(moves.cumsum(0) - 1).clamp(min=0)]
    return Motion(time, attitude, position, gyro, walks)


def _moves(g: Generator, count: int) -> Int[Tensor, " N"]:
    """Return 1 where a sensor moves and 0 where it rests, such as before it is picked up."""
    moves = torch.ones(count, dtype=torch.int64)
    if happens(g, REST_SHARE):
        length = int(uniform(g, 0.05, LONGEST_REST) * count)
        first = choose(g, (0, count - length, int(uniform(g, 0.0, 1.0) * (count - length))))
        moves[first : first + length] = 0
    return moves


def within(motion: Motion, other: Motion) -> Motion:
    """Move the motion to the place of another, and limit it to the other's range."""
    place, middle = motion.position.mean(0), other.position.mean(0)
    reach = [float(torch.linalg.vector_norm(m.position - m.position.mean(0), dim=-1).max()) for m in (motion, other)]
    return replace(motion, position=middle + min(1.0, reach[1] / reach[0]) * (motion.position - place))


POSES = (24, 32)
"""Number of orientations in a recording."""

TURNING = (0.25, 0.45)
"""Share of the time during which the sensor is turned."""


def poses(g: Generator, *, duration: float, rate: float) -> Motion:
    """Draw a motion with rests in several orientations; between them it turns by 1 to 3 rad about any axis.

    Args:
        duration: length in s.
        rate: samples per second.
    """
    count, step = round(duration * rate), 1.0 / rate
    number, share = whole(g, *POSES), uniform(g, *TURNING)
    gyro = torch.zeros(count, 3, dtype=torch.float64)
    ends = torch.linspace(0, count, number + 1).round().long().tolist()
    for start, end in pairwise(ends[1:]):
        length = max(round(share * (end - start)), 2)
        # from rest to rest
        course = torch.sin(math.pi * (torch.arange(length, dtype=torch.float64) + 0.5) / length).square()
        gyro[start : start + length] = uniform(g, 1.0, 3.0) * direction(g) * (course / course.sum() / step)[:, None]
    first = torch.nn.functional.normalize(normal(g, 4), dim=0)
    turns = rotation.from_vector(gyro * step)
    attitude = rotation.running_product(torch.cat([first[None], turns[:-1]]))
    moves = (gyro != 0.0).any(-1).long()
    hand = 0.5 * torch.tanh(0.5 * smooth(g, count, 3, step, 3.0))
    position = hand[(moves.cumsum(0) - 1).clamp(min=0)]  # a resting sensor does not move
    return Motion(torch.arange(count, dtype=torch.float64) * step, attitude, position, gyro, walks=False)
