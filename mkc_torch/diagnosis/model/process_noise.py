"""A simulation with its effects under the likeliest noise of the world: pushes of its states beside its sensors'."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit, pooled
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.no_first_fit import no_first_fit
from mkc_torch.diagnosis.model.parallel import run_parallel
from mkc_torch.diagnosis.model.shaped import shape_fitted
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.dynamics.first_fit import multiple_shooting_start, strongly_observed
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise, likeliest_noise, noise_of
from mkc_torch.simulation.dynamics.other_starts import other_starts
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "ProcessNoiseFit",
    "choose_input_hold",
    "estimate_noise",
    "first_samples",
    "fit_baseline",
    "fit_with_process_noise",
    "open_loop",
    "refit_input_hold",
    "refit_noise",
    "refit_open_loop",
]

_ROUNDS = 2
"""Times that the noise is sought along a trajectory and the parameters are fitted under it."""

_FIRST = 3
"""Samples, for each state, that a run's first states are known by."""

_OTHER_STARTS = 3
"""Further starts that fits are made from, where the first ones fail."""

_NOTHING = 0.05
"""Share of the outputs' variation up to which a first fit explains nothing."""

_ROOM = 3.0
"""Robust standard deviations of the residual that a domain holds at least."""

_STRONG = 10.0
"""Size of the pushes that a first observer is for, over that at which they move an output by its noise."""


@dataclass(frozen=True)
class ProcessNoiseFit:
    """A joint model, fitted.

    Attributes:
        free: as it runs freely; None where that run loses the recording, or where there is no fit.
        fit: under the likeliest noise; the same as ``free`` where the sensors' white noise is enough.
        noise: that noise; None of a simulation that has no states to be pushed.
        starts: from which a first fit was tried.
    """

    free: FittedModel | None
    fit: FittedModel
    noise: StateSpaceNoise | None
    starts: int = 1

    @property
    def pushed(self) -> bool:
        """Whether more than the sensors' white noise is in it."""
        return self.noise is not None and self.noise.observer is not None

    @property
    def pushes(self) -> int:
        """How many disturbances are in it."""
        return 0 if self.noise is None else len(self.noise.disturbed.disturbances)


def open_loop(prepared: PreparedSimulation) -> PreparedSimulation:
    """The simulation as it runs freely."""
    return prepared.observed(None) if isinstance(prepared, PreparedDynamics) else prepared


def first_samples(prepared: PreparedSimulation) -> Tensor | None:
    """The samples that a run's first states are known by; None where none are asked for."""
    if not isinstance(prepared, PreparedDynamics):
        return None
    index = torch.arange(len(prepared.time))
    first = torch.where(prepared.begins, index, 0).cummax(0).values
    return index - first < _FIRST * len(prepared.system.states)


def with_noise_of_fit(fit: FittedModel) -> bool:
    """Whether a fit is under more noise than the sensors' white one."""
    prepared = fit.model.prepared
    return isinstance(prepared, PreparedDynamics) and prepared.observer is not None


def estimate_noise(
    fit: FittedModel,
    declared: Mapping[str, float],
    settings: NoiseSettings,
    known: StateSpaceNoise | None = None,
) -> StateSpaceNoise | None:
    """The likeliest noise along a fit's trajectory; None where there is no trajectory, or are no states.

    Args:
        fit: along whose trajectory.
        declared: standard deviation of the white noise of outputs that it is known of.
        settings: of the noise.
        known: a noise nearby, whose disturbances are given their sizes; None to seek them.
    """
    prepared, model = fit.model.prepared, fit.model
    if not isinstance(prepared, PreparedDynamics):
        return None
    theta, changes = fit.parameters[: model.base], model.changes(fit.parameters)
    return likeliest_noise(
        prepared,
        theta,
        changes,
        model.near,
        declared=declared,
        least=settings.pushed,
        most=settings.pushes,
        known=None if known is None else known.disturbed,
    )


def fit_baseline(
    prepared: PreparedSimulation,
    declared: Mapping[str, float],
    settings: NoiseSettings,
    keep: Callable[[ProcessNoiseFit], object] = lambda _: None,
) -> ProcessNoiseFit:
    """The simulation alone, from as many starts as it takes to trust its first fit.

    Where fits from the first starts fail or explain nothing, others between and around the user's values are tried,
    and shorter horizons. ``keep`` is called with the first fit, before its noise is known.

    Raises:
        NoFitError: no start has a finite answer; the message says in words what was tried.
    """
    model, starts = JointModel(prepared), [prepared.start()]
    if not isinstance(prepared, PreparedDynamics):
        try:
            return fit_with_process_noise(_wider(fitted(model, starts[0]), settings), declared, settings, model=model)
        except NoFitError as error:
            raise NoFitError(no_first_fit(prepared)) from error
    short = multiple_shooting_start(prepared, prepared.given)
    starts += [] if short is None else [short]
    free = _likeliest_free(model, starts)
    if free is not None:
        keep(ProcessNoiseFit(free, free, None, len(starts)))
    if free is not None and _explains(free):
        return fit_with_process_noise(_wider(free, settings), declared, settings, beside=starts[1:], model=model)
    others = other_starts(prepared, starts[0], _OTHER_STARTS)
    works = [partial(multiple_shooting_start, prepared, one, shortest=True) for one in (prepared.given, *others.starts)]
    further = [one for one in run_parallel(works, prepared) if one is not None]
    more = [one for one in (free, _likeliest_free(model, [*others.starts, *further])) if one is not None]
    free = _wider(max(more, key=lambda one: one.log_likelihood), settings) if more else None
    try:
        found = fit_with_process_noise(free, declared, settings, beside=[*starts[1:], *further], model=model)
    except NoFitError as error:
        raise NoFitError(no_first_fit(prepared, others)) from error
    return replace(found, starts=len(starts) + others.tried + len(further))


def _likeliest_free(model: JointModel, starts: Sequence[Float[Tensor, " p"]]) -> FittedModel | None:
    """The likeliest fit of the free run from several starts; None where it has no finite answer from any of them."""
    tried = run_parallel([partial(_free, model, start) for start in starts], model.prepared)
    return max((one for one in tried if one is not None), key=lambda one: one.log_likelihood, default=None)


def _explains(free: FittedModel) -> bool:
    """Whether a free run explains anything of what was recorded."""
    return pooled(goodness_of_fit(free.model.prepared, free.residual, {}, None)) > _NOTHING


def _wider(free: FittedModel, settings: NoiseSettings) -> FittedModel:
    """The same fit on the wider domain that all models are compared on; as it is where it is lost there."""
    bound = settings.domain * free.bound.maximum(free.bound.mean())
    # residuals at the end can be larger than those that the domain was chosen by
    bound = bound.maximum(_ROOM * robust_scale(free.residual))
    try:
        return fitted(free.model, free.parameters, bound, graduate=False)
    except NoFitError:
        return free


def fit_with_process_noise(
    free: FittedModel | None,
    declared: Mapping[str, float],
    settings: NoiseSettings,
    *,
    beside: Sequence[Float[Tensor, " p"]] = (),
    model: JointModel | None = None,
) -> ProcessNoiseFit:
    """A free fit under the likeliest noise around it.

    Args:
        free: the fit; None where there is none.
        declared: standard deviation of the white noise of outputs that it is known of.
        settings: of the noise.
        beside: parameters that predict over short horizons, to begin with as well.
        model: what is fitted, where there is no free fit.
    """
    starts = 1 + len(beside)
    noise = None if free is None else estimate_noise(free, declared, settings)
    if free is not None and (noise is None or noise.observer is None):
        return ProcessNoiseFit(free, free, noise, starts)
    own = model if free is None else free.model
    assert own is not None
    bound = None if free is None else free.bound
    works = [partial(_from_short, own, start, bound, declared, settings) for start in beside]
    if beside and isinstance(own.prepared, PreparedDynamics):
        works.append(partial(_from_given, own, own.prepared.given, bound, declared, settings))
    if free is not None and not works:
        works = [partial(_under_noise, free, noise, declared, settings)]
    tried = run_parallel(works, own.prepared)
    found = [one for one in tried if one is not None]
    if not found:
        if free is None:
            raise NoFitError(
                "No trajectory of the simulation was found near the recording, over short horizons either."
            )
        return ProcessNoiseFit(free, free, noise, starts)
    best = max(found, key=lambda one: one[0].log_likelihood)
    if best[1].observer is None and free is not None:
        return ProcessNoiseFit(free, free, best[1], starts)
    return ProcessNoiseFit(free, *best, starts)


def refit_noise(
    fit: FittedModel, around: StateSpaceNoise | None, declared: Mapping[str, float], settings: NoiseSettings
) -> FittedModel:
    """A joint model under the pushes that are left beside its effects, or, where it is as likely, running freely."""
    found = _under_noise(fit, estimate_noise(fit, declared, settings, around), declared, settings)
    best = fit if found is None or found[0].log_likelihood < fit.log_likelihood else found[0]
    free = refit_open_loop(best)
    if free is None:
        return best
    # parameters that were fitted beside a push can need it where those of the free run do not
    left = estimate_noise(free, declared, settings)
    if left is None or left.observer is None or free.log_likelihood > best.log_likelihood:
        return free
    return best


def refit_input_hold(
    fit: FittedModel, declared: Mapping[str, float], fixed: Mapping[str, str], settings: NoiseSettings
) -> FittedModel:
    """The same with inputs held or straight between samples, whichever is likelier now that the effects are there.

    Without them another course between samples may have stood in for what they do.
    """
    prepared = fit.model.prepared
    if not isinstance(prepared, PreparedDynamics):
        return fit
    for name, how in prepared.input_hold.items():
        for other in ("held", "linear"):
            if name in fixed or other == how:
                continue
            moved = prepared.holding({name: other})
            try:
                under = fitted(JointModel(moved, fit.model.terms, fit.model.near), fit.parameters, fit.bound)
            except NoFitError:
                continue
            found = refit_noise(shape_fitted(under), noise_of(moved, declared), declared, settings)
            if found.log_likelihood > fit.log_likelihood:
                fit, prepared = found, found.model.prepared
                assert isinstance(prepared, PreparedDynamics)
    return fit


def refit_open_loop(fit: FittedModel) -> FittedModel | None:
    """The same joint model fitted to its free run; None where that loses the recording."""
    prepared = open_loop(fit.model.prepared)
    if prepared is fit.model.prepared:
        return fit
    model = JointModel(prepared, fit.model.terms, fit.model.near)

    def tried(graduate: bool) -> FittedModel | None:
        try:
            return fitted(model, fit.parameters, fit.bound, graduate=graduate)
        except NoFitError:
            return None

    both = run_parallel([partial(tried, False), partial(tried, True)], prepared, fit.model.terms)
    return max((one for one in both if one is not None), key=lambda one: one.log_likelihood, default=None)


def _free(model: JointModel, start: Float[Tensor, " p"]) -> FittedModel | None:
    try:
        return fitted(model, start)
    except NoFitError:
        return None


_Found = tuple[FittedModel, StateSpaceNoise]


def _under_noise(
    fit: FittedModel, noise: StateSpaceNoise | None, declared: Mapping[str, float], settings: NoiseSettings
) -> _Found | None:
    """Fits under the noise of the fit before, the likeliest of them, with the noise that is around it."""
    best: _Found | None = None
    for _ in range(_ROUNDS):
        if noise is None:
            break
        prepared = fit.model.prepared
        assert isinstance(prepared, PreparedDynamics)
        model = JointModel(prepared.observed(noise.observer), fit.model.terms, fit.model.near)
        try:
            fit = fitted(model, fit.parameters, fit.bound, graduate=False)
        except NoFitError:
            break
        under, noise = noise, estimate_noise(fit, declared, settings, noise)
        if best is None or fit.log_likelihood > best[0].log_likelihood:
            same = noise is not None and (noise.observer is None) == (under.observer is None)
            best = fit, noise if same and noise is not None else under
        if noise is not None and noise.observer is None and under.observer is None:
            break
    return best


def _from_short(
    model: JointModel,
    start: Float[Tensor, " p"],
    bound: Float[Tensor, " m"] | None,
    declared: Mapping[str, float],
    settings: NoiseSettings,
) -> _Found | None:
    """The same from parameters that predict over short horizons, along an observer that corrects by much."""
    prepared = model.prepared
    assert isinstance(prepared, PreparedDynamics)
    observed = strongly_observed(prepared, start, _STRONG)
    if observed is None:
        return None
    strong = JointModel(observed, model.terms)
    try:
        fit = fitted(strong, start, bound, graduate=False)
    except NoFitError:
        return None
    if bound is None:
        fit = replace(fit, bound=settings.domain * fit.bound.maximum(fit.bound.mean()))
    return _under_noise(fit, estimate_noise(fit, declared, settings), declared, settings)


def _from_given(
    model: JointModel,
    start: Float[Tensor, " p"],
    bound: Float[Tensor, " m"] | None,
    declared: Mapping[str, float],
    settings: NoiseSettings,
) -> _Found | None:
    """Fits under the noise that is around a user's own values: what is missing may drive any fit without it away."""
    prepared = model.prepared
    assert isinstance(prepared, PreparedDynamics)
    strong = strongly_observed(prepared, start, _STRONG)
    if strong is None or bound is None:
        return None
    noise = likeliest_noise(
        strong, start, {}, None, declared=declared, least=settings.pushed, most=settings.pushes, known=None
    )
    if noise is None or noise.observer is None:
        return None
    try:
        fit = fitted(JointModel(prepared.observed(noise.observer)), start, bound, graduate=False)
    except NoFitError:
        return None
    return _under_noise(fit, estimate_noise(fit, declared, settings), declared, settings)


def choose_input_hold(
    base: ProcessNoiseFit, declared: Mapping[str, float], fixed: Mapping[str, str], settings: NoiseSettings
) -> ProcessNoiseFit:
    """The same with inputs that are held or go straight from sample to sample, whichever is likelier.

    Args:
        base: with what the simulation says of its inputs.
        declared: of the outputs' white noise.
        fixed: inputs of which it is known.
        settings: of the noise.
    """
    prepared = open_loop(base.fit.model.prepared)
    if not isinstance(prepared, PreparedDynamics):
        return base
    for name, how in prepared.input_hold.items():
        others = [one for one in ("held", "linear") if one != how] if name not in fixed else []
        works = [partial(_holding, base, name, other, declared, settings) for other in others]
        tried = [one for one in run_parallel(works, prepared) if one is not None]
        base = max([base, *tried], key=lambda one: one.fit.log_likelihood - settings.pushed * one.pushes)
    return _with_sizes(base)


def _with_sizes(base: ProcessNoiseFit) -> ProcessNoiseFit:
    """The same with the fitted trajectory as the guess of all states, of those that no output shows as well."""
    known, near = base.fit.model.prepared, base.fit.model.near
    assert isinstance(known, PreparedDynamics)

    def moved(fit: FittedModel) -> FittedModel:
        prepared = fit.model.prepared
        assert isinstance(prepared, PreparedDynamics)
        return replace(fit, model=JointModel(prepared.guessed(near), (), fit.model.near))

    free = None if base.free is None else moved(base.free)
    return replace(base, free=free, fit=free if base.fit is base.free and free is not None else moved(base.fit))


def _holding(
    base: ProcessNoiseFit, name: str, how: str, declared: Mapping[str, float], settings: NoiseSettings
) -> ProcessNoiseFit | None:
    known = base.fit.model.prepared
    assert isinstance(known, PreparedDynamics)
    prepared = known.holding({name: how})
    free = None
    try:
        if base.free is not None:
            model = JointModel(prepared.observed(None), (), base.free.model.near)
            free = fitted(model, base.free.parameters, base.free.bound, graduate=False)
        if free is not None:
            running = replace(fit_with_process_noise(free, declared, settings), starts=base.starts)
            if not (base.pushed and running.pushed):
                return running
        fit = fitted(JointModel(prepared, (), base.fit.model.near), base.fit.parameters, base.fit.bound)
    except NoFitError:
        return None
    found = _under_noise(fit, estimate_noise(fit, declared, settings, base.noise), declared, settings)
    if found is None or (found[1].observer is None and free is None):
        return None
    if found[1].observer is None or (free is not None and free.log_likelihood > found[0].log_likelihood):
        assert free is not None
        return replace(fit_with_process_noise(free, declared, settings), starts=base.starts)
    return ProcessNoiseFit(free, *found, base.starts)
