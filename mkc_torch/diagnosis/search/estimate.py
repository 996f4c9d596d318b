"""The final parameters with their standard errors, under drift and coloured noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import ShapedModel, reach_of
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.drift import NoiseFit
from mkc_torch.diagnosis.noise.outliers import (
    near_median,
    out_of_bursts,
    pseudo_residual,
    rejected_in_all,
    without_one_sided,
)
from mkc_torch.diagnosis.noise.spectrum import NoiseSpectrum, agreed_innovation_gain
from mkc_torch.diagnosis.search.linearise import LinearisedSearch, linearise
from mkc_torch.diagnosis.search.tangents import ModelTangents, SlowBasis, tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

_ROUNDS = 4
"""Largest number of rounds of rejecting residuals by their distance from the drift and estimating the drift again."""

_MEDIANS = 75
"""Number of running-median windows in a recording."""

_ALIKE = 1e-10
"""Ratio of the smallest to the largest eigenvalue of normalised tangents below which they are inseparable."""

_REACH = 3.0
"""Smallest half-width of the density's domain, in robust standard deviations of the residual."""

_SETTLED = 5e-3
"""Share of samples whose mask may still change at convergence."""


@dataclass(frozen=True)
class Local:
    """Residuals about the drift, and their noise.

    Attributes:
        values: the pseudo-residuals.
        counts: 0 for a rejected residual, else 1.
        noise: their spectrum and drift; a search without candidates.
        slow: the cosines of the drift, with the share of each channel.
    """

    values: Float[Tensor, "N m"]
    counts: Float[Tensor, "N m"]
    noise: LinearisedSearch
    slow: SlowBasis | None


def drift_residuals(
    fit: FittedModel,
    model: JointModel,
    parameters: Float[Tensor, " p"],
    tangents: ModelTangents,
    settings: NoiseSettings,
) -> Local:
    """Return the pseudo-residual of a fit, about the most likely drift of its noise.

    Without the drift, a fit takes a drift larger than the white noise for a heavy tail, and rejects its excursions.

    Args:
        fit: its residuals are used.
        model, parameters: where the tangents are from; ``fit`` may have a term more.
        tangents: of the parameters and of the ports.
        settings: when a residual is rejected.
    """
    slow = tangents.slow
    if slow is None:
        values, counts = fit.pseudo(settings)
        return Local(values, counts, linearise(model, parameters, values, counts, tangents.bare), None)
    # a burst must not bias the first course
    recorded = torch.ones_like(fit.residual) if fit.recorded is None else fit.recorded.to(fit.residual)
    counts = recorded * near_median(fit.residual, len(fit.residual) // _MEDIANS, settings)
    values = counts * fit.residual
    noise = linearise(model, parameters, values, counts, tangents.bare, white=True)
    family = noise.search.noise_fit(noise.series).family
    for number in range(_ROUNDS):
        course = slow.waveform(noise.search.courses(noise.series))
        # with a drift the simulation's own parameters differ from those of the fit without a drift
        course = course + explained(fit.residual - course, counts, tangents.nuisance)
        quick = fit.residual - course
        # for a poor fit the residual about the course may be larger than its domain
        density = fit_density(quick, bound=fit.bound.maximum(_REACH * robust_scale(quick)))
        before = counts
        values, counts = pseudo_residual(quick, density.sigma, density.d, settings.rejected_below)
        alone = out_of_bursts((quick.abs() <= settings.far * robust_scale(quick)).to(quick.dtype), settings)
        near = rejected_in_all(alone * without_one_sided(quick, counts * alone, settings), settings)
        if float(near.mean()) < 1.0 - settings.bursts:
            near = alone
        near = recorded * near
        values, counts = values * near, counts * near
        values = values + counts * course
        if number > 0 and float((counts != before).double().mean()) < _SETTLED:
            break
        slow = slow.with_shares(noise.search.shares(noise.series, slow.channels))
        in_family = replace(tangents.bare, slow=slow.of_family(family))
        noise = linearise(model, parameters, values, counts, in_family, spectrum=noise.stationary_spectrum())
    noise = linearise(
        model, parameters, values, counts, replace(tangents.bare, slow=slow), near=noise.stationary_spectrum()
    )
    return Local(values, counts, noise, slow)


def explained(
    values: Float[Tensor, "N m"], counts: Float[Tensor, "N m"], nuisance: Float[Tensor, "N m p"]
) -> Float[Tensor, "N m"]:
    """Return what the simulation's own parameters explain of ``values``, by least squares on the samples that count."""
    columns = (counts.unsqueeze(-1) * nuisance).flatten(0, 1)
    scale = torch.linalg.vector_norm(columns, dim=0).clamp(min=1e-300).reciprocal()
    gram = scale.unsqueeze(-1) * (columns.mT @ columns) * scale
    inner = scale * (columns.mT @ (counts * values).flatten())
    return nuisance @ (scale * (torch.linalg.pinv(gram, hermitian=True, rtol=_ALIKE) @ inner))


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
    the noise model does not describe the fit; neither is a step that loses more than a nat per parameter, by judgement.
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
        taken = covariance
        if model.bounds is not None:
            step, taken = within_bounds(parameters, step, covariance, model.bounds)
        parameters = parameters - step
        residual, nearby = model.answer(parameters)
        # the simulation may have no finite trajectory there, or the step be beyond the linear range
        finite = bool(residual.isfinite().all())
        if finite and agreed_innovation_gain(fit.residual, residual.detach(), fit.recorded) > -len(parameters):
            moved = model if nearby is None else model.begun_with(nearby.bare)
            fit, covariance = replace(fit, model=moved, parameters=parameters, residual=residual.detach()), taken
    noise = found.search.noise_fit(found.series)
    spread = found.search.drift_spread(noise) if noise.size > 0 else 0.0
    plain = FinalEstimate(fit, covariance, noise, found.spectrum, spread, tuple({} for _ in fit.model.terms))
    return _shapes_free(
        plain.at_least(found.search.doubted_error(0, found.series, settings.doubted_family)), tangents, local
    )


def rough_estimate(fit: FittedModel, error: Float[Tensor, " p"]) -> FinalEstimate:
    """Return a fit with known standard errors of its parameters, as if the noise were white."""
    level = robust_scale(fit.residual)
    white = NoiseSpectrum(tuple(level.new_zeros(0) for _ in level), level.expand_as(fit.residual))
    noise = NoiseFit(0, 0.0, float(level.square().mean()), math.nan, 0.0)
    return FinalEstimate(fit, torch.diag(error.square()), noise, white, 0.0, tuple({} for _ in fit.model.terms))


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
        return shaped.residual(torch.cat([parameters, numbers]))

    columns, within = _with_secants(
        torch.func.jacfwd(dual_constants(residual))(start[shaped.joint :]), shaped, start, inside
    )
    if not bool(columns.isfinite().all()):
        return plain
    wide = replace(tangents, nuisance=torch.cat([tangents.nuisance, columns], -1), slow=local.slow)
    found = linearise(shaped, start, local.values, local.counts, wide, spectrum=local.noise.spectrum, joint=True)
    error = found.search.estimate(0, found.series)[1].diagonal().clamp(min=0.0).sqrt()
    numbers = [term.shape[name] for term, reach in zip(model.terms, inside, strict=True) for name in reach]
    errors = shaped.per_effect(shaped.spread(numbers, error[shaped.joint :]).hypot(within).tolist())
    known = [
        {
            name: deviation
            for name, deviation in found.items()
            if 0.0 < deviation < _UNKNOWN * (term.shape[name] if reach[name][0] > 0 else reach[name][1])
        }
        for term, reach, found in zip(model.terms, inside, errors, strict=True)
    ]
    return replace(plain.at_least(error[: shaped.joint]), shape_errors=tuple(known))


def _with_secants(
    columns: Float[Tensor, "N m s"],
    shaped: ShapedModel,
    start: Float[Tensor, " p"],
    inside: Sequence[Mapping[str, tuple[float, float]]],
) -> tuple[Float[Tensor, "N m s"], Float[Tensor, " s"]]:
    """Return the derivatives by the shape numbers, a secant for each delay with a derivative of 0; and its resolution.

    The residual is constant in the delay of a held input within a sample interval, and a step from one to the next. The
    secant is taken over one interval to either side; the position within an interval is uniformly distributed.
    """
    inner = shaped.prepared.time.diff()
    step = float(inner[inner > 0].median())
    within = columns.new_zeros(columns.shape[-1])
    names = [(term, name) for term, reach in zip(shaped.terms, inside, strict=True) for name in reach]
    for number, (term, name) in enumerate(names):
        if name not in term.effect.continuous or bool(columns[..., number].any()):
            continue
        low, high = (shaped.moved(start, number, term.shape[name] + by) for by in (-step, step))
        secant = (shaped.residual(high) - shaped.residual(low)) / (high - low)[shaped.joint + number]
        columns[..., number], within[number] = secant.detach(), step / math.sqrt(12.0)
    return columns, within


def _inside(term: Term, reach: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Return the shape numbers that are not at a limit of their range."""
    return {
        name: (low, high)
        for name, (low, high) in reach.items()
        if low + _AT_END * abs(low) < term.shape[name] < high - _AT_END * abs(high)
    }


MOVED_ERRORS = 0.5
"""Standard errors by which half the step has to move a parameter for the step to matter."""

NEGLIGIBLE = 1e-3
"""Relative change of every parameter below which the standard errors are not computed."""


def with_smaller_step(fit: FittedModel, settings: NoiseSettings) -> PreparedSimulation | None:
    """Return the system with half the step if that moves a parameter by more than half its standard error.

    Args:
        fit: of a simulation with or without effects.
        settings: of the noise that standard errors are of.

    Returns:
        None if the step does not matter, if the user set it, or if it is the smallest.
    """
    known, model = fit.model.prepared, fit.model
    finer = known.finer()
    if finer is None:
        return None
    try:
        again = fitted(JointModel(finer, model.terms), fit.parameters, fit.bound, graduate=False)
    except NoFitError:
        return None
    move = (again.parameters - fit.parameters).abs()
    # initial states are not results
    reported = torch.ones_like(move, dtype=torch.bool)
    reported[model.base - known.beginnings : model.base] = False
    if not bool((move > NEGLIGIBLE * fit.parameters.abs())[reported].any()):
        return None
    error = estimate(fit, settings).standard_error
    return finer.open_loop() if bool((move > MOVED_ERRORS * error)[reported].any()) else None
