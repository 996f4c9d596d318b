"""Robust share of the targets' variation that a fit explains."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch._support.arguments import refuse_not_finite, refuse_not_real
from mkc_torch._support.order_statistic import order_statistic, robust_scale

if TYPE_CHECKING:
    from jaxtyping import Float


def explained(residual: Float[Tensor, "*batch N m"], target: Tensor) -> Float[Tensor, "*batch m"]:
    """1 minus the squared ratio of the robust scales of residuals and targets.

    Args:
        residual: residual of the fit.
        target: (N,), (N, m) or (*, N, m).
    """
    refuse_not_real("target", target)
    shape = residual.shape
    given = target.unsqueeze(-1) if target.shape == shape[-2:-1] else target
    if given.shape not in (shape, shape[-2:]) and given.shape != (*shape[-2:-1], 1):
        raise ValueError(
            f"Expected argument `target` of shape {tuple(shape)}, {tuple(shape[-2:])} or ({shape[-2]},), as the "
            f"residual, but got {tuple(target.shape)}; pass the targets of the residual."
        )
    refuse_not_finite("target", given, "The scale uses all targets")
    given = given.to(residual).expand(shape)
    middle = order_statistic(given, None, 0.5 * shape[-2]).unsqueeze(-2)
    whole = robust_scale(given - middle)
    if not bool((whole > 0).all()):
        raise ValueError(
            "Expected argument `target` to vary but got targets of which more than half are equal; their robust scale "
            "is 0."
        )
    return 1.0 - (robust_scale(residual) / whole).square()
