"""Fit a response with a prior, and compute its evidence and the covariance of its parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.response import Model, PlaceField
from mkc_torch.calibration.aided.turns import Turns
from mkc_torch.nonlinear import GaussianPrior, NonlinearFit
from mkc_torch.nonlinear import fit as nonlinear_fit

if TYPE_CHECKING:
    from jaxtyping import Float

_LEAST_INFLATION = 1.0
"""Smallest inflation of the samples' errors by autocorrelation."""


@dataclass(frozen=True)
class FittedResponse:
    """A fitted response.

    Attributes:
        model: the response.
        fit: the maximum likelihood fit of the MKC density, with the prior.
        covariance: covariance of the parameters, (p, p), by the autocorrelated errors of the samples and by the prior.
            Parameters that the samples do not determine have the variance of the prior.
        inflation: factor by which autocorrelation reduces the effective number of samples.
        evidence: log evidence, the log probability of the measurements averaged over the prior, in nats, by Laplace's
            approximation. Only comparable at equal bounds.
    """

    model: Model
    fit: NonlinearFit
    covariance: Float[Tensor, "p p"]
    inflation: float
    evidence: float


def judged(
    model: Model,
    start: Float[Tensor, " p"],
    measured: Float[Tensor, "N 3"],
    turns: Turns,
    weight: Float[Tensor, " N"],
    *,
    place: PlaceField | None = None,
    errors: Float[Tensor, " 12"] | None = None,
    bound: Tensor | None = None,
    inflation: float | None = None,
) -> FittedResponse:
    """Fit a response and compute its evidence.

    Args:
        model: the response.
        start: starting values of its parameters.
        measured: finite measurements in the order of time.
        turns: turns of the same samples.
        weight: weight of each sample in the mean direction of its window.
        place: prior of the field.
        errors: errors of the gyroscope for which the turns are corrected already.
        bound: bounds of the density, (3,), from another fit with which this fit is compared.
        inflation: inflation from another fit; 1 if not given.

    References:
        MacKay, "Bayesian interpolation", Neural Computation 4 (1992), for the evidence.
    """
    known = model.prior(place, errors)
    # autocorrelation makes the likelihood too sharp by this factor, so the prior is strengthened by the same factor
    times = 1.0 if inflation is None else inflation
    prior = GaussianPrior(known.mean, times * known.precision)
    fit = nonlinear_fit(
        lambda theta: model.residual(theta, measured, turns, weight),
        start,
        prior=prior,
        bound=bound,
        graduate=bound is None,
        covariance="hac",
        max_iter=100,
        tol=1e-8,
    )
    precision = known.precision
    assert fit.covariance is not None
    # curvature of the kernel's loss, e² / (2 d²) near 0
    weight = fit.weights / fit.d.square()
    data = torch.einsum("kci,kc,kcj->ij", fit.jacobian, weight, fit.jacobian)
    curvature = data + times * precision
    inverse = torch.linalg.pinv(curvature, hermitian=True)
    sampled = fit.covariance.nan_to_num(0.0, posinf=0.0)
    plain = inverse @ data @ inverse
    ratio = sampled.diagonal() / plain.diagonal().clamp(min=1e-300)
    found = max(_LEAST_INFLATION, float(ratio.median()))
    counted = data / times + precision
    far = fit.theta - known.mean
    likelihood = float(fit.log_likelihood) * len(measured) / times
    # parameters without a prior are free in every response, and cancel
    volume = torch.linalg.slogdet(precision)[1] - torch.linalg.slogdet(counted)[1]
    evidence = likelihood - 0.5 * float(far @ precision @ far) + 0.5 * float(volume)
    return FittedResponse(model, fit, sampled + times**2 * inverse @ precision @ inverse, found, evidence)
