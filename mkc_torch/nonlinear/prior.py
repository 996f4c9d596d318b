"""Prior knowledge of the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class GaussianPrior:
    """A Gaussian prior on the parameters, which adds ``½ (θ - mean)ᵀ P (θ - mean)`` to the objective.

    Attributes:
        mean: mean of the parameters, (p,).
        precision: diagonal of P (p,), or P (p, p), symmetric and positive semi-definite, in 1 / unit².

    :func:`minimise` and :func:`fit` check the values.

    Example:
        >>> import torch
        >>> from mkc_torch.nonlinear import minimise
        >>> y = torch.full((3, 1), 4.0, dtype=torch.float64)
        >>> known = GaussianPrior(torch.zeros(1), torch.tensor([1.0]))  # 0 with a standard deviation of 1
        >>> minimise(lambda theta: y - theta, torch.zeros(1).double(), prior=known).theta
        tensor([3.0000], dtype=torch.float64)
    """

    mean: Float[Tensor, " p"]
    precision: Float[Tensor, " p"] | Float[Tensor, "p p"]
