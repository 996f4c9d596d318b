"""The score of a model of differential equations, comparable between all models of one recording.

    score = mean over horizons h of sum over samples k of log p(y[k] | y[..k-h]) - price

A prediction is normal or, with a probability of 5 %, uniform over the output's span. Every density sums to 1 and the
weights of the horizons do too, so the score is proper: in expectation no model scores higher than the true one. With
white sensor noise alone all horizons are the free run, and the score is the ordinary log-likelihood. Process noise of
any size can follow a recording one sample ahead; further ahead it has to pay with wide predictions. The last horizon is
the free run: what a user compares with the recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from mkc_torch._support.quantum import rounding_of
from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.diagnosis.thresholds import IMPLAUSIBLE
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.dynamics.draws import drawn
from mkc_torch.simulation.dynamics.entries import typical_gains
from mkc_torch.simulation.dynamics.flow import changes_by_inputs, flow_of, plausible_sizes
from mkc_torch.simulation.dynamics.horizons import horizons_of, log_likelihood_ahead, per_sample
from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.noise_grid import NoiseGrid, key_of
from mkc_torch.simulation.dynamics.noise_model import NoiseModel
from mkc_torch.simulation.dynamics.ports import ENTRIES, RATES
from mkc_torch.simulation.dynamics.unlikely import price_of_values

if TYPE_CHECKING:
    from jaxtyping import Float

_DECADES = (0.5, 0.25, 0.12)
"""Decades by which the sizes and times of the most likely noise are varied, round by round."""

_ROUNDS = 3
"""Steps of each round."""

_SETTLED = 0.05
"""Nats that a step has to gain for another."""

_DRAWS = 8
"""Recordings drawn for the variance ratio."""

_USUAL = 0.9
"""Quantile of an effect's changes over time that is compared."""


@dataclass(frozen=True)
class ScoreBasis:
    """What all scores of a recording share, fixed before the search.

    Attributes:
        horizons: of the predictions, in samples.
        span: (m,), range of each output.
        counts: (N, m), mask of the samples.
        samples: number of samples N, of which half the logarithm is the price of a number.
        kappa: long-run variance of the samples' scores over that of independent samples, at least 1; multiplies prices.
            Of recordings drawn with the noise of the simulation alone.
        choice: nats for the choice of an effect, the logarithm of the number of candidates.
        rounding: smallest white noise of each output.
        declared: known standard deviations of the outputs' white noise, by output.
        largest: (p+m,), largest plausible process noise of each rate and drift of each output.
        changes: (p,), largest plausible change of each rate by an effect.
    """

    horizons: tuple[int, ...]
    span: Float[np.ndarray, " m"]
    counts: Float[np.ndarray, "N m"]
    samples: int
    kappa: float
    choice: float
    rounding: tuple[float, ...]
    declared: Mapping[str, float]
    largest: Float[np.ndarray, " p+m"]
    changes: Float[np.ndarray, " p"]

    @property
    def number(self) -> float:
        """Price of a fitted number in nats (Schwarz, Annals of Statistics 6 (1978), 461; Varin & Vidoni, Biometrika 92
        (2005), 519, for likelihoods whose terms are not independent)."""
        return 0.5 * self.kappa * math.log(self.samples)


@dataclass(frozen=True)
class Score:
    """The score of a model and its parts, in nats.

    Attributes:
        by_horizon: log-likelihood of the recording from predictions over each horizon.
        numbers: price of the fitted numbers of effects and noise.
        terms: price of the choice of effects.
        disturbances: price of the disturbances of the noise.
        forms: price of forms that include others as special cases, and of curves without a name.
        given: price of parameters that are far from the values given, by their uncertainties.
        noise: the noise that scores best.
        per_sample: (N,), log-likelihood of each sample, averaged over the horizons.
    """

    by_horizon: tuple[float, ...]
    numbers: float
    terms: float
    disturbances: float
    forms: float
    given: float
    noise: NoiseModel
    per_sample: Float[np.ndarray, " N"]

    @property
    def log_likelihood(self) -> float:
        """Mean over the horizons."""
        return sum(self.by_horizon) / len(self.by_horizon)

    @property
    def value(self) -> float:
        """The score."""
        return self.log_likelihood - self.numbers - self.terms - self.disturbances - self.forms - self.given


def basis_of(base: FittedModel, candidates: int, declared: Mapping[str, float], settings: Settings) -> ScoreBasis:
    """Return what all scores of a recording share.

    Args:
        base: fit of the simulation without effects.
        candidates: number of different effects, drivers and places that are searched.
        declared: known standard deviations of the outputs' white noise, by output.
        settings: thresholds.

    Raises:
        NoFitError: the fit has no finite trajectory.
    """
    prepared = base.model.prepared.dynamics
    assert prepared is not None
    flow = _flow(base)
    measured = prepared.measured
    span = (measured.amax(0) - measured.amin(0)).clamp(min=1e-300).double().cpu().numpy()
    rounding = tuple(rounding_of(measured).tolist())
    counts = prepared.counts.double().cpu().numpy()
    choice = math.log(max(candidates, 1))
    if flow is None:
        raise NoFitError("The simulation has no finite trajectory at the fitted values.")
    theta, changes = base.parameters[: base.model.base], base.model.changes(base.parameters)
    largest = plausible_sizes(prepared, theta, changes, base.model.near)
    effects = np.maximum(IMPLAUSIBLE * largest[: len(prepared.disturbable)], changes_by_inputs(prepared, theta))
    basis = ScoreBasis(horizons_of(flow), span, counts, len(counts), 1.0, choice, rounding, declared, largest, effects)
    fits = [fit for fit in (base, base.open_loop) if fit is not None]
    scored = [(fit, found) for fit in fits if (found := score(fit, basis, settings)) is not None]
    if not scored:
        return basis
    fit, alone = max(scored, key=lambda pair: pair[1].value)
    return replace(basis, kappa=_kappa(fit, alone.noise, basis))


def _kappa(fit: FittedModel, noise: NoiseModel, basis: ScoreBasis) -> float:
    """Return the variance ratio of recordings drawn with the noise of a fit, whose residual may hold missing physics.

    The free run is left out: with process noise its errors are a single path, in which a number gains little.
    """
    flow = _flow(fit)
    if flow is None or not noise.components:
        return 1.0  # all horizons are the free run, and its errors are independent
    generator, horizons = np.random.default_rng(0), basis.horizons[:-1] or basis.horizons
    flow = replace(flow, counts=basis.counts, shift=np.zeros_like(flow.shift))
    draws = [replace(flow, new=new) for new in drawn(flow, noise, _DRAWS, generator)]
    whole = (basis.counts > 0.0).all(1)  # a sample that is masked in part has another mean
    return variance_ratio([per_sample(draw, noise, horizons, basis.span)[whole] for draw in draws], horizons[-1])


def variance_ratio(series: Sequence[Float[np.ndarray, " N"]], reach: int) -> float:
    """Return the long-run variance over the variance of several series of a kind, at least 1.

    Predictions over h samples overlap by h - 1, so their errors are correlated up to there. Newey & West, Econometrica
    55 (1987), 703.

    Args:
        series: the series, each with a mean of its own.
        reach: largest lag, with Bartlett's weights.

    Example:
        >>> variance_ratio([np.array([1.0, -1.0] * 50)], 3), variance_ratio([np.repeat([1.0, -1.0] * 25, 40)], 3) > 2.0
        (1.0, True)
    """
    power = total = 0.0
    for values in series:
        away = values - values.mean() if len(values) else values
        power += float(away @ away)
        lags = range(1, min(reach, len(away) - 1) + 1)
        total += sum((1.0 - lag / (reach + 1)) * float(away[lag:] @ away[:-lag]) for lag in lags)
    return max(1.0 + 2.0 * total / power, 1.0) if power > 0.0 else 1.0


def score(fit: FittedModel, basis: ScoreBasis, settings: Settings, near: Sequence[NoiseModel] = ()) -> Score | None:
    """Return the score of a fitted model under the noise that scores best; None if it loses the recording.

    The parameters and sizes are those of the fit; noise is fitted here, on the same grid for all models.

    Args:
        fit: the model, in open loop or along an observer.
        basis: what all scores of the recording share.
        settings: thresholds.
        near: further noise models to try.
    """
    flow, prepared = _flow(fit), fit.model.prepared.dynamics
    if flow is None or prepared is None or is_implausible(fit, basis):
        return None
    flow = replace(flow, counts=basis.counts)
    models = [*_grid(fit, flow, basis).singles(), *near, *_own_noise(fit, basis)]
    best = _best_noise(flow, models, basis, settings, _grid(fit, flow, basis))
    if best is None:
        return None
    noise, by_horizon = best
    disturbances = len(noise.components)
    numbers = sum(fit.model.sizes) + sum(len(term.effect.fitted_shape) for term in fit.model.terms)
    forms = sum(
        settings.naming.is_generalisation * term.effect.is_generalisation
        + settings.naming.nameless * term.effect.is_curve
        for term in fit.model.terms
    )
    return Score(
        by_horizon,
        basis.number * (numbers + _noise_numbers(noise)),
        basis.kappa * basis.choice * len(fit.model.terms),
        basis.kappa * settings.noise.disturbance_gain * disturbances,
        basis.kappa * forms,
        basis.kappa * price_of_values(prepared, fit.parameters),
        noise,
        per_sample(flow, noise, basis.horizons, basis.span),
    )


def highest(fits: Iterable[FittedModel | None], basis: ScoreBasis, settings: Settings) -> float:
    """Return the highest score of several fits of one model in nats; minus infinity if all lose the recording."""
    unique = {id(fit): fit for fit in fits if fit is not None}
    scores = [score(fit, basis, settings) for fit in unique.values()]
    return max((found.value for found in scores if found is not None), default=-math.inf)


def separation(best: Score | None, other: Score | None, basis: ScoreBasis) -> float:
    """Return how far a model is behind, in nats of a likelihood whose terms are independent; infinite without a score.

    The difference of the scores over κ, or the nats at which a normal likelihood ratio is as many standard errors from
    0 as the difference is, if these are fewer: models that follow different stretches differ by chance (Vuong,
    Econometrica 57 (1989), 307).

    Args:
        best: the score of the preferred model.
        other: the score of the other.
        basis: what all scores share.
    """
    if best is None or other is None:
        return math.inf
    gap = best.value - other.value
    away = best.per_sample - other.per_sample
    away = away - away.mean()
    error = math.sqrt(float(away @ away) * variance_ratio([away], len(away) // 10))
    return min(gap / basis.kappa, 0.5 * gap * abs(gap) / error**2) if error > 0.0 else gap / basis.kappa


def _noise_numbers(noise: NoiseModel) -> int:
    """Number of sizes and time constants of the disturbances."""
    return sum(1 + (lasting > 0.0) for _, _, lasting in noise.components)


def _flow(fit: FittedModel) -> Flow | None:
    """Return the linearised trajectory of a fit; None without a finite one."""
    model, prepared = fit.model, fit.model.prepared.dynamics
    if prepared is None:
        return None
    flow = flow_of(prepared, fit.parameters[: model.base], model.changes(fit.parameters), model.near)
    arrays = () if flow is None else (flow.transition, flow.seen, flow.new, flow.shift, flow.noise_input)
    return flow if flow is not None and all(bool(np.isfinite(array).all()) for array in arrays) else None


def is_implausible(fit: FittedModel, basis: ScoreBasis) -> bool:
    """Whether an effect changes a rate by far more than the recording's rates and its inputs: two changes cancel.

    Or whether effects take a parameter out of its bounds for more than a tenth of the recording.

    Args:
        fit: the model.
        basis: with the largest changes of the rates.
    """
    if not fit.model.terms:
        return False
    model, prepared = fit.model, fit.model.prepared.dynamics
    assert prepared is not None
    largest = dict(zip(prepared.disturbable, basis.changes, strict=True))
    signals = model.signals(fit.parameters)
    for name in {term.port for term in model.terms if prepared.ports[term.port].kind == "parameter"}:
        known = prepared.known[prepared.ports[name].channels[0]]
        value = (signals[name] + model.changes(fit.parameters)[name](signals[name])).detach()
        if float(((value < known.lower) | (value > known.upper)).double().mean()) > 1.0 - _USUAL:
            return True
    for term, gamma in zip(model.terms, model.gammas(fit.parameters), strict=True):
        port = prepared.ports[term.port]
        if port.kind not in (*RATES, *ENTRIES):
            continue
        signal = signals[term.port]
        change = term.effect.change(gamma, term.shape, term.context(prepared, signal))[:, 0].detach()
        usual = float(change.abs().nan_to_num(torch.inf).quantile(_USUAL))
        gains = (
            typical_gains(prepared.open_loop(), port.channels[0]) if port.kind in ENTRIES else {port.channels[0]: 1.0}
        )
        if any(not gain * usual <= largest[name] for name, gain in gains.items() if name in largest):
            return True
    return False


def _grid(fit: FittedModel, flow: Flow, basis: ScoreBasis) -> NoiseGrid:
    """Return the grid of noise models around a fit's white noise."""
    prepared = fit.model.prepared.dynamics
    assert prepared is not None
    observer = prepared.observer
    size = size_of(fit.residual) if observer is None else observer.sensor
    known = tuple(name in basis.declared for name in prepared.channels)
    sensor = [
        basis.declared.get(name, max(own, step, 1e-300))
        for name, own, step in zip(prepared.channels, size.tolist(), basis.rounding, strict=True)
    ]
    return NoiseGrid(flow, NoiseModel(tuple(sensor), (), known, basis.rounding))


def _own_noise(fit: FittedModel, basis: ScoreBasis) -> list[NoiseModel]:
    """Return the noise that a fit was made under, if it has disturbances."""
    prepared = fit.model.prepared.dynamics
    if prepared is None or prepared.observer is None:
        return []
    observer, channels = prepared.observer, prepared.channels
    known = tuple(name in basis.declared for name in channels)
    rates = prepared.disturbable
    return [NoiseModel.of(observer.disturbances, observer.sensor.tolist(), rates, channels, known, basis.rounding)]


def _best_noise(
    flow: Flow,
    models: Sequence[NoiseModel],
    basis: ScoreBasis,
    settings: Settings,
    grid: NoiseGrid,
) -> tuple[NoiseModel, tuple[float, ...]] | None:
    """Return the noise that scores best, refined on the grid, at its scale, and its log-likelihood by horizon."""

    def evaluated(tried: Sequence[NoiseModel]) -> tuple[float, NoiseModel, tuple[float, ...]]:
        values, scales = log_likelihood_ahead(flow, tried, basis.horizons, basis.span)
        best: tuple[float, NoiseModel, tuple[float, ...]] = -math.inf, tried[0], ()
        for noise, each, scale in zip(tried, values, scales, strict=True):
            scaled = replace(
                noise,
                sensor=tuple(scale * size for size in noise.sensor),
                components=tuple((place, scale * size, lasting) for place, size, lasting in noise.components),
            )
            if any(size > basis.largest[place] for place, size, _ in scaled.components):
                continue
            disturbances = basis.kappa * settings.noise.disturbance_gain * len(noise.components)
            price = disturbances + basis.number * _noise_numbers(noise)
            value = float(each.mean()) - price
            if value > best[0]:
                best = value, scaled, tuple(each.tolist())
        return best

    found = evaluated(models)
    if not math.isfinite(found[0]):
        return None
    seen = {key_of(model) for model in models}
    for decades in _DECADES:
        for _ in range(_ROUNDS):
            others = [model for model in grid.neighbours(found[1], decades) if key_of(model) not in seen]
            if not others:
                break
            seen |= {key_of(model) for model in others}
            better = evaluated(others)
            if not better[0] > found[0] + _SETTLED:
                break
            found = better
    return found[1], found[2]
