"""Jacobians of functions by forward mode, by reverse mode, or by reverse mode applied twice."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants

Residual = Callable[..., Tensor]


@functools.cache
def load_forward_mode() -> None:
    """Load torch's rules for forward mode, which it compiles at the first use by a function that it deprecates."""
    point = torch.ones(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.sin, (point,), (point,))


_CELLS = 250_000
"""Numbers in a batch of tangents, a limit of memory: a function holds several times as many during the evaluation."""


def directions_at_once(values: int) -> int:
    """Number of directions in a batch for a function with this number of values.

    Example:
        >>> directions_at_once(4_500), directions_at_once(360_000)
        (55, 1)
    """
    return max(1, _CELLS // max(values, 1))


def forward_tangents(function: Residual, values: int = 1) -> Residual:
    """The transposed Jacobian as a function, a row per parameter; in batches for a function with many ``values``."""
    load_forward_mode()

    def tangents(theta: Tensor, *data: Any) -> Tensor:
        def along(direction: Tensor) -> Tensor:
            return torch.func.jvp(dual_constants(lambda t: function(t, *data)), (theta,), (direction,))[1]

        basis = torch.eye(theta.shape[0], dtype=theta.dtype, device=theta.device)
        batch = directions_at_once(values)
        # a chunk of all directions would have another memory layout, and so another rounding in later operations
        return torch.func.vmap(along, chunk_size=None if batch >= len(basis) else batch)(basis)

    return tangents


def forward_jacobian(function: Residual, theta: Tensor, values: int) -> Tensor:
    """The Jacobian in the layout of ``torch.func.jacfwd``, for a function with this number of values."""
    return forward_tangents(function, values)(theta).movedim(0, -1)


def twice_reverse_tangents(function: Residual) -> Residual:
    """The transposed Jacobian as a function, by differentiating the vector-Jacobian product by its vector.

    This is faster than forward mode, in which each direction is a transform of the function. Forward mode is used where
    reverse mode is not finite, as next to an infinite slope that ``torch.where`` excludes, and where there is no second
    derivative. Torch takes a missing second derivative for 0, so the first result of each function is compared with
    forward mode along one direction.
    """

    def tangents(theta: Tensor, *data: Any) -> Tensor:
        trusted = _trusted.get(function)
        rows = None if trusted is False else _twice_reversed(function, theta, *data)
        if rows is None or not bool(rows.isfinite().all()):
            return forward_tangents(function)(theta, *data)
        if trusted is None:
            trusted = _trusted[function] = _agree(rows, function, theta, *data)
        return rows if trusted else forward_tangents(function)(theta, *data)

    return tangents


_trusted: WeakKeyDictionary[Residual, bool] = WeakKeyDictionary()
"""Whether a function's tangents by reverse mode applied twice agreed with forward mode when they were compared."""


def _agree(rows: Tensor, function: Residual, theta: Tensor, *data: Any) -> bool:
    """Whether tangents agree with forward mode along one direction."""
    load_forward_mode()
    sizes = rows.flatten(1).abs().amax(1)
    # scaled so that all parameters change the values alike
    direction = torch.where((sizes > 0) & sizes.isfinite(), 1.0 / sizes, 1.0)
    along = torch.func.jvp(dual_constants(lambda t: function(t, *data)), (theta,), (direction,))[1]
    off = (torch.tensordot(direction, rows, 1) - along).abs().amax()
    return bool(off <= 1e3 * torch.finfo(theta.dtype).eps ** 0.5 * along.abs().amax())


def _twice_reversed(function: Residual, theta: Tensor, *data: Any) -> Tensor | None:
    """The tangents by reverse mode applied twice; None where torch cannot compute them."""
    with torch.enable_grad():
        at = theta.detach().requires_grad_()
        values = function(at, *data)
        weights = torch.zeros_like(values, requires_grad=True)
        basis = torch.eye(len(at), dtype=at.dtype, device=at.device)
        try:
            (weighed,) = torch.autograd.grad(values, at, weights, create_graph=True)
            return torch.autograd.grad(weighed, weights, basis, is_grads_batched=True)[0].detach()
        except RuntimeError:
            return None


def vector_jacobian_product(function: Residual, point: Tensor, vector: Tensor) -> Tensor:
    """The product of a vector, of the shape of the function's value, and the Jacobian, of the shape of the point.

    As ``torch.func.vjp``, whose first use imports ``torch._dynamo`` in 1 s.
    """
    with torch.enable_grad():
        at = point.detach().requires_grad_()
        value = function(at)
        if not value.requires_grad:
            return torch.zeros_like(point)
        return torch.autograd.grad(value, at, vector, allow_unused=True, materialize_grads=True)[0]


def reverse_tangents(function: Residual) -> Residual:
    """The transposed Jacobian as a function, by reverse mode."""

    def tangents(theta: Tensor, *data: Any) -> Tensor:
        jacobian: Tensor = torch.func.jacrev(function)(theta, *data)
        return jacobian.movedim(-1, 0)

    return tangents
