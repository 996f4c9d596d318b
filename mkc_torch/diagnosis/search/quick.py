"""Decisions of a quick look, which draws no surrogates: a candidate's gain against the penalty of its numbers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.search.linearized import LinearizedSearch

if TYPE_CHECKING:
    from jaxtyping import Bool

__all__ = ["COUNTS", "COUNTS_NOT", "any_pays", "pays", "price"]

COUNTS = 0.0
"""Internal replacement of a p-value in a quick look, for a candidate that counts."""

COUNTS_NOT = 1.0
"""The same for a candidate that does not count."""


def price(numbers: float, samples: int, candidates: int) -> float:
    """Return the nats that a candidate has to gain to be as likely as no candidate.

    Half the logarithm of the number of samples for each of its numbers, plus the logarithm of the number of candidates:
    the extended criterion of Chen & Chen, Biometrika 95 (2008), 759, for one effect.

    Example:
        >>> round(price(2, 1000, 91), 2)
        11.42
    """
    return 0.5 * numbers * math.log(max(samples, 1)) + math.log(max(candidates, 1))


def pays(gain: float, numbers: float, samples: int, candidates: int) -> bool:
    """Whether a gain exceeds its penalty.

    Args:
        gain: log-likelihood gain, in nats.
        numbers: of the candidate.
        samples, candidates: of the recording and of the search.

    Example:
        >>> pays(12.0, 2, 1000, 91), pays(11.0, 2, 1000, 91)
        (True, False)
    """
    return gain > price(numbers, samples, candidates)


def any_pays(look: LinearizedSearch, possible: Bool[Tensor, " tried"]) -> float:
    """Return :data:`COUNTS` if one of the first candidates gains more than its penalty, else :data:`COUNTS_NOT`.

    Args:
        look: the search.
        possible: which of the first candidates may count.
    """
    scene, tried = look.scene, len(possible)
    samples, physics = int(scene.counts.sum()), len({term.key for term in scene.terms[:tried]})
    gain = torch.where(possible, 0.5 * look.gains.ratio[:tried, 0], 0.0).tolist()
    known = zip(gain, look.gains.dof[:tried].tolist(), strict=True)
    return COUNTS if any(pays(nats, numbers, samples, physics) for nats, numbers in known) else COUNTS_NOT
