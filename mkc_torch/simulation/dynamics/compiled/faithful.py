"""Compare traced functions with torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.simulation.dynamics.compiled.functions import CompiledBlock
from mkc_torch.simulation.dynamics.compiled.traced import Traceable, traced

if TYPE_CHECKING:
    from jaxtyping import Float

_FAITHFUL = 1e-9
"""Largest relative difference between traced functions and torch."""


def is_faithful(system: Traceable, theta: Float[Tensor, " p"]) -> bool:
    """Whether a system's traced functions have the same values and derivatives as torch, near the guess.

    They differ where a function defines its own derivative, as a ``torch.autograd.Function`` may.
    """
    found = traced(system, lambda parameters: (parameters, {}), len(theta))
    if found is None:
        return False
    load_forward_mode()
    generator = torch.Generator().manual_seed(0)

    def near(values: Tensor) -> Tensor:
        size = values.abs().amax(0, keepdim=True) if values.dim() == 2 else values.abs()
        return values + 0.01 * (size + 0.01) * torch.randn(values.shape, generator=generator, dtype=values.dtype)

    theta = near(theta)
    at, along = near(system.grid.spread(system.guess)), torch.randn(theta.shape, generator=generator).double()
    moved = torch.randn(at.shape, generator=generator, dtype=at.dtype)
    N, values = len(system.measured), theta.tolist()

    def functions(theta: Tensor, states: Tensor) -> tuple[Tensor, Tensor]:
        return system.rate(theta, {})(states), system.outputs_by_states(theta, {}, states[:N])

    try:
        expected, slopes = torch.func.jvp(dual_constants(functions), (theta, at), (along, moved))[:2]
    except RuntimeError:
        return False
    per = system.grid.per_interval
    ends, moves, rates, slope = (_ends(array, per) for array in (at, moved, expected[0], slopes[0]))
    outputs, seen = expected[1].T, slopes[1].T
    known = [(found.ends, ends, moves, rates, slope)]
    if found.outputs is not None:
        known.append((found.outputs, at[:N].T, moved[:N].T, outputs, seen))
    return all(_agrees(block, values, along, *arrays) for block, *arrays in known)


def _ends(values: Tensor, per_interval: int) -> Tensor:
    """Rearrange values at the stations (S, k) to the ends of the intervals, (k, 2, G-1), or (k, 1, G-1)."""
    return values.unflatten(0, (-1, per_interval))[:, ::2].permute(2, 1, 0)


def _agrees(
    block: CompiledBlock,
    parameters: Sequence[float],
    along: Tensor,
    at: Tensor,
    moved: Tensor,
    values: Tensor,
    slopes: Tensor,
) -> bool:
    """Whether a block has these values (k, *) and directional derivatives, wherever they are finite."""
    states = at.numpy()
    with np.errstate(all="ignore"):
        by_parameters = block.by_parameters.at(parameters)(states)
        change = np.einsum("kw...,w...->k...", block.by_states.at(parameters)(states), moved.numpy())
        change += np.einsum("kp...,p->k...", by_parameters, along[block.moving].numpy())
        own = block.values(parameters)(states)
    for computed, expected in ((own, values.numpy()), (change, slopes.numpy())):
        finite = np.isfinite(expected)
        size = np.abs(np.where(finite, expected, 0.0)).max() + np.finfo(float).tiny
        if not bool((np.abs(np.where(finite, computed - expected, 0.0)) <= _FAITHFUL * size).all()):
            return False
    return True
