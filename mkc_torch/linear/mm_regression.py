"""MM-regression: the breakdown point of S-regression with the efficiency of an M-estimator."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole
from mkc_torch._support.arrays import Data
from mkc_torch.linear._inference import RobustInference
from mkc_torch.linear._influence import scores
from mkc_torch.linear._problem import linear_problem
from mkc_torch.linear._psi import Psi, bisquare_for_efficiency
from mkc_torch.linear.covariance import RobustCovarianceKind
from mkc_torch.linear.m_estimator import check_iterations, reweight
from mkc_torch.linear.s_regression import checked_breakdown, checked_starts, m_scale_equation, minimise_m_scale

if TYPE_CHECKING:
    from jaxtyping import Float


class MMRegression(RobustInference):
    """MM-estimator of regression with Tukey's bisquare: an M-estimate near an S-estimate, at the scale of the latter.

    Iteratively reweighted least squares starts from the coefficients of :class:`SRegression` and descends to a local
    minimum of ``Σ ρ(r / (c scale))``. The scale stays fixed, and c is the wider constant that gives the efficiency.
    The breakdown point is that of the S-estimate.

    Args:
        efficiency: efficiency at Gaussian residuals, 0.3 to 0.99; c is 4.685 for 0.95.
        breakdown: breakdown point of the S-estimate, 0.01 to 0.5.
        starts: largest number of elemental starts of the S-estimate; :class:`SRegression` states how many are used.
        max_iter: largest number of steps after the S-estimate.
        tol: converged when a step moves the fitted values by less than this share of the scale, in root mean square.
        covariance: "sandwich" for independent samples, "hac" for a time series, "homoscedastic" where errors have the
            same distribution at every X and no outlier lies far out in X.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        seed: seed of the elemental starts.

    Attributes, after ``fit``:
        coef_, covariance_, dof_: (*, n), (*, n, n), (*,); differentiable by X and Y, as is ``scale_``.
        scale_: scale of the S-estimate, (*, m), m being 1 for one channel; for an exact fit the rounding error of Y.
        weights_: bisquare weights in [0, 1], (*, N, m).
        n_iter_, converged_: number of steps after the S-estimate, and whether they converged, (*,).

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        Yohai, "High breakdown-point and high efficiency robust estimates for regression", Annals of Statistics 15
        (1987) 642-656.

    Example:
        >>> import torch
        >>> X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
        >>> y = 1 + 2 * X[:, 1]
        >>> y[:4] = 100.0
        >>> MMRegression().fit(X, y).coef_
        tensor([1.0000, 2.0000], dtype=torch.float64)
    """

    scale_: Float[Tensor, "*batch m"]
    n_iter_: Tensor
    converged_: Tensor

    def __init__(
        self,
        efficiency: float = 0.95,
        *,
        breakdown: float = 0.5,
        starts: int = 500,
        max_iter: int = 500,
        tol: float = 1e-10,
        covariance: RobustCovarianceKind = "sandwich",
        bandwidth: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.efficiency = checked_number("efficiency", efficiency, 0.3, 0.99, "[]", "0.95 is usual")
        self.breakdown = checked_breakdown(breakdown)
        self.starts = checked_starts(starts)
        check_iterations(max_iter, tol)
        self.max_iter = max_iter
        self.tol = tol
        self._set_covariance(covariance, bandwidth)
        self.seed = checked_whole("seed", seed)

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> MMRegression:
        """Fit ``Y ~ X coef``; shapes and errors as in :meth:`LeastSquares.fit`.

        A weight of 2 is a sample that occurs twice.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        problem = linear_problem(X, Y, sample_weight)
        start = minimise_m_scale(problem, breakdown=self.breakdown, starts=self.starts, seed=self.seed)
        psi = Psi("tukey", (bisquare_for_efficiency(self.efficiency),))
        found = reweight(problem, start.beta, start.scale, psi.weight, max_iter=self.max_iter, tol=self.tol)
        self._set_common(problem, found.beta, found.weight)
        self.scale_ = problem.restore(found.scale)
        equation = scores(problem, found.beta, found.scale, psi)
        _, of_scale = m_scale_equation(problem, start.beta, start.scale, self.breakdown)
        self._infer(problem, found.beta, found.weight, equation, psi.ratio(), of_scale=of_scale)
        self.n_iter_ = problem.restore(found.n_iter)
        self.converged_ = problem.restore(found.converged)
        return self
