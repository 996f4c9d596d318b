"""A fit of a simulation with given findings, and the error message if no fit succeeds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch import nonlinear
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import run_parallel
from mkc_torch.diagnosis.noise.outliers import pseudo_residual
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.functional import mkc_nll
from mkc_torch.simulation.affine_rounds import fitted_in_rounds
from mkc_torch.simulation.dynamics.missing import recorded_weight
from mkc_torch.simulation.dynamics.other_starts import OtherStarts
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


_CLIP = 2.0
"""Robust standard deviations at which residuals are clipped for the start of a fit."""

_WIDE = 1.2
"""Ratio of a scale to the residual's robust standard deviation above which the scale may belong to another optimum."""

_DOMAIN_SCALES = 2.5
"""Least half-width of a domain in robust scales, so that 2 are left in each fold: the least that a fit accepts."""


@dataclass(frozen=True)
class Effort:
    """How far a fit goes.

    Attributes:
        steps: number of steps at most.
        tolerance: gain in nats per sample below which it ends.
        restarts: restarts from its own end, where a scale may belong to another optimum.
        rounds: number of rounds at most for a simulation that steps; see :mod:`mkc_torch.simulation.affine_rounds`.
    """

    steps: int
    tolerance: float
    restarts: int
    rounds: int


FULL = Effort(60, 1e-7, 2, 10)
"""A fit to the end."""

SEARCH = Effort(30, 3e-6, 0, 5)
"""A fit whose likelihood is compared with others: 0.01 nats on 3,000 samples."""

ROUGH = Effort(12, 1e-4, 0, 2)
"""A fit that chooses between starts."""

_SHARES = (1.0, 0.3, 0.1, 0.01, 0.0)
"""Shares of an effect's initial size to try in turn if the simulation has no finite result."""


@dataclass(frozen=True)
class FittedModel:
    """A joint model at its most likely parameters.

    Attributes:
        model, parameters: what was fitted; the model holds the trajectory at these parameters as its start.
        sigma, d, bound: (m,) of the MKC density.
        residual, weights: (N, m).
        log_likelihood: in nats, of all samples and channels.
        converged: whether the iteration has converged.
        squares: whether its open loop is of least squares, because a robust one would follow less of the recording.
    """

    model: JointModel
    parameters: Float[Tensor, " p"]
    sigma: Float[Tensor, " m"]
    d: Float[Tensor, " m"]
    bound: Float[Tensor, " m"]
    residual: Float[Tensor, "N m"]
    weights: Float[Tensor, "N m"]
    log_likelihood: float
    converged: bool
    squares: bool = False

    def pseudo(self, settings: NoiseSettings) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"]]:
        """Return the pseudo-residual and its mask, (N, m) each."""
        values, counts = pseudo_residual(self.residual, self.sigma, self.d, settings.rejected_below)
        if self.recorded is None:
            return values, counts
        recorded = self.recorded.to(counts.dtype)
        return values * recorded, counts * recorded

    def rejected_share(self, settings: NoiseSettings) -> float:
        """Share of the recorded samples that the fit rejects."""
        _, counts = self.pseudo(settings)
        return 1.0 - float(counts.sum()) / max(counts.numel() if self.recorded is None else int(self.recorded.sum()), 1)

    @property
    def sigma_held(self) -> bool:
        """Whether σ is held at infinity: further fits from here are of least squares."""
        return self.squares and bool(self.sigma.isinf().all())

    @property
    def recorded(self) -> Bool[Tensor, "N m"] | None:
        """Mask of the recorded outputs; None where none is missing."""
        return self.model.prepared.recorded

    @cached_property
    def open_loop(self) -> FittedModel | None:
        """The fit of the same joint model in open loop, for several stages; None if that loses the recording.

        The more likely of a fit from these parameters and of one with a graduated start, or that of least squares.
        """
        prepared = self.model.prepared.open_loop()
        if prepared is self.model.prepared:
            return self
        model = JointModel(prepared, self.model.terms, self.model.near)
        if self.squares:
            squares = by_least_squares(replace(self, model=model))
            return None if squares is None else with_own_density(squares)
        both = run_parallel(
            [partial(_tried, model, self, graduate) for graduate in (False, True)], prepared, model.terms
        )
        return max((found for found in both if found is not None), key=lambda found: found.log_likelihood, default=None)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the open-loop fit: another process rarely needs it."""
        return {name: value for name, value in vars(self).items() if name != "open_loop"}


def _tried(model: JointModel, like: FittedModel, graduate: bool) -> FittedModel | None:
    """Fit a model from the parameters of another fit; None where the simulation has no finite result."""
    try:
        return fitted(model, like.parameters, like.bound, graduate=graduate)
    except nonlinear.NoFitError:
        return None


def fitted(
    model: JointModel,
    start: Float[Tensor, " p"],
    bound: Float[Tensor, " m"] | None = None,
    *,
    rows: Float[Tensor, " N"] | None = None,
    graduate: bool = True,
    fresh: bool = False,
    effort: Effort = FULL,
    squares: bool = False,
    reference: Float[Tensor, " p"] | None = None,
) -> FittedModel:
    """Fit a joint model by maximum likelihood.

    Args:
        model: a simulation with effects.
        start: initial parameters.
        bound: half-width of the density's domain; None for the rule of :func:`mkc_torch.nonlinear.fit`.
        rows: weights of the samples; 0 leaves a sample out.
        graduate: False for a start near the solution.
        fresh: True to also search for a trajectory without the model's own as the start, if there is none near that:
            it may belong to another noise model. This is slow.
        effort: how far the fit goes.
        squares: True for least squares.
        reference: parameters of the model's own trajectory, for a simulation that steps.

    Raises:
        NoFitError: the simulation has no finite result at the start or at the end of the fit.
    """
    by = partial(_fit, rows=rows, squares=squares)
    begin = partial(_finite_start, fresh=fresh)
    found = by(model, start, bound, graduate=graduate, effort=effort, begin=begin, reference=reference)
    for _ in range(effort.restarts):
        seen = found.residual if rows is None else found.residual[rows > 0]
        if not bool((found.d > _WIDE * robust_scale(seen)).any()):
            break
        # a scale that fits the initial residuals can remain a local optimum
        again = by(found.model, found.parameters, found.bound, graduate=False)
        if not again.log_likelihood > found.log_likelihood:
            break
        found = again
    return found


_Begun = tuple[JointModel, "Float[Tensor, ' p']"]


def _fit(
    model: JointModel,
    start: Float[Tensor, " p"],
    bound: Float[Tensor, " m"] | None,
    *,
    rows: Float[Tensor, " N"] | None,
    graduate: bool,
    effort: Effort = FULL,
    squares: bool = False,
    begin: Callable[[JointModel, Tensor], _Begun] | None = None,
    reference: Float[Tensor, " p"] | None = None,
) -> FittedModel:
    """Fit once; ``begin`` returns a model and a start with a finite result, where the simulation itself is fitted."""
    way, recorded = model.continuation(), model.prepared.recorded
    weight = rows if recorded is None else recorded_weight(recorded, rows).to(start)
    (lower, upper), logarithms = model.bounds or (None, None), model.logarithms
    by = partial(
        nonlinear.fit,
        bound=bound,
        sigma=math.inf if squares else None,
        weight=weight,
        prior=model.prior,
        lower=lower,
        upper=upper,
        graduate=graduate,
        covariance=None,
        max_iter=effort.steps,
        tol=effort.tolerance,
        jacobian=model.prepared.jacobian,
    )
    by = by if logarithms is None else partial(logarithms.fit, by=by)
    rounds = partial(fitted_in_rounds, fit=by, weight=weight, tolerance=effort.tolerance, rounds=effort.rounds)
    known = rounds(way, start, reference=reference, log_prior=model.log_prior)
    if known is None and begin is not None:
        model, start = begin(model, start)
        way = model.continuation()
        known = rounds(way, start, log_prior=model.log_prior)
    found = by(way, start) if known is None else known
    there = model.begun_with(way.near(found.theta))
    residual = (there.residual if known is None else way)(found.theta).detach()
    if not bool((residual if rows is None else residual[rows > 0]).isfinite().all()):
        raise nonlinear.NoFitError("The simulation has no finite trajectory at the end of the fit.")
    return FittedModel(
        there,
        found.theta,
        found.sigma,
        found.d,
        found.bound,
        residual,
        found.weights,
        _total_log_likelihood(found, residual, weight, by_mean=recorded is None, own=known is None),
        bool(found.converged),
        squares,
    )


def _total_log_likelihood(
    found: nonlinear.NonlinearFit,
    residual: Float[Tensor, "N m"],
    weight: Tensor | None,
    *,
    by_mean: bool,
    own: bool,
) -> float:
    """Return the log-likelihood of all samples; with missing outputs, of the weighted recorded ones.

    ``by_mean`` extends the mean of the weighted samples to all; ``own`` states that the fit is of this residual.
    """
    N = len(residual)
    if by_mean and own:
        return float(found.log_likelihood) * N
    weight = residual.new_ones(N, 1) if weight is None else weight.reshape(N, -1)
    total = -float((weight * mkc_nll(residual, found.sigma, found.d, found.bound)).sum())
    return total * N / float(weight.sum()) if by_mean else total


def by_least_squares(fit: FittedModel, effort: Effort = FULL) -> FittedModel | None:
    """Return the fit of least squares from a fit's parameters; None if it fails.

    A robust fit takes a stretch that the model does not follow for outliers, and follows a quiet rest of the recording
    all the more closely.
    """
    try:
        return fitted(fit.model, fit.parameters, graduate=False, effort=effort, squares=True)
    except nonlinear.NoFitError:
        return None


def fitted_like(
    model: JointModel, start: Float[Tensor, " p"], like: FittedModel, *, graduate: bool = False
) -> FittedModel:
    """Fit a model by the estimator of another fit of the recording, on its domain.

    Args:
        model: the joint model.
        start: its parameters to start from.
        like: the other fit.
        graduate: False for a start near the solution.

    Raises:
        NoFitError: the simulation has no finite result at the start or at the end of the fit.
    """
    found = fitted(model, start, like.bound, graduate=graduate, squares=like.squares)
    own = with_own_density(found) if like.squares else found
    if own is None:
        raise nonlinear.NoFitError("The simulation has no finite trajectory at the end of the fit.")
    return own


def with_own_density(fit: FittedModel, model: JointModel | None = None) -> FittedModel | None:
    """Return a fit at the same parameters with the σ and d of its residual, on a domain that holds it.

    Args:
        fit: its parameters are kept.
        model: another model of the same parameters; None for the fit's own.

    Returns:
        None if the model has no finite residual there.
    """
    model = fit.model if model is None else model
    residual = model.residual(fit.parameters).detach()
    if not bool(residual.isfinite().all()):
        return None
    recorded = None if fit.recorded is None else fit.recorded.to(residual)
    bound = torch.maximum(fit.bound, _DOMAIN_SCALES * robust_scale(residual))
    density = fit_density(residual, bound=bound, weight=recorded)
    samples = len(residual) if recorded is None else recorded.sum(0)
    return replace(
        fit,
        model=model,
        sigma=density.sigma,
        d=density.d,
        bound=bound,
        residual=residual,
        weights=torch.exp(-0.5 * (residual / (density.d * density.sigma)).square()),
        log_likelihood=float((density.log_likelihood * samples).sum()),
    )


def fitted_with_effect(
    base: FittedModel, model: JointModel, start: Float[Tensor, " p"], *, graduate: bool = True, effort: Effort = FULL
) -> FittedModel:
    """Fit a model with one more effect on the domain of a fit without it; return the latter if this fails."""
    without = torch.cat([base.parameters, base.parameters.new_zeros(model.size - base.model.size)])
    # a model whose trajectory is the base's
    reference = without if model.near is base.model.near and len(model.terms) > len(base.model.terms) else None
    try:
        return fitted(
            model,
            start,
            base.bound,
            graduate=graduate,
            effort=effort,
            squares=base.sigma_held,
            reference=reference,
        )
    except nonlinear.NoFitError:
        return replace(base, model=model, parameters=without)


def without_term(fit: FittedModel, number: int) -> FittedModel:
    """Return the fit without one effect, at the same parameters, as a start for further fits."""
    model, place = fit.model, fit.model.base + sum(fit.model.sizes[:number])
    left = JointModel(model.prepared, (*model.terms[:number], *model.terms[number + 1 :]), model.near)
    parameters = torch.cat([fit.parameters[:place], fit.parameters[place + model.sizes[number] :]])
    return replace(fit, model=left, parameters=parameters)


def within_domain(fit: FittedModel) -> FittedModel:
    """Return a start that its domain can hold: a start that is too far for the domain is refitted on a wide domain.

    The domain grows only if it is also too narrow for the refit.
    """
    if not bool((fit.bound < 2.0 * robust_scale(fit.model.residual(fit.parameters).detach())).any()):
        return fit
    wide = fitted(fit.model, fit.parameters)
    bound = torch.maximum(fit.bound, _DOMAIN_SCALES * robust_scale(wide.residual))
    return replace(fit, model=wide.model, parameters=wide.parameters, bound=bound)


def _finite_start(
    model: JointModel, start: Float[Tensor, " p"], *, fresh: bool
) -> tuple[JointModel, Float[Tensor, " p"]]:
    """Return a model and a start with a finite result, if there are any; effects are scaled down if necessary."""
    fresh = fresh and model.near is not None
    if not model.terms and not fresh:
        return model, start
    for share in _SHARES if model.terms else (1.0,):
        smaller = torch.cat([start[: model.base], share * start[model.base :]])
        for variant in (model, model.begun_with(None)) if fresh and share == 1.0 else (model,):
            if bool(variant.residual(smaller).isfinite().all()):
                return variant, smaller
    return model, start


def clipped_residual(
    residual: Float[Tensor, "N m"], recorded: Bool[Tensor, "N m"] | None = None
) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"]]:
    """Return the pseudo-residual of Huber's score at two robust scales, and its mask: no recorded sample is rejected.

    Huber, "Robust Statistics" (1981), 7.6.
    """
    mask = torch.ones_like(residual) if recorded is None else recorded.to(residual.dtype)
    scale = robust_scale(residual)
    z = residual / scale.clamp(min=1e-300)
    slope = (z.abs() < _CLIP).to(z.dtype).mean(0).clamp(min=0.2)
    return mask * scale * z.clamp(-_CLIP, _CLIP) / slope, mask


def no_first_fit(prepared: PreparedSimulation, others: OtherStarts | None = None) -> str:
    """Return sentences: what is wrong, what was tried and what to change.

    Args:
        prepared: the simulation.
        others: the further starts that were tried; None for a simulation without states.
    """
    where = f"{prepared.recording.name}: " if prepared.recording.name else ""
    outputs = ", ".join(f"`{name}`" for name in prepared.channels)
    if others is None:
        return (
            f"{where}no fit of {prepared.name} to {outputs} succeeds from the given parameter values: its output is "
            "too far from the recording, or not finite nearby. Give values nearer to the system's own, and check "
            "units and signs."
        )
    return " ".join(
        [
            f"{where}no fit of {prepared.name} to {outputs} was found.",
            *_lost(others),
            f"Tried: the given values, values with which the measured states obey the equations, {others.tried} starts "
            "between and around them (each parameter with the other sign, 0, and 3 to 30 times smaller or larger), "
            "and predictions over a few samples only.",
            f"Check the sign and the unit of {_what(others)} in `derivative`; or give a value nearer to the system's "
            "own, or limits, Parameter(value, lower=..., upper=...), within which the simulation stays finite.",
        ]
    )


def _lost(others: OtherStarts) -> list[str]:
    """Describe how the simulation diverges with the user's values."""
    if not others.output:
        return []
    if others.until <= 0.0:
        first = f"With the given values, the equations have no finite solution: `{others.output}` diverges at once."
    else:
        first = f"With the given values, `{others.output}` diverges within {others.until:.4g} s."
    if not others.parameter:
        return [f"{first} No change of a single parameter keeps it finite for longer."]
    lasts = "throughout" if others.lasts == float("inf") else f"for {others.lasts:.4g} s"
    return [first, f"With `{others.parameter}` = {others.value:.4g} it stays finite {lasts}."]


def _what(others: OtherStarts) -> str:
    return f"`{others.parameter}`" if others.parameter else "each term"
