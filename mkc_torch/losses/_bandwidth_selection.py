"""Selection of the bandwidth that trains a network, by estimated variance and shrinkage of the predictions.

The variance alone does not distinguish wrong targets from wide noise. Wrong targets that are independent of their input
shrink the predictions toward the mean. Under least squares the residuals of right and wrong targets then look alike,
and a wide bandwidth seems best. The initial loss gives far residuals little weight and would undo the shrinkage: its
influence correlates with the prediction. The risk of a bandwidth is therefore its variance plus the square of its
shrinkage relative to the initial loss, if the shrinkage is significant.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from mkc_torch._support.numpy_or_torch import at_least, at_most
from mkc_torch.losses._initial_loss import initial_influence

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

BANDWIDTHS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 16.0, 64.0)
"""Candidate bandwidths, in scales."""

TOLERANCE = 1.1
"""Factor on the smallest risk up to which a wider bandwidth is preferred."""

CHANCE = 9.0
"""Square of the shrinkage attributed to chance, in squared standard errors: three standard errors. Tuned on Friedman's
second and third function and the Carseats and Hitters tables."""

LEAST_SLOPE = 1e-3
"""Lower limit of the mean derivative of an influence function."""

TINY = 1e-30
"""Lower limit of denominators."""

_FAR = 1e4
"""Square of a residual divided by its bandwidth from which the kernel is 0."""


class BandwidthSelection(NamedTuple):
    """The widest bandwidth with nearly the smallest risk, in scales, and whether its risk is below the initial loss's.

    Both have shape (m,).
    """

    bandwidth: Any
    better: Any


def select_bandwidth(
    xp: Any, z: Float[Tensor, "m L"], prediction: Float[Tensor, "m L"], weight: Float[Tensor, "m L"]
) -> BandwidthSelection:
    """Select the bandwidth of each channel by estimated risk, and compare it with the initial loss.

    The variance of an M-estimate with influence ψ is E ψ² / (E ψ')² (Huber, "Robust Statistics" (1981), 3.2). Its
    shrinkage is one step of Newton's method for the slope on the standardised prediction, E ψ q / E ψ'.

    Args:
        xp: ``numpy`` or ``torch``, the library of the other arrays.
        z: residuals (prediction - target) divided by their scale.
        prediction: the prediction of each residual.
        weight: the weight of each residual.

    Example:
        >>> import torch
        >>> z = torch.linspace(-0.999, 0.999, 999).erfinv().unsqueeze(0) * 2.0**0.5
        >>> select_bandwidth(torch, z, torch.zeros_like(z), torch.ones_like(z))
        BandwidthSelection(bandwidth=tensor([64.]), better=tensor([True]))
    """
    share = weight / at_least(xp, weight.sum(-1), TINY)[..., None]

    def mean(values: Any) -> Any:
        return (values @ share[..., None])[..., 0]

    influence, slope = _influences(xp, z)
    slope = at_least(xp, mean(slope), LEAST_SLOPE)
    risk = mean(influence * influence) / (slope * slope)
    # contribution of each sample to the slope, minus its contribution under the initial loss (the last entry)
    step = (influence - mean(influence)[..., None]) * (_standardised(xp, prediction, share)[..., None, :])
    step = step / slope[..., None]
    step = step - step[..., -1:, :]
    shrinkage = mean(step)
    spread = mean(step * step) - shrinkage * shrinkage
    size = 1.0 / at_least(xp, (share * share).sum(-1), TINY)[..., None]
    risk = risk + at_least(xp, size * at_least(xp, shrinkage, 0.0) ** 2 - CHANCE * spread, 0.0)
    annealed, initial = risk[..., :-1], risk[..., -1]
    least = xp.amin(annealed, -1)
    chosen = xp.where(annealed <= TOLERANCE * least[..., None], _widths(xp, z), 0.0)
    return BandwidthSelection(xp.amax(chosen, -1), TOLERANCE * least < initial)


def _widths(xp: Any, like: Any) -> Any:
    if xp.__name__ == "numpy":
        return xp.asarray(BANDWIDTHS, dtype=like.dtype)
    return xp.stack(
        [like.new_full((), width) for width in BANDWIDTHS]
    )  # copying a list to a GPU would wait for the GPU


def _influences(xp: Any, z: Any) -> tuple[Any, Any]:
    """Influence and its derivative under each bandwidth and, last, under the initial loss: (m, K + 1, L)."""
    each = z[..., None, :]
    ratio = each / _widths(xp, z)[:, None]
    square = at_most(xp, ratio * ratio, _FAR)  # beyond it, the product would be infinity times 0
    inlier = xp.exp(-0.5 * square)
    initial, slope = initial_influence(xp, each)
    return xp.concatenate([each * inlier, initial], -2), xp.concatenate([(1.0 - square) * inlier, slope], -2)


def _standardised(xp: Any, values: Any, share: Any) -> Any:
    """Values shifted and scaled to mean 0 and variance 1; 0 where all values are equal."""
    centred = xp.where(share > 0, values - (values * share).sum(-1)[..., None], 0.0)
    # division by the largest value keeps squares from overflow and underflow
    centred = centred / at_least(xp, xp.amax(xp.abs(centred), -1), TINY)[..., None]
    return centred / at_least(xp, xp.sqrt((centred * centred * share).sum(-1)), TINY)[..., None]
