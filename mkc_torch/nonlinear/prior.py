"""What is known of the parameters beforehand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["GaussianPrior"]


@dataclass(frozen=True)
class GaussianPrior:
    """A Gaussian on the parameters, ``½ (θ - mean)ᵀ P (θ - mean)`` added to the objective.

    Attributes:
        mean: (p,).
        precision: the diagonal of P (p,), or P (p, p), symmetric and positive semi-definite, in 1 / unit².
    """

    mean: Float[Tensor, " p"]
    precision: Float[Tensor, " p"] | Float[Tensor, "p p"]
