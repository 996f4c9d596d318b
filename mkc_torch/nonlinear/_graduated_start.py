"""A start that is robust to outliers: fits with kernels from many robust scales down to less than one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import order_statistic
from mkc_torch.nonlinear._constraints import descend_constrained
from mkc_torch.nonlinear._problem import Problem, ProblemPoint

if TYPE_CHECKING:
    from jaxtyping import Float

LEAST_SCALE = 0.3
"""Least d in robust scales. Outliers at most double a scale; the d of a fit that interpolates is far smaller."""

_KERNELS = (10.0, 4.0, 1.6, 0.7)
"""Successive kernel widths in robust scales: wide kernels have few local minima, narrow kernels ignore outliers."""


def residual_scale(problem: Problem, point: ProblemPoint) -> Float[Tensor, "B m"]:
    """Robust scale of each channel, and at least the rounding error of the residual.

    From the h-th smallest absolute residual, h = (N + p + 1) // 2 with p parameters a channel, since a narrow kernel
    can interpolate p of them. 1 + 5 / (N - p) is the small-sample factor of Rousseeuw & Leroy, Robust Regression and
    Outlier Detection (1987), p. 202, and N / (N - p) corrects for the degrees of freedom.
    """
    N, m = point.residual.shape[1:]
    p = math.ceil(point.theta.shape[-1] / m)
    left = max(N - p, 1)
    middle = order_statistic(point.residual.abs(), problem.weight, min((N + p + 1) // 2, N))
    scale = 1.4826 * (1.0 + 5.0 / left) * (N / left) * middle
    reach = torch.matmul(point.theta.abs().unsqueeze(-2), point.tangents.abs()).squeeze(-2)
    magnitude = torch.maximum(reach.unflatten(-1, (N, m)).amax(-2), point.residual.abs().amax(-2))
    eps = torch.finfo(scale.dtype).eps
    return torch.maximum(scale, 1e3 * eps * torch.where(magnitude > 0, magnitude, 1.0))


def graduated(problem: Problem, point: ProblemPoint, max_iter: int) -> tuple[ProblemPoint, int]:
    """Fit with kernels from many robust scales to less than one, and again while the scale shrinks."""
    n_iter = 0
    last: Tensor | None = None
    for stage in range(16):
        scale = residual_scale(problem, point)
        if last is not None and stage >= len(_KERNELS) and bool((scale > 0.8 * last).all()):
            break
        last = scale
        kernel = _KERNELS[min(stage, len(_KERNELS) - 1)] * scale
        found, _ = descend_constrained(
            problem, point, torch.ones_like(scale), kernel, max_iter=max_iter, tol=1e-3, exact=False
        )
        n_iter += found.n_iter
        point = problem.refreshed(found.point) if found.needs_refresh else found.point
    return point, n_iter
