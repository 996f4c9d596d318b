"""S-regression: the coefficients whose residuals have the smallest M-scale."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole
from mkc_torch._support.arrays import Data
from mkc_torch._support.order_statistic import order_statistic
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._psi import BISQUARE_50, bisquare_for_breakdown, bisquare_rho, bisquare_weight
from mkc_torch.linear._scale_search import ScaleMinimum, minimise_scale

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class MScale:
    """The scale s with mean ρ(r / (c s)) = b (1 - p/N), by at most ``steps`` Newton iterations, and its weights.

    b is the breakdown point and c the constant that makes s consistent for Gaussian residuals.
    """

    steps: int
    c: float = BISQUARE_50
    breakdown: float = 0.5

    def scale(self, problem: LinearProblem, residual: Tensor) -> Float[Tensor, "B S m"]:
        weight = problem.sample_weight
        w = None if weight is None else weight.unsqueeze(1)
        p = problem.coefficients_per_channel
        N = problem.num_samples
        target = self.breakdown * (problem.total_weight().unsqueeze(1) - p).clamp(min=1.0)
        # the quantile that is 0 just where s is, so that a fit through p values does not start at 0
        rank = min(N, math.ceil(N - self.breakdown * max(N - p, 0) - 1e-9))
        scale = 1.4826 * order_statistic(residual.abs(), w, rank)
        tiny = torch.finfo(residual.dtype).tiny
        for _ in range(self.steps):
            u = residual / (self.c * scale.clamp(min=tiny)).unsqueeze(-2)
            rho, slope = bisquare_rho(u), 6.0 * u.square().clamp(max=1.0) * bisquare_weight(u)
            if w is not None:
                rho, slope = w * rho, w * slope
            # Newton's method in log(scale), kept within a factor of two
            excess = rho.sum(-2) - target
            step = (excess / slope.sum(-2).clamp(min=tiny)).clamp(min=-0.7, max=0.7)
            scale = scale * torch.exp(torch.where(scale > 0, step, 0.0))
            if bool((step.abs() < 1e-13).all()):
                break
        return scale

    def weighed(self, problem: LinearProblem, residual: Tensor) -> tuple[Float[Tensor, "B S m"], Tensor]:
        scale = self.scale(problem, residual)
        tiny = torch.finfo(residual.dtype).tiny
        return scale, bisquare_weight(residual / (self.c * scale.clamp(min=tiny)).unsqueeze(-2))


def minimise_m_scale(
    problem: LinearProblem, *, breakdown: float = 0.5, starts: int = 500, max_iter: int = 500, seed: int = 0
) -> ScaleMinimum:
    """S-regression with Tukey's bisquare on a checked problem."""
    c = BISQUARE_50 if breakdown == 0.5 else bisquare_for_breakdown(breakdown)
    screening, final = MScale(2, c, breakdown), MScale(30, c, breakdown)
    return minimise_scale(problem, screening, final, starts=starts, max_iter=max_iter, seed=seed)


def check_breakdown(breakdown: float) -> None:
    checked_number("breakdown", breakdown, 0.01, 0.5, "[]", "0.5 withstands most")


def check_starts(starts: int) -> None:
    checked_whole("starts", starts, 1, "500 is usual")


class SRegression(LinearEstimator):
    """S-estimator of regression with Tukey's bisquare.

    The scale s solves mean ρ(r / (c s)) = breakdown with N - p in the denominator, p = ceil(n / m); with m channels the
    product of the channels' scales is minimised.

    Starts go through n values each, and one through clean values is enough: at a share ε of outliers ``starts`` of them
    miss with probability ``(1 - (1 - ε)^n)^starts``, which is 1e-6 at ε = 0.45 and 4e-4 at 0.5 for the default and
    n = 6. Take more for more coefficients.

    Args:
        breakdown: share of outliers the estimator withstands, 0.01 to 0.5. At Gaussian residuals 0.5 has efficiency
            0.287, 0.25 has 0.759; :class:`MMRegression` has both.
        starts: number of elemental starts.
        seed: of the elemental starts.

    Attributes, after ``fit``:
        coef_: (*, n).
        scale_: (*, m), m being 1 for one channel: the M-scale, consistent for Gaussian residuals.
        weights_: bisquare weights in [0, 1], (*, N, m).
        n_iter_, converged_: steps made, and whether they had come to rest, (*,).

    Raises:
        TypeError, ValueError: an argument of another kind, or out of range.

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

    scale_: Float[Tensor, "*batch m"]
    n_iter_: int
    converged_: Tensor

    def __init__(self, *, breakdown: float = 0.5, starts: int = 500, seed: int = 0) -> None:
        super().__init__()
        check_breakdown(breakdown)
        check_starts(starts)
        self.breakdown = breakdown
        self.starts = starts
        self.seed = checked_whole("seed", seed)

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> SRegression:
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. A weight of 2 is a sample that occurs twice."""
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        problem = linear_problem(X, Y, sample_weight)
        minimum = minimise_m_scale(problem, breakdown=self.breakdown, starts=self.starts, seed=self.seed)
        self._set_common(problem, minimum.beta, minimum.weight)
        self.scale_ = problem.restore(minimum.scale)
        self.n_iter_ = minimum.n_iter
        self.converged_ = problem.restore(minimum.converged)
        return self
