"""Inference from the covariance of coefficients: standard errors, intervals, tests, a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole, refuse_not_real
from mkc_torch._support.arrays import Data, as_tensor
from mkc_torch._support.fisher_f import fisher_tail
from mkc_torch._support.student_t import student_quantile, student_tails
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._goodness import robust_r_squared
from mkc_torch.linear._influence import ScaleInfluence, Scores, degrees_of_freedom, influence, robust_covariance
from mkc_torch.linear.covariance import RobustCovarianceKind, checked_bandwidth, checked_kind
from mkc_torch.linear.summary import LIGHT, Summary, coefficients_of, one_problem

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.linear._problem import LinearProblem


@dataclass(frozen=True)
class WaldTest:
    """A test of linear restrictions on coefficients.

    Attributes:
        statistic: squared distance of the estimates from the restrictions, in standard errors, divided by the number of
            restrictions; F-distributed if they hold, (*,).
        p_value: probability of a larger statistic if they hold, (*,).
        restrictions, dof: numerator and denominator degrees of freedom of the F.
    """

    statistic: Float[Tensor, " *batch"]
    p_value: Float[Tensor, " *batch"]
    restrictions: int
    dof: Float[Tensor, " *batch"]


class Inference(LinearEstimator):
    """Standard errors, intervals and tests of an estimator with ``coef_``, ``covariance_`` and ``dof_``.

    Attributes, after ``fit``:
        covariance_: covariance of the coefficients (*, n, n). That of "sandwich" and "hac" contains N / (N - n) for the
            degrees of freedom, so that standard errors are √(N / (N - n)) times those of R's robustbase.
        dof_: degrees of freedom, number of values in use minus n, (*,).
        standard_error_: standard error of each coefficient, (*, n).
        p_value_: two-sided p-value of each coefficient being 0, by Student's t, (*, n).
    """

    covariance_: Float[Tensor, "*batch n n"]
    dof_: Float[Tensor, " *batch"]

    @property
    def standard_error_(self) -> Float[Tensor, "*batch n"]:
        # sqrt has no derivative at the variance 0 of an exact fit
        variance = self.covariance_.diagonal(dim1=-2, dim2=-1)
        return torch.where(variance > 0, variance, 1.0).sqrt() * (variance > 0)

    @property
    def p_value_(self) -> Float[Tensor, "*batch n"]:
        error = self.standard_error_
        t = torch.where(error > 0, self.coef_ / error.clamp(min=torch.finfo(error.dtype).tiny), torch.inf)
        return student_tails(t, self.dof_.unsqueeze(-1).clamp(min=1.0)).to(error.dtype)

    def confidence_interval(self, level: float = 0.95) -> Float[Tensor, "*batch n 2"]:
        """Confidence interval of each coefficient, by Student's t with ``dof_`` degrees of freedom.

        Args:
            level: probability that an interval contains the true coefficient, above 0 and below 1.

        Raises:
            NotFittedError: before ``fit``.
            ValueError: ``level`` out of range.

        Example:
            >>> from mkc_torch.linear import MMRegression
            >>> X = torch.stack([torch.ones(8), torch.arange(8.0)], -1).double()
            >>> y = 1 + 2 * X[:, 1] + torch.tensor([0.1, -0.2, 0.1, 0.0, -0.1, 0.2, -0.1, 9.0])
            >>> MMRegression().fit(X, y).confidence_interval()[1]
            tensor([1.9185, 2.0784], dtype=torch.float64)
        """
        half = self._quantile(level).unsqueeze(-1) * self.standard_error_
        return torch.stack([self.coef_ - half, self.coef_ + half], -1)

    def mean_interval(self, X: Data, level: float = 0.95) -> Float[Tensor, "*batch N m 2"]:
        """Confidence interval of the fitted value at each row of X: the shape of ``predict(X)`` with a last axis 2.

        Args:
            X: as ``predict`` takes it.
            level: probability that an interval contains the true value, above 0 and below 1.

        Raises:
            NotFittedError, TypeError, ValueError: as ``predict``; ``level`` out of range.
        """
        return self._interval_at(X, level)

    def wald_test(self, restrictions: Tensor | Sequence[int] | None = None, value: float | Tensor = 0.0) -> WaldTest:
        """Test that some coefficients, or linear combinations of them, have given values.

        Args:
            restrictions: indices of coefficients, or a matrix (q, n) of linear combinations as rows. None takes all.
            value: values under the null hypothesis, a number or (q,).

        Raises:
            NotFittedError: before ``fit``.
            TypeError, ValueError: restrictions of the wrong type or shape, or dependent restrictions.

        Example:
            >>> from mkc_torch.linear import MMRegression
            >>> X = torch.stack([torch.ones(8), torch.arange(8.0)], -1).double()
            >>> y = 1 + 2 * X[:, 1] + torch.tensor([0.1, -0.2, 0.1, 0.0, -0.1, 0.2, -0.1, 9.0])
            >>> test = MMRegression().fit(X, y).wald_test([1], value=2.0)
            >>> test.p_value > 0.5
            tensor(True)
        """
        matrix = self._restrictions(restrictions)
        q = matrix.shape[0]
        expected = torch.as_tensor(value, dtype=matrix.dtype, device=matrix.device)
        if expected.dim() > 1 or (expected.dim() == 1 and expected.shape[0] not in (1, q)):
            raise ValueError(
                f"Expected argument `value` to be a number or of shape ({q},) but got {tuple(expected.shape)}; "
                "pass one value for each restriction."
            )
        difference = torch.matmul(self.coef_, matrix.mT) - expected
        spread = torch.matmul(torch.matmul(matrix, self.covariance_), matrix.mT)
        solved = torch.linalg.solve_ex(spread, difference.unsqueeze(-1))[0].squeeze(-1)
        statistic = (difference * solved).sum(-1) / q
        over = torch.tensor(float(q), device=statistic.device)
        p_value = fisher_tail(statistic, over, self.dof_.clamp(min=1.0)).to(statistic.dtype)
        return WaldTest(statistic, p_value, q, self.dof_)

    def summary(
        self, names: Sequence[str] | None = None, *, level: float = 0.95, problem: tuple[int, ...] = ()
    ) -> Summary:
        """Table of the coefficients with standard errors, p-values and intervals.

        Printed, it is text, in colour on a terminal with rich; in a notebook it is a table.

        Args:
            names: names of the coefficients; by default the column names given to ``fit``, or x0, x1, ….
            level: confidence level of the intervals.
            problem: index of a problem in the batch dimensions.

        Raises:
            NotFittedError: before ``fit``.
            IndexError: no problem of a batch is chosen, or the index is out of range.
            ValueError: the number of names differs from the number of coefficients; ``level`` out of range.

        Example:
            >>> from mkc_torch.linear import MMRegression
            >>> X = torch.stack([torch.ones(8), torch.arange(8.0)], -1).double()
            >>> y = 1 + 2 * X[:, 1] + torch.tensor([0.1, -0.2, 0.1, 0.0, -0.1, 0.2, -0.1, 9.0])
            >>> print(MMRegression().fit(X, y).summary(["intercept", "slope"]))
            MMRegression of 8 values, 1 with a weight below 0.1
            <BLANKLINE>
                        coefficient   std. error   p-value      95 % interval
            intercept         1.005       0.1146   0.00012     0.724 to 1.285
            slope            1.9984      0.03268   1.3e-09   1.9185 to 2.0784
            <BLANKLINE>
            scale 0.2326, robust R² 0.9987, 6 degrees of freedom, standard errors by the sandwich
        """
        interval = self.confidence_interval(level)
        at = one_problem(problem, tuple(self.dof_.shape))
        names = self.__dict__.get("feature_names_in_") if names is None else names
        rows = coefficients_of(names, (self.coef_[at], self.standard_error_[at], self.p_value_[at], interval[at]))
        facts = (vars(self).get("scale_"), vars(self).get("r_squared_"))
        scale, r_squared = (() if fact is None else tuple(fact[at].tolist()) for fact in facts)
        dof, kind = float(self.dof_[at]), str(vars(self)["covariance"])
        return Summary(type(self).__name__, rows, level, *self._light(at), scale, r_squared, dof, kind)

    def _light(self, problem: tuple[int, ...]) -> tuple[int, int]:
        """Number of values, and how many of them have a weight below :data:`LIGHT`."""
        weights = self.weights_[problem]
        return weights.numel(), int((weights < LIGHT).sum())

    def _quantile(self, level: float) -> Float[Tensor, " *batch"]:
        checked_number("level", level, 0.0, 1.0, "()", "0.95 is usual")
        return student_quantile(level, self.dof_.clamp(min=1.0)).to(self.coef_.dtype)

    def _interval_at(
        self, X: Data, level: float, scale: Float[Tensor, "*batch m"] | None = None
    ) -> Float[Tensor, "*batch N m 2"]:
        quantile, fitted = self._quantile(level), self.predict(X)
        X = as_tensor("X", X, like=self.coef_)
        dims = 1 if self._single_channel else 2
        covariance = self.covariance_.unsqueeze(-3) if dims == 2 else self.covariance_
        variance = (torch.matmul(X, covariance) * X).sum(-1)
        if scale is not None:
            variance = variance + (scale.unsqueeze(-2) if dims == 2 else scale).square()
        half = quantile.reshape(*quantile.shape, *(1,) * dims) * variance.sqrt()
        return torch.stack([fitted - half, fitted + half], -1)

    def _restrictions(self, restrictions: Tensor | Sequence[int] | None) -> Float[Tensor, "q n"]:
        n = self.coef_.shape[-1]
        unit = torch.eye(n, dtype=self.coef_.dtype, device=self.coef_.device)
        if restrictions is None:
            return unit
        if isinstance(restrictions, Tensor) and restrictions.is_floating_point():
            refuse_not_real("restrictions", restrictions)
            matrix = restrictions.to(unit)
            matrix = matrix.unsqueeze(0) if matrix.dim() == 1 else matrix
            if matrix.dim() != 2 or matrix.shape[-1] != n:
                raise ValueError(
                    f"Expected argument `restrictions` of shape (q, {n}) but got {tuple(restrictions.shape)}; a row "
                    "has a factor for each coefficient."
                )
        else:
            matrix = unit[[_coefficient_index(k, n) for k in restrictions]]
        if int(torch.linalg.matrix_rank(matrix)) < matrix.shape[0] or not matrix.shape[0]:
            raise ValueError(
                f"Expected argument `restrictions` to be independent but got {matrix.shape[0]} of rank "
                f"{int(torch.linalg.matrix_rank(matrix))}; remove dependent restrictions."
            )
        return matrix


class RobustInference(Inference):
    """Inference of an estimator that solves ``Σ ψ(r / s) x = 0``.

    Attributes, after ``fit``, in addition to those of :class:`Inference`:
        r_squared_: robust coefficient of determination, (*, m), m being 1 for one channel. Renaud & Victoria-Feser,
            JSPI 140 (2010) 1852-1862.
    """

    covariance: RobustCovarianceKind
    scale_: Float[Tensor, "*batch m"]
    r_squared_: Float[Tensor, "*batch m"]

    def _set_covariance(self, covariance: RobustCovarianceKind, bandwidth: float | None) -> None:
        self.covariance = checked_kind(covariance, get_args(RobustCovarianceKind))
        self.bandwidth = checked_bandwidth(bandwidth)

    def _infer(
        self,
        problem: LinearProblem,
        beta: Float[Tensor, "B n"],
        weight: Float[Tensor, "B N m"],
        equation: Scores,
        ratio: float,
        *,
        of_scale: ScaleInfluence | None = None,
        of_start: Callable[[Tensor | None], Tensor | None] | None = None,
        widening: Float[Tensor, " B"] | None = None,
    ) -> None:
        def influence_of(share: Tensor | None) -> Tensor:
            moved = influence(problem, equation, of_scale, share)
            passed_on = None if of_start is None else of_start(share)
            return moved if passed_on is None else moved + passed_on

        covariance = robust_covariance(problem, equation, influence_of, self.covariance, self.bandwidth)
        if widening is not None:
            covariance = covariance * problem.restore(widening.square())[..., None, None]
        self.covariance_ = covariance
        self.dof_ = problem.restore(degrees_of_freedom(problem))
        self.r_squared_ = problem.restore(robust_r_squared(problem, beta, weight, ratio))

    def prediction_interval(self, X: Data, level: float = 0.95) -> Float[Tensor, "*batch N m 2"]:
        """Prediction interval of a new observation at each row of X: the shape of ``predict(X)`` with a last axis 2.

        It contains a share ``level`` of the inliers, whose errors are assumed Gaussian with standard deviation
        ``scale_``. Outliers are not covered.

        Args:
            X: as ``predict`` takes it.
            level: above 0 and below 1.

        Raises:
            NotFittedError, TypeError, ValueError: as ``predict``; ``level`` out of range.
        """
        return self._interval_at(X, level, self.scale_)


def _coefficient_index(number: object, n: int) -> int:
    """Return the index of a coefficient, counted from 0, or from the end if negative."""
    k = checked_whole("restrictions", number, -n, f"it counts the {n} coefficients from 0")
    if k >= n:
        raise ValueError(
            f"Expected argument `restrictions` of numbers below {n} but got {k}; it counts coefficients from 0."
        )
    return k
