"""Maximum-likelihood fit of σ and d to residuals: the E-step of MKC-EM (Algorithm 2 of the paper).

The mean negative log-likelihood of each channel is a function of two parameters, minimised by the safeguarded Newton
method of :mod:`mkc_torch.density.likelihood`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole
from mkc_torch._support.arrays import Data
from mkc_torch.density._residuals import (
    Domain,
    Residuals,
    channel_values,
    checked_domain,
    checked_residuals,
    checked_weight,
)
from mkc_torch.density.energy import SIGMA_LEAST
from mkc_torch.density.likelihood import initial_state, maximise
from mkc_torch.density.tails import Tails, assess_tails

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True)
class DensityFit:
    """A fitted MKC density: the result of :func:`fit_density`.

    Attributes:
        sigma, d, bound: bandwidth (``inf`` for a Gaussian channel), scale and half-width of the domain, (*, m).
        log_likelihood: mean log-likelihood, in nats per residual, (*, m); compare only at equal ``bound``.
        converged: whether the fit of each channel converged, (*, m).
        n_iter: number of Newton steps.

    Example:
        >>> from mkc_torch import MKCDistribution
        >>> error = torch.linspace(-1.0, 1.0, 101, dtype=torch.float64).erfinv().clamp(-3.0, 3.0).unsqueeze(-1)
        >>> fit = fit_density(error, bound=10.0)
        >>> round(float(fit.bound)), bool(fit.converged)
        (10, True)
        >>> density = MKCDistribution(fit.sigma, fit.d, fit.bound)
        >>> bool((density.log_prob(error).mean(0) - fit.log_likelihood).abs() < 1e-9)
        True
    """

    sigma: Float[Tensor, "*batch m"]
    d: Float[Tensor, "*batch m"]
    bound: Float[Tensor, "*batch m"]
    log_likelihood: Float[Tensor, "*batch m"]
    converged: Bool[Tensor, "*batch m"]
    n_iter: int
    _residuals: Residuals = field(repr=False, compare=False)
    _domain: Domain = field(repr=False, compare=False)

    @cached_property
    def tails(self) -> Tails:
        """Test of the residuals for tails heavier than a Gaussian's: :func:`assess_tails` on the same domain.

        Computed at the first access, from a copy of the residuals. It fits σ and d even if they were fixed in this fit.

        Raises:
            ValueError: all residuals of a channel are 0.
        """
        error, weight = self._residuals.error, self._residuals.weight
        return assess_tails(error, weight, bound=self._domain.bound, d_min=self._domain.d_min)


def fit_density(
    error: Float[Tensor, "*batch N m"] | Data,
    *,
    sigma: float | Float[Tensor, " m"] | None = None,
    d: float | Float[Tensor, " m"] | None = None,
    bound: float | Float[Tensor, " m"] | None = None,
    weight: Float[Tensor, "*batch N m"] | Data | None = None,
    d_min: float | Float[Tensor, " m"] | None = None,
    max_iter: int = 100,
    tol: float = 1e-12,
) -> DensityFit:
    """Maximum-likelihood σ and d of residuals, all channels and batches at once.

    Args:
        error: residuals (*, N, m) of a fit; a tensor, a NumPy array or a DataFrame. They are not centred here.
        sigma: fixed σ in [0.05, inf] (``inf``: Gaussian); only d is fitted, Remark 7 of the paper.
        d: fixed d; only σ is fitted, Remark 6.
        bound: half-width of the domain, in the unit of ``error``, at least two robust scales; default from
            :func:`domain_rule`. Residuals beyond it have the density of the flat tail.
        weight: non-negative weights of the residuals, (*, N, m) or (N, 1).
        d_min: floor of d; default a tenth of the robust scale, because the likelihood of interpolated residuals grows
            without limit as d → 0.
        max_iter: maximum number of Newton steps.
        tol: a channel has converged when a step lowers its mean negative log-likelihood by less than this, in nats.

    Returns:
        The fit, with the domain it was made on: likelihoods compare only on the same domain.

    Raises:
        TypeError: residuals or weights that are not real numbers, or a parameter that is not a number.
        ValueError: fewer than two residuals, non-finite residuals, a parameter out of range, or shapes that do not fit.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (29)-(31), Algorithm 2, Remarks 6 and 7.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> error = torch.randn(10_000, 1, generator=generator, dtype=torch.float64)
        >>> fit = fit_density(error)
        >>> bool(fit.sigma > 8), round(float(fit.d), 1)
        (True, 1.0)
    """
    error = checked_residuals(error)
    checked_whole("max_iter", max_iter, 1, "100 is ample")
    checked_number("tol", tol, ends="[)", advice="1e-12 suits float64")
    residuals = checked_weight(weight, error)
    domain = checked_domain(residuals, bound, d_min)
    fixed_sigma = channel_values("sigma", sigma, error, SIGMA_LEAST, infinite=True)
    fixed_d = channel_values("d", d, error)
    if fixed_d is not None and bound is not None and bool((fixed_d >= domain.bound).any()):
        raise ValueError(f"Expected argument `d` below `bound` but got {d} and {bound}; widen `bound`.")
    start = initial_state(
        error,
        residuals.share,
        residuals.scale,
        *domain,
        kappa=None if fixed_sigma is None else fixed_sigma.pow(-2),
        d=fixed_d,
    )
    state, converged, n_iter = maximise(error, residuals.share, start, max_iter=max_iter, tol=tol)
    return DensityFit(
        sigma=state.kappa.rsqrt(),
        d=torch.exp(state.log_d),
        bound=torch.exp(state.log_bound),
        log_likelihood=-state.value,
        converged=converged,
        n_iter=n_iter,
        # a copy, because the caller may overwrite the residuals before the tails are computed
        _residuals=residuals.detached_copy(),
        _domain=domain,
    )
