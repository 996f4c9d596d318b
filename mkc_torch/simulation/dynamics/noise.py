"""The likeliest noise of the world around a simulation, and the same simulation predicted under it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
)
from mkc_torch.simulation.dynamics.observer import Observable, Observer
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole
from mkc_torch.simulation.protocol import Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["DisturbancePath", "StateSpaceNoise", "likeliest_noise", "noise_of", "pushes_over_time"]


@dataclass(frozen=True)
class StateSpaceNoise:
    """What is known of it, and the observer for it; None where the sensors' white noise is enough."""

    disturbed: SelectedNoise
    observer: Observer | None


def likeliest_noise(
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
    """The likeliest noise along a simulation's trajectory; None where there is no trajectory.

    White noise that is not declared is nowhere smaller than what the recording's steps add.

    Args:
        prepared: the simulation, free or observed.
        theta, changes, near: of its trajectory.
        declared: standard deviation of the white noise of outputs that it is known of.
        least, most: nats that a disturbance has to gain, and how many there may be.
        known: disturbances that are to be given their sizes; None to seek them.
    """
    flow = flow_of(prepared, theta, changes, near)
    if flow is None or not all(bool(np.isfinite(one).all()) for one in (flow.carried, flow.seen, flow.new, flow.shift)):
        return None
    names, channels = prepared.pushable, prepared.channels
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
    sensor = floor.new_tensor([declared.get(name, one) for name, one in zip(channels, white, strict=True)])
    found = select_noise_model(flow, names, channels, sensor, given, least, most, largest, rounding)
    return StateSpaceNoise(found, observer_of(flow, found.disturbances, found.sensor, names, channels))


def noise_of(prepared: Observable, declared: Mapping[str, float]) -> StateSpaceNoise | None:
    """The noise that an observed simulation is under; None of one that runs freely."""
    observer = prepared.observer
    if observer is None:
        return None
    given = tuple(name in declared for name in prepared.channels)
    return StateSpaceNoise(SelectedNoise(observer.disturbances, (), (), observer.sensor, 0.0, given), observer)


@dataclass(frozen=True)
class DisturbancePath:
    """The course of one disturbance by all samples, (N,), and its standard error."""

    value: Float[Tensor, " N"]
    error: Float[Tensor, " N"]


def pushes_over_time(
    prepared: Observable, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None, found: SelectedNoise
) -> tuple[DisturbancePath, ...]:
    """The courses of disturbances, in their order; none where there is no trajectory.

    What is new at each sample is given a short memory, of a sample's length, for its course to be seen.
    """
    flow = flow_of(prepared, theta, changes, near)
    if flow is None or not found.disturbances:
        return ()
    usual = float(np.median(flow.step[flow.step > 0]))
    lasting = tuple(one.lasting_at_least(0.1 * usual) for one in found.disturbances)
    models = models_of(flow, lasting, found.sensor, prepared.pushable, prepared.channels)
    state, covariance = smoothed(flow, models, filtered_whole(flow, models, keep=True))
    n = flow.carried.shape[1]
    courses = []
    for number in range(len(lasting)):
        variance = np.maximum(covariance[:, n + number, n + number], 0.0)
        courses.append(
            DisturbancePath(torch.from_numpy(state[:, n + number].copy()), torch.from_numpy(np.sqrt(variance)))
        )
    return tuple(courses)
