"""A first fit that can be trusted: over short horizons first, where no trajectory gets lost, then over longer ones.

An observer that corrects the states at each sample by much predicts over a few samples alone, so its residual is nearly
linear in the parameters; with weaker corrections the horizon grows, up to a free run. Ribeiro et al., "On the
smoothness of nonlinear system identification", Automatica 121 (2020), shows why long horizons have many minima.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.nonlinear import NoFitError, fit
from mkc_torch.simulation.continuation import Continuation
from mkc_torch.simulation.dynamics.disturbances import observer_of, usual_size
from mkc_torch.simulation.dynamics.flow import flow_along
from mkc_torch.simulation.dynamics.observer import Disturbance, Observable, Observer

if TYPE_CHECKING:
    from jaxtyping import Float


__all__ = ["floor_of", "over_short_horizons", "strong_observer", "without_noise"]

_CORRECTIONS = (100.0, 10.0)
"""Sizes of the pushes that the corrections are for, over that at which they move an output by its noise."""

_SHORTEST = 1000.0
"""The same of the shortest horizon, for a guess that the first of them loses."""

_STEPS = 60


def over_short_horizons(
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
        observer = strong_observer(prepared, theta, size)
        if observer is None:
            return None
        way = Continuation(prepared.observed(observer), lambda one: (one, {}))
        try:
            theta = fit(way, theta, lower=low, upper=high, covariance=None, max_iter=_STEPS).theta
        except NoFitError:
            return None
    return theta


def strong_observer(prepared: Observable, theta: Float[Tensor, " p"], size: float) -> Observer | None:
    """An observer for pushes of all rates, along the first guess of the states; None where none moves an output."""
    flow = flow_along(prepared, theta, prepared.guess)
    if not all(bool(np.isfinite(one).all()) for one in (flow.carried, flow.pushed, flow.seen)):
        return None
    floor = floor_of(prepared)
    if without_noise(floor):
        return None
    sizes = [usual_size(flow, number, 0.0, floor.numpy()) for number in range(len(prepared.pushable))]
    pushes = tuple(
        Disturbance(name, True, 0.0, size * usual)
        for name, usual in zip(prepared.pushable, sizes, strict=True)
        if np.isfinite(usual)
    )
    return observer_of(flow, pushes, floor, prepared.pushable, prepared.channels) if pushes else None


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
