"""Candidates in the order of their scores; which of two goes first that no data tells apart is not left to rounding."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.model_prior import ModelPrior

__all__ = ["best_first", "in_order"]

_TIE = 1e-6
"""Nats within which scores are the same: rounding moves them by 1e-12, a sample by 1e-3 and more."""


def in_order(scores: Sequence[float], terms: Sequence[Term]) -> list[int]:
    """Places, the largest score first; of those that are the same, the one with the fewest numbers in its shape.

    A body that is under water all the time and a constant force do the same: the plain one is told.

    Args:
        scores: of each candidate, in nats.
        terms: the candidates.
    """

    def key(place: int) -> tuple[float, int, int]:
        score = scores[place]
        return -round(score / _TIE) if math.isfinite(score) else -score, len(terms[place].shape), place

    return sorted(range(len(terms)), key=key)


def best_first(fits: Sequence[FittedModel], base: FittedModel, prefer: ModelPrior) -> list[FittedModel]:
    """Joint fits in the order of their scores."""
    scores = [prefer.score(fit, base) for fit in fits]
    return [fits[place] for place in in_order(scores, [fit.model.terms[-1] for fit in fits])]
