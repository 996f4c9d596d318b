"""S-regression: the coefficients whose residuals have the smallest M-scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._scale_search import ScaleMinimum, minimise_scale
from mkc_torch.linear.least_trimmed_squares import default_coverage
from mkc_torch.order_statistic import order_statistic

if TYPE_CHECKING:
    from jaxtyping import Float

BISQUARE_50 = 1.547645
"""Tukey's bisquare tuning constant for a breakdown point of 1/2 (robustbase, lmrob.control)."""


def bisquare_rho(u: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Tukey's bisquare ρ scaled to a maximum of 1, for u = residual / (c · scale)."""
    return 1.0 - (1.0 - u.square().clamp(max=1.0)).pow(3)


def bisquare_weight(u: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """ψ(u) / u of the bisquare, scaled to 1 at 0."""
    return (1.0 - u.square().clamp(max=1.0)).square()


@dataclass(frozen=True)
class MScale:
    """The scale s with mean ρ(r / (c s)) = (1 - p/N) / 2, by at most ``steps`` Newton iterations, and its weights."""

    steps: int
    c: float = BISQUARE_50

    def scale(self, problem: LinearProblem, residual: Tensor) -> Float[Tensor, "B S m"]:
        weight = problem.sample_weight
        w = None if weight is None else weight.unsqueeze(1)
        p = problem.coefficients_per_channel
        half = 0.5 * (problem.total_weight().unsqueeze(1) - p).clamp(min=1.0)
        # quantile rather than median, so that a fit through p values does not start at 0
        scale = 1.4826 * order_statistic(residual.abs(), w, default_coverage(problem))
        tiny = torch.finfo(residual.dtype).tiny
        for _ in range(self.steps):
            u = residual / (self.c * scale.clamp(min=tiny)).unsqueeze(-2)
            rho, slope = bisquare_rho(u), 6.0 * u.square().clamp(max=1.0) * bisquare_weight(u)
            if w is not None:
                rho, slope = w * rho, w * slope
            # Newton's method in log(scale), kept within a factor of two
            excess = rho.sum(-2) - half
            step = (excess / slope.sum(-2).clamp(min=tiny)).clamp(min=-0.7, max=0.7)
            scale = scale * torch.exp(torch.where(scale > 0, step, 0.0))
            if bool((step.abs() < 1e-13).all()):
                break
        return scale

    def weight(self, problem: LinearProblem, residual: Tensor, scale: Tensor) -> Float[Tensor, "B S N m"]:  # noqa: ARG002
        tiny = torch.finfo(residual.dtype).tiny
        return bisquare_weight(residual / (self.c * scale.clamp(min=tiny)).unsqueeze(-2))


def minimise_m_scale(problem: LinearProblem, *, starts: int = 500, max_iter: int = 500, seed: int = 0) -> ScaleMinimum:
    """S-regression with Tukey's bisquare on a checked problem."""
    return minimise_scale(problem, MScale(2), MScale(30), starts=starts, max_iter=max_iter, seed=seed)


class SRegression(LinearEstimator):
    """S-estimator of regression with Tukey's bisquare, breakdown point 1/2.

    The scale s solves mean ρ(r / (c s)) = 1/2 with N - p in the denominator, p = ceil(n / m); with m channels the
    product of the channels' scales is minimised.

    Args:
        starts: number of elemental starts.
        seed: of the elemental starts.

    Attributes, after ``fit``:
        coef_: (*, n).
        scale_: (*, m), m being 1 for one channel: the M-scale, consistent for Gaussian residuals.
        weights_: bisquare weights in [0, 1].
        n_iter_, converged_: steps made, and whether they had come to rest, (*,).

    References:
        Rousseeuw & Yohai, "Robust regression by means of S-estimators" (1984).
        Salibian-Barrera & Yohai, "A fast algorithm for S-regression estimates", JCGS 15 (2006) 414-427.

    Example:
        >>> X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
        >>> y = 1 + 2 * X[:, 1]
        >>> y[:4] = 100.0
        >>> SRegression().fit(X, y).coef_
        tensor([1.0000, 2.0000], dtype=torch.float64)
    """

    def __init__(self, *, starts: int = 500, seed: int = 0) -> None:
        super().__init__()
        if starts < 1:
            raise ValueError(f"Expected argument `starts` to be at least 1 but got {starts}.")
        self.starts = starts
        self.seed = seed

    def fit(self, X: Tensor, Y: Tensor, sample_weight: Tensor | None = None) -> SRegression:
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. A weight of 2 is a sample that occurs twice."""
        problem = linear_problem(X, Y, sample_weight)
        minimum = minimise_m_scale(problem, starts=self.starts, seed=self.seed)
        self._set_common(problem, minimum.beta, minimum.weight)
        self.scale_ = problem.restore(minimum.scale)
        self.n_iter_ = minimum.n_iter
        self.converged_ = problem.restore(minimum.converged)
        return self
