"""Calibration matrices from a magnetometer's parameters, by view."""

from __future__ import annotations

import torch
from torch import Tensor

SOFT_IRON = 0.1
"""Prior standard deviation of the matrix about the identity, by soft iron, gains and misalignment. It is weak for a
sensor that turns through all directions, and selects the identity for a vehicle that never tilts."""

SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Entries of a symmetric matrix, in the order of its parameters."""


def _symmetric(theta: Tensor) -> Tensor:
    xx, yy, zz, xy, xz, yz = theta[3:9].unbind()
    return torch.stack([torch.stack([xx, xy, xz]), torch.stack([xy, yy, yz]), torch.stack([xz, yz, zz])])


def _any(theta: Tensor) -> Tensor:
    return theta[3:12].unflatten(0, (3, 3))


def _inverse(theta: Tensor) -> Tensor:
    return torch.linalg.inv(_any(theta))


MATRIX_OF_VIEW = {"norm": _symmetric, "gyro": _any, "attitude": _inverse}
