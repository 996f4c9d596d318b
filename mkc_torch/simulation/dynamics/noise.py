"""Select the most likely noise model of a simulation, and estimate its disturbances over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.quantum import rounding_of
from mkc_torch.simulation.dynamics.first_fit import floor_of, without_noise
from mkc_torch.simulation.dynamics.flow import flow_of, plausible_sizes
from mkc_torch.simulation.dynamics.kalman import smoothed
from mkc_torch.simulation.dynamics.noise_selection import (
    SelectedNoise,
    models_of,
    observer_of,
    rescale_noise_model,
    select_noise_model,
    with_most_likely_sizes,
)
from mkc_torch.simulation.dynamics.observer import Observable, Observer
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole
from mkc_torch.simulation.ports import Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class StateSpaceNoise:
    """The selected noise, and its observer; the observer is None where white sensor noise is enough."""

    selected: SelectedNoise
    observer: Observer | None


def most_likely_noise(
    prepared: Observable,
    theta: Float[Tensor, " p"],
    changes: Changes,
    near: Nearby | None,
    *,
    declared: Mapping[str, float],
    least: float,
    most: int,
    known: SelectedNoise | None = None,
) -> StateSpaceNoise | None:
    """Select the most likely noise along a simulation's trajectory; None where no trajectory is found.

    White noise that is not declared is at least the rounding noise of the recording.

    Args:
        prepared: the simulation, in open loop or with an observer.
        theta, changes, near: of its trajectory; see :meth:`mkc_torch.simulation.PreparedSimulation.answer`.
        declared: standard deviation of the white noise by output, where it is known.
        least: nats that a disturbance has to gain.
        most: number of disturbances at most.
        known: disturbances whose sizes are refitted; None to search for disturbances.
    """
    flow = flow_of(prepared, theta, changes, near)
    if flow is None or not all(
        bool(np.isfinite(array).all()) for array in (flow.transition, flow.seen, flow.new, flow.shift)
    ):
        return None
    names, channels = prepared.disturbable, prepared.channels
    largest = plausible_sizes(prepared, theta, changes, near)
    rounding = rounding_of(prepared.measured).tolist()
    if known is not None and known.disturbances:
        found = rescale_noise_model(flow, names, channels, known, least, largest, rounding)
        return StateSpaceNoise(found, observer_of(flow, found.disturbances, found.sensor, names, channels))
    floor = floor_of(prepared)
    if without_noise(floor):
        return None
    given = [name in declared for name in prepared.channels]
    white = [max(size, step) for size, step in zip(floor.tolist(), rounding, strict=True)]
    sensor = floor.new_tensor([declared.get(name, size) for name, size in zip(channels, white, strict=True)])
    found = select_noise_model(flow, names, channels, sensor, given, least, most, largest, rounding)
    return StateSpaceNoise(found, observer_of(flow, found.disturbances, found.sensor, names, channels))


def sized_noise(
    prepared: Observable, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None, noise: StateSpaceNoise
) -> StateSpaceNoise:
    """Return a noise with maximum-likelihood sizes of its disturbances along a trajectory, for the report.

    The noise is unchanged where it has no disturbance, or no trajectory is found.
    """
    flow = flow_of(prepared, theta, changes, near)
    if flow is None or not noise.selected.disturbances:
        return noise
    largest = plausible_sizes(prepared, theta, changes, near)
    rounding = rounding_of(prepared.measured).tolist()
    names, channels = prepared.disturbable, prepared.channels
    return replace(noise, selected=with_most_likely_sizes(flow, names, channels, noise.selected, largest, rounding))


@dataclass(frozen=True)
class DisturbancePath:
    """A disturbance estimated from all samples, (N,), and its standard error, (N,)."""

    value: Float[Tensor, " N"]
    error: Float[Tensor, " N"]


def disturbance_paths(
    prepared: Observable, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None, found: SelectedNoise
) -> tuple[DisturbancePath, ...]:
    """Estimate the disturbances over time, in their order; empty where no trajectory is found.

    White disturbances are given a short time constant, so that the smoother estimates them as states.
    """
    flow = flow_of(prepared, theta, changes, near)
    if flow is None or not found.disturbances:
        return ()
    usual = float(np.median(flow.step[flow.step > 0]))
    lasting = tuple(disturbance.lasting_at_least(0.1 * usual) for disturbance in found.disturbances)
    models = models_of(flow, lasting, found.sensor, prepared.disturbable, prepared.channels)
    state, covariance = smoothed(flow, models, filtered_whole(flow, models, keep=True))
    n = flow.transition.shape[1]
    courses = []
    for number in range(len(lasting)):
        variance = np.maximum(covariance[:, n + number, n + number], 0.0)
        courses.append(
            DisturbancePath(torch.from_numpy(state[:, n + number].copy()), torch.from_numpy(np.sqrt(variance)))
        )
    return tuple(courses)
