"""Tangents of a function, by forward mode, by reverse mode, or by reverse mode of reverse mode."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from mkc_torch._support.torch_internals import is_wrapped

__all__ = [
    "Residual",
    "directions_at_once",
    "forward_jacobian",
    "forward_tangents",
    "load_forward_mode",
    "make_dual",
    "reverse_tangents",
    "twice_reverse_tangents",
]

Residual = Callable[..., Tensor]


@functools.cache
def load_forward_mode() -> None:
    """Torch compiles its rules for forward mode at the first use, by a function that it deprecates itself."""
    one = torch.ones(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.sin, (one,), (one,))


def make_dual(constant: Tensor, moving: Tensor) -> Tensor:
    """A constant, with a tangent of zeros where one number, ``moving``, has a tangent.

    What has none is added and multiplied by reference functions written in Python, half a millisecond each and a second
    at their first use.
    """
    if not is_wrapped(moving):
        return constant
    return torch.where(torch.ones((), dtype=torch.bool, device=constant.device), constant, moving)


_CELLS = 250_000
"""Numbers of the tangents that are made together: on the way to them a function holds several times as many."""


def directions_at_once(values: int) -> int:
    """Directions along which so many values are differentiated together.

    Example:
        >>> directions_at_once(4_500), directions_at_once(360_000)
        (55, 1)
    """
    return max(1, _CELLS // max(values, 1))


def forward_tangents(function: Residual, values: int = 1) -> Residual:
    """The transposed Jacobian, a row for each parameter; of a function of many ``values`` a few rows at a time."""
    load_forward_mode()

    def tangents(theta: Tensor, *data: Any) -> Tensor:
        def along(direction: Tensor) -> Tensor:
            return torch.func.jvp(lambda t: function(t, *data), (theta,), (direction,))[1]

        basis = torch.eye(theta.shape[0], dtype=theta.dtype, device=theta.device)
        few = directions_at_once(values)
        # all of them in one chunk would lie otherwise in memory, and be rounded otherwise in what follows
        return torch.func.vmap(along, chunk_size=None if few >= len(basis) else few)(basis)

    return tangents


def forward_jacobian(function: Residual, theta: Tensor, values: int) -> Tensor:
    """As ``torch.func.jacfwd`` has it, of a function of so many values."""
    return forward_tangents(function, values)(theta).movedim(0, -1)


def twice_reverse_tangents(function: Residual) -> Residual:
    """The tangents as slopes of what reverse mode makes of weights of the values, which is linear in these.

    Forward mode does in Python what torch does here in C++, unless a constant has a tangent too (:func:`make_dual`). It is
    used where reverse mode has no finite answer, as beside an infinite slope that ``torch.where`` leaves out, and where
    there is no second derivative. Torch takes that for 0, so a function's first answer is compared along one direction.
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
"""Whether a function's tangents by reverse mode of reverse mode were those of forward mode when they were compared."""


def _agree(rows: Tensor, function: Residual, theta: Tensor, *data: Any) -> bool:
    """Whether tangents are those of forward mode along one direction."""
    load_forward_mode()
    sizes = rows.flatten(1).abs().amax(1)
    # each parameter by as much as the others, in the values
    direction = torch.where((sizes > 0) & sizes.isfinite(), 1.0 / sizes, 1.0)
    along = torch.func.jvp(lambda t: function(t, *data), (theta,), (direction,))[1]
    off = (torch.tensordot(direction, rows, 1) - along).abs().amax()
    return bool(off <= 1e3 * torch.finfo(theta.dtype).eps ** 0.5 * along.abs().amax())


def _twice_reversed(function: Residual, theta: Tensor, *data: Any) -> Tensor | None:
    """None where reverse mode cannot be had."""
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


def reverse_tangents(function: Residual) -> Residual:
    def tangents(theta: Tensor, *data: Any) -> Tensor:
        jacobian: Tensor = torch.func.jacrev(function)(theta, *data)
        return jacobian.movedim(-1, 0)

    return tangents
