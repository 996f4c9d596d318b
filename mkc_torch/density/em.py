"""Helpers for alternating E-steps on (σ, d) with other steps, for linear and nonlinear models."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.density.likelihood import DensityState, initial_state

if TYPE_CHECKING:
    from jaxtyping import Float


def normalised(weight: Float[Tensor, "*batch N m"] | None) -> Float[Tensor, "*batch N m"] | None:
    """Weights that sum to 1 in each channel, as an E-step needs them."""
    return None if weight is None else weight / weight.sum(-2, keepdim=True)


def weighted_rms(
    residual: Float[Tensor, "*batch N m"], weight: Float[Tensor, "*batch N m"] | None, least: Float[Tensor, "*batch m"]
) -> Float[Tensor, "*batch m"]:
    """Root mean square of each channel under normalised weights (the d of a Gaussian), at least ``least``, (*, m)."""
    square = residual.square()
    mean = square.mean(-2) if weight is None else (weight * square).sum(-2)
    return torch.maximum(mean.sqrt(), least)


def gaussian_state(
    residual: Float[Tensor, "*batch N m"], weight: Float[Tensor, "*batch N m"] | None, state: DensityState
) -> DensityState:
    """State of the Gaussian fitted to the residuals on the domain of ``state``, for comparison with it."""
    least = torch.exp(state.log_d_min)
    return initial_state(residual, weight, least, torch.exp(state.log_bound), least, kappa=torch.zeros_like(least))


def replace_problems(whole: DensityState, index: Tensor, part: DensityState) -> DensityState:
    """Copy of ``whole`` with the problems at ``index`` replaced by ``part``."""
    names = ("kappa", "log_d", "log_bound", "log_d_min", "damping", "value")
    return replace(whole, **{name: getattr(whole, name).index_copy(0, index, getattr(part, name)) for name in names})
