"""M-estimation by iteratively reweighted least squares."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole
from mkc_torch._support.arrays import Data
from mkc_torch._support.order_statistic import order_statistic
from mkc_torch._support.side_by_side import steps_between_tests
from mkc_torch.linear._inference import RobustInference
from mkc_torch.linear._influence import m_scale_influence, scores
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._psi import TUNING_95, Psi, PsiName, Tuning, checked_tuning
from mkc_torch.linear._robust_start import checked_start, robust_start
from mkc_torch.linear._scale_search import relative_precision, rounding_scale
from mkc_torch.linear.covariance import RobustCovarianceKind
from mkc_torch.linear.least_absolute_deviations import LeastAbsoluteDeviations

if TYPE_CHECKING:
    from jaxtyping import Float

MScaleName = Literal["mad", "proposal2"]
MStart = Literal["lad", "lts", "s", "least_squares"]

MEDIAN_TO_SIGMA = 1.482602218505602
"""1 / Φ⁻¹(3/4): ratio of standard deviation to median absolute value of a Gaussian."""

_DAMPED_FROM = 30
"""Step from which a new scale is averaged geometrically with the last."""


def median_scale(problem: LinearProblem, residual: Float[Tensor, "B N m"]) -> Float[Tensor, "B m"]:
    """Median absolute residual, divided by that of a standard Gaussian; the mean of the middle two for even N."""
    size, half = residual.abs(), 0.5 * problem.num_samples
    low = order_statistic(size, problem.sample_weight, half)
    # just above one half, so that the upper of the middle two is taken for even N
    high = order_statistic(size, problem.sample_weight, min(half * (1.0 + 1e-6), problem.num_samples))
    return MEDIAN_TO_SIGMA * 0.5 * (low + high)


def proposal_2(
    problem: LinearProblem, residual: Float[Tensor, "B N m"], scale: Float[Tensor, "B m"], k: float
) -> Float[Tensor, "B m"]:
    """Make one step towards the scale s with ``Σ min(r / s, k)² = (N - p) E min(Z, k)²``, Huber's proposal 2."""
    square = torch.minimum(residual.square(), (k * scale).square().unsqueeze(-2))
    if problem.sample_weight is not None:
        square = square * problem.sample_weight
    inside = math.erf(k / math.sqrt(2.0))
    density = math.exp(-0.5 * k * k) / math.sqrt(2.0 * math.pi)
    expected = inside - 2.0 * k * density + k * k * (1.0 - inside)
    left = (problem.total_weight() - problem.coefficients_per_channel).clamp(min=1.0)
    return torch.sqrt(square.sum(-2) / (left * expected))


@dataclass(frozen=True)
class Reweighted:
    """Coefficients in the basis after the last step, their scale and weights, and the number of steps (B,)."""

    beta: Float[Tensor, "B n"]
    scale: Float[Tensor, "B m"]
    weight: Float[Tensor, "B N m"]
    n_iter: Tensor
    converged: Tensor


def reweight(
    problem: LinearProblem,
    beta: Float[Tensor, "B n"],
    scale: Float[Tensor, "B m"],
    weight_of: Callable[[Tensor], Tensor],
    next_scale: Callable[[Tensor, Tensor], Tensor] | None = None,
    *,
    max_iter: int,
    tol: float,
) -> Reweighted:
    """Iterate weighted least squares with the weights of the last residuals until the fitted values converge.

    Args:
        problem: the regression.
        beta: starting coefficients.
        scale: scale of their residuals; a scale of 0 is replaced by the rounding error of Y.
        weight_of: returns the weights of standardised residuals.
        next_scale: returns the scale from residuals and the last scale; None keeps the scale fixed.
        max_iter: largest number of steps.
        tol: converged when a step moves the fitted values by less than this share of the scale, in root mean square.
    """
    floor = rounding_scale(problem)
    scale = torch.maximum(scale, floor)
    eps = torch.finfo(beta.dtype).eps
    moving = torch.ones(beta.shape[0], dtype=torch.bool, device=beta.device)
    n_iter = torch.zeros(beta.shape[0], dtype=torch.long, device=beta.device)
    residual = problem.residual(beta)
    root = math.sqrt(problem.num_samples)
    every = steps_between_tests(beta)
    for step in range(max_iter):
        if next_scale is not None:
            proposal = torch.maximum(next_scale(residual, scale), floor)
            # a median may alternate between two values; their geometric mean ends the cycle
            proposal = proposal if step < _DAMPED_FROM else (proposal * scale).sqrt()
            scale = torch.where(moving.unsqueeze(-1), proposal, scale)
        weight = weight_of(residual / scale.unsqueeze(-2))
        updated = problem.weighted_fit(weight * relative_precision(scale).unsqueeze(-2))
        updated = torch.where(moving.unsqueeze(-1), updated, beta)
        change = torch.linalg.vector_norm(updated - beta, dim=-1)
        # the basis is orthonormal, so coefficients and fitted values have equal length
        rounding = 16 * eps * torch.linalg.vector_norm(updated, dim=-1)
        n_iter += moving
        beta = updated
        residual = problem.residual(beta)
        moving = moving & (change > torch.maximum(tol * root * scale.amin(-1), rounding))
        if (step + 1) % every == 0 and not bool(moving.any()):
            break
    return Reweighted(beta, scale, weight_of(residual / scale.unsqueeze(-2)), n_iter, ~moving)


def check_iterations(max_iter: int, tol: float) -> None:
    checked_whole("max_iter", max_iter, 1, "500 is ample")
    checked_number("tol", tol, 0.0, 1.0, advice="1e-10 suits float64")


class MEstimator(RobustInference):
    """M-estimator of regression: the coefficients with ``Σ ψ(r / scale) x = 0``, (18) of Indiveri (2009).

    Iteratively reweighted least squares; the scale is recomputed from the residuals before every step. With m channels
    each has its own scale. ψ of "huber" is monotone: outliers in Y have a bounded influence, outliers in X (leverage
    points) do not. The other four redescend to 0 and have several solutions; the solution near the start is found.
    Since the scale changes with the fit, leverage points can still move it away from a robust start.
    :class:`MMRegression` keeps its scale fixed, and thereby its breakdown point.

    Args:
        psi: "huber", "hampel", "tukey", "andrews" or "welsch", (13)-(16) of Indiveri (2009).
        tuning: constants of ψ in units of the scale: k; (a, b, c) of "hampel"; 1 / ω of "andrews". Default for
            95 % efficiency at Gaussian residuals: 1.345; (1.352, 3.156, 7.213); 4.685; 1.339; 2.985. Hampel's are
            those of R's robustbase; statsmodels' default (2, 4, 8) has efficiency 0.990.
        scale: "mad", 1.4826 times the median absolute residual (about 0), which needs N >= 2 p, p = ceil(n / m); or
            "proposal2", Huber's, which is smoother and breaks down earlier.
        start: "lad", "lts", "s", "least_squares" or coefficients (*, n); default "lad" for "huber", else "lts".
        max_iter: largest number of steps.
        tol: converged when a step moves the fitted values by less than this share of the scale, in root mean square.
        covariance: "sandwich" for independent samples, "hac" for a time series, "homoscedastic" where errors have the
            same distribution at every X and no outlier lies far out in X. A "mad" scale is treated as known, which is
            valid for symmetric errors; the error of a "proposal2" scale is included.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        seed: seed of the starts "lts" and "s".

    Attributes, after ``fit``:
        coef_, covariance_, dof_: (*, n), (*, n, n), (*,); differentiable by X and Y, as is ``scale_``.
        scale_: (*, m), m being 1 for one channel; for an exact fit the rounding error of Y.
        weights_: ψ(z) / z, 1 at z = 0, (*, N, m).
        n_iter_, converged_: number of steps, and whether they converged, (*,).

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        Indiveri, "An entropy-like estimator for robust parameter identification", Entropy 11 (2009), (11)-(21).
        Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics 35 (1964), proposal 2.
        Holland & Welsch, "Robust regression using iteratively reweighted least-squares" (1977), tuning constants.

    Example:
        >>> X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
        >>> y = 1 + 2 * X[:, 1]
        >>> y[:4] = 100.0
        >>> MEstimator("tukey").fit(X, y).coef_
        tensor([1.0000, 2.0000], dtype=torch.float64)
    """

    scale_: Float[Tensor, "*batch m"]
    n_iter_: Tensor
    converged_: Tensor

    def __init__(
        self,
        psi: PsiName = "huber",
        tuning: float | Tuning | None = None,
        *,
        scale: MScaleName = "mad",
        start: MStart | Tensor | None = None,
        max_iter: int = 500,
        tol: float = 1e-10,
        covariance: RobustCovarianceKind = "sandwich",
        bandwidth: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        checked_tuning(psi, tuning)
        if scale not in get_args(MScaleName):
            raise ValueError(f"Expected argument `scale` to be 'mad' or 'proposal2' but got {scale!r}.")
        if start is not None:
            checked_start(start, get_args(MStart), ", or None,")
        check_iterations(max_iter, tol)
        self.psi = psi
        self.tuning = tuning
        self.scale = scale
        self.start = start
        self.max_iter = max_iter
        self.tol = tol
        self._set_covariance(covariance, bandwidth)
        self.seed = checked_whole("seed", seed)

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> MEstimator:
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. A weight of 2 is a sample that occurs twice.

        Raises:
            ValueError: fewer than 2 p samples for "mad", a start of the wrong shape, or bad input as in
                :meth:`LeastSquares.fit`.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        name, tuning = checked_tuning(self.psi, self.tuning)
        problem = linear_problem(X, Y, sample_weight)
        p, N = problem.coefficients_per_channel, _fewest_samples(problem)
        if self.scale == "mad" and 2 * p > N:
            raise ValueError(
                f"Expected at least {2 * p} samples for `scale='mad'` with {p} coefficients a channel but got {N}: "
                "fewer may have a median residual of 0; use scale='proposal2'."
            )
        beta = self._start(problem, X, Y, sample_weight)
        clip = tuning[0] if name == "huber" else TUNING_95["huber"][0]

        psi = Psi(name, tuning)
        first = median_scale(problem, problem.residual(beta))
        exact = first <= rounding_scale(problem)

        def next_scale(residual: Tensor, scale: Tensor) -> Tensor:
            if self.scale == "proposal2":
                return proposal_2(problem, residual, scale, clip)
            # an exact fit of most values is kept; a scale of rounding errors would lose it
            return torch.where(exact, 0.0, median_scale(problem, residual))

        found = reweight(problem, beta, first, psi.weight, next_scale, max_iter=self.max_iter, tol=self.tol)
        self._set_common(problem, found.beta, found.weight)
        self.scale_ = problem.restore(found.scale)
        equation = scores(problem, found.beta, found.scale, psi)
        of_scale = None
        if self.scale == "proposal2":
            inside = equation.z.abs() < clip
            square = equation.z.square()
            slope = 2.0 * equation.z * inside
            of_scale = m_scale_influence(problem, square.clamp(max=clip * clip), slope, equation.z, found.scale)
        self._infer(problem, found.beta, found.weight, equation, psi.ratio(), of_scale=of_scale)
        self.n_iter_ = problem.restore(found.n_iter)
        self.converged_ = problem.restore(found.converged)
        return self

    def _start(self, problem: LinearProblem, X: Tensor, Y: Tensor, sample_weight: Tensor | None) -> Tensor:
        start = self.start if self.start is not None else ("lad" if self.psi == "huber" else "lts")
        if isinstance(start, str) and start == "lad":
            return problem.in_basis(LeastAbsoluteDeviations().fit(X, Y, sample_weight).coef_)
        return robust_start(problem, start, seed=self.seed).beta


def _fewest_samples(problem: LinearProblem) -> int:
    """Smallest number of samples of positive weight in a channel."""
    if problem.sample_weight is None:
        return problem.num_samples
    return int((problem.sample_weight > 0).sum(-2).min())
