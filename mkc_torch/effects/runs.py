"""Run numbers of samples, and recurrences along the samples within runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


def run_numbers(time: Float[Tensor, " N"]) -> Int[Tensor, " N"]:
    """Number of each sample's run; a run begins where time goes back.

    Example:
        >>> run_numbers(torch.tensor([0.0, 1.0, 0.0, 1.0]))
        tensor([0, 0, 1, 1])
    """
    return torch.cat([torch.zeros(1, dtype=torch.long), (time.diff() < 0).long()]).cumsum(0)


def first_of_runs(run: Int[Tensor, " N"]) -> Bool[Tensor, " N"]:
    """Whether each sample is the first of its run."""
    return torch.cat([torch.ones(1, dtype=torch.bool), run.diff() != 0])


def linear_recurrence(factor: Float[Tensor, " N"], level: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """The recurrence ``y[k] = factor[k] y[k-1] + level[k]`` from ``y[-1] = 0``, by a parallel scan of affine maps.

    A factor of 0 restarts it. Its derivatives are recurrences with the same factors, so the scan itself is never
    differentiated. Blelloch, "Prefix sums and their applications" (1990).

    Example:
        >>> linear_recurrence(torch.tensor([0.0, 0.5, 0.5]), torch.tensor([4.0, 0.0, 1.0]))
        tensor([4., 2., 2.])
    """
    found: Tensor = _LinearRecurrence.apply(factor, level)  # type: ignore[no-untyped-call]
    return found


def _composed(factor: Float[Tensor, "*#b N"], level: Float[Tensor, "*#b N"]) -> Float[Tensor, "*b N"]:
    """The recurrence along the last dimension."""
    shift, length = 1, level.shape[-1]
    # torch.broadcast_shapes would import sympy
    level = level.expand(np.broadcast_shapes(factor.shape, level.shape))
    while shift < length:
        tail = factor[..., shift:] * level[..., :-shift] + level[..., shift:]
        level = torch.cat([level[..., :shift], tail], -1)
        if 2 * shift < length:
            factor = torch.cat([factor[..., :shift], factor[..., shift:] * factor[..., :-shift]], -1)
        shift *= 2
    return level.clone()


def _before(values: Float[Tensor, "*b N"]) -> Float[Tensor, "*b N"]:
    """Each value's predecessor; 0 for the first."""
    return torch.cat([torch.zeros_like(values[..., :1]), values[..., :-1]], -1)


class _LinearRecurrence(torch.autograd.Function):
    """:func:`linear_recurrence` along the last dimension, with derivatives in both modes and a rule for ``vmap``."""

    @staticmethod
    def forward(factor: Tensor, level: Tensor) -> Tensor:
        return _composed(factor, level)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0], output)
        ctx.save_for_forward(inputs[0], output)
        ctx.level_shape = inputs[1].shape
        ctx.set_materialize_grads(False)

    @staticmethod
    def jvp(ctx: Any, factor_tangent: Tensor | None, level_tangent: Tensor | None) -> Tensor:
        factor, found = ctx.saved_tensors
        moved = torch.zeros_like(found) if level_tangent is None else level_tangent
        if factor_tangent is not None:
            moved = moved + factor_tangent * _before(found)
        return linear_recurrence(factor, moved)

    @staticmethod
    def backward(ctx: Any, slope: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        if slope is None:
            return None, None
        factor, found = ctx.saved_tensors
        # the transposed recurrence runs from the last sample to the first
        back = torch.cat([torch.zeros_like(factor[..., :1]), factor[..., 1:].flip(-1)], -1).conj()
        to_level = linear_recurrence(back, slope.flip(-1)).flip(-1)
        to_factor = to_level * _before(found).conj()
        if not factor.is_complex():
            to_factor = torch.real(to_factor)
        return to_factor.sum_to_size(factor.shape), to_level.sum_to_size(ctx.level_shape)

    @staticmethod
    def vmap(_info: Any, places: tuple[int | None, int | None], factor: Tensor, level: Tensor) -> tuple[Tensor, int]:
        if places[0] is not None:
            factor = factor.movedim(places[0], 0)
        if places[1] is not None:
            level = level.movedim(places[1], 0)
        return linear_recurrence(factor, level), 0


def clamped_recurrence(low: Float[Tensor, " N"], high: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """The recurrence ``y[k] = max(low[k], min(high[k], y[k-1]))``, by a parallel scan: a clamp of a clamp is a clamp.

    It restarts where ``low`` equals ``high``, as must be the case at the first sample.

    Example:
        >>> clamped_recurrence(torch.tensor([0.0, 1.0, 0.5, -2.0]), torch.tensor([0.0, 3.0, 2.5, 0.0]))
        tensor([0., 1., 1., 0.])
    """
    shift = 1
    while shift < len(low):
        floor, ceiling = low[shift:], high[shift:]
        tail_low = torch.maximum(floor, torch.minimum(ceiling, low[:-shift]))
        tail_high = torch.maximum(floor, torch.minimum(ceiling, high[:-shift]))
        low, high = torch.cat([low[:shift], tail_low]), torch.cat([high[:shift], tail_high])
        shift *= 2
    return low


def limited_recurrence(values: Float[Tensor, " N"], reach: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """The recurrence ``y[k] = y[k-1] + max(-reach[k], min(reach[k], values[k] - y[k-1]))``, without derivatives.

    It restarts where ``reach`` is infinite, as must be the case at the first sample.

    Example:
        >>> limited_recurrence(torch.tensor([0.0, 3.0, 3.0, 0.0]), torch.tensor([torch.inf, 2.0, 2.0, 2.0]))
        tensor([0., 2., 3., 1.])
    """
    found: Tensor = _LimitedRecurrence.apply(values, reach)  # type: ignore[no-untyped-call]
    return found


class _LimitedRecurrence(torch.autograd.Function):
    """:func:`limited_recurrence` along the last dimension, with a rule for ``vmap``."""

    @staticmethod
    def forward(values: Tensor, reach: Tensor) -> Tensor:
        rows = torch.broadcast_tensors(values, reach)
        # such maps do not compose to one of their kind, so there is no parallel scan
        found = [
            _limited(*pair) for pair in zip(*(row.reshape(-1, row.shape[-1]).tolist() for row in rows), strict=True)
        ]
        return values.new_tensor(found).reshape(rows[0].shape)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def vmap(_info: Any, places: tuple[int | None, int | None], *tables: Tensor) -> tuple[Tensor, int]:
        rows = [table if at is None else table.movedim(at, 0) for table, at in zip(tables, places, strict=True)]
        return limited_recurrence(rows[0], rows[1]), 0


def _limited(values: Sequence[float], reach: Sequence[float]) -> list[float]:
    followed, found = 0.0, []
    for value, far in zip(values, reach, strict=True):
        away = value - followed
        followed = value if -far <= away <= far else followed + math.copysign(far, away)
        found.append(followed)
    return found
