"""The final estimate: a step of generalised least squares from the robust fit, and its covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.forward_mode import make_dual
from mkc_torch.diagnosis.linearised.drift import NoiseFit
from mkc_torch.diagnosis.linearised.drift_residuals import Local, drift_residuals
from mkc_torch.diagnosis.linearised.linearise import linearise
from mkc_torch.diagnosis.linearised.tangents import ModelTangents, tangents_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.grid import reach_of
from mkc_torch.diagnosis.model.shaped import ShapedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.spectrum import NoiseSpectrum
from mkc_torch.diagnosis.settings import NoiseSettings

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["FinalEstimate", "estimate"]

_AT_END = 1e-6
"""Relative distance from a limit of its range within which a shape number is at the limit."""

_UNKNOWN = 0.5
"""Relative error of a shape number above which it counts as unknown."""


@dataclass(frozen=True)
class FinalEstimate:
    """A fit with its final parameters, their covariance (p, p), and the remaining noise.

    Attributes:
        fit, covariance: the estimate.
        noise, spectrum: of the residual; ``drift_spread`` is the standard deviation of the drift over the recording,
            in its port's unit.
        shape_errors: standard errors of the fitted shape numbers of each effect, as far as they are known.
    """

    fit: FittedModel
    covariance: Float[Tensor, "p p"]
    noise: NoiseFit
    spectrum: NoiseSpectrum
    drift_spread: float
    shape_errors: tuple[Mapping[str, float], ...]

    @property
    def standard_error(self) -> Float[Tensor, " p"]:
        return self.covariance.diagonal().clamp(min=0.0).sqrt()

    def at_least(self, error: Float[Tensor, " p"]) -> FinalEstimate:
        """Return the estimate with these errors as lower limits of the standard errors; correlations stay."""
        own = self.standard_error
        larger = torch.where(own > 0, torch.maximum(error / own.clamp(min=1e-300), torch.ones_like(own)), 1.0)
        return replace(self, covariance=larger.unsqueeze(-1) * self.covariance * larger)


def estimate(fit: FittedModel, settings: NoiseSettings) -> FinalEstimate:
    """Take a step of generalised least squares on the pseudo-residuals, with the spectrum and drift of their noise.

    The M-estimate weighs samples as if they were independent. For coloured noise this step is more precise, and its
    covariance includes the autocorrelation. A step of more than ``last_step`` standard errors is not taken, because
    the noise model does not describe the fit.
    """
    model, parameters = fit.model, fit.parameters
    tangents = tangents_of(model, parameters, settings)
    local = drift_residuals(fit, model, parameters, tangents, settings)
    found = linearise(
        model,
        parameters,
        local.values,
        local.counts,
        replace(tangents, slow=local.slow),
        spectrum=local.noise.spectrum,
        joint=True,
    )
    step, covariance = found.search.estimate(0, found.series)
    error = covariance.diagonal().clamp(min=1e-300).sqrt()
    if float((step.abs() / error).max()) <= settings.last_step:
        if model.bounds is not None:
            step, covariance = within_bounds(parameters, step, covariance, model.bounds)
        parameters = parameters - step
        residual, nearby = model.answer(parameters)
        # the simulation may have no finite trajectory there
        if bool(residual.isfinite().all()):
            moved = model if nearby is None else model.begun_with(nearby.bare)
            fit = replace(fit, model=moved, parameters=parameters, residual=residual.detach())
    noise = found.search.noise_fit(found.series)
    spread = found.search.drift_spread(noise) if noise.size > 0 else 0.0
    plain = FinalEstimate(fit, covariance, noise, found.spectrum, spread, tuple({} for _ in fit.model.terms))
    return _shapes_free(
        plain.at_least(found.search.doubted_error(0, found.series, settings.doubted_family)), tangents, local
    )


def within_bounds(
    parameters: Float[Tensor, " p"],
    step: Float[Tensor, " p"],
    covariance: Float[Tensor, "p p"],
    bounds: tuple[Float[Tensor, " p"], Float[Tensor, " p"]],
) -> tuple[Float[Tensor, " p"], Float[Tensor, "p p"]]:
    """Return the step that ends within the bounds, and its covariance.

    A parameter that would leave its range is held at the end of it, and the others take their conditional estimates:
    cut off alone, it would leave the others at the values that belong to the parameter outside its range.

    Args:
        parameters: before the step, within the bounds.
        step: to subtract from the parameters.
        covariance: of the step.
        bounds: smallest and largest values.
    """
    lower, upper = bounds
    inside = torch.ones_like(step, dtype=torch.bool)
    for _ in range(len(step)):
        ends = parameters - step
        beyond = torch.maximum(lower - ends, ends - upper).where(inside, ends.new_tensor(-torch.inf))
        worst = int(beyond.argmax())
        if float(beyond[worst]) <= 0.0:
            break
        inside[worst] = False
        end = ends[worst].clamp(lower[worst], upper[worst])
        variance = float(covariance[worst, worst])
        gain = covariance[:, worst] / variance if variance > 0.0 else torch.zeros_like(step)
        step = step + gain * (parameters[worst] - end - step[worst])
        step[worst] = parameters[worst] - end
        covariance = covariance - gain.unsqueeze(-1) * covariance[worst]
    return step, covariance


def _shapes_free(plain: FinalEstimate, tangents: ModelTangents, local: Local) -> FinalEstimate:
    """Add the uncertainty of the fitted shape numbers to the standard errors, and their own errors.

    A number at a limit of its range is held there, as in the fit.
    """
    model, parameters = plain.fit.model, plain.fit.parameters
    inside = [_inside(term, reach_of(term, model.prepared)) for term in model.terms]
    shaped = ShapedModel(model.around(parameters), inside)
    start = shaped.start(parameters)
    if shaped.size == shaped.joint:
        return plain

    def residual(numbers: Tensor) -> Tensor:
        return shaped.residual(torch.cat([make_dual(parameters, numbers[0]), numbers]))

    columns = torch.func.jacfwd(residual)(start[shaped.joint :])
    if not bool(columns.isfinite().all()):
        return plain
    wide = replace(tangents, nuisance=torch.cat([tangents.nuisance, columns], -1), slow=local.slow)
    found = linearise(shaped, start, local.values, local.counts, wide, spectrum=local.noise.spectrum, joint=True)
    error = found.search.estimate(0, found.series)[1].diagonal().clamp(min=0.0).sqrt()
    numbers = [term.shape[name] for term, reach in zip(model.terms, inside, strict=True) for name in reach]
    errors = shaped.per_effect(shaped.spread(numbers, error[shaped.joint :]).tolist())
    known = [
        {
            name: deviation
            for name, deviation in found.items()
            if 0.0 < deviation < _UNKNOWN * (term.shape[name] if reach[name][0] > 0 else reach[name][1])
        }
        for term, reach, found in zip(model.terms, inside, errors, strict=True)
    ]
    return replace(plain.at_least(error[: shaped.joint]), shape_errors=tuple(known))


def _inside(term: Term, reach: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Return the shape numbers that are not at a limit of their range."""
    return {
        name: (low, high)
        for name, (low, high) in reach.items()
        if low + _AT_END * abs(low) < term.shape[name] < high - _AT_END * abs(high)
    }
