"""A first fit that can be trusted: over short horizons first, where no trajectory gets lost, then over longer ones.

An observer that corrects the states at each sample by much predicts over a few samples alone, so its residual is nearly
linear in the parameters; with weaker corrections the horizon grows, up to a free run. Ribeiro et al., "On the
smoothness of nonlinear system identification", Automatica 121 (2020), shows why long horizons have many minima.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.nonlinear import NoFitError, fit
from mkc_torch.simulation.continuation import Continuation
from mkc_torch.simulation.dynamics.flow import flow_along
from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.noise_selection import observer_of, usual_size
from mkc_torch.simulation.dynamics.observer import Disturbance, Observable, Observer

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

__all__ = ["floor_of", "multiple_shooting_start", "strong_observer", "strongly_observed", "without_noise"]

_CORRECTIONS = (100.0, 10.0)
"""Sizes of the pushes that the corrections are for, over that at which they move an output by its noise."""

_SHORTEST = 1000.0
"""The same of the shortest horizon, for a guess that the first of them loses."""

_OVERGROWN = 1e-30
"""Share of a push's size without growth below which its size with growth says nothing of a few samples."""

_LOST = 1e6
"""Standard deviations of an output from which a prediction over few samples is lost."""

_STEPS = 60


def multiple_shooting_start(
    prepared: Observable, theta: Float[Tensor, " p"], *, shortest: bool = False
) -> Float[Tensor, " p"] | None:
    """Parameters that predict over short horizons, from a guess that may be ten times off; None where there are none.

    Args:
        prepared: the simulation.
        theta: the guess.
        shortest: begin with a horizon that is shorter still.
    """
    low, high = prepared.bounds
    for size in (_SHORTEST, *_CORRECTIONS) if shortest else _CORRECTIONS:
        observer = strong_observer(prepared, theta, size, shortest=shortest)
        if observer is None:
            return None
        way = Continuation(prepared.observed(observer), lambda one: (one, {}))
        try:
            theta = fit(way, theta, lower=low, upper=high, covariance=None, max_iter=_STEPS).theta
        except NoFitError:
            return None
    return theta


def strong_observer(
    prepared: Observable, theta: Float[Tensor, " p"], size: float, *, shortest: bool = False
) -> Observer | None:
    """An observer for pushes of all rates, along the first guess of the states; None where none moves an output.

    Args:
        prepared: the simulation.
        theta: its parameters.
        size: of the pushes, over that at which they move an output by its noise.
        shortest: what a push does is followed as if nothing in the system grew; so it is where what grows nears the
            largest numbers.
    """
    flow = flow_along(prepared, theta, prepared.guess)
    if not all(bool(np.isfinite(one).all()) for one in (flow.carried, flow.pushed, flow.seen)):
        return None
    floor = floor_of(prepared)
    if without_noise(floor):
        return None
    steady = _usual_sizes(prepared, _without_growth(flow), floor)
    sizes = steady if shortest else _usual_sizes(prepared, flow, floor)
    sizes = [
        limit if not np.isfinite(usual) or usual < _OVERGROWN * limit else usual
        for usual, limit in zip(sizes, steady, strict=True)
    ]
    pushes = tuple(
        Disturbance(name, True, 0.0, size * usual)
        for name, usual in zip(prepared.pushable, sizes, strict=True)
        if np.isfinite(usual)
    )
    try:
        with np.errstate(over="raise", invalid="raise"):
            return observer_of(flow, pushes, floor, prepared.pushable, prepared.channels) if pushes else None
    except FloatingPointError:  # what grows is lost between two samples already
        return None


def _usual_sizes(prepared: Observable, flow: Flow, floor: Float[Tensor, " m"]) -> list[float]:
    with np.errstate(over="ignore", invalid="ignore"):
        return [usual_size(flow, number, 0.0, floor.numpy()) for number in range(len(prepared.pushable))]


def _without_growth(flow: Flow) -> Flow:
    """The flow with what grows from sample to sample held at its size."""
    radius = np.abs(np.linalg.eigvals(flow.carried)).max(-1)
    return replace(flow, carried=flow.carried / np.maximum(radius, 1.0)[:, None, None])


def strongly_observed(prepared: PreparedDynamics, theta: Float[Tensor, " p"], size: float) -> PreparedDynamics | None:
    """The simulation under that observer; None where there is none, or where even so it is lost within a few samples.

    Args:
        prepared: the simulation.
        theta: its parameters.
        size: of the pushes that the observer is for; see :func:`strong_observer`.
    """
    observer = strong_observer(prepared, theta, size)
    if observer is None:
        return None
    strong = prepared.observed(observer)
    away = (prepared.measured - strong.simulated(theta, {}).detach()).abs()
    spread = prepared.measured.std(0).clamp(min=torch.finfo(away.dtype).tiny)
    return strong if bool((away <= _LOST * spread).all()) else None


def without_noise(floor: Float[Tensor, " m"]) -> bool:
    """Whether an output has no noise at all, so that nothing can be weighed against it."""
    return bool((floor.square() <= torch.finfo(floor.dtype).tiny).any())


def floor_of(prepared: Observable) -> Float[Tensor, " m"]:
    """White noise of each output, by third differences: of what is smooth from sample to sample little is left.

    Never below a millionth of the output's spread.
    """
    y = prepared.measured
    third = y[3:] - 3.0 * y[2:-1] + 3.0 * y[1:-2] - y[:-3]
    inside = ~(prepared.begins[1:-2] | prepared.begins[2:-1] | prepared.begins[3:])
    spread = y.std(0).clamp(min=torch.finfo(y.dtype).tiny)
    rough = robust_scale(third[inside]) / 20.0**0.5 if bool(inside.any()) else spread
    return torch.maximum(rough, 1e-6 * spread)
