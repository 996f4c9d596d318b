"""Reweighted least squares: least squares on the samples that a robust fit does not reject."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole, format_value
from mkc_torch._support.arrays import Data
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._inference import RobustInference
from mkc_torch.linear._influence import Scores, coefficients_a_value, influence
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._robust_start import residual_scale
from mkc_torch.linear._scale_search import relative_precision, rounding_scale
from mkc_torch.linear.covariance import RobustCovarianceKind
from mkc_torch.linear.least_median_of_squares import LeastMedianOfSquares
from mkc_torch.linear.least_trimmed_squares import LeastTrimmedSquares, default_coverage, trimmed_equation
from mkc_torch.linear.s_regression import SRegression, checked_starts, m_scale_equation

if TYPE_CHECKING:
    from jaxtyping import Float

_STARTS: dict[str, Callable[..., LinearEstimator]] = {
    "lts": LeastTrimmedSquares,
    "lms": LeastMedianOfSquares,
    "s": SRegression,
}


class ReweightedLeastSquares(RobustInference):
    """Least squares with weights 0 and 1 from the residuals of a robust fit, rejected in two rounds, (26)-(29).

    Values beyond ``threshold`` times a first scale are excluded from the second scale, and values beyond ``threshold``
    times the second scale are excluded from the fit. The breakdown point is that of the start, and the precision is
    that of least squares on the values kept. With m channels each has its own scale and is weighted by it.

    The first scale is that of the h-th smallest residual, h = (N + p + 1) // 2, with small-sample factors (p. 202 of
    Rousseeuw & Leroy). The paper's example is the median absolute deviation. After a fit that has minimised it, it is
    so small that inliers are rejected at N = 21.

    Args:
        start: robust fit of the first residuals: "lts", "lms", "s", or an estimator of this package.
        threshold: number of scales beyond which a residual is rejected, at least 1.
        starts: number of random starts of "lts", "lms" and "s"; None takes their defaults.
        covariance: "sandwich" for independent samples, "hac" for a time series, "homoscedastic" where errors have the
            same distribution at every X and no outlier lies far out in X.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        seed: seed of the random starts.

    Attributes, after ``fit``:
        coef_: (*, n); its gradient is that of least squares on the values kept.
        scale_: (*, m), m being 1 for one channel: (27) of the values kept, corrected for degrees of freedom.
        covariance_, dof_: (*, n, n), (*,); includes the error that "lts" or "s" passes on (He & Portnoy, "Reweighted
            LS estimators converge at the same rate as the initial estimator", Annals of Statistics 20 (1992), for
            Gaussian inliers); the error of other starts is unknown and not included.
        weights_: 1 for the values kept, 0 for the values rejected, (*, N, m).
        start_: the robust fit.

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        Rousseeuw & Leroy, Robust Regression and Outlier Detection (1987), pp. 44-45 and 202 (the first scale).
        Indiveri, "An entropy-like estimator for robust parameter identification", Entropy 11 (2009), (26)-(29).

    Example:
        >>> X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
        >>> y = 1 + 2 * X[:, 1]
        >>> y[:4] = 100.0
        >>> fit = ReweightedLeastSquares().fit(X, y)
        >>> fit.coef_, fit.weights_.flatten().long().tolist()
        (tensor([1.0000, 2.0000], dtype=torch.float64), [0, 0, 0, 0, 1, 1, 1, 1, 1, 1])
    """

    scale_: Float[Tensor, "*batch m"]
    start_: LinearEstimator

    def __init__(
        self,
        start: Literal["lts", "lms", "s"] | LinearEstimator = "lts",
        *,
        threshold: float = 2.5,
        starts: int | None = None,
        covariance: RobustCovarianceKind = "sandwich",
        bandwidth: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if not (isinstance(start, LinearEstimator) or (isinstance(start, str) and start in _STARTS)):
            remedy = f"; pass an instance, {start.__name__}()" if isinstance(start, type) else ""
            raise ValueError(
                "Expected argument `start` to be 'lts', 'lms', 's' or an estimator but got "
                f"{format_value(start)}{remedy}."
            )
        checked_number("threshold", threshold, 1.0, math.inf, "[)", "it is a number of scales; 2.5 is usual")
        self.start = start
        self.threshold = threshold
        self.starts = None if starts is None else checked_starts(starts)
        self._set_covariance(covariance, bandwidth)
        self.seed = checked_whole("seed", seed)

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> ReweightedLeastSquares:
        """Fit ``Y ~ X coef``; shapes and errors as in :meth:`LeastSquares.fit`.

        A weight of 2 is a sample that occurs twice, but for the small-sample factors of the first scale.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        problem = linear_problem(X, Y, sample_weight)
        self.start_ = self._robust().fit(X, Y, sample_weight)
        residual = problem.residual(problem.in_basis(self.start_.coef_)).detach()
        floor = rounding_scale(problem)
        first = torch.maximum(residual_scale(problem, residual), floor)
        second = torch.maximum(_kept_scale(problem, residual, self._keep(residual, first)), floor)
        weight = self._keep(residual, second)
        beta = problem.weighted_fit(weight * relative_precision(second).unsqueeze(-2))
        self._set_common(problem, beta, weight)
        scale = _kept_scale(problem, problem.residual(beta), weight)
        self.scale_ = problem.restore(scale)
        self._infer_from(problem, beta, weight, torch.maximum(scale, floor))
        return self

    def _infer_from(self, problem: LinearProblem, beta: Tensor, weight: Tensor, scale: Tensor) -> None:
        z = problem.residual(beta) / scale.unsqueeze(-2)
        equation = Scores(z * weight, weight, z, scale)
        inside, edge = _gaussian_edge(self.threshold)

        def of_start(share: Tensor | None) -> Tensor | None:
            start = self._start_influence(problem, share)
            return None if start is None else edge / inside * start

        wider = 1.0 + _SMALL_SAMPLE * coefficients_a_value(problem)
        ratio = inside / (inside - edge)
        self._infer(problem, beta, weight, equation, ratio, of_start=of_start, widening=wider)

    def _start_influence(self, problem: LinearProblem, share: Tensor | None) -> Tensor | None:
        """Influence of each sample on the start's coefficients, in the basis; None if unknown."""
        start = self.start_
        beta = problem.in_basis(start.coef_)
        if isinstance(start, LeastTrimmedSquares):
            h = default_coverage(problem) if start.h is None else start.h
            kept = start.weights_.reshape(problem.Y.shape)
            return influence(problem, trimmed_equation(problem, beta, kept, h / problem.num_samples), None, share)
        if isinstance(start, SRegression):
            scale = start.scale_.reshape(-1, problem.num_channels)
            equation, of_scale = m_scale_equation(problem, beta, scale, start.breakdown)
            return influence(problem, equation, of_scale, share)
        return None

    def _keep(self, residual: Tensor, scale: Tensor) -> Float[Tensor, "B N m"]:
        return (residual.abs() <= self.threshold * scale.unsqueeze(-2)).to(residual.dtype)

    def _robust(self) -> LinearEstimator:
        if isinstance(self.start, LinearEstimator):
            return self.start
        kind = _STARTS[self.start]
        return kind(seed=self.seed) if self.starts is None else kind(starts=self.starts, seed=self.seed)


_SMALL_SAMPLE = 4.0
"""Standard errors grow by this times n / N, since the same values decide which of them are kept.

From Gaussian draws of 2, 4 and 8 coefficients with 10 to 80 samples each. Their errors are 1.4, 1.2, 1.1 and 1.0 times
the large-sample values.
"""


def _gaussian_edge(threshold: float) -> tuple[float, float]:
    """Share of a Gaussian within ±c, and 2 c φ(c), the derivative of the mean within the edges by their shift."""
    density = math.exp(-0.5 * threshold * threshold) / math.sqrt(2.0 * math.pi)
    return math.erf(threshold / math.sqrt(2.0)), 2.0 * threshold * density


def _kept_scale(problem: LinearProblem, residual: Tensor, weight: Tensor) -> Float[Tensor, "B m"]:
    """Root mean square of the kept residuals, corrected for the degrees of freedom of the fit, (27)."""
    if problem.sample_weight is not None:
        weight = weight * problem.sample_weight
    left = (weight.sum(-2) - problem.coefficients_per_channel).clamp(min=1.0)
    return torch.sqrt((weight * residual.square()).sum(-2) / left)
