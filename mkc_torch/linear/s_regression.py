"""S-regression: the coefficients whose residuals have the smallest M-scale."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole
from mkc_torch._support.arrays import Data
from mkc_torch._support.order_statistic import order_statistic
from mkc_torch.linear._inference import RobustInference
from mkc_torch.linear._influence import (
    ScaleInfluence,
    Scores,
    coefficients_a_value,
    influence,
    m_scale_influence,
    scores,
    weighed,
)
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._psi import BISQUARE_50, Psi, bisquare_for_breakdown, bisquare_rho, bisquare_weight
from mkc_torch.linear._scale_search import ScaleMinimum, minimise_scale, rounding_scale
from mkc_torch.linear.covariance import RobustCovarianceKind

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
    """S-regression with Tukey's bisquare on a checked problem; the result has the derivatives of the minimum."""
    c = bisquare_of(breakdown)
    screening, final = MScale(2, c, breakdown), MScale(30, c, breakdown)
    with torch.no_grad():
        found = minimise_scale(problem, screening, final, starts=starts, max_iter=max_iter, seed=seed)
        found = _polished(problem, found, final)
    if not (problem.basis.requires_grad or problem.Y.requires_grad):
        return found
    along = final.scale(problem, problem.residual(found.beta).unsqueeze(1)).squeeze(1)
    beta = found.beta - _newton_step(problem, found.beta, along, c)
    scale, weight = final.weighed(problem, problem.residual(beta).unsqueeze(1))
    return replace(found, beta=beta, scale=scale.squeeze(1), weight=weight.squeeze(1))


def _polished(problem: LinearProblem, found: ScaleMinimum, rule: MScale) -> ScaleMinimum:
    """Newton's steps from where steps that lower the scale no longer do: they halve the digits that are wrong."""
    for _ in range(_POLISH):
        step = _newton_step(problem, found.beta, found.scale, rule.c)
        beta = found.beta - step
        scale, weight = rule.weighed(problem, problem.residual(beta).unsqueeze(1))
        scale, weight = scale.squeeze(1), weight.squeeze(1)
        tiny = torch.finfo(beta.dtype).tiny
        rise = (scale.clamp(min=tiny) / found.scale.clamp(min=tiny)).log().sum(-1)
        short = torch.linalg.vector_norm(step, dim=-1) < 1e-3 * problem.num_samples**0.5 * found.scale.amin(-1)
        better = ((rise <= 16 * torch.finfo(beta.dtype).eps) & short).unsqueeze(-1)
        found = replace(
            found,
            beta=torch.where(better, beta, found.beta),
            scale=torch.where(better, scale, found.scale),
            weight=torch.where(better.unsqueeze(-1), weight, found.weight),
        )
    return found


_POLISH = 2
"""Newton's steps after the search, which ends at half of the digits."""


def bisquare_of(breakdown: float) -> float:
    """The constant of the bisquare whose scale has this breakdown point."""
    return BISQUARE_50 if breakdown == 0.5 else bisquare_for_breakdown(breakdown)


def _newton_step(problem: LinearProblem, beta: Tensor, scale: Tensor, c: float) -> Float[Tensor, "B n"]:
    """Newton's step of the summed logarithms of the scales, whose Hessian is a constant to derivatives.

    At the minimum it is 0, and its derivative by the data is minus that of the minimum.
    """
    at = scores(problem, beta, torch.maximum(scale, rounding_scale(problem)), Psi("tukey", (c,)))
    w = weighed(problem, torch.ones_like(at.z))
    basis = problem.basis.expand(beta.shape[0], -1, -1, -1)

    def summed(values: Tensor) -> Float[Tensor, "B m n"]:
        return torch.einsum("bkc,bkcn->bcn", w * values / at.scale.unsqueeze(-2), basis)

    pull = (w * at.psi * at.z).sum(-2).clamp(min=torch.finfo(beta.dtype).eps)
    first = summed(at.psi) / pull.unsqueeze(-1)
    with torch.no_grad():
        bend = at.slope * at.z + at.psi
        cross = summed(bend).unsqueeze(-1) * (first / pull.unsqueeze(-1)).unsqueeze(-2)
        own = ((w * bend * at.z).sum(-2) / pull)[..., None, None] * first.unsqueeze(-1) * first.unsqueeze(-2)
        curved = problem.normal_equations(at.slope / (at.scale.square() * pull).unsqueeze(-2))[0]
        inverse = torch.linalg.pinv(curved + (own - cross - cross.mT).sum(1), hermitian=True)
    return -torch.matmul(inverse, first.sum(1).unsqueeze(-1)).squeeze(-1)


def m_scale_equation(
    problem: LinearProblem, beta: Float[Tensor, "B n"], scale: Float[Tensor, "B m"], breakdown: float
) -> tuple[Scores, ScaleInfluence]:
    """The estimating equation of an S-estimate, and what moves its scales, which are at their least."""
    c = bisquare_of(breakdown)
    at = scores(problem, beta, torch.maximum(scale, rounding_scale(problem)), Psi("tukey", (c,)))
    u = at.z / c
    return at, m_scale_influence(problem, bisquare_rho(u), 6.0 * u * bisquare_weight(u) / c, at.z)


def check_breakdown(breakdown: float) -> None:
    checked_number("breakdown", breakdown, 0.01, 0.5, "[]", "0.5 withstands most")


def check_starts(starts: int) -> None:
    checked_whole("starts", starts, 1, "500 is usual")


_SMALL_SAMPLE = 12.0
"""Standard errors grow by this times the breakdown point times the coefficients a value.

The fit was chosen to make its residuals small. From Gaussian draws of 2, 4 and 8 coefficients with 10 to 80 samples
each at a breakdown point of 1/2, whose errors are 2.2, 1.5, 1.2 and 1.07 times what large samples let expect.
"""


class SRegression(RobustInference):
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
        covariance: "sandwich" for independent samples, "hac" for a time series, "homoscedastic" where errors are alike
            at every X and no outlier lies far out in X.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        seed: of the elemental starts.

    Attributes, after ``fit``:
        coef_, covariance_, dof_: (*, n), (*, n, n), (*,); they and ``scale_`` have derivatives by X and Y.
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

    def __init__(
        self,
        *,
        breakdown: float = 0.5,
        starts: int = 500,
        covariance: RobustCovarianceKind = "sandwich",
        bandwidth: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_breakdown(breakdown)
        check_starts(starts)
        self.breakdown = breakdown
        self.starts = starts
        self._set_covariance(covariance, bandwidth)
        self.seed = checked_whole("seed", seed)

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> SRegression:
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. A weight of 2 is a sample that occurs twice."""
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        problem = linear_problem(X, Y, sample_weight)
        minimum = minimise_m_scale(problem, breakdown=self.breakdown, starts=self.starts, seed=self.seed)
        self._set_common(problem, minimum.beta, minimum.weight)
        self.scale_ = problem.restore(minimum.scale)
        equation, of_scale = m_scale_equation(problem, minimum.beta, minimum.scale, self.breakdown)
        self._infer(
            problem,
            minimum.beta,
            minimum.weight,
            equation,
            lambda share: influence(problem, equation, of_scale, share),
            Psi("tukey", (bisquare_of(self.breakdown),)).ratio(),
            1.0 + _SMALL_SAMPLE * self.breakdown * coefficients_a_value(problem),
        )
        self.n_iter_ = minimum.n_iter
        self.converged_ = problem.restore(minimum.converged)
        return self
