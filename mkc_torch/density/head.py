"""The head of the MKC density, where it exceeds its flat tail: reach and quadrature."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.torch_internals import functorch_is_active
from mkc_torch.density.energy import energy_value

if TYPE_CHECKING:
    from jaxtyping import Float, Float64

HEAD_TOLERANCE = 1e-13
"""Excess of the density over its flat tail at which the head ends."""


def head_quadrature(count: int) -> tuple[Tensor, Tensor]:
    """Nodes on [0, 1] and weights of an even integrand on [-1, 1]: Gauss-Legendre under sinh(2t), denser near 0."""
    x, w = np.polynomial.legendre.leggauss(count)
    t = 0.5 * (x + 1.0)
    nodes, weights = np.sinh(2.0 * t) / np.sinh(2.0), 2.0 * w * np.cosh(2.0 * t) / np.sinh(2.0)
    return torch.from_numpy(nodes), torch.from_numpy(weights)


_NODES, _WEIGHTS = head_quadrature(32)


def head_rule_constants() -> tuple[Float[Tensor, " nodes"], Float[Tensor, " nodes"]]:
    """Nodes on [0, 1] and weights of the rule on the head, in float64."""
    return _NODES, _WEIGHTS


_COPIES: dict[tuple[torch.device, torch.dtype], tuple[Tensor, Tensor]] = {}
"""Copies of the rule by device and dtype: copying to a GPU waits for it, so each copy is made once."""


def _rule_like(values: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes and weights in the dtype and on the device of a tensor."""
    key = (values.device, values.dtype)
    if torch.compiler.is_compiling() or type(values) is not Tensor or functorch_is_active():
        return _NODES.to(values), _WEIGHTS.to(values)
    if key not in _COPIES:
        with torch.inference_mode(False), torch.no_grad():
            _COPIES[key] = _NODES.to(values), _WEIGHTS.to(values)
    return _COPIES[key]


def tail_density(kappa: Tensor) -> Tensor:
    """``exp(-1 / kappa)``, the unnormalised density of the flat tail, with value and gradient 0 at ``kappa = 0``."""
    positive = kappa > 1e-3  # exp(-1000) is 0 in float64
    return torch.where(positive, torch.exp(-1.0 / torch.where(positive, kappa, 1.0)), 0.0)


def head_reach(kappa: Tensor) -> Tensor:
    """The ``z`` beyond which the density exceeds its flat tail by less than 1e-13; without a gradient."""
    k = kappa.detach().clamp(min=1e-3)
    excess = k * torch.nn.functional.softplus(1.0 / k + math.log(HEAD_TOLERANCE), threshold=30.0)
    return torch.sqrt(-2.0 * torch.log(excess) / k)


def head_rule(kappa: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Quadrature on the head: nodes ``u`` in [0, min(length, reach)] and weights for both signs, shape (*, nodes).

    A negative length gives negative nodes and weights, so that integrals are odd in it.
    """
    reach = head_reach(kappa)
    end = torch.maximum(torch.minimum(length, reach), -reach).unsqueeze(-1)
    nodes, weights = _rule_like(end)
    return end * nodes, end * weights


def integrate(
    values: Float[Tensor, "*batch nodes"],
    tail: Float[Tensor, "*batch"],
    length: Float[Tensor, "*batch"],
    weights: Float[Tensor, "*batch nodes"],
) -> Float[Tensor, "*batch"]:
    """Integral over the domain of a function that is constant on the tail: tail in closed form, head by quadrature.

    Args:
        values: the function at the nodes of :func:`head_rule`.
        tail: its value on the flat tail.
        length: half-width of the domain.
        weights: weights of :func:`head_rule`.
    """
    return 2.0 * length * tail + (weights * (values - tail.unsqueeze(-1))).sum(-1)


def head_integral(kappa: Float64[Tensor, "*batch"]) -> Float64[Tensor, "*batch"]:
    """Integral of the density minus its flat tail, over a domain that extends beyond the head."""
    nodes, weights = head_rule(kappa, torch.full_like(kappa, math.inf))
    density = torch.exp(-energy_value(nodes, kappa.unsqueeze(-1)))
    return integrate(density, tail_density(kappa), torch.zeros_like(kappa), weights)
