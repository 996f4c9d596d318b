"""Density with several kernels per channel: its tail decreases with the error, whereas a single kernel's is flat.

The energy is Σ_j θ_j (1 - exp(-e² / (2 h_j²))), with a kernel for each bandwidth of a geometric sequence and a kernel
of infinite bandwidth, e². A single kernel of depth θ = σ² and bandwidth h = σ d is the MKC density. A continuum of
kernels gives Student's t, because log(1 + e²) = ∫ (1 - exp(-t e²)) exp(-t) / t dt. In the depths θ ≥ 0 the density is
an exponential family, so its likelihood has a single maximum: neither a start nor a bandwidth has to be chosen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.arguments import as_numbers, refuse_not_real
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.domain import refuse_bad_bound

if TYPE_CHECKING:
    from jaxtyping import Float

_NARROWEST = 0.5
"""Smallest bandwidth, in robust scales. Tuned on draws of the Cauchy and the Gaussian distribution."""

_RATIO = 2.0
"""Ratio of successive bandwidths."""

_LEAST_ERROR = 0.02
"""Lower limit of absolute errors, in robust scales: errors of exactly 0 would make the density a spike."""

_NODES = 400
"""Nodes of the normaliser's quadrature in asinh(error); the error is 1e-9 nats on a domain of 1e8 scales."""

_RULE = np.polynomial.legendre.leggauss(_NODES)
"""Nodes on [-1, 1] and weights."""

_BARRIERS = tuple(10.0**-k for k in range(1, 10))
"""Successive μ of the barrier -μ Σ log θ, which keeps depths positive; the last costs 1e-8 nats."""

_MAX_STEPS = 50
"""Newton steps per barrier, at most."""

_TOLERANCE = 1e-10
"""Decrease, in nats, below which Newton's method has converged."""


@dataclass(frozen=True)
class KernelsFit:
    """A fitted density with several kernels per channel: the result of :func:`fit_kernels`.

    Attributes:
        bandwidth: bandwidths of the kernels, in the unit of the errors, ``inf`` last, (J,) for each channel.
        depth: depths of the kernels, in nats, (J,) for each channel: each kernel's energy far from 0. For the infinite
            bandwidth, the coefficient of ``(e / bound)² / 2``.
        bound: half-width of the domain, (m,).
        log_likelihood: mean log-likelihood, in nats per error, (m,); compare only at equal bounds.
    """

    bandwidth: tuple[Float[Tensor, " J"], ...]
    depth: tuple[Float[Tensor, " J"], ...]
    bound: Float[Tensor, " m"]
    log_normalizer: Float[Tensor, " m"]
    log_likelihood: Float[Tensor, " m"]

    def energy(self, error: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
        """Negative log-density minus its value at 0, in nats; constant beyond the bound."""
        size = torch.minimum(error.abs().to(self.bound), self.bound)
        channels = zip(size.unbind(-1), self.bandwidth, self.depth, self.bound, strict=True)
        return torch.stack([_features(e, h, a) @ depth for e, h, depth, a in channels], -1)

    def log_prob(self, error: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
        """Log-density of errors, in nats."""
        return -self.energy(error) - self.log_normalizer


def fit_kernels(error: Float[Tensor, "N m"], *, bound: float | Float[Tensor, " m"] | None = None) -> KernelsFit:
    """Maximum-likelihood depths of a series of kernels, for residuals with decreasing tails: delays, returns, claims.

    For outliers that are uniform over the domain, :func:`mkc_torch.fit_density` needs two parameters only.

    Args:
        error: residuals (N, m) of a fit. They are not centred here.
        bound: half-width of the domain; by default the largest absolute error.

    Raises:
        TypeError: residuals that are not a real tensor.
        ValueError: fewer than two residuals, non-finite residuals, a channel with more than half of them equal to 0, or
            a bound below four robust scales.

    Example:
        >>> u = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000
        >>> cauchy = torch.tan(math.pi * (u - 0.5)).unsqueeze(-1)
        >>> fit = fit_kernels(cauchy)
        >>> far = fit.log_prob(torch.tensor([[10.0], [100.0]], dtype=torch.float64)).exp()
        >>> bool((far[0] / far[1]).log10().round() == 2)  # as the square of the error
        True
    """
    refuse_not_real("error", error)
    if error.dim() != 2 or len(error) < 2 or error.shape[1] == 0 or not bool(torch.isfinite(error).all()):
        raise ValueError(
            f"Expected argument `error` of shape (N >= 2, m), finite throughout, but got {tuple(error.shape)}; for a "
            "single channel pass error.unsqueeze(-1), and leave out residuals that are not finite."
        )
    error = error.detach().double()
    scale = robust_scale(error, None)
    if not bool((scale > 0).all()):
        raise ValueError(
            f"Expected argument `error` with a robust scale above 0 but got {scale.tolist()}: more than half of a "
            "channel's residuals are 0, which has no density."
        )
    largest = error.abs().amax(0)
    half_width = torch.maximum(largest, 4.0 * scale) if bound is None else as_numbers("bound", bound).double()
    if half_width.shape not in ((), (1,), scale.shape):
        raise ValueError(
            f"Expected argument `bound` to be a number or of shape {tuple(scale.shape)} but got "
            f"{tuple(half_width.shape)}."
        )
    half_width = half_width.to(error.device).expand_as(scale)
    refuse_bad_bound(half_width, scale)
    if not bool((half_width >= 4.0 * scale).all()):
        raise ValueError(
            f"Expected argument `bound` to be at least four robust scales of the residuals, {(4.0 * scale).tolist()}, "
            f"but got {bound}; it is the half-width of the domain that errors can lie in."
        )
    found = [_fitted(*channel) for channel in zip(error.unbind(-1), scale, half_width, strict=True)]
    bandwidth, depth, log_normalizer, log_likelihood = zip(*found, strict=True)
    return KernelsFit(bandwidth, depth, half_width, torch.stack(log_normalizer), torch.stack(log_likelihood))


def _fitted(error: Float[Tensor, " N"], scale: Tensor, bound: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bandwidths, depths, log-normaliser and mean log-likelihood of a channel."""
    octaves = math.floor(math.log(float(bound / scale) / _NARROWEST, _RATIO))
    ladder = [_NARROWEST * float(scale) * _RATIO**k for k in range(octaves + 1)]
    bandwidth = error.new_tensor([*ladder, math.inf])
    size = torch.minimum(error.abs().clamp(min=_LEAST_ERROR * float(scale)), bound)
    # plus an error at the bound: without errors far out, the most likely tail would have no mass
    mean = _features(torch.cat([size, bound.unsqueeze(0)]), bandwidth, bound).mean(0)
    nodes, weights = _quadrature(scale, bound)
    basis = _features(nodes, bandwidth, bound)
    depth = torch.full_like(mean, 0.5)
    for barrier in _BARRIERS:
        for _ in range(_MAX_STEPS):
            depth, decrease = _newton_step(depth, mean, basis, weights, barrier)
            if decrease < _TOLERANCE:
                break
    log_normalizer = _log_normalizer(depth, basis, weights)
    own = _features(size, bandwidth, bound).mean(0)
    return bandwidth, depth, log_normalizer, -(own @ depth) - log_normalizer


def _features(size: Float[Tensor, " N"], bandwidth: Float[Tensor, " J"], bound: Tensor) -> Float[Tensor, "N J"]:
    """``1 - exp(-e² / (2 h²))`` of each kernel; ``(e / bound)² / 2`` for the infinite bandwidth."""
    finite = -torch.expm1(-0.5 * (size.unsqueeze(-1) / bandwidth[:-1]).square())
    return torch.cat([finite, 0.5 * (size / bound).square().unsqueeze(-1)], -1)


def _quadrature(scale: Tensor, bound: Tensor) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"]]:
    """Nodes in (0, bound), dense near 0 and uniform in the logarithm far away, and weights for both signs."""
    x, w = (torch.from_numpy(v).to(bound) for v in _RULE)
    near = 0.1 * scale
    reach = torch.asinh(bound / near)
    place = 0.5 * (x + 1.0) * reach
    return near * place.sinh(), near * place.cosh() * reach * w


def _log_normalizer(depth: Tensor, basis: Tensor, weights: Tensor) -> Tensor:
    return torch.log(weights @ torch.exp(-basis @ depth))


def _newton_step(
    depth: Float[Tensor, " J"],
    mean: Float[Tensor, " J"],
    basis: Float[Tensor, "K J"],
    weights: Float[Tensor, " K"],
    barrier: float,
) -> tuple[Float[Tensor, " J"], float]:
    """Depths after a Newton step on the mean negative log-likelihood with barrier, and its decrease in nats."""

    def value(at: Tensor) -> Tensor:
        return mean @ at + _log_normalizer(at, basis, weights) - barrier * at.log().sum()

    density = weights * torch.exp(-basis @ depth)
    density = density / density.sum()
    expected = density @ basis
    centred = basis - expected
    gradient = mean - expected - barrier / depth
    hessian = (centred * density.unsqueeze(-1)).mT @ centred + torch.diag(barrier / depth.square())
    # scaled by the depths, so that the barrier's curvature is equal for all
    step = -depth * torch.linalg.solve(hessian * torch.outer(depth, depth), depth * gradient)
    shrinks = step < 0
    length = min(1.0, 0.95 * float((depth / -step)[shrinks].min())) if bool(shrinks.any()) else 1.0
    before, slope = value(depth), gradient @ step
    while length > 1e-12:
        after = value(depth + length * step)
        if after <= before + 1e-4 * length * slope:
            return depth + length * step, float(before - after)
        length *= 0.5
    return depth, 0.0
