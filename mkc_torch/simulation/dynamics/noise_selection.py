"""The noise of the world: what pushes each state's rate, and what is added to each output, by likelihood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from mkc_torch._parallel.deadline import check_deadline
from mkc_torch.simulation.dynamics.kalman import Flow, Models, Parts, filtered, robust_likelihood
from mkc_torch.simulation.dynamics.most_likely_sizes import most_likely_sizes
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, filter_models, longest_run, place_of
from mkc_torch.simulation.dynamics.observer import Disturbance, Observer
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "SelectedNoise",
    "models_of",
    "observer_of",
    "rescale_noise_model",
    "select_noise_model",
    "usual_size",
]

_SIZES = (0.1, 1.0, 10.0, 100.0)
"""Tried, over that at which a disturbance moves an output by as much as its white noise."""

_LASTING = (0.004, 0.03, 0.25)
"""Time constants tried, as shares of the longest run."""

_STRETCH, _BEFORE = 150, 50
"""Samples of a stretch that is filtered beside others, and before it, for the filter to find its way."""

_MOST_STRETCHES = 24
"""Stretches that noises are tried on, spread over a recording; what is found is weighed on all samples.

They are 3,600 samples, which tell the size of an oscillator's white push to some 4 %.
"""

_SHARES = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01)
"""Of known sizes, tried where an effect may have made some of a push needless."""

_IMPLAUSIBLE = 1e12
"""Nats that a disturbance of an implausible size is behind: it is taken where there is no other."""

_FINER = (0.5, 0.63, 0.8, 1.0, 1.26, 1.6, 2.0)
_ROUNDS = 3


@dataclass(frozen=True)
class SelectedNoise:
    """The likeliest noise.

    Attributes:
        disturbances: strongest first; none where white noise of the sensors is enough.
        errors: standard error of the logarithm of each one's size.
        gains: nats by which each is needed beside those before it.
        sensor: (m,), standard deviation of each output's white noise.
        log_likelihood: in nats, robust, up to a constant.
        declared: of which outputs the white noise is.
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
    """The likeliest noise along a flow: one disturbance after the other is taken up, whichever gains most.

    Args:
        flow: of the trajectory.
        names: of the states whose rates can be pushed, in the order of the flow.
        channels: of the outputs.
        floor: the outputs' white noise where it is known, else a first guess.
        known: whether it is known.
        lower: nats that a disturbance has to gain.
        upper: disturbances at most.
        largest: plausible size of a disturbance of each rate and each output, in their units; None for any.
        rounding: least size of each output's white noise, unless it is known; none for any.
    """
    p, m = flow.rates, len(channels)
    best = NoiseModel(tuple(floor.tolist()), (), tuple(known), tuple(rounding))
    best, value = _white(flow, best)
    gains: list[float] = []
    for _ in range(most):
        tried = [replace(best, pushes=(*best.pushes, one)) for one in _candidates(flow, best, p + m)]
        if not tried:
            break
        number, scale = _likeliest(flow, tried, largest)
        other = _finer(flow, _scaled(tried[number], scale), largest)
        more, scale = _exactly(flow, other)
        # the others may have come nearer to their best as well
        nearer = replace(other, pushes=other.pushes[:-1])
        again, its_scale = _exactly(flow, nearer)
        if again > value:
            best, value = _scaled(nearer, its_scale), again
        if not more > value + least:
            break
        gains.append(more - value)
        best, value = _scaled(other, scale), more
    found = _told(best, gains, flow, names, channels, floor, value, largest)
    if len(gains) < 2:
        return found
    # one may have stood for another that was found later
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
    """The same disturbances at the sizes that they have along another flow, without those that are needless there.

    Args:
        flow: of the trajectory.
        names, channels: as of :func:`select_noise_model`.
        known: the disturbances.
        lower: nats that each has to gain.
        largest, rounding: as of :func:`select_noise_model`.
    """
    places = [*names, *channels]
    pushes = tuple((place_of(places, one, len(names)), one.size, one.lasting) for one in known.disturbances)
    noise = NoiseModel(tuple(known.sensor.tolist()), pushes, known.declared, tuple(rounding))
    noise = noise.no_lower()
    tried = [replace(noise, pushes=tuple((a, share * s, t) for a, s, t in pushes)) for share in _SHARES]
    number, scale = _likeliest(flow, tried, largest)
    best = _finer(flow, _scaled(tried[number], scale), largest)
    value, scale = _exactly(flow, best)
    best = _scaled(best, scale)
    gains: list[float] = []
    while best.pushes:
        without = [replace(best, pushes=(*best.pushes[:d], *best.pushes[d + 1 :])) for d in range(len(best.pushes))]
        less = [_white(flow, one) if not one.pushes else (one, _exactly(flow, one)[0]) for one in without]
        gains = [value - other for _, other in less]
        weakest = min(range(len(gains)), key=gains.__getitem__)
        if gains[weakest] > least:
            break
        best, value = less[weakest][0], less[weakest][1]
        gains = []
    return _told(best, gains, flow, names, channels, known.sensor, value, largest)


def _told(
    noise: NoiseModel,
    gains: Sequence[float],
    flow: Flow,
    names: Sequence[str],
    channels: Sequence[str],
    like: Float[Tensor, " m"],
    value: float,
    largest: Float[np.ndarray, " p+m"] | None,
) -> SelectedNoise:
    """What was found, at the likeliest sizes."""
    places, p = (*names, *channels), flow.rates
    noise, errors = most_likely_sizes(flow, noise, largest)
    value = _exactly(flow, noise)[0] if errors else value
    found = tuple(Disturbance(places[place], place < p, lasting, size) for place, size, lasting in noise.pushes)
    sensor = like.new_tensor(noise.sensor)
    return SelectedNoise(found, errors, tuple(gains), sensor, value, noise.known)


def _candidates(flow: Flow, known: NoiseModel, places: int) -> list[tuple[int, float, float]]:
    """Disturbances of any place, time constant and size that is not there yet."""
    p = flow.rates
    longest = longest_run(flow)
    usual = float(np.median(flow.step[flow.step > 0]))
    lasting = sorted({max(share * longest, 2.0 * usual) for share in _LASTING})
    sensor = np.array(known.sensor)
    found = []
    for place in range(places):
        if place < p:
            times = [0.0, *lasting]
            units = [usual_size(flow, place, time, sensor) for time in times]
        else:
            times, units = list(lasting), [float(sensor[place - p])] * len(lasting)
        for time, unit in zip(times, units, strict=True):
            if not any(one[0] == place and one[2] == time for one in known.pushes):
                found += [(place, size * unit, time) for size in _SIZES if math.isfinite(size * unit)]
    return found


_REACH = 400
"""Samples over which the effect of a push is followed to find its usual size."""


def usual_size(flow: Flow, place: int, lasting: float, sensor: Float[np.ndarray, " m"]) -> float:
    """The size of a push at which it moves an output by the sensor's noise, somewhere along a run."""
    N = len(flow.new)
    state = np.zeros(flow.carried.shape[1])
    power = np.zeros(len(sensor))
    start = N // 3
    most = 0.0
    hold = lasting if lasting > 0 else 0.0
    age = 0.0
    for row in range(start, min(start + _REACH, N - 1)):
        if flow.step[row] <= 0:
            break
        state = flow.carried[row] @ state
        if age <= hold:
            state = state + flow.pushed[row][:, place]
        age += flow.step[row]
        seen = flow.seen[row + 1] @ state
        power = power + seen**2 if lasting == 0.0 else np.maximum(power, seen**2)
        # of an output without noise, and of a state that runs away, it is beyond all numbers
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            most = max(most, float((np.sqrt(power) / sensor).max()))
    return 1.0 / most if 0.0 < most < math.inf else math.inf


def _likelihoods(flow: Flow, noises: Sequence[NoiseModel]) -> tuple[np.ndarray, np.ndarray]:
    """Of each, its scale profiled out, and that scale; at the scale it has, where some of the sensors' is declared."""
    check_deadline()
    parts = _parts(flow)
    found = filtered(parts, filter_models(flow, noises))
    least = np.array([noise.least_scale for noise in noises])
    return robust_likelihood(found, parts.mine, flow.reach, free=not any(noises[0].known), least=least)


def _likeliest(
    flow: Flow, noises: Sequence[NoiseModel], largest: Float[np.ndarray, " p+m"] | None
) -> tuple[int, float]:
    """The number of the likeliest model whose disturbances are of a plausible size at its scale, and that scale."""
    values, scales = _likelihoods(flow, noises)
    values = np.nan_to_num(values, nan=-np.inf)
    if largest is not None:
        allowed = [
            all(scale * size <= largest[place] for place, size, _ in noise.pushes)
            for noise, scale in zip(noises, scales, strict=True)
        ]
        values = np.where(allowed, values, values - _IMPLAUSIBLE)
    number = int(values.argmax())
    return number, float(scales[number])


def _exactly(flow: Flow, noise: NoiseModel) -> tuple[float, float]:
    """The same of one, in one stretch: without a push there is nothing that corrects a filter which begins inside."""
    found = filtered_whole(flow, filter_models(flow, [noise]))
    free, least = not any(noise.known), noise.least_scale
    values, scales = robust_likelihood(found, flow.counts[:, None], flow.reach, free=free, least=least)
    return float(values[0]), float(scales[0])


@lru_cache(maxsize=2)
def _parts(flow: Flow) -> Parts:
    return flow.in_parts(_STRETCH, _BEFORE, _MOST_STRETCHES)


def _scaled(noise: NoiseModel, scale: float) -> NoiseModel:
    pushes = tuple((place, scale * size, lasting) for place, size, lasting in noise.pushes)
    return replace(noise, sensor=tuple(scale * one for one in noise.sensor), pushes=pushes)


def _white(flow: Flow, noise: NoiseModel) -> tuple[NoiseModel, float]:
    """The sensors' white noise alone, each output by itself where there are several."""
    if not any(noise.known):
        new = flow.new
        sizes = [
            float(np.median(np.abs(one[used > 0])) / 0.6745) for one, used in zip(new.T, flow.counts.T, strict=True)
        ]
        typical = [max(size, 1e-300) for size in sizes]
        other = replace(noise, sensor=tuple(typical)).no_lower()
        noise = min((noise, other), key=lambda one: -_exactly(flow, one)[0])
    value, scale = _exactly(flow, noise)
    return _scaled(noise, scale), value


def _finer(flow: Flow, noise: NoiseModel, largest: Float[np.ndarray, " p+m"] | None) -> NoiseModel:
    """Sizes, time constants and the sensors' noise one after the other, on a grid that closes in; the scale at once."""
    power = 1.0
    for _ in range(_ROUNDS):
        tried = [noise]
        alone = len(noise.sensor) == 1 and not noise.pushes  # its size is the scale
        for j in [j for j, known in enumerate(noise.known) if not known and not alone]:
            tried += [
                replace(noise, sensor=(*noise.sensor[:j], f**power * noise.sensor[j], *noise.sensor[j + 1 :]))
                for f in _FINER
                if f != 1.0
            ]
        for d, (place, size, lasting) in enumerate(noise.pushes):
            others = [(place, f**power * size, lasting) for f in _FINER if f != 1.0]
            if lasting > 0:
                others += [(place, size, f**power * lasting) for f in _FINER if f != 1.0]
                others += [(place, f ** (0.5 * power) * size, lasting / f**power) for f in _FINER if f != 1.0]
            tried += [replace(noise, pushes=(*noise.pushes[:d], one, *noise.pushes[d + 1 :])) for one in others]
        tried = [one.no_lower() for one in tried]
        number, scale = _likeliest(flow, tried, largest)
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
    """The gains of a noise along a flow; None where there is nothing but the sensors' white noise."""
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
    # of mean logarithm 0, so that likelihoods compare
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
) -> Models:
    places = [*names, *channels]
    pushes = tuple((place_of(places, one, len(names)), one.size, one.lasting) for one in disturbances)
    return filter_models(flow, [NoiseModel(tuple(sensor.tolist()), pushes, (False,) * len(channels))])
