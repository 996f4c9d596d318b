"""A first fit from a poor guess: over short prediction horizons first, then over longer horizons.

An observer with large gains predicts over a few samples only, so its residual is nearly linear in the parameters. With
smaller gains the horizon grows, up to the open loop. Ribeiro et al., "On the smoothness of nonlinear system
identification", Automatica 121 (2020), shows why long horizons have many local minima.
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

_CORRECTIONS = (100.0, 10.0)
"""Process noise that the observers assume, in units of the size at which it moves an output by its noise floor."""

_SHORTEST = 1000.0
"""The same for a still shorter horizon, for a guess from which the first observer diverges."""

_OVERGROWN = 1e-30
"""Ratio of the size with growth to the size without, below which the size with growth is useless for few samples."""

_LOST = 1e6
"""Standard deviations of an output beyond which a prediction over few samples has diverged."""

_STEPS = 60
"""Iterations of each fit at most."""


def multiple_shooting_start(
    prepared: Observable, theta: Float[Tensor, " p"], *, shortest: bool = False
) -> Float[Tensor, " p"] | None:
    """Fit the parameters over growing horizons, from a guess that may be off by a factor of ten.

    Args:
        prepared: the simulation.
        theta: (p,), the guess.
        shortest: start with a still shorter horizon.

    Returns:
        (p,), the parameters; None where a fit fails or no observer exists.
    """
    low, high = prepared.bounds
    for size in (_SHORTEST, *_CORRECTIONS) if shortest else _CORRECTIONS:
        observer = strong_observer(prepared, theta, size, shortest=shortest)
        if observer is None:
            return None
        continuation = Continuation(prepared.observed(observer), lambda parameters: (parameters, {}))
        try:
            theta = fit(continuation, theta, lower=low, upper=high, covariance=None, max_iter=_STEPS).theta
        except NoFitError:
            return None
    return theta


def strong_observer(
    prepared: Observable, theta: Float[Tensor, " p"], size: float, *, shortest: bool = False
) -> Observer | None:
    """An observer with large gains, for white process noise of all rates, along the first guess of the states.

    Args:
        prepared: the simulation.
        theta: (p,), its parameters.
        size: of the process noise, in units of the size at which it moves an output by its noise floor.
        shortest: compute that unit without growth of the states, also used where growth would overflow.

    Returns:
        The observer; None where process noise moves no output, or numbers overflow or are lost by rounding.
    """
    flow = flow_along(prepared, theta, prepared.guess)
    if not all(bool(np.isfinite(matrices).all()) for matrices in (flow.transition, flow.noise_input, flow.seen)):
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
    disturbances = tuple(
        Disturbance(name, True, 0.0, size * usual)
        for name, usual in zip(prepared.disturbable, sizes, strict=True)
        if np.isfinite(usual)
    )
    try:
        with np.errstate(over="raise", invalid="raise"):
            return (
                observer_of(flow, disturbances, floor, prepared.disturbable, prepared.channels)
                if disturbances
                else None
            )
    # unstable states overflow between two samples, or lose the positive covariance of their prediction by rounding
    except (FloatingPointError, np.linalg.LinAlgError):
        return None


def _usual_sizes(prepared: Observable, flow: Flow, floor: Float[Tensor, " m"]) -> list[float]:
    with np.errstate(over="ignore", invalid="ignore"):
        return [usual_size(flow, number, 0.0, floor.numpy()) for number in range(len(prepared.disturbable))]


def _without_growth(flow: Flow) -> Flow:
    """The flow with transitions scaled to a spectral radius of at most 1."""
    radius = np.abs(np.linalg.eigvals(flow.transition)).max(-1)
    return replace(flow, transition=flow.transition / np.maximum(radius, 1.0)[:, None, None])


def with_strong_observer(
    prepared: PreparedDynamics, theta: Float[Tensor, " p"], size: float
) -> PreparedDynamics | None:
    """The simulation with the observer of :func:`strong_observer`.

    Args:
        prepared: the simulation.
        theta: (p,), its parameters.
        size: of the process noise; see :func:`strong_observer`.

    Returns:
        The simulation; None where there is no observer, or where its prediction diverges within a few samples.
    """
    observer = strong_observer(prepared, theta, size)
    if observer is None:
        return None
    strong = prepared.observed(observer)
    away = (prepared.measured - strong.simulated(theta, {}).detach()).abs()
    spread = prepared.measured.std(0).clamp(min=torch.finfo(away.dtype).tiny)
    return strong if bool((away <= _LOST * spread).all()) else None


def without_noise(floor: Float[Tensor, " m"]) -> bool:
    """Whether the noise floor of an output is 0, so that no residual can be scaled by it."""
    return bool((floor.square() <= torch.finfo(floor.dtype).tiny).any())


def floor_of(prepared: Observable) -> Float[Tensor, " m"]:
    """White noise of each output, (m,), estimated by third differences, which remove smooth variation.

    At least a millionth of the output's standard deviation.
    """
    y = prepared.measured
    third = y[3:] - 3.0 * y[2:-1] + 3.0 * y[1:-2] - y[:-3]
    inside = ~(prepared.begins[1:-2] | prepared.begins[2:-1] | prepared.begins[3:])
    spread = y.std(0).clamp(min=torch.finfo(y.dtype).tiny)
    rough = robust_scale(third[inside]) / 20.0**0.5 if bool(inside.any()) else spread
    return torch.maximum(rough, 1e-6 * spread)
