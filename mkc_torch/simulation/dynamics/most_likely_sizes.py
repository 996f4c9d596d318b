"""The likeliest sizes of disturbances near those that a grid has, and their standard errors."""

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

__all__ = ["most_likely_sizes"]

_NEAR = math.log(30.0)
"""Of the logarithm of a number, by which the likeliest is sought away from the grid's."""


def most_likely_sizes(
    flow: Flow, noise: NoiseModel, largest: Float[np.ndarray, " p+m"] | None
) -> tuple[NoiseModel, tuple[float, ...]]:
    """The likeliest sizes and time constants near those of a grid, by all samples, and each size's standard error.

    The errors are of logarithms, and count that the time constants and the sensors' noise are not known either. Where
    the likeliest is not plausible, or farther than thirty times away, sizes are as they were.

    Args:
        flow: of the trajectory.
        noise: with sizes of a grid.
        largest: plausible size of a disturbance of each rate and each output, in their units; None for any.
    """
    if not noise.pushes:
        return noise, ()

    def values(by: Float[np.ndarray, "B k"]) -> Float[np.ndarray, " B"]:
        check_deadline()
        found = filtered_whole(flow, filter_models(flow, [_times(noise, one) for one in by]))
        return robust_likelihood(found, flow.counts[:, None], flow.reach, free=False)[0]

    start = np.zeros(len(noise.pushes) + len(_lasting(noise)) + len(_unknown(noise)))
    at, curvature = peak(values, start)
    if np.abs(at).max() > _NEAR or not _plausible(_times(noise, at), noise, largest):
        at, curvature = peak(values, start, rounds=0)
    return _times(noise, at).no_lower(), _errors(curvature)[: len(noise.pushes)]


def _lasting(noise: NoiseModel) -> list[int]:
    """Numbers of the disturbances that have a time constant."""
    return [d for d, (_, _, time) in enumerate(noise.pushes) if time > 0]


def _unknown(noise: NoiseModel) -> list[int]:
    """Numbers of the outputs whose white noise is not declared."""
    return [j for j in range(len(noise.sensor)) if not (noise.known and noise.known[j])]


def _times(noise: NoiseModel, logarithms: Float[np.ndarray, " k"]) -> NoiseModel:
    """A noise with its sizes, its time constants and its sensors' noise times numbers that are given in this order."""
    lasting, unknown = _lasting(noise), _unknown(noise)
    of_size, of_time, of_sensor = np.split(np.exp(logarithms), np.cumsum([len(noise.pushes), len(lasting)]))
    time, sensor = np.ones(len(noise.pushes)), np.ones(len(noise.sensor))
    time[lasting], sensor[unknown] = of_time, of_sensor
    pushes = zip(noise.pushes, of_size.tolist(), time.tolist(), strict=True)
    return replace(
        noise,
        pushes=tuple((place, by * size, longer * lasts) for (place, size, lasts), by, longer in pushes),
        sensor=tuple((sensor * noise.sensor).tolist()),
    )


def _plausible(found: NoiseModel, before: NoiseModel, largest: Float[np.ndarray, " p+m"] | None) -> bool:
    """Whether no disturbance has become larger than is plausible."""
    pairs = zip(found.pushes, before.pushes, strict=True)
    return largest is None or all(one[1] <= max(float(largest[one[0]]), was[1]) for one, was in pairs)


def _errors(curvature: Float[np.ndarray, "k k"]) -> tuple[float, ...]:
    """Standard errors by the curvature of a log-likelihood; infinite where it does not bend down."""
    if not np.isfinite(curvature).all() or float(np.linalg.eigvalsh(curvature)[0]) <= 0.0:
        bend = np.diagonal(curvature)
        return tuple(1.0 / math.sqrt(one) if math.isfinite(one) and one > 0 else math.inf for one in bend)
    return tuple(np.sqrt(np.diagonal(np.linalg.inv(curvature))).tolist())
