"""Maximum-likelihood sizes of disturbances near a grid point, and their standard errors."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mkc_torch._parallel.deadline import check_deadline
from mkc_torch.simulation.dynamics.kalman import Flow, robust_likelihood
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, filter_models
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole
from mkc_torch.simulation.dynamics.peak import peak

if TYPE_CHECKING:
    from jaxtyping import Float

_NEAR = math.log(30.0)
"""Largest distance of the maximum from the grid point, in the logarithm of each number."""


def most_likely_sizes(
    flow: Flow, noise: NoiseModel, largest: Float[np.ndarray, " p+m"] | None
) -> tuple[NoiseModel, tuple[float, ...]]:
    """Maximise the likelihood of all samples over sizes and time constants, from a grid point.

    Where the maximum is implausible, or farther than a factor of 30 away, the grid point is returned.

    Args:
        flow: the linearised trajectory.
        noise: the model at the grid point.
        largest: (p+m,), largest plausible disturbance of each rate and each output, in their units; None for no limit.

    Returns:
        The model, and the standard error of the logarithm of each size. The errors include that the time constants
        and the sensors' noise are estimated too.
    """
    if not noise.components:
        return noise, ()

    def values(by: Float[np.ndarray, "B k"]) -> Float[np.ndarray, " B"]:
        check_deadline()
        models = replace(filter_models(flow, [_times(noise, logarithms) for logarithms in by]), hard_clip=True)
        found = filtered_whole(flow, models)
        return robust_likelihood(found, flow.counts[:, None], flow.reach, free=False)[0]

    start = np.zeros(len(noise.components) + len(_lasting(noise)) + len(_unknown(noise)))
    at, curvature = peak(values, start)
    if np.abs(at).max() > _NEAR or not _plausible(_times(noise, at), noise, largest):
        at, curvature = peak(values, start, rounds=0)
    return _times(noise, at).raised_to_floor(), _errors(curvature)[: len(noise.components)]


def _lasting(noise: NoiseModel) -> list[int]:
    """Indices of the lasting disturbances."""
    return [d for d, (_, _, time) in enumerate(noise.components) if time > 0]


def _unknown(noise: NoiseModel) -> list[int]:
    """Indices of the outputs whose white noise is not declared."""
    return [j for j in range(len(noise.sensor)) if not (noise.known and noise.known[j])]


def _times(noise: NoiseModel, logarithms: Float[np.ndarray, " k"]) -> NoiseModel:
    """Scale sizes, time constants and unknown sensor noise, in this order, by the exponentials of logarithms."""
    lasting, unknown = _lasting(noise), _unknown(noise)
    of_size, of_time, of_sensor = np.split(np.exp(logarithms), np.cumsum([len(noise.components), len(lasting)]))
    time, sensor = np.ones(len(noise.components)), np.ones(len(noise.sensor))
    time[lasting], sensor[unknown] = of_time, of_sensor
    components = zip(noise.components, of_size.tolist(), time.tolist(), strict=True)
    return replace(
        noise,
        components=tuple((place, by * size, longer * lasts) for (place, size, lasts), by, longer in components),
        sensor=tuple((sensor * noise.sensor).tolist()),
    )


def _plausible(found: NoiseModel, before: NoiseModel, largest: Float[np.ndarray, " p+m"] | None) -> bool:
    """Whether no disturbance exceeds both its largest plausible size and its size before."""
    pairs = zip(found.components, before.components, strict=True)
    return largest is None or all(component[1] <= max(float(largest[component[0]]), old[1]) for component, old in pairs)


def _errors(curvature: Float[np.ndarray, "k k"]) -> tuple[float, ...]:
    """Standard errors by the curvature of a log-likelihood; infinite where the curvature is not positive."""
    if not np.isfinite(curvature).all() or float(np.linalg.eigvalsh(curvature)[0]) <= 0.0:
        diagonal = np.diagonal(curvature)
        return tuple(1.0 / math.sqrt(value) if math.isfinite(value) and value > 0 else math.inf for value in diagonal)
    return tuple(np.sqrt(np.diagonal(np.linalg.inv(curvature))).tolist())
