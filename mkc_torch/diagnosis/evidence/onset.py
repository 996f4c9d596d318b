"""How surely an onset is known: the moments that the noise of the search does not tell from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.linearised.candidates import Candidates
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.search.run import SearchResult

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["of_finding", "onset_interval", "said", "test"]

_CRITICAL = -2.0 * math.log(1.0 - math.sqrt(0.95))
"""Twice the nats by which the true onset falls short of the likeliest one in no more than 5 % of recordings."""

_RISE = 1
"""Samples to either side: a change takes its time, and its middle can lie off where an instant one fits best."""

_GROWTH = 1.3
"""Growth of the distance from one sample that is tried to the next."""

_BETWEEN = 12
"""Samples that are tried between the last one within and the first one beyond."""


def of_finding(case: EvidenceContext) -> tuple[float, float] | None:
    return onset_interval(case.fits[case.number].model, case.located)


def test(case: EvidenceContext) -> EvidenceResult:
    """The interval of the finding's onset."""
    return said(case.ahead)


def said(interval: tuple[float, float] | None) -> EvidenceResult:
    return EvidenceResult("onset", interval, keys={} if interval is None else {"onset_interval": interval})


def onset_interval(model: JointModel, located: SearchResult) -> tuple[float, float] | None:
    """The 95 % confidence interval of an effect's onset, in s.

    The likelihood ratio of a change point is no chi-square: it is the larger of two exponential variables, one for each
    side, with ``P(ratio <= x) = (1 - exp(-x / 2))²``.

    Hansen, "Sample splitting and threshold estimation", Econometrica 68 (2000), theorem 2.

    Args:
        model: the simulation without the effect.
        located: the effect.

    Returns:
        None where it has no onset, or acts where each onset would take a trajectory of its own.
    """
    term, pointwise = located.fit.model.terms[-1], located.scene.tangents.pointwise
    if "onset" not in term.shape or pointwise[term.port] is None:
        return None
    time = model.prepared.time
    place = int(torch.searchsorted(time, term.shape["onset"]).clamp(1, len(time) - 1))
    parameters = located.fit.parameters[: model.size]

    def ratios(numbers: Sequence[int]) -> Float[Tensor, " n"]:
        """Of a change that comes with the sample of each number."""
        shapes = [replace(term, shape={**term.shape, "onset": float(time[number])}) for number in numbers]
        tangents = Candidates(model, parameters, shapes, pointwise)
        return located.look.linearised.gains_of(tangents, located.scene.counts).ratio[:, 0]

    tried = _spread(place, len(time))
    found = ratios(tried)
    least = float(found.max()) - _CRITICAL
    within = [number for number, ratio in zip(tried, found.tolist(), strict=True) if ratio >= least or number == place]
    first, last = within[0], within[-1]
    before, after = tried[max(tried.index(first) - 1, 0)], tried[min(tried.index(last) + 1, len(tried) - 1)]
    closer = sorted({*_between(before, first), *_between(last, after)})
    if closer:
        within += [number for number, ratio in zip(closer, ratios(closer).tolist(), strict=True) if ratio >= least]
    # a change that is seen with a sample came after the one before; and none is over at once
    return float(time[max(min(within) - 1 - _RISE, 0)]), float(time[min(max(within) + _RISE, len(time) - 1)])


def _spread(place: int, count: int) -> list[int]:
    """Numbers of samples around one, ever farther apart, to both ends of the recording.

    Example:
        >>> _spread(3, 9)
        [1, 2, 3, 4, 6, 8]
    """
    away, step = [0], 1.0
    while away[-1] < count:
        away.append(away[-1] + math.ceil(step))
        step *= _GROWTH
    numbers = {place - element for element in away} | {place + item for item in away}
    return sorted({min(max(number, 1), count - 1) for number in numbers})


def _between(low: int, high: int) -> list[int]:
    """Some whole numbers between two."""
    return sorted({low + (high - low) * k // _BETWEEN for k in range(1, _BETWEEN)} - {low, high})
