"""Separability of the candidates on a recording."""

from __future__ import annotations

import torch

from mkc_torch.diagnosis.findings.finding import labels
from mkc_torch.diagnosis.result import Separability
from mkc_torch.diagnosis.search.run import SearchResult

__all__ = ["separability"]

_MOST = 8
"""Largest number of candidates in the matrix."""


def separability(located: SearchResult) -> Separability:
    """Return the separability of the leading candidates at their best shapes, in the metric of the noise.

    The trace of a candidate is its tangent along the best γ, orthogonal to the simulation's parameters. The share is
    the
    squared norm that remains after projection on the rival, relative to the norm before.
    """
    numbers = [ranked.number for ranked in located.ranking[:_MOST]]
    traces, spaces, left = [], [], []
    for number in numbers:
        trace, space, kept = located.look.linearised.search.trace(number, located.look.linearised.series)
        traces.append(trace)
        spaces.append(space)
        left.append(kept)
    share = torch.ones(len(numbers), len(numbers), dtype=torch.float64)
    for i, trace in enumerate(traces):
        length = float(trace.square().sum())
        for j, space in enumerate(spaces):
            taken = float((space.mT @ trace).square().sum())
            share[i, j] = max(0.0, 1.0 - taken / length) if i != j and length > 0 else 0.0
    return Separability(
        labels([located.scene.terms[n] for n in numbers]), share, torch.tensor(left, dtype=torch.float64)
    )
