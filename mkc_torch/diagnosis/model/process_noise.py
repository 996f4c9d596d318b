"""A simulation with its effects under its most likely noise: process noise of its states, and its sensors' noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit, pooled
from mkc_torch.diagnosis.model.fit import FULL, Effort, FittedModel, fitted, no_first_fit, with_own_density
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import run_parallel
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.diagnosis.thresholds import HOLD
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.dynamics.first_fit import multiple_shooting_start, with_strong_observer
from mkc_torch.simulation.dynamics.first_observed import first_observed
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise, most_likely_noise
from mkc_torch.simulation.dynamics.other_starts import at_other_scales, log_size_at, other_starts
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.ports import Nearby
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

_ROUNDS = 2
"""Rounds of estimating the noise along a trajectory and fitting the parameters under it."""

_FIRST = 3
"""Samples per state that determine a run's initial states."""

_OTHER_STARTS = 3
"""Number of further starts for fits, if the first starts fail."""

_SCALED = 3
"""Numbers, one after the other, of which other scales are tried."""

_SMALLER = 0.05
"""Logarithm of the residual's size by which another scale has to leave less."""

_NOTHING = 0.05
"""Explained share of the outputs' variation up to which a first fit is poor."""

_ROOM = 3.0
"""Smallest half-width of a domain, in robust standard deviations of the residual."""

_STRONG = 10.0
"""Process noise assumed by a first observer, relative to that which moves an output by its noise."""


@dataclass(frozen=True)
class ProcessNoiseFit:
    """A fitted joint model, open loop and under its most likely noise.

    Attributes:
        free: the open-loop fit; None if it loses the recording, or could not be fitted.
        fit: the fit under the most likely noise; the same as ``free`` if the sensors' white noise is enough.
        noise: that noise; None for a simulation without states.
        starts: number of starting points of the first fit.
    """

    free: FittedModel | None
    fit: FittedModel
    noise: StateSpaceNoise | None
    starts: int = 1

    @property
    def has_disturbances(self) -> bool:
        """Whether the noise contains more than the sensors' white noise."""
        return self.noise is not None and self.noise.observer is not None


def first_samples(prepared: PreparedSimulation) -> Tensor | None:
    """Mask the samples that determine a run's initial states; None for a simulation without states."""
    system = prepared.dynamics
    if system is None:
        return None
    index = torch.arange(len(system.time))
    first = torch.where(system.begins, index, 0).cummax(0).values
    return index - first < _FIRST * len(system.system.states)


def has_process_noise(fit: FittedModel) -> bool:
    """Whether a fit is under more noise than the sensors' white noise."""
    return fit.model.prepared.observer is not None


def has_only_drift(fit: FittedModel) -> bool:
    """Whether a fit has drift but no process noise, so that its parameters are those of an open-loop fit."""
    observer = fit.model.prepared.observer
    return observer is not None and not any(disturbance.at_rate for disturbance in observer.disturbances)


def estimate_noise(
    fit: FittedModel,
    declared: Mapping[str, float],
    settings: NoiseSettings,
    known: StateSpaceNoise | None = None,
) -> StateSpaceNoise | None:
    """Return the most likely noise along a fit's trajectory; None without a trajectory or without states.

    Args:
        fit: its trajectory is used.
        declared: known standard deviations of the outputs' white noise.
        settings: of the noise.
        known: a similar noise, whose disturbances only get new sizes; None to select the disturbances.
    """
    model, system = fit.model, fit.model.prepared.dynamics
    if system is None:
        return None
    theta, changes = fit.parameters[: model.base], model.changes(fit.parameters)
    return most_likely_noise(
        system,
        theta,
        changes,
        model.near,
        declared=declared,
        least=settings.disturbance_gain,
        most=settings.max_disturbances,
        known=None if known is None else known.selected,
    )


def fit_alone(
    prepared: PreparedSimulation,
    declared: Mapping[str, float],
    settings: NoiseSettings,
    keep: Callable[[ProcessNoiseFit], object] = lambda _: None,
) -> ProcessNoiseFit:
    """Fit the simulation without effects, from as many starts as a reliable first fit needs.

    If fits from the first starts fail or explain nothing, starts between and around the user's values are tried, and
    shorter horizons. ``keep`` is called with the first fit, before its noise is known.

    Raises:
        NoFitError: no start has a finite result; the message lists what was tried.
    """
    model, starts = JointModel(prepared), [prepared.start()]
    system = prepared.dynamics
    if system is None:
        try:
            return fit_with_process_noise(_wider(fitted(model, starts[0]), settings), declared, settings, model=model)
        except NoFitError as error:
            raise NoFitError(no_first_fit(prepared)) from error
    # the steps of a simulation that steps are dear: single numbers at other scales instead of shorter horizons
    short = None if system.system.steps is not None else multiple_shooting_start(system, system.given)
    starts += [] if short is None else [short]
    scales = [] if system.system.steps is None else _best_scale(system, starts[0])
    free = _best_open_loop(model, [*starts, *scales])
    if free is not None:
        keep(ProcessNoiseFit(free, free, None, len(starts)))
    if free is not None and _explains(free):
        return fit_with_process_noise(_wider(free, settings), declared, settings, more_starts=starts[1:], model=model)
    others = other_starts(system, starts[0], _OTHER_STARTS)
    guesses = (system.given, *others.starts)
    works = [partial(multiple_shooting_start, system, guess, shortest=True) for guess in guesses]
    further = [start for start in run_parallel(works, prepared) if start is not None]
    more = [fit for fit in (free, _best_open_loop(model, [*others.starts, *further])) if fit is not None]
    free = _wider(max(more, key=lambda fit: fit.log_likelihood), settings) if more else None
    try:
        found = fit_with_process_noise(free, declared, settings, more_starts=[*starts[1:], *further], model=model)
    except NoFitError as error:
        raise NoFitError(no_first_fit(prepared, others)) from error
    return replace(found, starts=len(starts) + others.tried + len(further))


def _best_scale(system: PreparedDynamics, start: Float[Tensor, " p"]) -> list[Float[Tensor, " p"]]:
    """Return the user's values with numbers at other scales, one after the other, if that leaves less than the start.

    Returns:
        A start, or none.
    """
    best, least, at = None, log_size_at(system, start), system.given
    for _ in range(_SCALED):
        tried = at_other_scales(system, at)
        sizes = run_parallel([partial(log_size_at, system, theta) for theta in tried], system)
        if not sizes or not min(sizes) < least - _SMALLER:
            break
        least = min(sizes)
        best = at = tried[sizes.index(least)]
    return [] if best is None else [best]


def _best_open_loop(model: JointModel, starts: Sequence[Float[Tensor, " p"]]) -> FittedModel | None:
    """Return the most likely open-loop fit from several starts; None if it is finite from none of them."""
    tried = run_parallel([partial(_free, model, start) for start in starts], model.prepared)
    return max((fit for fit in tried if fit is not None), key=lambda fit: fit.log_likelihood, default=None)


def _explains(free: FittedModel) -> bool:
    """Whether an open-loop fit explains more than nothing of the recording."""
    return pooled(goodness_of_fit(free.model.prepared, free.residual, {})) > _NOTHING


def _wider(free: FittedModel, settings: NoiseSettings) -> FittedModel:
    """Return the fit on the wider domain that all models share; unchanged if that fit fails."""
    bound = settings.domain * free.bound.maximum(free.bound.mean())
    # the final residuals can be larger than those that set the domain
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
    more_starts: Sequence[Float[Tensor, " p"]] = (),
    model: JointModel | None = None,
    effort: Effort = FULL,
) -> ProcessNoiseFit:
    """Fit a model under its most likely noise, from its open-loop fit.

    Args:
        free: the open-loop fit; None if there is none.
        declared: known standard deviations of the outputs' white noise.
        settings: of the noise.
        more_starts: parameters that predict over short horizons, to start from as well.
        model: the model, if there is no open-loop fit.
        effort: how far each fit from the open-loop fit goes.
    """
    starts = 1 + len(more_starts)
    if free is not None and free.model.open_loop_only:
        return ProcessNoiseFit(free, free, None, starts)
    noise = None if free is None else estimate_noise(free, declared, settings)
    if free is not None and (noise is None or noise.observer is None):
        return ProcessNoiseFit(free, free, noise, starts)
    own = model if free is None else free.model
    assert own is not None
    bound = None if free is None else free.bound
    works = [partial(_from_short, own, start, bound, declared, settings) for start in more_starts]
    system = own.prepared.dynamics
    if more_starts and system is not None:
        works.append(partial(_from_given, system, bound, declared, settings))
    if free is not None and not works:
        works = [partial(under_noise, free, noise, declared, settings, effort)]
    tried = run_parallel(works, own.prepared)
    found = [pair for pair in tried if pair is not None]
    if not found:
        if free is None:
            raise NoFitError(
                "No trajectory of the simulation was found near the recording, not even over short horizons."
            )
        return ProcessNoiseFit(free, free, noise, starts)
    best = max(found, key=lambda pair: pair[0].log_likelihood)
    if best[1].observer is None and free is not None:
        return ProcessNoiseFit(free, free, best[1], starts)
    return ProcessNoiseFit(free, *best, starts)


def at_half_step(base: ProcessNoiseFit) -> ProcessNoiseFit | None:
    """Return the fit of the simulation alone with half the step of integration, from its parameters.

    Returns:
        None if the step is the smallest or the user's.

    Raises:
        NoFitError: the fit loses the recording.
    """
    fits = [fit for fit in (base.free, base.fit) if fit is not None]
    again: dict[int, FittedModel] = {}
    for fit in fits:
        finer = fit.model.prepared.finer()
        if finer is None:
            return None
        again[id(fit)] = fitted(JointModel(finer, fit.model.terms), fit.parameters, fit.bound, graduate=False)
    return replace(base, free=None if base.free is None else again[id(base.free)], fit=again[id(base.fit)])


def with_noise_around(fit: FittedModel, declared: Mapping[str, float], settings: NoiseSettings) -> FittedModel:
    """Return a fit at the same parameters, along the observer of its most likely noise.

    Parameters that are fitted together with process noise can leave the open loop that they were chosen for.
    """
    noise = None if fit.model.open_loop_only else estimate_noise(fit, declared, settings)
    if noise is None or noise.observer is None:
        return fit
    model = JointModel(fit.model.prepared.observed(noise.observer), fit.model.terms, fit.model.near)
    return with_own_density(fit, model) or fit


def refit_open_loop(fit: FittedModel) -> FittedModel | None:
    """Return the open-loop fit of the same joint model; None if that loses the recording."""
    return fit.open_loop


def _free(model: JointModel, start: Float[Tensor, " p"]) -> FittedModel | None:
    try:
        return fitted(model, start)
    except NoFitError:
        return None


_Found = tuple[FittedModel, StateSpaceNoise]


def under_noise(
    fit: FittedModel,
    noise: StateSpaceNoise | None,
    declared: Mapping[str, float],
    settings: NoiseSettings,
    effort: Effort = FULL,
) -> _Found | None:
    """Alternate noise estimation and fit; return the most likely fit with the noise around it."""
    best: _Found | None = None
    for _ in range(_ROUNDS):
        if noise is None:
            break
        near = _along(fit, noise)
        model = JointModel(fit.model.prepared.observed(noise.observer), fit.model.terms, near)
        try:
            # the open-loop trajectory may be far from that along the observer
            fit = fitted(model, fit.parameters, fit.bound, graduate=False, fresh=True, effort=effort)
        except NoFitError:
            break
        under, noise = noise, estimate_noise(fit, declared, settings, noise)
        if best is None or fit.log_likelihood > best[0].log_likelihood:
            same = noise is not None and (noise.observer is None) == (under.observer is None)
            best = fit, noise if same and noise is not None else under
        if noise is not None and noise.observer is None and under.observer is None:
            break
    return best


def _along(fit: FittedModel, noise: StateSpaceNoise) -> Nearby | None:
    """Return a start of the trajectory along an observer, from that of a fit in open loop."""
    model, system = fit.model, fit.model.prepared.dynamics
    if system is None or system.observer is not None or noise.observer is None:
        return model.near
    theta, changes = fit.parameters[: model.base], model.changes(fit.parameters)
    return first_observed(system, theta, changes, model.near, noise.observer) or model.near


def _from_short(
    model: JointModel,
    start: Float[Tensor, " p"],
    bound: Float[Tensor, " m"] | None,
    declared: Mapping[str, float],
    settings: NoiseSettings,
) -> _Found | None:
    """Fit from parameters that predict over short horizons, along a strongly correcting observer."""
    system = model.prepared.dynamics
    observed = None if system is None else with_strong_observer(system, start, _STRONG)
    if observed is None:
        return None
    strong = JointModel(observed, model.terms)
    try:
        fit = fitted(strong, start, bound, graduate=False)
    except NoFitError:
        return None
    if bound is None:
        fit = replace(fit, bound=settings.domain * fit.bound.maximum(fit.bound.mean()))
    return under_noise(fit, estimate_noise(fit, declared, settings), declared, settings)


def _from_given(
    system: PreparedDynamics,
    bound: Float[Tensor, " m"] | None,
    declared: Mapping[str, float],
    settings: NoiseSettings,
) -> _Found | None:
    """Fit under the noise around a user's own values, because a missing effect can drive any fit without it away."""
    start = system.given
    strong = with_strong_observer(system, start, _STRONG)
    if strong is None or bound is None:
        return None
    least, most = settings.disturbance_gain, settings.max_disturbances
    noise = most_likely_noise(strong, start, {}, None, declared=declared, least=least, most=most, known=None)
    if noise is None or noise.observer is None:
        return None
    try:
        fit = fitted(JointModel(system.observed(noise.observer)), start, bound, graduate=False)
    except NoFitError:
        return None
    return under_noise(fit, estimate_noise(fit, declared, settings), declared, settings)


def choose_input_hold(
    base: ProcessNoiseFit,
    declared: Mapping[str, float],
    fixed: Mapping[str, str],
    settings: NoiseSettings,
    value: Callable[[ProcessNoiseFit], float],
) -> ProcessNoiseFit:
    """Return the fit with the best hold of each input, constant or linear between samples.

    Args:
        base: the fit with the simulation's own holds, which are kept where the gain is below ``HOLD``.
        declared: known standard deviations of the outputs' white noise.
        fixed: inputs whose hold is known.
        settings: of the noise.
        value: the score of a fit.
    """
    prepared = base.fit.model.prepared.open_loop()
    for name, how in prepared.input_hold.items():
        others = [hold for hold in ("held", "linear") if hold != how] if name not in fixed else []
        works = [partial(_holding, base, name, other, declared, settings) for other in others]
        tried = [found for found in run_parallel(works, prepared) if found is not None]
        best = max(tried, key=value, default=base)
        base = best if value(best) > value(base) + HOLD else base
    return _with_sizes(base)


def _with_sizes(base: ProcessNoiseFit) -> ProcessNoiseFit:
    """Return the fit with its trajectory as the guess of all states, including those that no output shows."""
    near = base.fit.model.near

    def moved(fit: FittedModel) -> FittedModel:
        system = fit.model.prepared.dynamics
        return fit if system is None else replace(fit, model=JointModel(system.guessed(near), (), fit.model.near))

    free = None if base.free is None else moved(base.free)
    return replace(base, free=free, fit=free if base.fit is base.free and free is not None else moved(base.fit))


def _holding(
    base: ProcessNoiseFit, name: str, how: str, declared: Mapping[str, float], settings: NoiseSettings
) -> ProcessNoiseFit | None:
    prepared = base.fit.model.prepared.with_input_hold({name: how})
    free = None
    try:
        if base.free is not None:
            model = JointModel(prepared.open_loop(), (), base.free.model.near)
            free = fitted(model, base.free.parameters, base.free.bound, graduate=False, fresh=True)
        if free is not None:
            running = replace(fit_with_process_noise(free, declared, settings), starts=base.starts)
            if not (base.has_disturbances and running.has_disturbances):
                return running
        fit = fitted(JointModel(prepared, (), base.fit.model.near), base.fit.parameters, base.fit.bound, fresh=True)
    except NoFitError:
        return None
    found = under_noise(fit, estimate_noise(fit, declared, settings, base.noise), declared, settings)
    if found is None or (found[1].observer is None and free is None):
        return None
    if found[1].observer is None or (free is not None and free.log_likelihood > found[0].log_likelihood):
        assert free is not None
        return replace(fit_with_process_noise(free, declared, settings), starts=base.starts)
    return ProcessNoiseFit(free, *found, base.starts)
