"""Test of residuals for tails heavier than a Gaussian's, and the share of errors beyond three scales.

A finite σ is not evidence of heavy tails: with Gaussian noise the maximum-likelihood κ = 1/σ² is positive in about half
of all samples. The test statistic is twice the log-likelihood ratio against the Gaussian on the same domain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.arrays import Data
from mkc_torch._support.effective_size import effective_size
from mkc_torch.density._residuals import Residuals, channel_values, checked_domain, checked_residuals, checked_weight
from mkc_torch.density.energy import KAPPA_MAX, energy_dkappa, energy_dz, energy_value
from mkc_torch.density.head import head_rule, integrate, tail_density
from mkc_torch.density.likelihood import DensityState, initial_state, maximise

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

GAUSSIAN_BELOW = 2.71
"""5 % point of the equal mixture of χ²₀ and χ²₁, because κ = 0 is on the boundary: Chernoff 1954, Self & Liang 1987."""

REACH_SCALES = 3.0
"""Beginning of the tail, in scales d."""

GAUSSIAN_SHARE = math.erfc(REACH_SCALES / math.sqrt(2.0))
"""Share of Gaussian errors beyond three standard deviations, 0.27 %."""

_MAX_STEPS = 200
"""Newton steps of each of the two fits, at most."""

_TOLERANCE = 1e-13
"""Gain, in nats per residual, at which a fit has converged; the ratio of a million residuals is exact to 1e-6."""

_MOST_CORRELATED = 1.0 - 1e-9
"""Upper limit of the squared correlation of the estimates of κ and log d, to keep their covariance finite."""


class ChannelTails(NamedTuple):
    """Test of a channel's tails as plain numbers.

    Attributes:
        likelihood_ratio: twice the log-likelihood ratio of the MKC density and the Gaussian.
        share_beyond, share_error: share of the errors expected beyond 3 d, and its standard error.

    Example:
        >>> str(ChannelTails(31.2, 0.041, 0.006)), str(ChannelTails(1.3, 0.0027, 0.0014))
        ('heavy-tailed: 4.1 ± 0.6 % of the errors beyond 3 d (0.27 % if Gaussian)', 'Gaussian')
    """

    likelihood_ratio: float
    share_beyond: float
    share_error: float

    @property
    def is_gaussian(self) -> bool:
        """Whether the ratio is below 2.71: a Gaussian is not rejected at the 5 % level."""
        return self.likelihood_ratio < GAUSSIAN_BELOW

    def __str__(self) -> str:
        if self.is_gaussian:
            return "Gaussian"
        if self.share_beyond == 0.0:
            return "heavy-tailed, on a domain that ends within 3 d"
        share = percent_with_error(self.share_beyond, self.share_error)
        return f"heavy-tailed: {share} of the errors beyond 3 d ({100.0 * GAUSSIAN_SHARE:.2f} % if Gaussian)"


def percent_with_error(share: float, error: float) -> str:
    """A share and its standard error in per cent, rounded to the first digit of the error.

    Example:
        >>> percent_with_error(0.0412, 0.0058), percent_with_error(0.31, 0.021), percent_with_error(0.0031, 0.0002)
        ('4.1 ± 0.6 %', '31 ± 2 %', '0.31 ± 0.02 %')
    """
    places = 1 if error <= 0.0 else min(max(-math.floor(math.log10(100.0 * error)), 0), 4)
    return f"{100.0 * share:.{places}f} ± {100.0 * error:.{places}f} %"


@dataclass(frozen=True)
class Tails:
    """Test of residuals for tails heavier than a Gaussian's: the result of :func:`assess_tails`.

    ``str(tails)`` has a line for each channel.

    Attributes:
        likelihood_ratio: twice the log-likelihood of the MKC fit minus that of the Gaussian fit on the same domain,
            >= 0, (*, m).
        is_gaussian: whether the ratio is below 2.71, (*, m): the Gaussian is not rejected at the 5 % level.
        share_beyond: probability of an error beyond 3 d, in [0, 1], (*, m): of the MKC fit, or of the Gaussian fit
            where ``is_gaussian``, 0.0027 on a wide domain.
        share_error: standard error of ``share_beyond``, (*, m). Where ``is_gaussian``, it covers what the test may have
            missed: ``share_beyond + 2 share_error`` is at least two standard errors above the share of the MKC fit.
        share_observed: weighted share of the given residuals beyond 3 d, (*, m). If it differs from ``share_beyond`` by
            several ``share_error``, the tail is not flat and the MKC density does not describe it.
        sigma, d: bandwidth and scale of the MKC fit, (*, m).
        bound: half-width of the domain of both fits, (*, m).
        count: number of independent residuals that the test assumes, (*, m).

    Example:
        >>> print(Tails(*(torch.tensor([v]) for v in (31.2, False, 0.041, 0.006, 0.043, 2.3, 0.5, 5.0, 500.0))))
        heavy-tailed: 4.1 ± 0.6 % of the errors beyond 3 d (0.27 % if Gaussian)
    """

    likelihood_ratio: Float[Tensor, "*batch m"]
    is_gaussian: Bool[Tensor, "*batch m"]
    share_beyond: Float[Tensor, "*batch m"]
    share_error: Float[Tensor, "*batch m"]
    share_observed: Float[Tensor, "*batch m"]
    sigma: Float[Tensor, "*batch m"]
    d: Float[Tensor, "*batch m"]
    bound: Float[Tensor, "*batch m"]
    count: Float[Tensor, "*batch m"]

    @property
    def channels(self) -> tuple[ChannelTails, ...]:
        """Test of each channel as plain numbers, batches flattened."""
        numbers = (self.likelihood_ratio, self.share_beyond, self.share_error)
        return tuple(map(ChannelTails, *(t.flatten().tolist() for t in numbers)))

    def __str__(self) -> str:
        channels = self.channels
        if len(channels) == 1:
            return str(channels[0])
        return "\n".join(f"channel {k}: {channel}" for k, channel in enumerate(channels))


@torch.no_grad()
def assess_tails(
    error: Float[Tensor, "*batch N m"] | Data,
    weight: Float[Tensor, "*batch N m"] | Data | None = None,
    *,
    bound: float | Float[Tensor, " m"] | None = None,
    d_min: float | Float[Tensor, " m"] | None = None,
    count: float | Float[Tensor, " m"] | None = None,
) -> Tails:
    """Test residuals for tails heavier than a Gaussian's, and estimate the share of errors beyond 3 d.

    The MKC density and the Gaussian (σ = ∞) are fitted by maximum likelihood on the same domain. The Gaussian is
    rejected if twice the log-likelihood ratio reaches 2.71, the 5 % point of the equal mixture of χ²₀ and χ²₁ (κ =
    1/σ² = 0 is on the boundary of the parameter space). The rate of false rejections is 5 % asymptotically and lower in
    small samples: 3 % at 500 residuals, 1.5 % at 100.

    Tails lighter than a Gaussian's, such as those of uniform errors, are not rejected. The test assumes independent
    residuals of mean zero. Autocorrelated residuals contain less information: pass the effective number of independent
    residuals as ``count``, or expect more than 5 % false rejections.

    The standard error of the share comes from the delta method with the Fisher information of the MKC density. It does
    not include the bias of a misspecified density, which ``share_observed`` reveals: for Gaussian noise with 1 % (5 %)
    of uniform outliers up to 10 d the share is 2.0 % (5.2 %), whereas 1.4 % (4.5 %) are observed.

    Computed in float64; the result has the dtype of ``error``.

    Args:
        error: residuals, in any unit; a tensor, a NumPy array or a DataFrame.
        weight: non-negative weights of the residuals, (*, N, m) or (N, 1).
        bound: half-width of the domain, in the unit of ``error``, at least two robust scales; default from
            :func:`mkc_torch.density.domain.domain_rule`. The ratio depends on it slightly: compare at equal bounds.
        d_min: floor of d in both fits, in the unit of ``error``; default a tenth of the robust scale.
        count: number of independent residuals, at most N or the sum of the weights; default N, and with weights
            ``(Σw)² / Σw²`` (Kish).

    Raises:
        TypeError: residuals or weights that are not real numbers, or a parameter that is not a number.
        ValueError: fewer than two residuals, non-finite residuals, a channel of zeros, a parameter out of range, or
            shapes that do not fit.

    References:
        Chernoff, "On the distribution of the likelihood ratio", Annals of Mathematical Statistics 25 (1954).
        Self & Liang, "Asymptotic properties of maximum likelihood estimators and likelihood ratio tests under
        nonstandard conditions", JASA 82 (1987), case 5.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> error = torch.randn(2000, 2, generator=generator, dtype=torch.float64)
        >>> error[:100, 1] *= 8.0
        >>> print(assess_tails(error, bound=30.0))
        channel 0: Gaussian
        channel 1: heavy-tailed: ... of the errors beyond 3 d (0.27 % if Gaussian)
    """
    error = checked_residuals(error)
    dtype = error.dtype
    residuals = checked_weight(weight, error.double())
    error, _, share, scale = residuals
    _refuse_zeros(error if share is None else torch.where(share > 0, error, 0.0))
    domain = checked_domain(residuals, bound, d_min)
    number = _count(residuals, count)

    def fitted(kappa: Tensor | None) -> DensityState:
        start = initial_state(error, share, scale, *domain, kappa=kappa)
        return maximise(error, share, start, max_iter=_MAX_STEPS, tol=_TOLERANCE).state

    mkc, gaussian = fitted(None), fitted(torch.zeros_like(scale))
    # the Gaussian is a special case of the MKC density, so a less likely fit is a local maximum
    mkc = _where(mkc.value < gaussian.value, mkc, gaussian)
    ratio = (2.0 * number * (gaussian.value - mkc.value)).clamp(min=0.0)
    is_gaussian = ratio < GAUSSIAN_BELOW
    free_share, free_error = _share_beyond(mkc, number)
    gaussian_share, gaussian_error = _share_beyond(gaussian, number)
    # share + 2 errors of the Gaussian is at least share + 2 errors of the free fit
    undetected = torch.maximum(gaussian_error, 0.5 * (free_share - gaussian_share) + free_error)
    probability = torch.where(is_gaussian, gaussian_share, free_share)
    standard_error = torch.where(is_gaussian, undetected, free_error)
    d = torch.exp(mkc.log_d)
    beyond = (error.abs() > REACH_SCALES * d.unsqueeze(-2)).to(error.dtype)
    observed = beyond.mean(-2) if share is None else (share * beyond).sum(-2)
    sigma, half_width = mkc.kappa.rsqrt(), torch.exp(mkc.log_bound)
    return Tails(
        ratio.to(dtype),
        is_gaussian,
        *(t.to(dtype) for t in (probability, standard_error, observed, sigma, d, half_width, number)),
    )


def time_series_tails(error: Float[Tensor, "N m"]) -> tuple[ChannelTails, ...]:
    """Test of each channel's tails in a time series, with the effective sample size of its autocorrelation.

    The autocorrelation is that of ``|e| / (|e| + scale)``, which is robust to outliers.

    Args:
        error: residuals in the order of time.

    Returns:
        A test per channel; empty if a channel's residuals are all 0 (an exact fit).

    Example:
        >>> error = torch.randn(500, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> [str(channel) for channel in time_series_tails(error)], time_series_tails(0.0 * error)
        (['Gaussian'], ())
    """
    if bool((error == 0).all(-2).any()):
        return ()
    size = error.abs().double()
    bounded = size / (size + checked_weight(None, size).scale)
    count = error.new_tensor([effective_size(channel) for channel in bounded.unbind(-1)])
    return assess_tails(error, count=count).channels


def _count(residuals: Residuals, count: float | Tensor | None) -> Float[Tensor, "*batch m"]:
    """Number of independent residuals: ``count``, or Kish's effective sample size."""
    error, weight, share, scale = residuals
    number = channel_values("count", count, error)
    if number is None:
        return torch.full_like(scale, error.shape[-2]) if share is None else share.square().sum(-2).reciprocal()
    # weights may be counts of repetitions
    most = error.shape[-2] if weight is None else max(error.shape[-2], float(weight.sum(-2).max()))
    if bool((number > most).any()):
        raise ValueError(
            f"Expected argument `count` to be at most the number of residuals, {most:.6g}, but got "
            f"{float(number.max()):.6g}; it is the number of independent residuals, leave it out if all are."
        )
    return number


def _refuse_zeros(error: Float[Tensor, "*batch N m"]) -> None:
    """Raise ValueError for a channel whose residuals are all 0: its tails have no scale."""
    exact = (error == 0).all(-2)
    if bool(exact.any()):
        index = tuple(exact.nonzero()[0].tolist())
        raise ValueError(
            "Expected argument `error` with a residual of positive weight that is not 0 in every channel but got zeros "
            f"alone in channel {index[-1] if len(index) == 1 else index}; an exact fit has no tails, leave the "
            "channel out."
        )


def _where(condition: Bool[Tensor, "*batch m"], yes: DensityState, no: DensityState) -> DensityState:
    """``yes`` where the condition holds, else ``no``, per channel."""
    return replace(
        no,
        kappa=torch.where(condition, yes.kappa, no.kappa),
        log_d=torch.where(condition, yes.log_d, no.log_d),
        value=torch.where(condition, yes.value, no.value),
    )


class _Moments(NamedTuple):
    """Integral of the density, and moments of the derivatives of the negative energy by κ and log d, each (*, m)."""

    partition: Tensor
    kappa: Tensor
    log_d: Tensor
    kappa_kappa: Tensor
    kappa_log_d: Tensor
    log_d_log_d: Tensor


def _moments(kappa: Float[Tensor, "*batch m"], length: Float[Tensor, "*batch m"]) -> _Moments:
    """Moments of the derivatives of the log-density over ``|u| <= length``, u in units of d."""
    tail = tail_density(kappa)
    nodes, weights = head_rule(kappa, length)
    each = kappa.unsqueeze(-1)
    density = torch.exp(-energy_value(nodes, each))
    by_kappa, by_log_d = -energy_dkappa(nodes, each), nodes * energy_dz(nodes, each)
    # on the flat tail the energy is 1 / κ for every d
    tail_by_kappa = torch.where(tail > 0, kappa, 1.0).pow(-2)
    zero = torch.zeros_like(tail)
    partition = integrate(density, tail, length, weights)

    def mean(values: Tensor, on_tail: Tensor) -> Tensor:
        return integrate(values * density, on_tail * tail, length, weights) / partition

    return _Moments(
        partition,
        mean(by_kappa, tail_by_kappa),
        mean(by_log_d, zero),
        mean(by_kappa.square(), tail_by_kappa.square()),
        mean(by_kappa * by_log_d, zero),
        mean(by_log_d.square(), zero),
    )


def _share_beyond(
    state: DensityState, count: Float[Tensor, "*batch m"]
) -> tuple[Float[Tensor, "*batch m"], Float[Tensor, "*batch m"]]:
    """Probability beyond 3 d and its standard error by the delta method; a parameter at its limit is taken as known."""
    kappa = state.kappa
    length = torch.exp(state.log_bound - state.log_d)
    inner_length = length.clamp(max=REACH_SCALES)
    whole, inner = _moments(kappa, length), _moments(kappa, inner_length)
    inside = inner.partition / whole.partition
    wide = length > REACH_SCALES
    share = torch.where(wide, 1.0 - inside, 0.0).clamp(min=0.0)
    # the domain is fixed, so its length in units of d falls with d
    edge = 2.0 * length * torch.exp(-energy_value(length, kappa)) / whole.partition
    slope_kappa = torch.where(wide & (kappa < KAPPA_MAX), inside * (whole.kappa - inner.kappa), 0.0)
    free_d = (state.log_d > state.log_d_min) & (state.log_d < state.log_bound)
    slope_log_d = torch.where(wide & free_d, -inside * edge, 0.0)
    tiny = torch.finfo(kappa.dtype).tiny
    fisher_kappa = (whole.kappa_kappa - whole.kappa.square()).clamp(min=tiny)
    fisher_log_d = (whole.log_d_log_d - whole.log_d.square()).clamp(min=tiny)
    # normalised, because the information on κ may be orders of magnitude smaller than that on log d
    correlation = (whole.kappa_log_d - whole.kappa * whole.log_d) * fisher_kappa.rsqrt() * fisher_log_d.rsqrt()
    correlation = torch.where(free_d & (kappa < KAPPA_MAX), correlation, 0.0)
    a, b = slope_kappa * fisher_kappa.rsqrt(), slope_log_d * fisher_log_d.rsqrt()
    determinant = 1.0 - correlation.square().clamp(max=_MOST_CORRELATED)
    variance = (a.square() - 2.0 * correlation * a * b + b.square()) / determinant
    return share, (variance.clamp(min=0.0) / count).sqrt()
