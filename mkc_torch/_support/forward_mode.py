"""Tangents of a function, by forward mode or by reverse mode."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

__all__ = ["Residual", "beside", "forward_tangents", "load_forward_mode", "reverse_tangents"]

Residual = Callable[..., Tensor]


@functools.cache
def load_forward_mode() -> None:
    """Torch compiles its rules for forward mode at the first use, by a function that it deprecates itself."""
    one = torch.ones(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.sin, (one,), (one,))


def beside(constant: Tensor, moving: Tensor) -> Tensor:
    """A constant, with a tangent of zeros where one number, ``moving``, has a tangent.

    What has none is added and multiplied by reference functions written in Python, half a millisecond each and a second
    at their first use.
    """
    if not torch._C._functorch.is_functorch_wrapped_tensor(moving):
        return constant
    return torch.where(torch.ones((), dtype=torch.bool, device=constant.device), constant, moving)


def forward_tangents(function: Residual) -> Residual:
    load_forward_mode()

    def tangents(theta: Tensor, *data: Any) -> Tensor:
        def along(direction: Tensor) -> Tensor:
            return torch.func.jvp(lambda t: function(t, *data), (theta,), (direction,))[1]

        basis = torch.eye(theta.shape[0], dtype=theta.dtype, device=theta.device)
        return torch.func.vmap(along)(basis)

    return tangents


def reverse_tangents(function: Residual) -> Residual:
    def tangents(theta: Tensor, *data: Any) -> Tensor:
        jacobian: Tensor = torch.func.jacrev(function)(theta, *data)
        return jacobian.movedim(-1, 0)

    return tangents
