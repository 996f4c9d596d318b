"""Doubts about an estimate: parameters at a bound, or far above the plausible size."""

from __future__ import annotations

import math
from collections.abc import Iterator

from torch import Tensor

from mkc_torch._support.unit_text import ratio, sized, tidy
from mkc_torch.diagnosis.model.grid import reach_of
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects.context import Context
from mkc_torch.simulation.protocol import PreparedSimulation

__all__ = ["ended_shapes", "far_from_plausible", "shape_at_ends", "times_plausible"]

FAR = 10.0
"""Multiple of the plausible size above which a finding is unconfirmed."""

_AT_END = 0.01
"""Relative distance within which a number is at a bound."""


def shape_at_ends(term: Term, prepared: PreparedSimulation, context: Context) -> tuple[str, ...]:
    """Return a sentence for each shape parameter at a bound.

    Args:
        term: the effect with its fitted shape.
        prepared: the simulation.
        context: context of the effect.
    """
    return tuple(_ended(term, prepared, context))


def far_from_plausible(term: Term, gamma: Tensor, context: Context) -> str:
    """Return why the amplitude is impossible: at its bound, or above :data:`FAR` times a plausible size; else empty.

    Args:
        term: the effect.
        gamma: its amplitude.
        context: context of the effect.
    """
    first = term.effect.quantities(term.shape, context)[0]
    largest, most = float(gamma[: first.size].abs().max()), term.effect.upper
    name = first.name.replace("_", " ")
    # an upper bound of 1 is a share, which may be 1
    if 1.0 < most < math.inf and _near(largest, most):
        return f"Its {name} ended at {sized(most, tidy(first.unit))}, the upper bound: the recording does not limit it."
    times = times_plausible(term, gamma, context)
    if times is not None and times > FAR:
        return f"Its {name} is {times:.2g} times the largest plausible size ({term.effect.source})."
    return ""


def times_plausible(term: Term, gamma: Tensor, context: Context) -> float | None:
    """Return the largest number of the first quantity as a multiple of the plausible size; None if that is unknown."""
    first, limit = term.effect.quantities(term.shape, context)[0], term.effect.plausible
    times = ratio(term.effect.plausible_unit or first.unit, first.unit)
    if not math.isfinite(limit) or times is None:
        return None
    return float(gamma[: first.size].abs().max()) / (limit * times)


def _ended(term: Term, prepared: PreparedSimulation, context: Context) -> Iterator[str]:
    for name, side in ended_shapes(term, prepared).items():
        text = sized(float(term.shape[name]), tidy(term.effect.unit_of_shape(name, context)))
        yield (
            f"{term.effect.id}: its {name.replace('_', ' ')} ended at {text}, the {side} bound: this recording "
            "does not determine it. Other physics may act there, or the recording is too short."
        )


def ended_shapes(term: Term, prepared: PreparedSimulation) -> dict[str, str]:
    """Return the fitted shape parameters that ended at a bound without a physical meaning, and which bound."""
    found = {}
    for name, ends in reach_of(term, prepared).items():
        for side, end in zip(("least", "greatest"), ends, strict=True):
            if side not in term.effect.natural_ends.get(name, ()) and _near(float(term.shape[name]), end):
                found[name] = side
    return found


def _near(value: float, end: float) -> bool:
    return abs(value - end) <= _AT_END * abs(end)
