"""The final parameters: one step of generalised least squares from the robust fit, and their covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearise import Linearised, linearise, tangents_of
from mkc_torch.diagnosis.local import beside_wander
from mkc_torch.diagnosis.refit import FittedModel
from mkc_torch.diagnosis.search import NoiseFit

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Estimate", "estimate"]

_MOST_ERRORS = 5.0


@dataclass(frozen=True)
class Estimate:
    """A fit with its final parameters, their covariance (p, p), and the noise that is left."""

    fit: FittedModel
    covariance: Float[Tensor, "p p"]
    noise: NoiseFit
    linearised: Linearised

    @property
    def standard_error(self) -> Float[Tensor, " p"]:
        return self.covariance.diagonal().clamp(min=0.0).sqrt()

    def at_least(self, error: Float[Tensor, " p"]) -> Estimate:
        """The same with standard errors that are nowhere smaller than these; correlations stay."""
        own = self.standard_error
        larger = torch.where(own > 0, torch.maximum(error / own.clamp(min=1e-300), torch.ones_like(own)), 1.0)
        return replace(self, covariance=larger.unsqueeze(-1) * self.covariance * larger)


def estimate(fit: FittedModel) -> Estimate:
    """One step of generalised least squares on the pseudo-residuals, with the colour and wander of their noise.

    The M-estimate weighs samples as if they were independent; where noise is coloured this step is the more precise
    one, and its covariance respects the autocorrelation. A step of more than five standard errors is a fit that the
    noise model does not describe, and is not taken.
    """
    model, parameters = fit.model, fit.parameters
    tangents = tangents_of(model, parameters)
    local = beside_wander(fit, model, parameters, tangents)
    found = linearise(
        model,
        parameters,
        local.values,
        local.counts,
        replace(tangents, slow=local.slow),
        colour=local.noise.colour,
        joint=True,
    )
    step, covariance = found.search.estimate(0, found.series)
    error = covariance.diagonal().clamp(min=1e-300).sqrt()
    if float((step.abs() / error).max()) <= _MOST_ERRORS:
        parameters = parameters - step
        if model.bounds is not None:
            parameters = parameters.clamp(*model.bounds)
        residual = model.residual(parameters).detach()
        # there may be no trajectory a step away
        if bool(residual.isfinite().all()):
            fit = replace(fit, parameters=parameters, residual=residual)
    return Estimate(fit, covariance, found.search.noise_fit(found.series), found)
