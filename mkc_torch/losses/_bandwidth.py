"""By which bandwidth a network should learn: the variance of an estimate from the recent residuals, and its shrinkage.

The variance alone does not tell wrong targets from wide noise. A wrong target that knows nothing of its input pulls the
prediction toward the middle; least squares gives in, the residuals of right and wrong targets then look alike, and wide
looks best. What gives it away is that the first loss, which heeds far residuals little, would stretch the predictions
again: its influence goes with the prediction. So each bandwidth is judged by its variance and by the square of the
shrinkage that it adds to the first loss's, as far as that is beyond chance.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.losses._first_loss import first_influence

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["Choice", "choice"]

_BANDWIDTHS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 16.0, 64.0)
"""In scales."""

_TOLERANCE = 1.1
"""Times the smallest risk up to which a wider bandwidth is taken."""

_CHANCE = 9.0
"""Squared standard errors of shrinkage that are put down to chance: three of them. Set on Friedman's second and third
function and the Carseats and Hitters tables."""

_LEAST_SLOPE, _TINY = 1e-3, 1e-30


class Choice(NamedTuple):
    """The widest bandwidth of nearly the smallest risk, in scales; whether it is better than the first loss."""

    bandwidth: Float[Tensor, " m"]
    better: Bool[Tensor, " m"]


def choice(z: Float[Tensor, "m L"], prediction: Float[Tensor, "m L"], counts: Float[Tensor, "m L"]) -> Choice:
    """Judge all bandwidths, and the first loss, on residuals.

    The variance of an M-estimate with influence ψ is E ψ² / (E ψ')² (Huber, "Robust Statistics" (1981), 3.2). Its
    shrinkage is one step of Newton's method for the slope on the standardised prediction, E ψ q / E ψ'.

    Args:
        z: residuals, prediction less target, over their scale.
        prediction: beside each.
        counts: their weights.

    Example:
        >>> z = torch.linspace(-0.999, 0.999, 999).erfinv().unsqueeze(0) * 2.0**0.5
        >>> choice(z, torch.zeros_like(z), torch.ones_like(z))
        Choice(bandwidth=tensor([64.]), better=tensor([True]))
    """
    total = counts.sum(-1, keepdim=True).clamp(min=_TINY)
    share = counts / total
    widths = z.new_tensor(_BANDWIDTHS)
    influence, slope = _influences(z, widths)
    slope = torch.einsum("mkl,ml->mk", slope, share).clamp(min=_LEAST_SLOPE)
    risk = torch.einsum("mkl,ml->mk", influence.square(), share) / slope.square()
    # of each sample on the slope; less that of the first loss, which is the last
    step = (influence - _mean(influence, share)) * _standardised(prediction, share).unsqueeze(-2) / slope.unsqueeze(-1)
    step = step - step[:, -1:]
    shrinkage = _mean(step, share).squeeze(-1)
    spread = torch.einsum("mkl,ml->mk", (step - shrinkage.unsqueeze(-1)).square(), share)
    size = 1.0 / share.square().sum(-1, keepdim=True).clamp(min=_TINY)
    risk = risk + (size * shrinkage.clamp(min=0.0).square() - _CHANCE * spread).clamp(min=0.0)
    late, first = risk[:, :-1], risk[:, -1]
    least = late.amin(-1, keepdim=True)
    chosen = torch.where(late <= _TOLERANCE * least, widths, 0.0).amax(-1)
    return Choice(chosen, _TOLERANCE * least.squeeze(-1) < first)


def _influences(z: Float[Tensor, "m L"], widths: Float[Tensor, " K"]) -> tuple[Tensor, Tensor]:
    """Influence and its derivative under each bandwidth and, last, under the first loss: (m, K + 1, L)."""
    each = z.unsqueeze(-2)
    square = (each / widths.unsqueeze(-1)).square()
    inlier = torch.exp(-0.5 * square)
    first, slope = first_influence(each)
    return torch.cat([each * inlier, first], -2), torch.cat([(1.0 - square) * inlier, slope], -2)


def _mean(values: Float[Tensor, "m K L"], share: Float[Tensor, "m L"]) -> Float[Tensor, "m K 1"]:
    return torch.einsum("mkl,ml->mk", values, share).unsqueeze(-1)


def _standardised(values: Float[Tensor, "m L"], share: Float[Tensor, "m L"]) -> Float[Tensor, "m L"]:
    """Of mean 0 and variance 1; 0 where they are all alike."""
    centred = values - (values * share).sum(-1, keepdim=True)
    # over their largest, whose square neither overflows nor is 0
    centred = centred / centred.abs().amax(-1, keepdim=True).clamp(min=_TINY)
    return centred / (centred.square() * share).sum(-1, keepdim=True).sqrt().clamp(min=_TINY)
