"""Newton's method with a trust region for a batch of smooth, possibly nonconvex functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.side_by_side import side_by_side, steps_between_tests
from mkc_torch._support.small_factors import symmetric_eigen

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_NEGATIVE = 1e-6
"""Negative curvature, relative to the largest curvature, up to which a stationary point counts as a minimum."""


@dataclass(frozen=True)
class Quadratic:
    """Second-order models of K functions: values (K,), gradients (K, n), symmetric Hessians (K, n, n)."""

    value: Float[Tensor, " K"]
    gradient: Float[Tensor, "K n"]
    hessian: Float[Tensor, "K n n"]

    def select(self, keep: Tensor) -> Quadratic:
        return Quadratic(self.value[keep], self.gradient[keep], self.hessian[keep])

    def moved(self, accept: Tensor, to: Quadratic) -> Quadratic:
        return Quadratic(
            torch.where(accept, to.value, self.value),
            torch.where(accept[:, None], to.gradient, self.gradient),
            torch.where(accept[:, None, None], to.hessian, self.hessian),
        )


@dataclass(frozen=True)
class Minima:
    """Results of the descents: points (K, n), values (K,), steps tried (K,), and whether each is a minimum (K,)."""

    point: Float[Tensor, "K n"]
    value: Float[Tensor, " K"]
    n_iter: Int[Tensor, " K"]
    converged: Bool[Tensor, " K"]


@dataclass(frozen=True)
class _Step:
    """Steps (K, n), their lengths, predicted gains of the steps and of the full Newton steps, and convexity."""

    step: Float[Tensor, "K n"]
    length: Float[Tensor, " K"]
    gain: Float[Tensor, " K"]
    whole_gain: Float[Tensor, " K"]
    convex: Bool[Tensor, " K"]


def _step(at: Quadratic, radius: Float[Tensor, " K"]) -> _Step:
    """Newton's step with the absolute values of the curvatures, shortened to the radius.

    Where a step along the most negative curvature gains more, such as at a saddle, it is taken instead.
    """
    curvature, vectors = symmetric_eigen(at.hessian)
    slope = torch.matmul(at.gradient.unsqueeze(-2), vectors).squeeze(-2)
    size = curvature.abs()
    largest = size.amax(-1)
    floor = (torch.finfo(size.dtype).eps * largest).clamp(min=torch.finfo(size.dtype).tiny)
    whole = slope / torch.maximum(size, floor.unsqueeze(-1))
    whole_gain = 0.5 * (slope * whole).sum(-1)
    length = torch.linalg.vector_norm(whole, dim=-1)
    step = whole * (-radius / torch.maximum(length, radius)).unsqueeze(-1)
    length = torch.minimum(length, radius)
    gain = -(step * (slope + 0.5 * curvature * step)).sum(-1)
    # eigenvalues ascend: the first is the most negative
    convex = curvature[:, 0] >= -_NEGATIVE * largest
    if side_by_side(step) or not bool(convex.all()):
        away = radius * slope[:, 0].abs() - 0.5 * curvature[:, 0] * radius.square()
        leave = ~convex & (away > gain)
        downhill = torch.zeros_like(step)
        downhill[:, 0] = torch.where(slope[:, 0] > 0, -radius, radius)
        step = torch.where(leave.unsqueeze(-1), downhill, step)
        gain, length = torch.where(leave, away, gain), torch.where(leave, radius, length)
    return _Step(torch.matmul(vectors, step.unsqueeze(-1)).squeeze(-1), length, gain, whole_gain, convex)


def minimise(
    function: Callable[[Tensor, Tensor], Quadratic],
    start: Float[Tensor, "K n"],
    radius: Float[Tensor, " K"],
    *,
    tol: float | None = None,
    max_iter: int = 200,
    retract: Callable[[Tensor], Tensor] | None = None,
) -> Minima:
    """Descend from every start to a local minimum of its function.

    Args:
        function: called with points (k, n) and the indices (k,) of the running descents; returns the values, gradients
            and Hessians there.
        start: start points, (K, n).
        radius: maximum length of the first steps, (K,).
        tol: predicted gain of Newton's step below which a descent ends with that step, relative to the absolute value
            of the function or 1 if larger; default 64 times the rounding error of the dtype.
        max_iter: maximum number of steps tried.
        retract: maps points to others with the same value, for functions that are constant along curves; None keeps
            the points.

    Raises:
        ValueError: a function, its gradient or its Hessian is not finite at a start.

    Example:
        >>> def wells(x, index):  # x⁴ - 2 x², with minima at -1 and 1
        ...     return Quadratic((x**4 - 2 * x**2)[:, 0], 4 * x**3 - 4 * x, (12 * x**2 - 4).unsqueeze(-1))
        >>> minimise(wells, torch.tensor([[0.5], [-3.0]]), torch.ones(2)).point
        tensor([[ 1.],
                [-1.]])
    """
    eps = torch.finfo(start.dtype).eps
    tol = 64.0 * eps if tol is None else tol
    retract = retract if retract is not None else _same
    active = torch.arange(start.shape[0], device=start.device)
    point, at = start, function(start, active)
    _refuse_not_finite(at, torch.linalg.vector_norm(point, dim=-1) + radius)
    found, value = start.clone(), at.value.clone()
    n_iter, converged = torch.zeros_like(active), torch.zeros_like(active, dtype=torch.bool)
    every = steps_between_tests(start)
    ended = torch.zeros_like(converged)
    for iteration in range(1, max_iter + 1):
        newton = _step(at, radius)
        scale = at.value.abs().clamp(min=1.0)
        last = newton.convex & (newton.whole_gain <= tol * scale)
        size = torch.linalg.vector_norm(point, dim=-1)
        # a trust region of the size of rounding errors contains no lower point
        stuck = newton.length <= eps * size
        new = (last | stuck) & ~ended
        if every > 1 or bool(new.any()):
            # the last step is taken only if it is short, not along a flat direction
            short = last & (newton.length <= 1e-3 * size)
            ends = torch.where(short.unsqueeze(-1), retract(point + newton.step), point)
            near = newton.convex & (newton.whole_gain <= max(tol, 1e4 * eps) * scale)
            found[active] = torch.where(new.unsqueeze(-1), ends, found[active])
            value[active] = torch.where(new, at.value, value[active])
            n_iter[active] = torch.where(new, iteration, n_iter[active])
            converged[active] = torch.where(new, near, converged[active])
            ended = ended | new
        if iteration % every == 0 and (every > 1 or bool(new.any())):
            running = (~ended).nonzero().squeeze(-1)
            if running.numel() == 0:
                return Minima(found, value, n_iter, converged)
            ended = ended[running]
            active, point, radius, at = active[running], point[running], radius[running], at.select(running)
            newton = _Step(*(getattr(newton, f)[running] for f in ("step", "length", "gain", "whole_gain", "convex")))
        trial = retract(point + newton.step)
        there = function(trial, active)
        ratio = (at.value - there.value) / newton.gain
        accept = ~ended & (ratio > 1e-4) & torch.isfinite(there.gradient).all(-1)
        if every == 1 and bool(accept.all()):
            point, at = trial, there
        else:
            point, at = torch.where(accept.unsqueeze(-1), trial, point), at.moved(accept, there)
        kept = torch.where((ratio > 0.75) & (newton.length > 0.99 * radius), 2.0 * radius, radius)
        radius = torch.where(accept & (ratio > 0.25), kept, 0.25 * newton.length)
    found[active] = torch.where(ended.unsqueeze(-1), found[active], point)
    value[active] = torch.where(ended, value[active], at.value)
    n_iter[active] = torch.where(ended, n_iter[active], max_iter)
    return Minima(found, value, n_iter, converged)


def _refuse_not_finite(at: Quadratic, reach: Float[Tensor, " K"]) -> None:
    for name, value in (("size", reach), ("value", at.value), ("gradient", at.gradient), ("curvature", at.hessian)):
        wrong = ~torch.isfinite(value).reshape(len(value), -1).all(-1)
        if bool(wrong.any()):
            raise ValueError(
                f"The {name} of the minimised function is not finite at start {int(wrong.nonzero()[0])}: squares "
                "overflow or vanish. Rescale the data to values near 1, or choose another start."
            )


def _same(point: Tensor) -> Tensor:
    return point
