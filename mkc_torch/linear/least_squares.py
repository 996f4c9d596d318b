"""Least squares and ridge regression."""

from __future__ import annotations

import torch

from mkc_torch._support.arguments import checked_number
from mkc_torch._support.arrays import Data
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._inference import Inference
from mkc_torch.linear._mkc import coefficient_covariance, residual_dof
from mkc_torch.linear._problem import canonical_shapes, linear_problem
from mkc_torch.linear.covariance import CovarianceKind, checked_bandwidth, checked_kind


class LeastSquares(Inference):
    """Ordinary or weighted least squares, (5) and (7) of Li et al. (2023).

    Args:
        covariance: "sandwich" for independent samples, "hac" for a time series.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    Example:
        >>> X = torch.tensor([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
        >>> LeastSquares().fit(X, torch.tensor([1.0, 3.0, 5.0])).coef_
        tensor([1.0000, 2.0000])
    """

    def __init__(self, *, covariance: CovarianceKind = "sandwich", bandwidth: float | None = None) -> None:
        super().__init__()
        self.covariance = checked_kind(covariance)
        self.bandwidth = checked_bandwidth(bandwidth)

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> LeastSquares:
        """Fit ``Y ~ X coef``.

        Args:
            X: (*, N, m, n) with Y (*, N, m), the paper's X_k; or (*, N, n) with Y (*, N) for one channel.
            Y: targets.
            sample_weight: non-negative weights (*, N) or (*, N, m), proportional to inverse variances; weight 0
                excludes a value.

        Returns:
            The estimator, with ``coef_`` (*, n), its ``covariance_`` (*, n, n) and ``weights_``, all 1.

        Raises:
            TypeError: X, Y or the weights are not real floating-point tensors, or their dtypes or devices differ.
            ValueError: shapes do not fit, values are not finite or out of range, there are fewer values than
                coefficients.
            RankDeficientError: columns of X are linearly dependent.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        problem = linear_problem(X, Y, sample_weight)
        unit_weight = torch.ones_like(problem.Y)
        beta = problem.weighted_fit(unit_weight)
        self._set_common(problem, beta, unit_weight)
        self.dof_ = problem.restore(residual_dof(problem))
        unit = torch.ones_like(problem.Y[:, 0])
        self.covariance_ = coefficient_covariance(
            problem, beta, torch.zeros_like(unit), unit, self.covariance, self.bandwidth
        )
        return self


class Ridge(LinearEstimator):
    """Least squares with the penalty ``alpha * |coef|^2`` on all coefficients, an intercept column included.

    Args:
        alpha: penalty >= 0, in units of ``X^2`` summed over samples (scikit-learn's convention).

    Raises:
        TypeError, ValueError: ``alpha`` is not a number, or out of range.

    References:
        Hoerl & Kennard, "Ridge regression: biased estimation for nonorthogonal problems", Technometrics 12 (1970).

    Example:
        >>> X = torch.eye(2)
        >>> Ridge(alpha=1.0).fit(X, torch.tensor([1.0, 2.0])).coef_
        tensor([0.5000, 1.0000])
    """

    def __init__(self, alpha: float = 1.0) -> None:
        self.alpha = checked_number("alpha", alpha, ends="[)", advice="0 is least squares")

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> Ridge:
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. Dependent columns are allowed for alpha > 0."""
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        values = canonical_shapes(X, Y, sample_weight)
        rows, target = values.X.flatten(-3, -2), values.Y.flatten(-2)
        if values.sample_weight is not None:
            root = values.sample_weight.sqrt().flatten(-2)
            rows, target = rows * root.unsqueeze(-1), target * root
        n = rows.shape[-1]
        penalty = (self.alpha**0.5) * torch.eye(n, dtype=rows.dtype, device=rows.device)
        rows = torch.cat([rows.expand(*values.batch, -1, n), penalty.expand(*values.batch, n, n)], dim=-2)
        target = torch.cat([target, target.new_zeros(*values.batch, n)], dim=-1)
        augmented = linear_problem(rows.unsqueeze(-2), target.unsqueeze(-1))
        self.coef_ = augmented.coefficients(augmented.weighted_fit(torch.ones_like(augmented.Y)))
        self._single_channel = values.single_channel
        self.weights_ = torch.ones_like(values.Y)
        return self
