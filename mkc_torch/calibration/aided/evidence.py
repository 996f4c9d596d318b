"""A fit of one response, its evidence, and the covariance of its parameters with what was known beforehand in it."""

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

__all__ = ["FittedResponse", "judged"]

_LEAST_INFLATION = 1.0


@dataclass(frozen=True)
class FittedResponse:
    """A fitted response.

    Attributes:
        model: which.
        fit: by maximum likelihood of the MKC density, with the prior.
        covariance: of the parameters, (p, p): of the errors of the samples, which are a time series, and of what the
            prior is off by. What the samples do not determine has the spread of the prior.
        prior_covariance: of the prior alone, (p, p); infinite, as a large number, where it says nothing.
        inflation: times by which the samples' errors, which follow one another, count as fewer.
        evidence: log of the chance of the measurements by this response, over all parameters that the prior allows, in
            nats; by Laplace's approximation. Compare at equal bounds only.
    """

    model: Model
    fit: NonlinearFit
    covariance: Float[Tensor, "p p"]
    prior_covariance: Float[Tensor, "p p"]
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
    """Fit a response and say how likely it is.

    Args:
        model: the response.
        start: of its parameters.
        measured: finite, in the order of time.
        turns: of the same samples.
        weight: with which each enters into the direction of its stretch.
        place: what is known of the field.
        errors: of the gyroscope, that are taken off the turns already.
        bound: of the density, (3,), of another fit that this one is compared with.
        inflation: times by which the samples count as fewer, of another fit; 1 if not given.

    References:
        MacKay, "Bayesian interpolation", Neural Computation 4 (1992), for the evidence.
    """
    known = model.prior(place, errors)
    # errors that follow one another make the likelihood surer than it is, so what was known counts as much more
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
    # what the prior leaves free is as free in every response, and cancels
    volume = torch.linalg.slogdet(precision)[1] - torch.linalg.slogdet(counted)[1]
    evidence = likelihood - 0.5 * float(far @ precision @ far) + 0.5 * float(volume)
    return FittedResponse(
        model,
        fit,
        sampled + times**2 * inverse @ precision @ inverse,
        torch.linalg.inv(precision),
        found,
        evidence,
    )
