"""Check points in space and their weights."""

from __future__ import annotations

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_bad_weight, refuse_not_real

MIN_POINTS = 9
"""Fewest points: as many as coefficients of an ellipsoid."""


def refuse_no_points(points: Tensor) -> None:
    """Raise an error unless ``points`` is a real tensor of shape (*, N, 3)."""
    refuse_not_real("points", points)
    if points.dim() < 2 or points.shape[-1] != 3:
        remedy = "; a point is a row, so try points.mT" if points.dim() > 1 and points.shape[-2] == 3 else ""
        if points.shape == (3,):
            remedy = "; for a single point use points[None]"
        raise ValueError(f"Expected argument `points` of shape (*, N, 3) but got {tuple(points.shape)}{remedy}.")


def prepared(points: Tensor, sample_weight: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Check points and weights; points of weight 0 may hold any values, which are replaced by those of a used point."""
    refuse_no_points(points)
    if points.dtype in (torch.float16, torch.bfloat16):
        raise TypeError(f"Expected argument `points` of dtype float32 or float64 but got {points.dtype}; use .float().")
    weight = None
    if sample_weight is not None:
        refuse_bad_weight(sample_weight, "sample_weight")
        if sample_weight.shape != points.shape[:-1] and sample_weight.shape != points.shape[-2:-1]:
            raise ValueError(
                f"Expected argument `sample_weight` of shape {tuple(points.shape[:-1])} "
                f"but got {tuple(sample_weight.shape)}; give a weight for each point."
            )
        weight = sample_weight.to(points).expand(points.shape[:-1])
    count = points.shape[-2] if weight is None else int((weight > 0).sum(-1).min())
    if count < MIN_POINTS:
        raise ValueError(
            f"Expected at least {MIN_POINTS} points, one for each coefficient of an ellipsoid, but got {count}; record "
            "more, in all directions."
        )
    finite = torch.isfinite(points)
    if weight is not None:
        finite = finite | (weight == 0).unsqueeze(-1)
    if not bool(finite.all()):
        first = tuple((~finite).nonzero()[0].tolist())
        raise ValueError(
            f"Expected argument `points` to be finite but got {points[first].item()} at index {first} "
            f"({int((~finite).sum())} such values); drop those points."
        )
    if weight is not None:
        first_used = (weight > 0).to(torch.int64).argmax(-1)[..., None, None].expand(*points.shape[:-2], 1, 3)
        points = torch.where((weight > 0).unsqueeze(-1), points, points.gather(-2, first_used))
    _refuse_magnitude(points)
    return points, weight


def _refuse_magnitude(points: Tensor) -> None:
    """Raise an error if squared distances between the points would overflow or underflow."""
    most, limit = float(points.detach().abs().max()), 0.1 * float(torch.finfo(points.dtype).max) ** 0.5
    if most > limit or 0.0 < most < 1.0 / limit:
        raise ValueError(
            f"Expected argument `points` of a magnitude between {1.0 / limit:.0e} and {limit:.0e} in {points.dtype} "
            f"but got {most:.3g}; choose another unit."
        )
