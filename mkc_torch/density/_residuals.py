"""Checked residuals and density parameters in a common shape."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.arguments import as_numbers, refuse_not_finite, refuse_not_real
from mkc_torch._support.arrays import Data, as_tensor
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density._full_weight import full_weight
from mkc_torch.density.domain import domain_rule, refuse_bad_bound

if TYPE_CHECKING:
    from jaxtyping import Float


class Residuals(NamedTuple):
    """Residuals with their weights and robust scales.

    Attributes:
        error: (*, N, m).
        weight: (*, N, m), as given; None for equal weights.
        share: weights that sum to 1 in each channel, (*, N, m); None for equal weights.
        scale: robust scale of each channel, above 0, (*, m).
    """

    error: Float[Tensor, "*batch N m"]
    weight: Float[Tensor, "*batch N m"] | None
    share: Float[Tensor, "*batch N m"] | None
    scale: Float[Tensor, "*batch m"]

    def detached_copy(self) -> Residuals:
        """A copy without autograd's graph."""

        def copy(values: Tensor | None) -> Tensor | None:
            return None if values is None else values.detach().clone()

        return Residuals(self.error.detach().clone(), copy(self.weight), copy(self.share), self.scale.detach().clone())


class Domain(NamedTuple):
    """Half-width of the domain and floor of d, each (*, m)."""

    bound: Float[Tensor, "*batch m"]
    d_min: Float[Tensor, "*batch m"]


def checked_residuals(error: Float[Tensor, "*batch N m"] | Data) -> Float[Tensor, "*batch N m"]:
    """Residuals as a tensor.

    Raises:
        TypeError: residuals that are not real numbers, or of half precision.
        ValueError: fewer than two residuals, or residuals that are not finite or whose squares overflow.
    """
    error = as_tensor("error", error)
    refuse_not_real("error", error)
    if error.dtype in (torch.float16, torch.bfloat16):
        raise TypeError(f"Expected argument `error` of dtype float32 or float64 but got {error.dtype}; use .float().")
    if error.dim() < 2 or error.shape[-2] < 2 or error.shape[-1] == 0:
        fix = "; for a single channel pass error[:, None]" if error.dim() == 1 and len(error) > 1 else ""
        raise ValueError(
            f"Expected argument `error` of shape (*, N >= 2, m) with at least one channel but got {tuple(error.shape)}"
            f"{fix}."
        )
    refuse_not_finite("error", error, "Leave those residuals out")
    most = torch.finfo(error.dtype).max ** 0.4
    if not bool((error.abs() <= most).all()):
        raise ValueError(
            f"Expected argument `error` within {most:.1g}, beyond which squares overflow, but got "
            f"{float(error.abs().max()):.2g}; divide by a unit near its scale, or leave out impossible values."
        )
    return error


def checked_weight(weight: Float[Tensor, "*batch N m"] | Data | None, error: Float[Tensor, "*batch N m"]) -> Residuals:
    """Checked residuals with their weights and robust scales.

    Raises:
        TypeError, ValueError: as :func:`full_weight`.
    """
    full = share = None
    if weight is not None:
        full = full_weight(as_tensor("weight", weight), error)
        share = full / full.sum(-2, keepdim=True)
    scale = robust_scale(error, full)
    square = error.square().mean(-2) if share is None else (share * error.square()).sum(-2)
    tiny = torch.finfo(error.dtype).tiny ** 0.5
    return Residuals(error, full, share, torch.where(scale > 0, scale, square.sqrt()).clamp(min=tiny))


def channel_values(
    name: str,
    value: float | Tensor | None,
    error: Float[Tensor, "*batch N m"],
    least: float = 0.0,
    infinite: bool = False,
) -> Float[Tensor, "*batch m"] | None:
    """A positive parameter of each channel, from a number or a tensor that broadcasts; None stays None.

    Raises:
        TypeError: a value that is not a number.
        ValueError: not positive, below ``least``, infinite unless ``infinite``, or of a shape that does not fit.
    """
    if value is None:
        return None
    shape = (*error.shape[:-2], error.shape[-1])
    t = as_numbers(name, value, error.dtype, error.device).to(error)
    if not bool(((t > 0) & (t >= least) & (torch.isfinite(t) | infinite)).all()):
        wanted = f"in [{least:.4g}, inf]" if infinite else "positive and finite"
        raise ValueError(f"Expected argument `{name}` to be {wanted} but got {value}.")
    try:
        return t.expand(shape)
    except RuntimeError:
        raise ValueError(
            f"Expected argument `{name}` to be a number or of shape (m,) or {shape} but got {tuple(t.shape)}."
        ) from None


def checked_domain(
    residuals: Residuals, bound: float | Float[Tensor, " m"] | None, d_min: float | Float[Tensor, " m"] | None
) -> Domain:
    """The domain, by default from :func:`domain_rule`, and the floor of d, by default a tenth of the scale.

    Raises:
        TypeError: a parameter that is not a number.
        ValueError: a parameter out of range, or ``d_min`` that is not below ``bound``.
    """
    error, weight, _, scale = residuals
    floor = channel_values("d_min", d_min, error)
    half_width = channel_values("bound", bound, error)
    if half_width is not None:
        refuse_bad_bound(half_width, scale)
    else:
        half_width = domain_rule(error, scale, None if weight is None else weight > 0)
    if floor is not None and bool((floor >= half_width).any()):
        raise ValueError(
            f"Expected argument `d_min` below the half-width of the domain, {half_width.tolist()}, but got {d_min}; it "
            "is the precision of the residuals."
        )
    return Domain(half_width, 0.1 * scale if floor is None else floor)
