"""Single samples under a fitted loss: inlier weights, outlier flags, errors beyond the bound, intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.arguments import DIVERGED, checked_number, refuse_bad_batch, refuse_not_finite, seems_finite
from mkc_torch.density.distribution import SIGMA_MIN, MKCDistribution
from mkc_torch.functional import mkc_weight
from mkc_torch.losses._checks import at_least_float32, checked_weight
from mkc_torch.losses.mkc import MKCLoss, checked_loss

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class BeyondBound:
    """Number of each channel's unmasked errors beyond the loss's bound, and their share of the weight, (m,) each."""

    count: Int[Tensor, " m"]
    share: Float[Tensor, " m"]


class PredictiveInterval(NamedTuple):
    """Ends of an interval around each prediction, in its shape and unit."""

    low: Float[Tensor, "*shape"]
    high: Float[Tensor, "*shape"]


@torch.no_grad()
def inlier_weight(
    loss: MKCLoss, input: Float[Tensor, "*shape"], target: Float[Tensor, "*shape"]
) -> Float[Tensor, "*shape"]:
    """Inlier weight of each element, ``exp(-e² / (2 d² σ²))``: 1 at the prediction, 0 far from it.

    It is the weight of the error in the paper's fixed point (15): the gradient relative to that of least squares. At
    σ = ∞ every weight is 1: the loss has found no outliers.

    Args:
        loss: the loss with its current σ and d.
        input: predictions, as for the loss.
        target: targets of the same shape.

    Returns:
        Weights in [0, 1] of the shape of ``input``, float32 at least, without a gradient.

    Raises:
        TypeError: a loss of another class; integer or complex input or target, or an argument that is not a tensor.
        ValueError: shapes that differ, are empty, or have another number of channels than the loss; a NaN error. An
            infinite error has the weight 0.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (15).

    Example:
        >>> loss = MKCLoss(1, sigma=2.0, d=1.0)
        >>> inlier_weight(loss, torch.zeros(3, 1), torch.tensor([[0.0], [2.0], [50.0]])).flatten()
        tensor([1.0000, 0.6065, 0.0000])
    """
    loss = checked_loss(loss)
    axis = loss._checked_axis(input, target)
    error = _error(input, target)
    _refuse_missing(error)
    return mkc_weight(error, _along(loss.sigma, input, axis), _along(loss.d, input, axis))


def outliers(
    loss: MKCLoss, input: Float[Tensor, "*shape"], target: Float[Tensor, "*shape"], weight_below: float = 0.1
) -> Bool[Tensor, "*shape"]:
    """Outlier flags: True where :func:`inlier_weight` is below a limit.

    At the limit 0.1 these are the errors larger than 2.15 σ d. At σ = ∞ no error is flagged, however large.

    Args:
        loss, input, target: as in :func:`inlier_weight`.
        weight_below: the limit, in (0, 1).

    Returns:
        Flags of the shape of ``input``, True for an outlier.

    Raises:
        TypeError: as in :func:`inlier_weight`.
        ValueError: as in :func:`inlier_weight`; a limit outside (0, 1).

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (15).

    Example:
        >>> loss = MKCLoss(1, sigma=2.0, d=1.0)
        >>> outliers(loss, torch.zeros(3, 1), torch.tensor([[0.0], [2.0], [50.0]])).flatten()
        tensor([False, False,  True])
    """
    checked_number("weight_below", weight_below, 0.0, 1.0, advice="0.1 is usual")
    return inlier_weight(loss, input, target) < weight_below


@torch.no_grad()
def beyond_bound(
    loss: MKCLoss,
    input: Float[Tensor, "*shape"],
    target: Float[Tensor, "*shape"],
    weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
) -> BeyondBound:
    """Number and share of errors outside the domain of the density, per channel.

    Outside the domain the density is 0, and the loss is continued with a finite gradient. A share above a few in a
    thousand means that ``MKCLoss(bound=...)`` is smaller than the errors that physically occur.

    Args:
        loss: the loss with its bound.
        input: predictions, as for the loss.
        target: targets of the same shape.
        weight: as for the loss: non-negative weights or a mask, of the shape of ``input`` or without its channels.

    Returns:
        For each channel the number of elements of positive weight beyond the bound, and their share of the weight; NaN
        for a channel whose weights are all 0.

    Raises:
        TypeError: as in :func:`inlier_weight`.
        ValueError: as the loss: shapes, channels, weights, an unmasked input or target that is not finite.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17).

    Example:
        >>> loss = MKCLoss(2, bound=10.0)
        >>> target = torch.tensor([[0.0, 11.0], [-12.0, 1.0], [0.5, 0.0], [9.9, 0.0]])
        >>> beyond_bound(loss, torch.zeros(4, 2), target)
        BeyondBound(count=tensor([1, 1]), share=tensor([0.2500, 0.2500]))
    """
    loss = checked_loss(loss)
    axis = loss._checked_axis(input, target)
    error = _error(input, target)
    weights, counts = checked_weight(torch.ones_like(error) if weight is None else weight, error, axis)
    refuse_bad_batch(input, target, counts, torch.where(counts, error, 0.0))
    beyond = counts & (error.abs() > _along(loss.bound, input, axis))
    others = [i for i in range(error.dim()) if i != axis]
    count, outside, total = (
        t.sum(others) if others else t for t in (beyond.to(torch.int64), torch.where(beyond, weights, 0.0), weights)
    )
    return BeyondBound(count, outside / total)


@torch.no_grad()
def predictive_interval(loss: MKCLoss, input: Float[Tensor, "*shape"], level: float = 0.9) -> PredictiveInterval:
    """Equal-tailed predictive interval of each target under the loss's density.

    The interval covers only the noise, not the uncertainty of the prediction. σ and d must have been fitted: learned,
    by MKC-EM, or by :func:`mkc_torch.fit_density` on residuals of data that the network has not seen. With
    ``normalize=False`` they are the values passed to the loss.

    Args:
        loss: the loss with its current σ, d and bound.
        input: predictions, any shape whose ``channel_dim`` has the loss's channels.
        level: probability inside, in (0, 1).

    Returns:
        The ends ``(low, high)``, of the shape of ``input``, float32 at least, without a gradient. Where the tails hold
        more than ``1 - level``, the ends lie far out on the flat tail, within ``bound`` of the prediction.

    Raises:
        TypeError: a loss of another class; an integer or complex input, or an argument that is not a tensor.
        ValueError: a level outside (0, 1), an input that is empty or not finite, or another number of channels than the
            loss.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17).

    Example:
        >>> loss = MKCLoss(1, sigma=float("inf"), d=1.0, learn_sigma=False)
        >>> predictive_interval(loss, torch.tensor([[10.0]]), level=0.95)
        PredictiveInterval(low=tensor([[8.0400]]), high=tensor([[11.9600]]))
    """
    checked_number("level", level, 0.0, 1.0, advice="0.9 leaves 5 % on either side")
    loss = checked_loss(loss)
    axis = loss._checked_axis(input, input)
    if not seems_finite(input):
        refuse_not_finite("input", input, DIVERGED)
    # on the CPU, because not every accelerator has float64
    kappa, d, bound = (t.detach().cpu().double() for t in (loss.kappa, loss.d, loss.bound))
    density = MKCDistribution(kappa.rsqrt().clamp(min=SIGMA_MIN), d, bound)  # rounding may lead below the smallest σ
    half = density.icdf(torch.tensor(0.5 + 0.5 * level, dtype=torch.float64))
    centre = input.to(at_least_float32(input))
    half = _along(half.to(centre), input, axis)
    return PredictiveInterval(centre - half, centre + half)


def _refuse_missing(error: Tensor) -> None:
    """Raise ValueError on a NaN error, which is neither inlier nor outlier. An infinite error is an outlier."""
    unknown = error.isnan()
    if bool(unknown.any()):
        raise ValueError(
            f"Expected `input - target` without NaN but got {int(unknown.sum())}, the first at index "
            f"{tuple(unknown.nonzero()[0].tolist())}: neither inlier nor outlier. Replace missing targets by the "
            "prediction, torch.where(torch.isfinite(target), target, input); these are never flagged."
        )


def _error(input: Tensor, target: Tensor) -> Tensor:
    return input.to(at_least_float32(input)) - target.to(at_least_float32(target))


def _along(per_channel: Float[Tensor, " m"], input: Tensor, axis: int) -> Tensor:
    """Values of each channel in a shape that broadcasts with the input, channels in dimension ``axis``."""
    shape = [1] * input.dim()
    shape[axis] = -1
    return per_channel.reshape(shape)
