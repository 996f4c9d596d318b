"""Select process noise of the rates and drift of the outputs by likelihood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from mkc_torch._parallel.deadline import check_deadline
from mkc_torch.simulation.dynamics.kalman import FilterModels, Flow, FlowParts, filtered, robust_likelihood
from mkc_torch.simulation.dynamics.most_likely_sizes import most_likely_sizes
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, filter_models, longest_run, place_of
from mkc_torch.simulation.dynamics.observer import Disturbance, Observer
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole

if TYPE_CHECKING:
    from jaxtyping import Float

_SIZES = (0.1, 1.0, 10.0, 100.0)
"""Sizes tried, in units of the size at which a disturbance moves an output by its white noise."""

_TIME_CONSTANTS = (0.004, 0.03, 0.25)
"""Time constants tried, as shares of the longest run."""

_STRETCH_SAMPLES = 150
"""Samples of a stretch; stretches are filtered in parallel."""

_WARMUP_SAMPLES = 50
"""Samples before a stretch in which its filter converges."""

_MOST_STRETCHES = 24
"""Stretches, spread over the recording, that candidates are compared on; the selection is confirmed on all samples.

Their 3,600 samples determine the size of an oscillator's white process noise to about 4 %.
"""

_SHARES = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01)
"""Shares of known sizes that are tried, since an effect may explain part of a disturbance."""

_IMPLAUSIBLE = 1e12
"""Nats subtracted for an implausible size, so that it is selected only where no plausible size is left."""

_FINER = (0.5, 0.63, 0.8, 1.0, 1.26, 1.6, 2.0)
"""Factors of the refinement's grid around a number."""

_ROUNDS = 3
"""Rounds of the refinement."""


@dataclass(frozen=True)
class SelectedNoise:
    """The most likely noise.

    Attributes:
        disturbances: strongest first; empty where white sensor noise is enough.
        errors: standard error of the logarithm of each disturbance's size; infinite where it is not estimated.
        gains: log-likelihood gain of each disturbance given those before it, in nats.
        sensor: (m,), standard deviation of each output's white noise.
        log_likelihood: robust, in nats, up to a constant.
        declared: whether each output's white noise is declared.
    """

    disturbances: tuple[Disturbance, ...]
    errors: tuple[float, ...]
    gains: tuple[float, ...]
    sensor: Float[Tensor, " m"]
    log_likelihood: float
    declared: tuple[bool, ...]


def select_noise_model(
    flow: Flow,
    names: Sequence[str],
    channels: Sequence[str],
    floor: Float[Tensor, " m"],
    known: Sequence[bool],
    least: float,
    most: int,
    largest: Float[np.ndarray, " p+m"] | None = None,
    rounding: Sequence[float] = (),
) -> SelectedNoise:
    """Select the most likely noise along a flow by forward selection of disturbances.

    Args:
        flow: the linearised trajectory.
        names: names of the states whose rates can be disturbed, in the order of the flow.
        channels: names of the outputs.
        floor: (m,), the outputs' white noise where it is known, else a first guess.
        known: whether each output's white noise is known.
        least: nats that a disturbance has to gain.
        most: number of disturbances at most.
        largest: (p+m,), largest plausible disturbance of each rate and each output, in their units; None for no limit.
        rounding: smallest white noise of each output that is not known; empty for no limit.
    """
    p, m = flow.rates, len(channels)
    best = NoiseModel(tuple(floor.tolist()), (), tuple(known), tuple(rounding))
    best, value = _with_white_noise(flow, best)
    gains: list[float] = []
    for _ in range(most):
        tried = [
            replace(best, components=(*best.components, component)) for component in _candidates(flow, best, p + m)
        ]
        if not tried:
            break
        number, scale = _most_likely(flow, tried, largest)
        other = _refined(flow, _scaled(tried[number], scale), largest)
        more, scale = _likelihood(flow, other)
        # refining may have improved the disturbances before it as well
        nearer = replace(other, components=other.components[:-1])
        again, its_scale = _likelihood(flow, nearer)
        if again > value:
            best, value = _scaled(nearer, its_scale), again
        if not more > value + least:
            break
        gains.append(more - value)
        best, value = _scaled(other, scale), more
    found = _as_selected_noise(best, gains, flow, names, channels, floor, value)
    if len(gains) < 2:
        return found
    # a disturbance may have become superfluous by another selected later
    fewer = rescale_noise_model(flow, names, channels, found, least, largest, rounding)
    return fewer if len(fewer.disturbances) < len(gains) else found


def rescale_noise_model(
    flow: Flow,
    names: Sequence[str],
    channels: Sequence[str],
    known: SelectedNoise,
    least: float,
    largest: Float[np.ndarray, " p+m"] | None = None,
    rounding: Sequence[float] = (),
) -> SelectedNoise:
    """Refit the sizes of known disturbances along another flow, and remove those that it does not need.

    Args:
        flow: the linearised trajectory.
        names, channels: as in :func:`select_noise_model`.
        known: the disturbances.
        least: nats that each disturbance has to gain.
        largest, rounding: as in :func:`select_noise_model`.
    """
    places = [*names, *channels]
    components = tuple(
        (place_of(places, disturbance, len(names)), disturbance.size, disturbance.lasting)
        for disturbance in known.disturbances
    )
    noise = NoiseModel(tuple(known.sensor.tolist()), components, known.declared, tuple(rounding))
    noise = noise.raised_to_floor()
    tried = [replace(noise, components=tuple((a, share * s, t) for a, s, t in components)) for share in _SHARES]
    number, scale = _most_likely(flow, tried, largest)
    best = _refined(flow, _scaled(tried[number], scale), largest)
    value, scale = _likelihood(flow, best)
    best = _scaled(best, scale)
    gains: list[float] = []
    while best.components:
        without = [
            replace(best, components=(*best.components[:d], *best.components[d + 1 :]))
            for d in range(len(best.components))
        ]
        less = [
            _with_white_noise(flow, model) if not model.components else (model, _likelihood(flow, model)[0])
            for model in without
        ]
        gains = [value - other for _, other in less]
        weakest = min(range(len(gains)), key=gains.__getitem__)
        if gains[weakest] > least:
            break
        best, value = less[weakest][0], less[weakest][1]
        gains = []
    return _as_selected_noise(best, gains, flow, names, channels, known.sensor, value)


def _as_selected_noise(
    noise: NoiseModel,
    gains: Sequence[float],
    flow: Flow,
    names: Sequence[str],
    channels: Sequence[str],
    like: Float[Tensor, " m"],
    value: float,
) -> SelectedNoise:
    """Convert a noise model to a selected noise, with unknown standard errors."""
    places, p = (*names, *channels), flow.rates
    found = tuple(Disturbance(places[place], place < p, lasting, size) for place, size, lasting in noise.components)
    return SelectedNoise(
        found, (math.inf,) * len(found), tuple(gains), like.new_tensor(noise.sensor), value, noise.known
    )


def with_most_likely_sizes(
    flow: Flow,
    names: Sequence[str],
    channels: Sequence[str],
    found: SelectedNoise,
    largest: Float[np.ndarray, " p+m"] | None = None,
    rounding: Sequence[float] = (),
) -> SelectedNoise:
    """Return a selected noise at its maximum-likelihood sizes, with their standard errors.

    Args:
        flow: the linearised trajectory.
        names, channels, largest, rounding: as in :func:`select_noise_model`.
        found: the noise with sizes of the grid; its gains are kept.
    """
    known = NoiseModel.of(found.disturbances, found.sensor.tolist(), names, channels, found.declared, rounding)
    noise, errors = most_likely_sizes(flow, known, largest)
    at_maximum = _as_selected_noise(noise, found.gains, flow, names, channels, found.sensor, found.log_likelihood)
    return replace(at_maximum, errors=errors)


def _candidates(flow: Flow, known: NoiseModel, places: int) -> list[tuple[int, float, float]]:
    """Components of any place, time constant and size, unless their place and time constant are taken."""
    p = flow.rates
    longest = longest_run(flow)
    usual = float(np.median(flow.step[flow.step > 0]))
    lasting = sorted({max(share * longest, 2.0 * usual) for share in _TIME_CONSTANTS})
    sensor = np.array(known.sensor)
    found = []
    for place in range(places):
        if place < p:
            times = [0.0, *lasting]
            units = [usual_size(flow, place, time, sensor) for time in times]
        else:
            times, units = list(lasting), [float(sensor[place - p])] * len(lasting)
        for time, unit in zip(times, units, strict=True):
            if not any(component[0] == place and component[2] == time for component in known.components):
                found += [(place, size * unit, time) for size in _SIZES if math.isfinite(size * unit)]
    return found


_REACH = 400
"""Samples over which the response to a disturbance is followed."""


def usual_size(flow: Flow, place: int, lasting: float, sensor: Float[np.ndarray, " m"]) -> float:
    """Size at which a rate's disturbance moves an output by its sensor noise; infinite if it moves none.

    Args:
        flow: the linearised trajectory.
        place: index of the rate.
        lasting: time in s that the disturbance lasts; 0 for white noise.
        sensor: (m,), standard deviation of each output's white noise.
    """
    N = len(flow.new)
    state = np.zeros(flow.transition.shape[1])
    power = np.zeros(len(sensor))
    start = N // 3
    most = 0.0
    hold = lasting if lasting > 0 else 0.0
    age = 0.0
    for row in range(start, min(start + _REACH, N - 1)):
        if flow.step[row] <= 0:
            break
        state = flow.transition[row] @ state
        if age <= hold:
            state = state + flow.noise_input[row][:, place]
        age += flow.step[row]
        seen = flow.seen[row + 1] @ state
        power = power + seen**2 if lasting == 0.0 else np.maximum(power, seen**2)
        # infinite for an output without noise or an unstable state
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            most = max(most, float((np.sqrt(power) / sensor).max()))
    return 1.0 / most if 0.0 < most < math.inf else math.inf


def _likelihoods(flow: Flow, noises: Sequence[NoiseModel]) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihood and profiled scale of each model, on the stretches; scale 1 where a sensor's noise is declared."""
    check_deadline()
    parts = _parts(flow)
    found = filtered(parts, filter_models(flow, noises))
    least = np.array([noise.least_scale for noise in noises])
    return robust_likelihood(found, parts.mine, flow.reach, free=not any(noises[0].known), least=least)


def _most_likely(
    flow: Flow, noises: Sequence[NoiseModel], largest: Float[np.ndarray, " p+m"] | None
) -> tuple[int, float]:
    """Index and scale of the most likely model, plausible sizes preferred."""
    values, scales = _likelihoods(flow, noises)
    values = np.nan_to_num(values, nan=-np.inf)
    if largest is not None:
        allowed = [
            all(scale * size <= largest[place] for place, size, _ in noise.components)
            for noise, scale in zip(noises, scales, strict=True)
        ]
        values = np.where(allowed, values, values - _IMPLAUSIBLE)
    number = int(values.argmax())
    return number, float(scales[number])


def _likelihood(flow: Flow, noise: NoiseModel) -> tuple[float, float]:
    """Log-likelihood and profiled scale of a model on all samples in one stretch.

    Stretches would not do: without process noise, a filter that starts within the flow never converges.
    """
    found = filtered_whole(flow, filter_models(flow, [noise]))
    free, least = not any(noise.known), noise.least_scale
    values, scales = robust_likelihood(found, flow.counts[:, None], flow.reach, free=free, least=least)
    return float(values[0]), float(scales[0])


@lru_cache(maxsize=2)
def _parts(flow: Flow) -> FlowParts:
    return flow.in_parts(_STRETCH_SAMPLES, _WARMUP_SAMPLES, _MOST_STRETCHES)


def _scaled(noise: NoiseModel, scale: float) -> NoiseModel:
    components = tuple((place, scale * size, lasting) for place, size, lasting in noise.components)
    return replace(noise, sensor=tuple(scale * size for size in noise.sensor), components=components)


def _with_white_noise(flow: Flow, noise: NoiseModel) -> tuple[NoiseModel, float]:
    """The model at its most likely white noise, each output scaled by itself, and its log-likelihood."""
    if not any(noise.known):
        new = flow.new
        sizes = [
            float(np.median(np.abs(values[used > 0])) / 0.6745)
            for values, used in zip(new.T, flow.counts.T, strict=True)
        ]
        typical = [max(size, 1e-300) for size in sizes]
        other = replace(noise, sensor=tuple(typical)).raised_to_floor()
        noise = min((noise, other), key=lambda model: -_likelihood(flow, model)[0])
    value, scale = _likelihood(flow, noise)
    return _scaled(noise, scale), value


def _refined(flow: Flow, noise: NoiseModel, largest: Float[np.ndarray, " p+m"] | None) -> NoiseModel:
    """Refine sizes, time constants and sensor noise by coordinate search on a shrinking grid; the scale is profiled."""
    power = 1.0
    for _ in range(_ROUNDS):
        tried = [noise]
        alone = len(noise.sensor) == 1 and not noise.components  # its size is the scale
        for j in [j for j, known in enumerate(noise.known) if not known and not alone]:
            tried += [
                replace(noise, sensor=(*noise.sensor[:j], f**power * noise.sensor[j], *noise.sensor[j + 1 :]))
                for f in _FINER
                if f != 1.0
            ]
        for d, (place, size, lasting) in enumerate(noise.components):
            others = [(place, f**power * size, lasting) for f in _FINER if f != 1.0]
            if lasting > 0:
                others += [(place, size, f**power * lasting) for f in _FINER if f != 1.0]
                others += [(place, f ** (0.5 * power) * size, lasting / f**power) for f in _FINER if f != 1.0]
            tried += [
                replace(noise, components=(*noise.components[:d], component, *noise.components[d + 1 :]))
                for component in others
            ]
        tried = [model.raised_to_floor() for model in tried]
        number, scale = _most_likely(flow, tried, largest)
        noise = _scaled(tried[number], scale)
        if number == 0:
            power *= 0.4
    return noise


def observer_of(
    flow: Flow,
    disturbances: tuple[Disturbance, ...],
    sensor: Float[Tensor, " m"],
    names: Sequence[str],
    channels: Sequence[str],
) -> Observer | None:
    """The observer of a noise along a flow; None without disturbances."""
    if not disturbances:
        return None
    models = models_of(flow, disturbances, sensor, names, channels)
    kept = filtered_whole(flow, models, keep=True)
    D, m = models.place.shape[1], flow.new.shape[1]
    own = np.zeros((m, D))
    for d in range(D):
        if models.place[0, d] >= len(names):
            own[models.place[0, d] - len(names), d] = 1.0
    C = np.concatenate([flow.seen, np.broadcast_to(own, (len(flow.new), m, D))], -1)
    P = kept.prior[:, 0, 0]
    cross = P @ C.swapaxes(1, 2)
    S = C @ cross + np.diag(models.sensor[0] ** 2)
    counts = flow.counts
    gain = np.linalg.solve(S, cross.swapaxes(1, 2)).swapaxes(1, 2) * counts[:, None, :]
    L = np.linalg.cholesky(S)
    white = np.linalg.inv(L)
    # determinants of mean logarithm 0, so that likelihoods compare across observers
    level = np.exp(-np.log(np.diagonal(white, axis1=1, axis2=2)).mean(0))
    white = white * level[:, None]
    as_tensor = sensor.new_tensor
    return Observer(
        tuple(channels),
        disturbances,
        sensor,
        as_tensor(gain),
        as_tensor(white),
        as_tensor(np.sqrt(np.diagonal(S, axis1=1, axis2=2).copy())),
    )


def models_of(
    flow: Flow,
    disturbances: Sequence[Disturbance],
    sensor: Float[Tensor, " m"],
    names: Sequence[str],
    channels: Sequence[str],
) -> FilterModels:
    places = [*names, *channels]
    components = tuple(
        (place_of(places, disturbance, len(names)), disturbance.size, disturbance.lasting)
        for disturbance in disturbances
    )
    return filter_models(flow, [NoiseModel(tuple(sensor.tolist()), components, (False,) * len(channels))])
