"""Further starts of a first fit: other scales of a number, and after a failure values between and around the user's."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

if TYPE_CHECKING:
    from jaxtyping import Float

_BETWEEN = (0.25, 0.5, 0.75)
"""Points between the user's values (0) and the failed start (1)."""

_FACTORS = (-1.0, 0.1, 10.0, 0.03, 30.0, 0.3, 3.0, 0.0)
"""Factors that a single parameter, or all of them, are multiplied by."""

_SCALES = (1.0 / 32.0, 1.0 / 8.0, 8.0)
"""Factors that a positive number with an uncertainty is multiplied by; its own is mostly a factor of two."""

_MOST_TRIED = 60
"""Number of starts that are simulated at most."""


@dataclass(frozen=True)
class OtherStarts:
    """Starts whose open-loop simulation stays finite, and how the others diverge.

    Attributes:
        starts: (p,) each, smallest residual first.
        tried: number of starts that were simulated.
        output: first output that diverges with the user's values; empty where none diverges.
        until: time of the divergence, in s since the recording's first sample; 0 where no trajectory is found.
        parameter: the parameter whose change alone keeps the simulation finite longest; empty where no such change
            helps.
        value: that parameter's changed value.
        lasts: time until which the simulation is finite then, in s.
    """

    starts: tuple[Float[Tensor, " p"], ...]
    tried: int
    output: str = ""
    until: float = 0.0
    parameter: str = ""
    value: float = 0.0
    lasts: float = 0.0


def other_starts(prepared: PreparedDynamics, start: Float[Tensor, " p"], count: int) -> OtherStarts:
    """Search starts whose open-loop simulation is finite: the user's values, and values between and around them.

    The initial states of a run are those of the first guess.

    Args:
        prepared: the simulation.
        start: (p,), the start of the failed fit.
        count: number of starts to return at most.
    """
    free, given = prepared.observed(None), prepared.given
    usable: list[tuple[float, Tensor]] = []
    output, until, best, tried = "", 0.0, (-1, 0.0, -1.0), 0
    for number, theta in itertools.islice(_distinct(prepared, start), _MOST_TRIED):
        tried += 1
        residual = free.residual(theta, {}).detach()
        lost = ~residual.isfinite()
        rows = lost.any(-1).nonzero().flatten()
        lasts = float(prepared.time[rows[0]] - prepared.time[0]) if len(rows) else float("inf")
        if torch.equal(theta, given) and len(rows):
            output, until = prepared.channels[int(lost[rows[0]].nonzero()[0])], lasts
        if number >= 0 and lasts > best[2]:
            best = number, float(theta[number]), lasts
        if not len(rows):
            usable.append((_log_size(free, residual), theta))
    usable.sort(key=lambda pair: pair[0])
    starts = tuple(theta for _, theta in usable[:count])
    if not output or best[2] <= until:
        return OtherStarts(starts, tried, output, until)
    return OtherStarts(starts, tried, output, until, prepared.parameter_names[best[0]], *best[1:])


def at_other_scales(prepared: PreparedDynamics, values: Float[Tensor, " p"]) -> list[Float[Tensor, " p"]]:
    """Return parameters with one positive number at another scale each.

    A servo given ten times too stiff holds its largest force all the time: then the residual hardly depends on its
    stiffness, and a fit from there ends at a stiffness that is larger still.

    Args:
        prepared: the simulation; only numbers with an uncertainty, which are fitted, are changed.
        values: (p,), the parameters.
    """
    low, high = prepared.bounds
    found = []
    for number, known in enumerate(prepared.known.values()):
        if known.uncertainty is None or known.lower != 0.0 or not known.value > 0.0:
            continue
        for factor in _SCALES:
            theta = values.clone()
            theta[number] = factor * theta[number]
            if bool(low[number] < theta[number]) and bool(theta[number] < high[number]):
                found.append(theta)
    return found[:_MOST_TRIED]


def log_size_at(prepared: PreparedDynamics, theta: Float[Tensor, " p"]) -> float:
    """Return the logarithm of the open-loop residual's robust size, summed over the outputs; infinite if it is lost."""
    free = prepared.observed(None)
    residual = free.residual(theta, {}).detach()
    return _log_size(free, residual) if bool(residual.isfinite().all()) else math.inf


def _log_size(prepared: PreparedDynamics, residual: Float[Tensor, "N m"]) -> float:
    variation = robust_scale(prepared.measured - prepared.measured.median(0).values).clamp(min=1e-300)
    return float((robust_scale(residual) / variation).clamp(min=1e-300).log().sum())


def _distinct(prepared: PreparedDynamics, start: Tensor) -> Iterator[tuple[int, Tensor]]:
    """Distinct candidates within the bounds, with the index of the changed parameter; -1 where several are changed."""
    low, high = prepared.bounds
    known: list[Tensor] = []
    for number, theta in _candidates(prepared.given, start, len(start) - prepared.beginnings):
        inside = torch.minimum(torch.maximum(theta, low), high)
        if bool(inside.isfinite().all()) and not any(torch.equal(inside, other) for other in known):
            known.append(inside)
            yield number, inside


def _candidates(given: Tensor, start: Tensor, own: int) -> Iterator[tuple[int, Tensor]]:
    yield -1, given
    for share in _BETWEEN:
        yield -1, torch.cat([torch.lerp(given[:own], start[:own], share), given[own:]])
    for factor in _FACTORS:
        for number in range(own):
            theta = given.clone()
            theta[number] = factor * theta[number]
            yield number, theta
        if own > 1:
            yield -1, torch.cat([factor * given[:own], given[own:]])
