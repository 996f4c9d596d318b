"""Whether a candidate counts in a quick look, which draws no noise: its gain against the price of its numbers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.search.linearized import LinearizedSearch

if TYPE_CHECKING:
    from jaxtyping import Bool

__all__ = ["COUNTS", "COUNTS_NOT", "any_pays", "pays", "price"]

COUNTS, COUNTS_NOT = 0.0, 1.0
"""What stands in the place of a p-value inside a quick look; it is never shown."""


def price(numbers: float, samples: int, candidates: int) -> float:
    """Nats that a candidate of a search has to gain to be as likely as no candidate.

    Half the logarithm of the number of samples for each of its numbers, and the logarithm of the number of candidates:
    the extended criterion of Chen & Chen, Biometrika 95 (2008), 759, for one effect.

    Example:
        >>> round(price(2, 1000, 91), 2)
        11.42
    """
    return 0.5 * numbers * math.log(max(samples, 1)) + math.log(max(candidates, 1))


def pays(gain: float, numbers: float, samples: int, candidates: int) -> bool:
    """Whether a gain is more than its price.

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
    """:data:`COUNTS` if one of the first candidates of a look gains more than its price, else the other.

    Args:
        look: at candidates beside a fit.
        possible: which of the first ones may count.
    """
    scene, tried = look.scene, len(possible)
    samples, physics = int(scene.counts.sum()), len({term.key for term in scene.terms[:tried]})
    gain = torch.where(possible, 0.5 * look.gains.ratio[:tried, 0], 0.0).tolist()
    known = zip(gain, look.gains.dof[:tried].tolist(), strict=True)
    return COUNTS if any(pays(one, numbers, samples, physics) for one, numbers in known) else COUNTS_NOT
