"""Least absolute deviations (median) regression."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole
from mkc_torch._support.arrays import Data
from mkc_torch._support.independent_rows import independent_rows, taken
from mkc_torch._support.side_by_side import steps_between_tests
from mkc_torch._support.small_factors import solve, solve_gram
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import linear_problem

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class LeastAbsoluteDeviations(LinearEstimator):
    """Coefficients with the smallest (weighted) sum of absolute residuals, by exact solution of the linear program.

    An interior-point method on the bounded dual (Frisch-Newton, predictor and corrector) runs for all problems at once.
    The coefficients are then solved exactly through the n values with the smallest residuals. Computation is in float64
    whatever the dtype of the data. If several coefficient vectors are optimal, one of them is returned.

    Outliers in Y have a bounded influence; outliers in X (leverage points) do not.

    Args:
        tol: largest gap between the objective and its lower bound from the dual, relative to the objective; in (0, 1).
        max_iter: largest number of interior-point iterations, at least 1; 10 to 30 are usual.

    Attributes, after ``fit``:
        coef_: coefficients (*, n). Their gradient by Y is that of the solution through the n values.
        weights_: all 1, (*, N, m); the estimator does not downweight values.
        objective_: the minimum (*,) of ``sum(sample_weight * |Y - X coef|)`` over samples and channels.
        n_iter_: interior-point iterations (*,) of each problem, 0 where least squares already fits exactly.
        converged_: whether each problem (*,) reached ``tol``, or the rounding error of an objective near 0.

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    Example:
        >>> X = torch.tensor([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0], [1.0, 3.0]])
        >>> fit = LeastAbsoluteDeviations().fit(X, torch.tensor([1.0, 3.0, 50.0, 7.0]))
        >>> fit.coef_.round(decimals=4), fit.objective_.round(decimals=4)
        (tensor([1., 2.]), tensor(45.))

    References:
        S. Portnoy, R. Koenker, The Gaussian hare and the Laplacian tortoise: computability of squared-error versus
        absolute-error estimators, Statistical Science 12(4), 1997, pp. 279-300, sections 3 and 4.
    """

    objective_: Float[Tensor, "*batch"]
    n_iter_: Tensor
    converged_: Tensor

    def __init__(self, tol: float = 1e-9, max_iter: int = 100) -> None:
        self.tol = checked_number("tol", tol, 0.0, 1.0, advice="1e-9 suits float64")
        self.max_iter = checked_whole("max_iter", max_iter, 1, "100 is ample")

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> LeastAbsoluteDeviations:
        """Fit ``Y ~ X coef``; shapes and errors as in :meth:`LeastSquares.fit`. Weights multiply absolute residuals."""
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        problem = linear_problem(X, Y, sample_weight)
        # the conditioning near the optimum is too bad for float32
        rows = problem.basis.flatten(-3, -2).double()
        target = problem.Y.flatten(-2).double()
        weight = torch.ones_like(target)
        if problem.sample_weight is not None:
            weight = problem.sample_weight.flatten(-2).double()
        with torch.no_grad():
            start = problem.weighted_fit(torch.ones_like(problem.Y)).double()
            scale = weight.amax(-1, keepdim=True)
            relative = weight / scale
            # without weights, a shared X stays shared
            scaled_rows = rows if problem.sample_weight is None else rows * relative.unsqueeze(-1)
            # residuals of least squares, so that a large offset costs no digits
            centred = relative * (target - _apply(rows, start))
            floor = 8 * torch.finfo(torch.float64).eps * (relative * target.abs()).sum(-1)
            step, bound, n_iter = _interior_point(scaled_rows, centred, floor, self.tol, self.max_iter)
            inner = start + step
            chosen = _tight_rows(rows, target - _apply(rows, inner), weight > 0)
        vertex = _solve_through(rows, target, chosen)
        with torch.no_grad():
            inner_objective = (relative * (target - _apply(rows, inner)).abs()).sum(-1)
            objective = (relative * (target - _apply(rows, vertex)).abs()).sum(-1)
            better = objective <= inner_objective + floor
            objective = torch.where(better, objective, inner_objective)
            converged = objective - bound <= torch.maximum(self.tol * objective, floor)
        beta = torch.where(better.unsqueeze(-1), vertex, inner)
        self._set_common(problem, beta.to(Y.dtype), torch.ones_like(problem.Y))
        self.objective_ = problem.restore((objective * scale.squeeze(-1)).to(Y.dtype))
        self.n_iter_ = problem.restore(n_iter)
        self.converged_ = problem.restore(converged)
        return self


def _apply(rows: Float[Tensor, "#B R n"], beta: Float[Tensor, "B n"]) -> Float[Tensor, "B R"]:
    return torch.matmul(rows, beta.unsqueeze(-1)).squeeze(-1)


def _moment(rows: Float[Tensor, "#B R n"], values: Float[Tensor, "B R"]) -> Float[Tensor, "B n"]:
    return torch.matmul(rows.mT, values.unsqueeze(-1)).squeeze(-1)


@dataclass(frozen=True)
class _Iterate:
    """An interior point: ``beta``, the residual as ``above - below`` and the dual ``d = 1 - upper = lower - 1``.

    The dual is ``max target·d`` with ``rowsᵀ d = 0`` and ``|d| <= 1``. The last four are positive; at the optimum
    ``above * upper`` and ``below * lower`` are 0.
    """

    rows: Float[Tensor, "#B R n"]
    target: Float[Tensor, "B R"]
    floor: Float[Tensor, " B"]
    beta: Float[Tensor, "B n"]
    above: Float[Tensor, "B R"]
    below: Float[Tensor, "B R"]
    upper: Float[Tensor, "B R"]
    lower: Float[Tensor, "B R"]

    @classmethod
    def first(cls, rows: Tensor, target: Tensor, floor: Tensor) -> _Iterate:
        spread = target.abs().mean(-1, keepdim=True)
        above, below = target.clamp(min=0) + spread, (-target).clamp(min=0) + spread
        unit = torch.ones_like(target)
        beta = target.new_zeros(target.shape[0], rows.shape[-1])
        return cls(rows, target, floor, beta, above, below, unit, unit)

    def select(self, keep: Tensor) -> _Iterate:
        rows = self.rows if self.rows.shape[0] == 1 else self.rows[keep]
        rest = (self.target, self.floor, self.beta, self.above, self.below, self.upper, self.lower)
        return _Iterate(rows, *(value[keep] for value in rest))

    def where(self, ended: Bool[Tensor, " B"], other: _Iterate) -> _Iterate:
        """This iterate for the problems that have ended, ``other`` for those that go on."""
        names = ("beta", "above", "below", "upper", "lower")
        mask = ended.unsqueeze(-1)
        return replace(self, **{name: torch.where(mask, getattr(self, name), getattr(other, name)) for name in names})

    def residual(self) -> Float[Tensor, "B R"]:
        return self.target - _apply(self.rows, self.beta)

    def finished(self, tol: float) -> Bool[Tensor, " B"]:
        residual = self.residual()
        size = residual.abs()
        gap = (residual.clamp(min=0) * self.upper + (-residual).clamp(min=0) * self.lower).sum(-1)
        # a few huge outliers dominate the objective, so the gap is compared with a typical size of the residuals
        typical = torch.minimum(size.mean(-1), size.median(-1).values) * size.shape[-1]
        return gap <= torch.maximum(tol * typical, self.floor)

    def bound(self) -> Float[Tensor, " B"]:
        """Lower bound of the objective; using the residual, not the target, absorbs rounding in ``rowsᵀ d = 0``."""
        return ((self.lower - self.upper) / 2 * self.residual()).sum(-1)

    def advance(self) -> _Iterate:
        """Make one predictor-corrector step (Portnoy and Koenker 1997, section 4)."""
        rows, above, below, upper, lower = self.rows, self.above, self.below, self.upper, self.lower
        stiffness = 1 / (above / upper + below / lower)
        weighted = rows * stiffness.unsqueeze(-1)
        gram = torch.matmul(weighted.mT, rows)
        slip = _moment(rows, (lower - upper) / 2)
        drift = self.residual() - (above - below)

        def newton(to_above: Tensor, to_below: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            right_side = drift - to_above / upper + to_below / lower
            d_beta = solve_gram(gram, _moment(weighted, right_side) + slip)
            d_dual = stiffness * (right_side - _apply(rows, d_beta))
            return d_beta, d_dual, (to_above + above * d_dual) / upper, (to_below - below * d_dual) / lower

        gap = (above * upper + below * lower).sum(-1, keepdim=True)
        _, d_dual, d_above, d_below = newton(-above * upper, -below * lower)
        primal, dual = _longest(above, d_above, below, d_below), _longest(upper, -d_dual, lower, d_dual)
        left = (above + primal * d_above) * (upper - dual * d_dual) + (below + primal * d_below) * (
            lower + dual * d_dual
        )
        centre = gap * (left.sum(-1, keepdim=True) / gap) ** 3 / (2 * above.shape[-1])
        d_beta, d_dual, d_above, d_below = newton(
            centre - above * upper + d_above * d_dual, centre - below * lower - d_below * d_dual
        )
        primal, dual = _longest(above, d_above, below, d_below), _longest(upper, -d_dual, lower, d_dual)
        return _Iterate(
            rows,
            self.target,
            self.floor,
            self.beta + primal * d_beta,
            above + primal * d_above,
            below + primal * d_below,
            upper - dual * d_dual,
            lower + dual * d_dual,
        )


def _interior_point(
    rows: Float[Tensor, "#B R n"], target: Float[Tensor, "B R"], floor: Float[Tensor, " B"], tol: float, max_iter: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Minimise ``sum |target - rows beta|``: coefficients (B, n), lower bounds (B,) of the sum, iterations (B,)."""
    solution = target.new_zeros(target.shape[0], rows.shape[-1])
    bound, n_iter = torch.zeros_like(floor), torch.zeros_like(floor, dtype=torch.long)
    active = torch.arange(target.shape[0], device=target.device)
    iterate = _Iterate.first(rows, target, floor)
    every = steps_between_tests(target)
    ended, end = torch.zeros_like(active, dtype=torch.bool), torch.zeros_like(active)
    for iteration in range(max_iter + 1):
        done = ended | iterate.finished(tol) | (iteration == max_iter)
        end, ended = torch.where(done & ~ended, iteration, end), done
        if iteration % every == 0 or iteration == max_iter:
            left = (~done).nonzero().squeeze(-1)
            if len(left) < len(active):
                # those that go on are written again when they end
                solution[active], bound[active], n_iter[active] = iterate.beta, iterate.bound(), end
                active, iterate, ended, end = active[left], iterate.select(left), ended[left], end[left]
                if len(left) == 0:
                    break
        iterate = iterate.advance() if every == 1 else iterate.where(ended, iterate.advance())
    return solution, bound, n_iter


def _longest(a: Tensor, d_a: Tensor, b: Tensor, d_b: Tensor) -> Float[Tensor, "B 1"]:
    """Longest step, at most 1, that keeps ``a`` and ``b`` positive."""
    fastest = torch.maximum((-d_a / a).amax(-1, keepdim=True), (-d_b / b).amax(-1, keepdim=True))
    return torch.where(fastest > 0.9995, 0.9995 / fastest, torch.ones_like(fastest))


def _tight_rows(
    rows: Float[Tensor, "#B R n"], residual: Float[Tensor, "B R"], used: Bool[Tensor, "B R"]
) -> Int[Tensor, "B n"]:
    """The n linearly independent rows with the smallest residuals.

    The n rows with the smallest residuals alone may be dependent, as for repeated samples.
    """
    eps = torch.finfo(residual.dtype).eps
    size = residual.abs()
    size = size.clamp(min=eps * size.median(-1, keepdim=True).values + torch.finfo(size.dtype).tiny ** 0.5)
    return independent_rows(rows, 1.0 / size, used, 1e-10)


def _solve_through(
    rows: Float[Tensor, "#B R n"], target: Float[Tensor, "B R"], chosen: Int[Tensor, "B n"]
) -> Float[Tensor, "B n"]:
    """Coefficients that fit the chosen rows exactly."""
    matrix = taken(rows.expand(target.shape[0], -1, -1), chosen)
    return solve(matrix, target.gather(-1, chosen).unsqueeze(-1)).squeeze(-1)
