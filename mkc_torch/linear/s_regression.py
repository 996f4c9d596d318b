"""S-regression: coefficients whose residuals have the smallest M-scale."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole
from mkc_torch._support.arrays import Data
from mkc_torch._support.order_statistic import order_statistic
from mkc_torch._support.side_by_side import steps_between_tests
from mkc_torch._support.small_factors import symmetric_pinv
from mkc_torch.linear._concentration import M_SCALE, ScaleOptions
from mkc_torch.linear._inference import RobustInference
from mkc_torch.linear._influence import (
    ScaleInfluence,
    Scores,
    coefficients_a_value,
    m_scale_influence,
    scores,
    summed,
    weighted,
)
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._psi import BISQUARE_50, Psi, bisquare_for_breakdown, bisquare_rho, tukey_weight
from mkc_torch.linear._scale_search import ScaleMinimum, ScaleSearch, descend, minimise_scale, rounding_scale
from mkc_torch.linear.covariance import RobustCovarianceKind

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class MScale:
    """Scale s with mean ρ(r / (c s)) = b (1 - p/N), by at most ``steps`` Newton iterations, and its weights.

    b is the breakdown point and c the constant that makes s consistent for Gaussian residuals.
    """

    steps: int
    c: float = BISQUARE_50
    breakdown: float = 0.5

    def options(self, problem: LinearProblem) -> ScaleOptions:
        return ScaleOptions(
            M_SCALE,
            self._first_rank(problem),
            self.c,
            self.breakdown,
            problem.coefficients_per_channel,
            self.steps,
            self.steps >= _EXACT,
        )

    def scale(self, problem: LinearProblem, residual: Tensor, near: Tensor | None = None) -> Float[Tensor, "B S m"]:
        return self._solved(problem, residual, residual.square() if self.steps else residual, near)

    def weighted(
        self, problem: LinearProblem, residual: Tensor, near: Tensor | None = None
    ) -> tuple[Float[Tensor, "B S m"], Tensor]:
        square = residual.square()
        scale = self._solved(problem, residual, square, near)
        return scale, self._inner(square, scale).square()

    def _first(self, problem: LinearProblem, residual: Tensor) -> Float[Tensor, "B S m"]:
        """First guess of the scale: a quantile that is 0 exactly where s is 0; it is not for a fit through p values."""
        w = None if problem.sample_weight is None else problem.sample_weight.unsqueeze(1)
        return 1.4826 * order_statistic(residual.abs(), w, self._first_rank(problem))

    def _first_rank(self, problem: LinearProblem) -> int:
        N, p = problem.num_samples, problem.coefficients_per_channel
        return min(N, math.ceil(N - self.breakdown * max(N - p, 0) - 1e-9))

    def _inner(self, square: Tensor, scale: Tensor) -> Float[Tensor, "B S N m"]:
        """``max(1 - (r / (c s))², 0)``: its square is the weight, its cube 1 - ρ."""
        # the square of the smallest size still has an inverse
        size = self.c * scale.clamp(min=torch.finfo(scale.dtype).tiny ** 0.5)
        return torch.mul(square, -size.pow(-2).unsqueeze(-2)).add_(1.0).clamp_(min=0.0)

    def _solved(
        self, problem: LinearProblem, residual: Tensor, square: Tensor, near: Tensor | None
    ) -> Float[Tensor, "B S m"]:
        w = None if problem.sample_weight is None else problem.sample_weight.unsqueeze(1)
        total = problem.total_weight().unsqueeze(1)
        target = self.breakdown * (total - problem.coefficients_per_channel).clamp(min=1.0)
        tiny = torch.finfo(residual.dtype).tiny
        scale = self._first(problem, residual) if near is None else near
        # off the CPU a test waits for the device, and steps from a near guess need none
        every = steps_between_tests(residual)
        steps = self.steps if near is None or every == 1 else min(self.steps, _FROM_NEAR)
        for step_number in range(steps):
            inner = self._inner(square, scale)
            second = inner.square()
            third = inner * second
            if w is not None:
                second, third = w * second, w * third
            outside = third.sum(-2)
            slope = 6.0 * (second.sum(-2) - outside)
            # Newton's method in log(scale), limited to a factor of two
            step = ((total - outside - target) / slope.clamp(min=tiny)).clamp(min=-0.7, max=0.7)
            scale = scale * torch.exp(torch.where(scale > 0, step, 0.0))
            # the next error is about the square of this step
            if (
                (step_number + 1) % every == 0
                and steps > _FROM_NEAR
                and bool((step.abs() < 0.5 * torch.finfo(step.dtype).eps ** 0.5).all())
            ):
                return scale
        # a scale that collapsed is solved again without the first guess
        return scale if near is None or steps < _EXACT else self._solved(problem, residual, square, None)


_FROM_NEAR = 8
"""Newton steps from a near guess off the CPU, each of which doubles the correct digits."""

_EXACT = 30
"""Newton steps that solve for the scale to rounding."""

_RANKED = 3
"""Largest number of coefficients at which the starts are ranked without a step, by the first guess of the scale."""

_SCREENING = 2
"""Newton steps for the scale of each start in the screening."""

_SCREENING_RANKED = 1
"""The same if the starts were ranked before."""

_CANDIDATES = 10
"""Number of candidates after the screening."""

_NARROWING = ((4, 5), (8, 2))
"""Pairs of a number of further steps and the number of candidates kept after them."""

_NARROWING_RANKED = ((3, 4), (5, 2))
"""The same if the starts were ranked before."""

_NEAR = 1e-7
"""Decrease of the log scale below which concentration steps end and Newton steps follow."""

_MISSED = 1e-9
"""Probability that all starts miss at 50 % outliers; no more starts are drawn than reach it."""


def starts_worth_drawing(starts: int, num_coefficients: int) -> int:
    """Smaller of ``starts`` and the number of starts that reach :data:`_MISSED`."""
    return min(starts, math.ceil(math.log(_MISSED) / math.log1p(-(0.5**num_coefficients))))


def minimise_m_scale(
    problem: LinearProblem, *, breakdown: float = 0.5, starts: int = 500, max_iter: int = 500, seed: int = 0
) -> ScaleMinimum:
    """S-regression with Tukey's bisquare on a checked problem; the result has the derivatives of the minimum."""
    c = bisquare_of(breakdown)
    final = MScale(_EXACT, c, breakdown)
    ranked = problem.num_coefficients <= _RANKED
    search = ScaleSearch(
        MScale(_SCREENING_RANKED if ranked else _SCREENING, c, breakdown),
        final,
        starts=starts_worth_drawing(starts, problem.num_coefficients),
        ranking=MScale(0, c, breakdown) if ranked else None,
        candidates=_CANDIDATES,
        narrowing=_NARROWING_RANKED if ranked else _NARROWING,
        tolerance=_NEAR,
        max_iter=max_iter,
        seed=seed,
    )
    with torch.no_grad():
        found = _polish_until_converged(problem, minimise_scale(problem, search), search)
    if not (problem.basis.requires_grad or problem.Y.requires_grad):
        return found
    # a Newton step from the solution has the derivative of the solution
    along = final.scale(problem, problem.residual(found.beta).unsqueeze(1), found.scale.unsqueeze(1)).squeeze(1)
    beta = found.beta - _newton_step(problem, found.beta, along, c)
    scale, weight = final.weighted(problem, problem.residual(beta).unsqueeze(1), found.scale.unsqueeze(1))
    return replace(found, beta=beta, scale=scale.squeeze(1), weight=weight.squeeze(1))


def _polish_until_converged(problem: LinearProblem, found: ScaleMinimum, search: ScaleSearch) -> ScaleMinimum:
    """Polish by Newton steps; where they do not converge, alternate with concentration steps and Newton steps."""
    rule = search.final
    assert isinstance(rule, MScale)
    found, moved = _polished(problem, found, rule)
    # a minimum moves by less than rounding changes the gradient
    at_most = 1e2 * torch.finfo(moved.dtype).eps ** 0.5
    index = (~(moved < at_most)).nonzero().squeeze(-1)
    left = search.max_iter
    while index.numel() > 0 and left > 0:
        some = problem.select(index)
        more = descend(some, found.beta[index], replace(search, tolerance=0.0, max_iter=min(_BETWEEN, left)))
        more, moved = _polished(some, more, rule)
        converged = more.converged | (moved < at_most)
        found = ScaleMinimum(
            found.beta.index_copy(0, index, more.beta),
            found.scale.index_copy(0, index, more.scale),
            found.weight.index_copy(0, index, more.weight),
            found.n_iter + more.n_iter,
            found.converged.index_copy(0, index, converged),
        )
        index, left = index[~converged], left - _BETWEEN
    return found


_BETWEEN = 40
"""Concentration steps before Newton steps are tried again."""


def _polished(problem: LinearProblem, found: ScaleMinimum, rule: MScale) -> tuple[ScaleMinimum, Float[Tensor, " B"]]:
    """Newton steps from near the minimum, each of which doubles the correct digits, and the length of the last step.

    The length is the root mean square change of the fitted values in scales; infinite where it is too long.
    """
    moved = found.beta.new_full(found.beta.shape[:1], math.inf)
    for _ in range(_POLISH):
        step = _newton_step(problem, found.beta, found.scale, rule.c)
        beta = found.beta - step
        scale, weight = rule.weighted(problem, problem.residual(beta).unsqueeze(1), found.scale.unsqueeze(1))
        scale, weight = scale.squeeze(1), weight.squeeze(1)
        tiny = torch.finfo(beta.dtype).tiny
        rise = (scale.clamp(min=tiny) / found.scale.clamp(min=tiny)).log().sum(-1)
        length = torch.linalg.vector_norm(step, dim=-1) / (problem.num_samples**0.5 * found.scale.amin(-1))
        short = length < _LONGEST
        # near convergence a rise of the scale is rounding
        moved = torch.where(short, length, torch.inf)
        better = ((rise <= 16 * torch.finfo(beta.dtype).eps) & short).unsqueeze(-1)
        found = replace(
            found,
            beta=torch.where(better, beta, found.beta),
            scale=torch.where(better, scale, found.scale),
            weight=torch.where(better.unsqueeze(-1), weight, found.weight),
        )
    return found, moved


_POLISH = 3
"""Newton steps after the search, which ends with a quarter of the digits."""

_LONGEST = 1e-2
"""Longest Newton step, in scales: from further away it may lead to a saddle point."""


def bisquare_of(breakdown: float) -> float:
    """Tuning constant of the bisquare whose scale has this breakdown point."""
    return BISQUARE_50 if breakdown == 0.5 else bisquare_for_breakdown(breakdown)


def _newton_step(problem: LinearProblem, beta: Tensor, scale: Tensor, c: float) -> Float[Tensor, "B n"]:
    """Newton step for the sum of the log scales; its Hessian is a constant to derivatives.

    At the minimum the step is 0, and its derivative by the data is minus that of the minimum.
    """
    at = scores(problem, beta, torch.maximum(scale, rounding_scale(problem)), Psi("tukey", (c,)))
    w = weighted(problem, torch.ones_like(at.z))
    weight = w / at.scale.unsqueeze(-2)
    slope_sum = (w * at.psi * at.z).sum(-2).clamp(min=torch.finfo(beta.dtype).eps)
    first = summed(problem, weight * at.psi) / slope_sum.unsqueeze(-1)
    with torch.no_grad():
        product_slope = at.slope * at.z + at.psi
        cross = summed(problem, weight * product_slope).unsqueeze(-1) * (first / slope_sum.unsqueeze(-1)).unsqueeze(-2)
        own = (
            ((w * product_slope * at.z).sum(-2) / slope_sum)[..., None, None]
            * first.unsqueeze(-1)
            * first.unsqueeze(-2)
        )
        curved = problem.normal_equations(at.slope / (at.scale.square() * slope_sum).unsqueeze(-2))[0]
        inverse = symmetric_pinv(curved + (own - cross - cross.mT).sum(1))
    return -torch.matmul(inverse, first.sum(1).unsqueeze(-1)).squeeze(-1)


def m_scale_equation(
    problem: LinearProblem, beta: Float[Tensor, "B n"], scale: Float[Tensor, "B m"], breakdown: float
) -> tuple[Scores, ScaleInfluence]:
    """Estimating equation of an S-estimate, and the influence on its scales, which are at their minimum."""
    c = bisquare_of(breakdown)
    at = scores(problem, beta, torch.maximum(scale, rounding_scale(problem)), Psi("tukey", (c,)))
    u = at.z / c
    return at, m_scale_influence(problem, bisquare_rho(u), 6.0 * u * tukey_weight(u, 1.0) / c, at.z)


def checked_breakdown(breakdown: float) -> float:
    """Return ``breakdown`` if it is valid, else raise."""
    return checked_number("breakdown", breakdown, 0.01, 0.5, "[]", "0.5 withstands most outliers")


def checked_starts(starts: int) -> int:
    """Return ``starts`` if it is valid, else raise."""
    return checked_whole("starts", starts, 1, "500 is usual")


_SMALL_SAMPLE = 12.0
"""Standard errors grow by this times the breakdown point times n / N.

The fit was chosen to make its residuals small. From Gaussian draws of 2, 4 and 8 coefficients with 10 to 80 samples
each at a breakdown point of 1/2. Their errors are 2.2, 1.5, 1.2 and 1.07 times the large-sample values.
"""


class SRegression(RobustInference):
    """S-estimator of regression with Tukey's bisquare.

    The scale s solves mean ρ(r / (c s)) = breakdown with N - p in the denominator, p = ceil(n / m); with m channels the
    product of the channels' scales is minimised.

    Each start is a fit through n values, and one start through clean values is enough. At a share ε of outliers all
    ``starts`` miss with probability ``(1 - (1 - ε)^n)^starts``, which is 1e-6 at ε = 0.45 and 4e-4 at 0.5 for the
    default and n = 6. Take more starts for more coefficients. For few coefficients only so many are drawn that the
    probability of missing is 1e-9 at ε = 0.5: 73 for n = 2 and 156 for n = 3.

    Args:
        breakdown: share of outliers that the estimator withstands, 0.01 to 0.5. Efficiency at Gaussian residuals is
            0.287 for 0.5 and 0.759 for 0.25; :class:`MMRegression` has both high breakdown and high efficiency.
        starts: largest number of elemental starts.
        covariance: "sandwich" for independent samples, "hac" for a time series, "homoscedastic" where errors have the
            same distribution at every X and no outlier lies far out in X.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        seed: seed of the elemental starts.

    Attributes, after ``fit``:
        coef_, covariance_, dof_: (*, n), (*, n, n), (*,); differentiable by X and Y, as is ``scale_``.
        scale_: (*, m), m being 1 for one channel: the M-scale, consistent for Gaussian residuals.
        weights_: bisquare weights in [0, 1], (*, N, m).
        n_iter_, converged_: number of steps, and whether they converged, (*,).

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

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
        self.breakdown = checked_breakdown(breakdown)
        self.starts = checked_starts(starts)
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
        ratio = Psi("tukey", (bisquare_of(self.breakdown),)).ratio()
        wider = 1.0 + _SMALL_SAMPLE * self.breakdown * coefficients_a_value(problem)
        self._infer(problem, minimum.beta, minimum.weight, equation, ratio, of_scale=of_scale, widening=wider)
        self.n_iter_ = minimum.n_iter
        self.converged_ = problem.restore(minimum.converged)
        return self
