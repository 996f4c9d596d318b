"""Rotations from quaternions and angular rates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_GAP = 5.0
"""Longest interval over which rates are integrated, in median intervals."""


def from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices from the body to the world frame, of quaternions (w, x, y, z) of nonzero length.

    Example:
        >>> from_quaternion(torch.tensor([2.0, 0.0, 0.0, 0.0])) @ torch.tensor([1.0, 2.0, 3.0])
        tensor([1., 2., 3.])
    """
    w, x, y, z = (quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def rotated(vectors: Float[Tensor, "N 3"], by: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 3"]:
    """Multiply each vector by its own matrix.

    Example:
        >>> rotated(torch.tensor([[1.0, 2.0, 3.0]]), 2.0 * torch.eye(3).unsqueeze(0))
        tensor([[2., 4., 6.]])
    """
    # an einsum takes three times as long in forward mode
    return (by @ vectors.unsqueeze(-1)).squeeze(-1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    w1, v1, w2, v2 = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = w1 * w2 - (v1 * v2).sum(-1, keepdim=True)
    return torch.cat([w, w1 * v2 + w2 * v1 + torch.linalg.cross(v1, v2)], -1)


def _steps(time: Float[Tensor, " N"], rate: Float[Tensor, "N 3"]) -> Float[Tensor, "n 4"]:
    """Quaternions of the rotation between consecutive samples."""
    turn = 0.5 * (rate[1:] + rate[:-1]) * time.diff().unsqueeze(-1)
    angle = torch.linalg.vector_norm(turn, dim=-1, keepdim=True)
    return torch.cat([torch.cos(0.5 * angle), 0.5 * torch.sinc(0.5 * angle / torch.pi) * turn], -1)


def gaps(time: Float[Tensor, " N"]) -> Bool[Tensor, " n"]:
    """Mask of the intervals that are too long for integrating the rates at their ends, (N - 1,).

    Example:
        >>> gaps(torch.tensor([0.0, 0.1, 0.2, 0.3, 1.3, 1.4]))
        tensor([False, False, False,  True, False])
    """
    step = time.diff()
    return step > _GAP * step.median()


def turns(time: Float[Tensor, " N"], rate: Float[Tensor, "N 3"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices from the body at each sample to the body at the previous sample, by a gyroscope."""
    return from_quaternion(_steps(time, rate))


def rotation_since(time: Float[Tensor, " N"], rate: Float[Tensor, "N 3"], first: Tensor) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices from the body at each sample to the body at sample ``first`` of its window, by a gyroscope.

    Args:
        time: in s, ascending.
        rate: angular rate in the body's axes, in rad/s.
        first: for each sample the index of the first sample of its window; windows are consecutive samples.

    Example:
        >>> time = torch.linspace(0.0, 1.0, 101)
        >>> rate = torch.tensor([0.0, 0.0, torch.pi / 2]).expand(101, 3)
        >>> turned = rotation_since(time, rate, torch.zeros(101, dtype=torch.long))
        >>> (turned[-1] @ torch.tensor([1.0, 0.0, 0.0])).round(decimals=3) + 0.0
        tensor([0., 1., 0.])
    """
    step = _steps(time, rate)
    identity = step.new_tensor([[1.0, 0.0, 0.0, 0.0]])
    total = torch.cat([identity, step])
    # a prefix product by doubling: q[k] becomes the product of the 2^j steps that end at k
    shift = 1
    while shift < len(total):
        total = torch.cat([total[:shift], _product(total[:-shift], total[shift:])])
        shift *= 2
    attitude = from_quaternion(total)
    return attitude[first].mT @ attitude
