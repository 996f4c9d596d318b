"""The E-step of MKC-EM on weighted residuals: σ and d of greatest likelihood, annealed and damped."""

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


class ChannelEstimate(NamedTuple):
    """κ = 1/σ² and d of each channel, and where the domain is too narrow for the residuals, each (m,)."""

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
    """σ and d that are likeliest for weighted residuals, Algorithm 2 of Li et al. (2023).

    A domain of less than two robust scales has no room for the density's head, as may happen while a network is
    untrained or diverges. Such a channel gets the Gaussian of half the bound, least squares, which pulls at every
    residual; it is reported as ``narrow``.

    Args:
        error: residuals.
        weight: weights ≥ 0, positive somewhere in every channel.
        bound: half-widths of the domain, in the unit of ``error``.
        d_min: floors under d.
        share: the part of the likeliest 1/σ² that is used, in (0, 1]; d is then fitted for that σ.

    Example:
        >>> error = torch.linspace(-2, 2, 101, dtype=torch.float64).unsqueeze(-1)
        >>> bound, d_min = torch.tensor([20.0]).double(), torch.tensor([1e-3]).double()
        >>> step = expectation_step(error, torch.ones_like(error), bound=bound, d_min=d_min)
        >>> step.kappa, step.d
        (tensor([0.], dtype=torch.float64), tensor([1.1662], dtype=torch.float64))
    """
    if error.shape[0] == 1:  # one that stands for many is two of half the weight
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
    """Part of the way from one d to the next, in log d; ``keep`` in [0, 1) is the part of the old one."""
    return torch.exp(torch.lerp(torch.log(after), torch.log(before), torch.as_tensor(keep).to(after)))


def damped_kappa(before: Float[Tensor, " m"], after: Float[Tensor, " m"], keep: Tensor | float) -> Float[Tensor, " m"]:
    """Part of the way from one κ = 1/σ² to the next, in log(κ + 0.02), which is finite at σ = ∞ and exact there."""
    s = torch.lerp(
        torch.log1p(after / _KAPPA_OFFSET), torch.log1p(before / _KAPPA_OFFSET), torch.as_tensor(keep).to(after)
    )
    return _KAPPA_OFFSET * torch.expm1(s)
