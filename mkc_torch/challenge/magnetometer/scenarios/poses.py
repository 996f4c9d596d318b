"""A sensor that is laid down in one orientation after another, as in a calibration on a table."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Generator

from mkc_torch.challenge.draws import direction, normal, smooth, uniform, whole
from mkc_torch.challenge.magnetometer import rotation
from mkc_torch.challenge.magnetometer.motion import Motion

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
