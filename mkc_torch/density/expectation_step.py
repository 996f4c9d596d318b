"""The E-step of MKC-EM on weighted residuals: maximum-likelihood σ and d, with annealing and damping."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.density.fit import fit_density

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_KAPPA_OFFSET = 0.02
"""Offset of κ in the logarithm in which it is damped."""


class ChannelEstimate(NamedTuple):
    """κ = 1/σ² and d of each channel, and whether the domain is too narrow for the residuals, each (m,)."""

    kappa: Float[Tensor, " m"]
    d: Float[Tensor, " m"]
    narrow: Bool[Tensor, " m"]


def expectation_step(
    error: Float[Tensor, "N m"],
    weight: Float[Tensor, "N m"],
    *,
    bound: Float[Tensor, " m"],
    d_min: Float[Tensor, " m"],
    share: float = 1.0,
) -> ChannelEstimate:
    """Maximum-likelihood σ and d of weighted residuals, Algorithm 2 of Li et al. (2023).

    A domain of less than two robust scales is too short for the density's head. This may happen while a network is
    untrained or diverges. Such a channel gets σ = ∞ (least squares) and d = half the bound, and is reported as
    ``narrow``.

    Args:
        error: residuals.
        weight: weights ≥ 0, with a positive weight in every channel.
        bound: half-widths of the domain, in the unit of ``error``.
        d_min: floors of d.
        share: factor on the maximum-likelihood 1/σ², in (0, 1]; d is then fitted for that σ.

    Example:
        >>> error = torch.linspace(-2, 2, 101, dtype=torch.float64).unsqueeze(-1)
        >>> bound, d_min = torch.tensor([20.0]).double(), torch.tensor([1e-3]).double()
        >>> step = expectation_step(error, torch.ones_like(error), bound=bound, d_min=d_min)
        >>> step.kappa, step.d
        (tensor([0.], dtype=torch.float64), tensor([1.1662], dtype=torch.float64))
    """
    if error.shape[0] == 1:  # a residual that represents many becomes two, so that a scale exists
        error, weight = error.expand(2, -1), weight.expand(2, -1)
    narrow = bound < 2.0 * robust_scale(error, weight)
    kappa, d = torch.zeros_like(bound), 0.5 * bound
    roomy = ~narrow
    if bool(roomy.any()):
        e, w, a, floor = error[:, roomy], weight[:, roomy], bound[roomy], d_min[roomy]
        fit = fit_density(e, weight=w, bound=a, d_min=floor)
        if share < 1.0:
            fit = fit_density(e, weight=w, bound=a, d_min=floor, sigma=fit.sigma / share**0.5)
        kappa[roomy], d[roomy] = fit.sigma.pow(-2), fit.d
    return ChannelEstimate(kappa.clamp(max=KAPPA_MAX), torch.maximum(d, d_min), narrow)


def damped(before: Float[Tensor, " m"], after: Float[Tensor, " m"], keep: Tensor | float) -> Float[Tensor, " m"]:
    """Damped d: interpolated from ``after`` to ``before`` in log d; ``keep`` in [0, 1) is the share of ``before``."""
    return torch.exp(torch.lerp(torch.log(after), torch.log(before), torch.as_tensor(keep).to(after)))


def damped_kappa(before: Float[Tensor, " m"], after: Float[Tensor, " m"], keep: Tensor | float) -> Float[Tensor, " m"]:
    """Damped κ = 1/σ²: interpolated as :func:`damped`, in log(κ + 0.02), which is finite and exact at σ = ∞."""
    s = torch.lerp(
        torch.log1p(after / _KAPPA_OFFSET), torch.log1p(before / _KAPPA_OFFSET), torch.as_tensor(keep).to(after)
    )
    return _KAPPA_OFFSET * torch.expm1(s)
