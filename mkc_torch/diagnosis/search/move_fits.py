"""Fits of the search's moves, each from a known fit; all in open loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import torch

from mkc_torch.diagnosis.model.fit import (
    ROUGH,
    SEARCH,
    FittedModel,
    by_least_squares,
    clipped_residual,
    fitted,
    fitted_with_effect,
    with_own_density,
    within_domain,
    without_term,
)
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_process_noise
from mkc_torch.diagnosis.model.shapes import Better, more_likely, shape_fitted, with_form_of_grid
from mkc_torch.diagnosis.model.simpler import simpler_start
from mkc_torch.diagnosis.model.term import Key, Term
from mkc_torch.diagnosis.search.moves import STARTS, Addition, additions, at_size_zero
from mkc_torch.diagnosis.settings import NoiseSettings, Settings
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.dynamics.impossible import impossible_values
from mkc_torch.simulation.dynamics.kalman import OUTLIERS

POLISHED = 2
"""Rough fits of an effect that are refined to the end."""


def most_likely(fits: Sequence[FittedModel]) -> FittedModel:
    return max(fits, key=lambda fit: fit.log_likelihood)


def at_other_values(fit: FittedModel, away: float) -> list[FittedModel]:
    """Return a fit moved to the initial values of its parameters, and to the user's, where it must not stay.

    A missing effect can drive a parameter to where no effect helps: far from its initial value, or to a value that
    cannot be.

    Args:
        fit: of the simulation alone.
        away: factor by which a parameter has grown or shrunk that is far.
    """
    prepared = fit.model.prepared
    theta, own = prepared.start(), fit.model.base - prepared.beginnings
    sizes = torch.stack([theta[:own], fit.parameters[:own]]).abs()
    starts = [theta] if bool((sizes.amax(0) > away * sizes.amin(0)).any()) else []
    system = prepared.dynamics
    if system is not None and impossible_values(system, fit.parameters):
        nominal = theta.clone()
        nominal[:own] = system.given[:own]
        starts += [] if starts and torch.equal(nominal, theta) else [nominal]
    moved = []
    for start in starts:
        residual = fit.model.residual(start)
        # a clipped residual: at values that are not fitted any sample may be far
        value, _ = clipped_residual(residual, fit.recorded)
        if bool(residual.isfinite().all()):
            moved.append(replace(fit, parameters=start, residual=value))
    return moved


def at_own_holds(fit: FittedModel, fixed: Mapping[str, str]) -> FittedModel | None:
    """Return the fit with the simulation's own holds of its inputs; None if it has them, or if that fit fails.

    Args:
        fit: of the simulation alone.
        fixed: inputs whose hold is known.
    """
    prepared = fit.model.prepared
    if prepared.dynamics is None:
        return None
    own = dict.fromkeys(prepared.input_hold, prepared.dynamics.system.input_hold) | dict(fixed)
    if own == dict(prepared.input_hold):
        return None
    moved = JointModel(prepared.with_input_hold(own), fit.model.terms, fit.model.near)
    try:
        return fitted(moved, fit.parameters, fit.bound, fresh=True)
    except NoFitError:
        return None


def fits_at_own_holds(
    fit: FittedModel, terms: Sequence[Term], fixed: Mapping[str, str], settings: NoiseSettings
) -> Iterator[tuple[Key, Callable[[], FittedModel]]]:
    """Yield fits of each delay, lag and clock from the simulation's own holds of its inputs, if the fit has others.

    A hold imitates a delay of half a sample, so the most likely hold of the simulation alone can hide a part of it.

    Args:
        fit: of the simulation alone.
        terms: the candidates.
        fixed: inputs whose hold is known.
        settings: of the noise.
    """
    held = at_own_holds(fit, fixed)
    if held is None:
        return
    in_time = [term for term in terms if term.effect.remembers]
    for addition in additions(held, in_time, settings):
        for term, size in addition.starts[:POLISHED]:
            start = torch.cat([held.parameters, size])
            yield addition.key, partial(fitted_with_effect, held, held.model.with_term(term), start, effort=SEARCH)


def by_squares(fit: FittedModel, settings: NoiseSettings) -> FittedModel | None:
    """Return the fit of least squares, if the robust fit rejects more samples than the score takes for outliers.

    A robust fit takes a stretch that the model does not follow for outliers: what is missing there then shows in no
    linear gain, and the parameters follow the quiet rest.
    """
    if has_process_noise(fit) or (not fit.squares and fit.rejected_share(settings) <= OUTLIERS):
        return None
    return by_least_squares(fit, SEARCH)


def by_both_estimators(fit: FittedModel, settings: NoiseSettings) -> Iterator[FittedModel]:
    """Yield a model's robust fit, and that of least squares with the density of its residual, where they may differ."""
    squares = fit if fit.sigma_held else by_squares(fit, settings)
    own = None if squares is None else with_own_density(squares)
    robust = fit if own is None or not fit.squares else _refitted(replace(own, squares=False), own)
    yield from (found for found in (robust, own) if found is not None and not found.sigma_held)


def fitted_through_noise(noisy: FittedModel, term: Term, size: torch.Tensor) -> FittedModel | None:
    """Return the open-loop fit with an effect from its fit under process noise."""
    start = torch.cat([noisy.parameters, size])
    return fitted_with_effect(noisy, noisy.model.with_term(term), start, graduate=False, effort=SEARCH).open_loop


def other_starts(
    fit: FittedModel,
    terms: Sequence[Term],
    further: Sequence[Term],
    noisy: FittedModel | None,
    fixed: Mapping[str, str],
    settings: Settings,
) -> dict[Key, list[Callable[[], FittedModel | None]]]:
    """Return fits of each effect from elsewhere than the simulation alone in open loop.

    From its initial values, if the fit went far from them or to values that cannot be; and through the process
    noise of the simulation alone, along whose trajectory a strong effect can be fitted that the open loop does not
    reach. The latter is slow, and is for the candidates that the screening found there. A delay also starts from
    the simulation's own holds.
    """
    found: dict[Key, list[Callable[[], FittedModel | None]]] = {}
    for there in at_other_values(fit, settings.search.ran_away):
        for addition in additions(there, terms, settings.noise):
            for term, size in addition.starts[:POLISHED]:
                start = torch.cat([there.parameters, size])
                work = partial(fitted_with_effect, fit, fit.model.with_term(term), start, effort=SEARCH)
                found.setdefault(addition.key, []).append(work)
    for key, held in fits_at_own_holds(fit, terms, fixed, settings.noise):
        found.setdefault(key, []).append(held)
    if noisy is not None:
        leading = {term.key for term in further}
        led = [term for term in terms if term.key in leading and not term.effect.open_loop_only]
        for addition in additions(noisy, led, settings.noise):
            found.setdefault(addition.key, []).append(partial(fitted_through_noise, noisy, *addition.starts[0]))
    return found


def fitted_with(
    fit: FittedModel,
    addition: Addition,
    others: Sequence[Callable[[], FittedModel | None]] = (),
    *,
    implausible: Callable[[FittedModel], bool] = lambda _: False,
    better: Better | None = None,
) -> FittedModel:
    """Return the most likely plausible fit with one more effect, from its best shapes and from other fits.

    Args:
        fit: the fit without the effect.
        addition: the effect with its shapes.
        others: further fits with the effect.
        implausible: whether a fit is not to be returned if there is another, such as a curve of the angle that cancels
            the simulation's own gravity.
        better: compares forms such as a width with the most likely form; None for that.
    """
    begun = sorted((_begun(fit, term, size) for term, size in addition.starts), key=lambda found: -found.log_likelihood)
    least = 0.5 * (begun[0].log_likelihood + fit.log_likelihood)
    near = [found for number, found in enumerate(begun[:POLISHED]) if number == 0 or found.log_likelihood >= least]
    near += [found for other in others if (found := other()) is not None]
    polished = [_polished(found) for found in near]
    plausible = [found for found in polished if not implausible(found)]
    criteria = (more_likely,) if better is None else (more_likely, better)
    return with_form_of_grid(most_likely(plausible or polished), SEARCH, criteria)


def _polished(begun: FittedModel) -> FittedModel:
    """Return a rough fit at the most likely sizes and shapes."""
    if begun.model.terms[-1].effect.fitted_shape:
        return shape_fitted(begun, SEARCH)
    found = _refitted(begun, begun)
    return begun if found is None else found


def _begun(fit: FittedModel, term: Term, size: torch.Tensor) -> FittedModel:
    """Return a rough fit with one more effect at a fixed shape: from its linear size, or from 0 if that is worse."""
    model = fit.model.with_term(term)
    found = fitted_with_effect(fit, model, torch.cat([fit.parameters, size]), graduate=False, effort=ROUGH)
    if found.log_likelihood > fit.log_likelihood:
        return found
    zero = torch.cat([fit.parameters, torch.zeros_like(size)])
    return most_likely([found, fitted_with_effect(fit, model, zero, graduate=False, effort=ROUGH)])


def fitted_without(fit: FittedModel, number: int) -> FittedModel | None:
    try:
        # an effect that explains nearly all leaves a residual that the domain of the fit with it cannot hold
        start = within_domain(without_term(fit, number))
        return shape_fitted(fitted(start.model, start.parameters, start.bound, graduate=False, effort=SEARCH), SEARCH)
    except NoFitError:
        return None


def fitted_exchanged(
    fit: FittedModel, number: int, group: Sequence[Term], settings: NoiseSettings, better: Better | None = None
) -> FittedModel | None:
    """Return the fit with another effect in place of one, from its first shape and those of the largest linear gain.

    ``better`` compares forms, as in :func:`fitted_with`.
    """
    rest = fitted_without(fit, number) if len(fit.model.terms) > 1 else _refitted(without_term(fit, number), fit)
    if rest is None:
        return None
    led = [start for addition in additions(rest, group[1:], settings) for start in addition.starts]
    starts = (*at_size_zero(rest, group[:1]).starts, *led)[:STARTS]
    return fitted_with(rest, Addition(starts, 0.0), better=better)


def _refitted(start: FittedModel, like: FittedModel) -> FittedModel | None:
    try:
        return fitted(start.model, start.parameters, like.bound, graduate=False, effort=SEARCH, squares=like.sigma_held)
    except NoFitError:
        return None


def fitted_held(fit: FittedModel, name: str, how: str) -> FittedModel | None:
    """Return the fit with another hold of an input; its trajectory is found again if the fit's own is too far."""
    moved = JointModel(fit.model.prepared.with_input_hold({name: how}), fit.model.terms, fit.model.near)
    try:
        return shape_fitted(fitted(moved, fit.parameters, fit.bound, fresh=True))
    except NoFitError:
        return None


def fitted_reordered(fit: FittedModel, terms: tuple[Term, ...]) -> FittedModel | None:
    model = JointModel(fit.model.prepared, terms, fit.model.near)
    try:
        return shape_fitted(fitted(model, fit.parameters, fit.bound, graduate=False, effort=SEARCH), SEARCH)
    except NoFitError:
        return None


def fitted_in_form(
    fit: FittedModel, number: int, group: Sequence[Term], settings: NoiseSettings, rest: FittedModel | None
) -> FittedModel | None:
    """Return the fit with a size of each recording in place of an effect's common size, or the other way round.

    From the present size and shape, and from the linear sizes without the effect: with a common size the fit can follow
    one recording and take the others for outliers.

    Args:
        fit: with the effect.
        number: of the effect.
        group: the effect in the other form, with the shapes of its grid.
        settings: of the noise.
        rest: the fit without the effect, if it is known.
    """
    found = [_from_form(fit, number, group[0])]
    if rest is not None:
        found += [fitted_with(rest, addition) for addition in additions(rest, group, settings)]
    fits = [other for other in found if other is not None]
    return most_likely(fits) if fits else None


def _from_form(fit: FittedModel, number: int, term: Term) -> FittedModel | None:
    """Return the fit with an effect in another form, from its size and shape; None if it loses the recording."""
    parts = list(fit.model.gammas(fit.parameters))
    own, k = parts[number], len(term.effect.recordings or fit.model.terms[number].effect.recordings)
    parts[number] = own.repeat_interleave(k) if term.effect.recordings else own.unflatten(0, (-1, k)).mean(-1)
    terms = list(fit.model.terms)
    terms[number] = replace(terms[number], effect=term.effect)
    model = JointModel(fit.model.prepared, terms, fit.model.near)
    start = torch.cat([fit.parameters[: fit.model.base], *parts])
    try:
        return shape_fitted(fitted(model, start, fit.bound, graduate=False, effort=SEARCH), SEARCH)
    except NoFitError:
        return None


def fitted_simpler(fit: FittedModel, number: int) -> FittedModel | None:
    """Return the fit with the simpler form of an effect, such as equal exchange of two states; None without that."""
    start = simpler_start(fit, number) if fit.model.terms[number].effect.simpler is not None else None
    try:
        return None if start is None else shape_fitted(fitted(*start, fit.bound, graduate=False))
    except NoFitError:
        return None
