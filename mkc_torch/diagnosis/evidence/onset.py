"""Confidence interval of an onset."""

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

__all__ = ["as_result", "of_finding", "onset_interval", "test"]

_CRITICAL = -2.0 * math.log(1.0 - math.sqrt(0.95))
"""95 % quantile of the likelihood ratio of the onset."""

_RISE = 1
"""Margin in samples: a change takes time, and its middle can differ from the best instantaneous change."""

_GROWTH = 1.3
"""Growth factor of the spacing of the tried samples."""

_BETWEEN = 12
"""Samples tried between the last sample inside the interval and the first sample outside."""


def of_finding(case: EvidenceContext) -> tuple[float, float] | None:
    return onset_interval(case.fits[case.number].model, case.located)


def test(case: EvidenceContext) -> EvidenceResult:
    """Return the confidence interval of the finding's onset."""
    return as_result(case.ahead)


def as_result(interval: tuple[float, float] | None) -> EvidenceResult:
    return EvidenceResult("onset", interval, keys={} if interval is None else {"onset_interval": interval})


def onset_interval(model: JointModel, located: SearchResult) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of an effect's onset, in s.

    The likelihood ratio of a change point is not chi-square distributed: it is the maximum of two exponential
    variables, one per side, with ``P(ratio <= x) = (1 - exp(-x / 2))²``.

    Hansen, "Sample splitting and threshold estimation", Econometrica 68 (2000), theorem 2.

    Args:
        model: the simulation without the effect.
        located: the effect.

    Returns:
        None without an onset, or at a port at which each onset needs its own trajectory.
    """
    term, pointwise = located.fit.model.terms[-1], located.scene.tangents.pointwise
    if "onset" not in term.shape or pointwise[term.port] is None:
        return None
    time = model.prepared.time
    place = int(torch.searchsorted(time, term.shape["onset"]).clamp(1, len(time) - 1))
    parameters = located.fit.parameters[: model.size]

    def ratios(numbers: Sequence[int]) -> Float[Tensor, " n"]:
        """Return the likelihood ratio of an onset at each sample."""
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
    # a change seen at a sample happened after the previous sample, and takes time
    return float(time[max(min(within) - 1 - _RISE, 0)]), float(time[min(max(within) + _RISE, len(time) - 1)])


def _spread(place: int, count: int) -> list[int]:
    """Return sample numbers around ``place``, with growing distances, to both ends of the recording.

    Example:
        >>> _spread(3, 9)
        [1, 2, 3, 4, 6, 8]
    """
    away, step = [0], 1.0
    while away[-1] < count:
        away.append(away[-1] + math.ceil(step))
        step *= _GROWTH
    numbers = {place - distance for distance in away} | {place + distance for distance in away}
    return sorted({min(max(number, 1), count - 1) for number in numbers})


def _between(low: int, high: int) -> list[int]:
    """Return up to ``_BETWEEN`` integers between two integers."""
    return sorted({low + (high - low) * k // _BETWEEN for k in range(1, _BETWEEN)} - {low, high})
