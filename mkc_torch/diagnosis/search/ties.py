"""Order candidates by score; ties do not depend on rounding."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.model_prior import ModelPrior

__all__ = ["best_first", "in_order"]

_TIE = 1e-6
"""Nats within which scores are equal: rounding changes them by 1e-12, a sample by 1e-3 and more."""


def in_order(scores: Sequence[float], terms: Sequence[Term]) -> list[int]:
    """Return places by descending score; among equal scores the candidate with the fewest shape numbers comes first.

    A body that is always under water and a constant force have the same effect: the simpler name is reported.

    Args:
        scores: of each candidate, in nats.
        terms: the candidates.
    """

    def key(place: int) -> tuple[float, int, int]:
        score = scores[place]
        return -round(score / _TIE) if math.isfinite(score) else -score, len(terms[place].shape), place

    return sorted(range(len(terms)), key=key)


def best_first(fits: Sequence[FittedModel], base: FittedModel, prefer: ModelPrior) -> list[FittedModel]:
    """Return joint fits by descending score."""
    scores = [prefer.score(fit, base) for fit in fits]
    return [fits[place] for place in in_order(scores, [fit.model.terms[-1] for fit in fits])]
