"""Joint robust refits of a simulation with candidate effects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch import nonlinear
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.noise.pseudo_residual import pseudo_residual
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["FittedModel", "clipped_residual", "fitted", "fitted_beside", "without_term"]

_CLIP = 2.0
"""Robust standard deviations at which residuals are clipped where a fit is only begun with them."""

_WIDE = 1.2
"""Robust standard deviations of the residual beyond which a scale is suspected to be that of another one."""

_NARROWER = 2
"""Times that a fit with such a scale is begun again where it ended."""

_SHARES = (1.0, 0.3, 0.1, 0.01, 0.0)
"""Of the size that an effect begins with, tried one after the other where the simulation has no finite answer."""


@dataclass(frozen=True)
class FittedModel:
    """A joint model at its most likely parameters.

    Attributes:
        model, parameters: what was fitted; the model begins with the answer at these parameters.
        sigma, d, bound: (m,) of the MKC density.
        residual, weights: (N, m).
        log_likelihood: in nats, of all samples and channels.
        converged: whether another step would bring nothing.
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

    def pseudo(self, settings: NoiseSettings) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"]]:
        """The pseudo-residual, and 1 where it counts."""
        return pseudo_residual(self.residual, self.sigma, self.d, settings.rejected_below)


def fitted(
    model: JointModel,
    start: Float[Tensor, " p"],
    bound: Float[Tensor, " m"] | None = None,
    *,
    rows: Float[Tensor, " N"] | None = None,
    graduate: bool = True,
    anew: bool = False,
) -> FittedModel:
    """The most likely parameters of a joint model.

    Raises:
        NoFitError: the simulation has no finite answer where the fit begins, or none where it ends.

    Args:
        model: a simulation with effects.
        start: where to begin.
        bound: half-width of the density's domain; None for the rule of :func:`mkc_torch.nonlinear.fit`.
        rows: weights of the samples; 0 leaves one out.
        graduate: False for a start near the answer.
        anew: True to search a trajectory without the one that the model knows, where there is no answer near that one:
            it may be of another noise. That takes long.
    """
    found = _fit(*_begun(model, start, anew=anew), bound, rows, graduate=graduate)
    for _ in range(_NARROWER):
        seen = found.residual if rows is None else found.residual[rows > 0]
        if not bool((found.d > _WIDE * robust_scale(seen)).any()):
            break
        # a scale that suited the residuals where the fit began can hold on beside one that suits those of its end
        again = _fit(found.model, found.parameters, found.bound, rows, graduate=False)
        if not again.log_likelihood > found.log_likelihood:
            break
        found = again
    return found


def _fit(
    model: JointModel,
    start: Float[Tensor, " p"],
    bound: Float[Tensor, " m"] | None,
    rows: Float[Tensor, " N"] | None,
    *,
    graduate: bool,
) -> FittedModel:
    way = model.continuation()
    found = nonlinear.fit(
        way,
        start,
        bound=bound,
        weight=rows,
        prior=model.prior,
        lower=None if model.bounds is None else model.bounds[0],
        upper=None if model.bounds is None else model.bounds[1],
        graduate=graduate,
        covariance=None,
        max_iter=60,
        tol=1e-7,
        # a user's equations are many small operations
        jacobian="reverse twice" if isinstance(model.prepared, PreparedDynamics) else "forward",
    )
    there = model.begun_with(way.near(found.theta))
    residual = there.residual(found.theta).detach()
    if not bool((residual if rows is None else residual[rows > 0]).isfinite().all()):
        raise nonlinear.NoFitError("A trajectory that was found on the way of the fit is lost again in its end.")
    return FittedModel(
        there,
        found.theta,
        found.sigma,
        found.d,
        found.bound,
        residual,
        found.weights,
        float(found.log_likelihood) * len(model.prepared.time),
        bool(found.converged),
    )


def fitted_beside(
    base: FittedModel, model: JointModel, start: Float[Tensor, " p"], *, graduate: bool = True
) -> FittedModel:
    """A model with one more effect on the domain of a fit without it; that fit, where the effect has no answer."""
    try:
        return fitted(model, start, base.bound, graduate=graduate)
    except nonlinear.NoFitError:
        none = base.parameters.new_zeros(model.size - base.model.size)
        return replace(base, model=model, parameters=torch.cat([base.parameters, none]))


def without_term(fit: FittedModel, number: int) -> FittedModel:
    """The simulation with all effects of a fit but one, as a start for fits: at its parameters, not fitted anew."""
    model, place = fit.model, fit.model.base + sum(fit.model.sizes[:number])
    left = JointModel(model.prepared, (*model.terms[:number], *model.terms[number + 1 :]), model.near)
    parameters = torch.cat([fit.parameters[:place], fit.parameters[place + model.sizes[number] :]])
    return replace(fit, model=left, parameters=parameters)


def _begun(model: JointModel, start: Float[Tensor, " p"], *, anew: bool) -> tuple[JointModel, Float[Tensor, " p"]]:
    """A model and a start at which it has a finite answer, where there are any; effects are made smaller for that."""
    anew = anew and model.near is not None
    if not model.terms and not anew:
        return model, start
    for share in _SHARES if model.terms else (1.0,):
        smaller = torch.cat([start[: model.base], share * start[model.base :]])
        for one in (model, model.begun_with(None)) if anew and share == 1.0 else (model,):
            if bool(one.residual(smaller).isfinite().all()):
                return one, smaller
    return model, start


def clipped_residual(residual: Float[Tensor, "N m"]) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"]]:
    """Pseudo-residual of Huber's score at two robust scales: what a redescending score takes for outliers still counts.

    Huber, "Robust Statistics" (1981), 7.6.
    """
    scale = robust_scale(residual)
    z = residual / scale.clamp(min=1e-300)
    slope = (z.abs() < _CLIP).to(z.dtype).mean(0).clamp(min=0.2)
    return scale * z.clamp(-_CLIP, _CLIP) / slope, torch.ones_like(residual)
