"""Unit quaternions (w, x, y, z) that turn body axes into world axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


def product(p: Float[Tensor, "*batch 4"], q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Return the Hamilton product: first the rotation ``q``, then ``p``."""
    a, u = p[..., :1], p[..., 1:]
    b, v = q[..., :1], q[..., 1:]
    scalar = a * b - (u * v).sum(-1, keepdim=True)
    return torch.cat([scalar, a * v + b * u + torch.linalg.cross(u, v)], -1)


def from_vector(turn: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Return the rotation by ``|turn|`` radians about ``turn``."""
    half = 0.5 * torch.linalg.vector_norm(turn, dim=-1, keepdim=True)
    return torch.cat([half.cos(), 0.5 * turn * torch.sinc(half / torch.pi)], -1)


def matrix(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """World from body.

    Example:
        >>> matrix(torch.tensor([1.0, 0.0, 0.0, 0.0])).equal(torch.eye(3))
        True
    """
    w, x, y, z = q.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def running_product(turns: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """Return ``turns[0] * … * turns[k]`` for each k, by doubling."""
    q, reach = turns.clone(), 1
    while reach < len(q):
        q = torch.cat([q[:reach], product(q[:-reach], q[reach:])])
        reach *= 2
    return torch.nn.functional.normalize(q, dim=-1)
