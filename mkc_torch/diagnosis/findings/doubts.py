"""Why an estimate is to be doubted by its own numbers: at the end of a range, or far from what is plausible."""

from __future__ import annotations

import math
from collections.abc import Iterator

from torch import Tensor

from mkc_torch._support.unit_text import ratio, sized, tidy
from mkc_torch.diagnosis.model.grid import reach_of
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects.context import Context
from mkc_torch.simulation.protocol import PreparedSimulation

__all__ = ["far_from_plausible", "shape_at_ends", "times_plausible"]

FAR = 10.0
"""Times the plausible size from which a finding does not count as confirmed."""

_AT_END = 0.01
"""Share of an end's own size within which a number is at that end."""


def shape_at_ends(term: Term, prepared: PreparedSimulation, context: Context) -> tuple[str, ...]:
    """A sentence for each number of a shape that was fitted to the end of its range.

    Args:
        term: the effect with its fitted shape.
        prepared: the simulation.
        context: what the effect sees there.
    """
    return tuple(_ended(term, prepared, context))


def far_from_plausible(term: Term, gamma: Tensor, context: Context) -> str:
    """Why the amplitude cannot be believed: at the end of its range, or :data:`FAR` times a plausible size; else empty.

    Args:
        term: the effect.
        gamma: its amplitude.
        context: what the effect sees.
    """
    first = term.effect.quantities(term.shape, context)[0]
    largest, most = float(gamma[: first.size].abs().max()), term.effect.upper
    name = first.name.replace("_", " ")
    # a share of one is all of it, and as good a value as any
    if 1.0 < most < math.inf and _near(largest, most):
        return f"Its {name} ended at {sized(most, tidy(first.unit))}, the most that is tried: nothing holds it."
    times = times_plausible(term, gamma, context)
    if times is not None and times > FAR:
        return f"Its {name} is {times:.2g} times the largest that is plausible ({term.effect.source})."
    return ""


def times_plausible(term: Term, gamma: Tensor, context: Context) -> float | None:
    """The largest number of the first quantity as a multiple of the plausible size; None where that is not known."""
    first, limit = term.effect.quantities(term.shape, context)[0], term.effect.plausible
    times = ratio(term.effect.plausible_unit or first.unit, first.unit)
    if not math.isfinite(limit) or times is None:
        return None
    return float(gamma[: first.size].abs().max()) / (limit * times)


def _ended(term: Term, prepared: PreparedSimulation, context: Context) -> Iterator[str]:
    for name, ends in reach_of(term, prepared).items():
        value = float(term.shape[name])
        for side, end in zip(("least", "greatest"), ends, strict=True):
            if side in term.effect.natural_ends.get(name, ()) or not _near(value, end):
                continue
            text = sized(value, tidy(term.effect.unit_of_shape(name, context)))
            yield (
                f"{term.effect.id}: its {name.replace('_', ' ')} ended at {text}, the {side} that is tried, so this "
                "recording does not tell it: something else may act there, or the recording is too short for it."
            )


def _near(value: float, end: float) -> bool:
    return abs(value - end) <= _AT_END * abs(end)
