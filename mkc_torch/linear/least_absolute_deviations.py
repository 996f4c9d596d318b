"""Least absolute deviations (median) regression."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import linear_problem, solve_gram

if TYPE_CHECKING:
    from jaxtyping import Float


class LeastAbsoluteDeviations(LinearEstimator):
    """The coefficients of the smallest (weighted) sum of absolute residuals, the linear program solved to its optimum.

    An interior point of the bounded dual (Frisch-Newton, predictor and corrector) runs for all problems at once, then
    the coefficients are solved exactly through the n values of the smallest residuals. It computes in float64 whatever
    the dtype of the data. Where several coefficients share the optimum, one of them is returned.

    Outliers in Y have a bounded influence; those in X (leverage points) do not.

    Args:
        tol: largest gap between the objective and its lower bound from the dual, relative to the objective; in (0, 1).
        max_iter: most interior-point iterations, at least 1; 10 to 30 are usual.

    Attributes, after ``fit``:
        coef_: coefficients (*, n). Their gradient in X and Y is that of the solution through the n values.
        weights_: ones of the shape of Y; the estimator weighs no value down.
        objective_: the minimum (*,) of ``sum(sample_weight * |Y - X coef|)`` over samples and channels.
        n_iter_: interior-point iterations (*,) of each problem, 0 where least squares already fits exactly.
        converged_: whether each problem (*,) reached ``tol``, or the rounding error of an objective near 0.

    Example:
        >>> X = torch.tensor([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0], [1.0, 3.0]])
        >>> fit = LeastAbsoluteDeviations().fit(X, torch.tensor([1.0, 3.0, 50.0, 7.0]))
        >>> fit.coef_, fit.objective_
        (tensor([1., 2.]), tensor(45.))

    References:
        S. Portnoy, R. Koenker, The Gaussian hare and the Laplacian tortoise: computability of squared-error versus
        absolute-error estimators, Statistical Science 12(4), 1997, pp. 279-300, sections 3 and 4.
    """

    objective_: Float[Tensor, "*batch"]
    n_iter_: Tensor
    converged_: Tensor

    def __init__(self, tol: float = 1e-9, max_iter: int = 100) -> None:
        if not 0 < tol < 1:
            raise ValueError(f"Expected argument `tol` to be in (0, 1) but got {tol}; 1e-9 suits float64.")
        if max_iter < 1:
            raise ValueError(f"Expected argument `max_iter` to be >= 1 but got {max_iter}; 100 is ample.")
        self.tol = tol
        self.max_iter = max_iter

    def fit(self, X: Tensor, Y: Tensor, sample_weight: Tensor | None = None) -> LeastAbsoluteDeviations:
        """Fit ``Y ~ X coef``.

        Args:
            X: (*, N, m, n) with Y (*, N, m), or (*, N, n) with Y (*, N).
            Y: targets.
            sample_weight: non-negative factors (*, N) or (*, N, m) of the absolute residuals; 0 leaves a value out.

        Returns:
            The estimator, with ``coef_`` (*, n), ``weights_``, ``objective_``, ``n_iter_`` and ``converged_``.

        Raises:
            TypeError: X or Y is not a floating tensor, or their dtypes or devices differ.
            ValueError: shapes do not fit, values are not finite, there are fewer values than coefficients.
            RankDeficientError: columns of X are linearly dependent.
        """
        problem = linear_problem(X, Y, sample_weight)
        flat = problem.flatten_batch()
        # conditioning near the optimum is beyond float32
        rows = flat.basis.flatten(-3, -2).double()
        target = flat.Y.flatten(-2).double()
        weight = torch.ones_like(target)
        if flat.sample_weight is not None:
            weight = flat.sample_weight.flatten(-2).double()
        with torch.no_grad():
            start = flat.weighted_fit(torch.ones_like(flat.Y)).double()
            scale = weight.amax(-1, keepdim=True)
            relative = weight / scale
            if flat.sample_weight is None:
                scaled_rows = rows
            else:
                scaled_rows = rows * relative.unsqueeze(-1)
            # around least squares, so that a large offset costs no digits
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
        self._set_common(
            problem,
            beta.to(Y.dtype).reshape(*problem.batch, -1),
            torch.ones_like(problem.Y),
        )
        self.objective_ = (objective * scale.squeeze(-1)).to(Y.dtype).reshape(problem.batch)
        self.n_iter_ = n_iter.reshape(problem.batch)
        self.converged_ = converged.reshape(problem.batch)
        return self


def _apply(rows: Float[Tensor, "#B R n"], beta: Float[Tensor, "B n"]) -> Float[Tensor, "B R"]:
    return torch.matmul(rows, beta.unsqueeze(-1)).squeeze(-1)


def _moment(rows: Float[Tensor, "#B R n"], values: Float[Tensor, "B R"]) -> Float[Tensor, "B n"]:
    return torch.matmul(rows.mT, values.unsqueeze(-1)).squeeze(-1)


def _interior_point(
    rows: Float[Tensor, "#B R n"], target: Float[Tensor, "B R"], floor: Float[Tensor, "B"], tol: float, max_iter: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Minimise ``sum |target - rows beta|``; the dual is ``max target·d`` with ``rowsᵀ d = 0`` and ``|d| <= 1``.

    The state is ``beta``, the residual's parts ``above - below`` and the dual's slacks ``upper = 1 - d`` and
    ``lower = 1 + d``, all four positive; at the optimum ``above * upper`` and ``below * lower`` are 0.

    Returns:
        The coefficients (B, n), a lower bound (B,) of the objective, and the iterations (B,) used.
    """
    B, R = target.shape
    n = rows.shape[-1]
    solution = target.new_zeros(B, n)
    bound = torch.zeros_like(floor)
    n_iter = torch.zeros(B, dtype=torch.long, device=target.device)
    active = torch.arange(B, device=target.device)
    beta = solution.clone()
    spread = target.abs().mean(-1, keepdim=True)
    above, below = target.clamp(min=0) + spread, (-target).clamp(min=0) + spread
    upper, lower = torch.ones_like(target), torch.ones_like(target)
    for iteration in range(max_iter + 1):
        gap = (above * upper + below * lower).sum(-1)
        residual = target - _apply(rows, beta)
        objective = residual.abs().sum(-1)
        going = gap > torch.maximum(tol * objective, floor)
        going &= objective > floor
        done = ~going if iteration < max_iter else torch.ones_like(going)
        if done.any():
            at = active[done]
            solution[at] = beta[done]
            dual = (lower - upper)[done] / 2
            # the second term repairs what rounding left of rowsᵀ d = 0
            finished = rows if rows.shape[0] == 1 else rows[done]
            slip = (_moment(finished, dual) * beta[done]).sum(-1)
            bound[at] = (dual * target[done]).sum(-1) - slip
            n_iter[at] = iteration
            if done.all():
                break
            keep = ~done
            active, floor = active[keep], floor[keep]
            rows = rows if rows.shape[0] == 1 else rows[keep]
            target, residual, beta, gap = target[keep], residual[keep], beta[keep], gap[keep]
            above, below, upper, lower = above[keep], below[keep], upper[keep], lower[keep]

        inverse = 1 / (above / upper + below / lower)
        weighted = rows * inverse.unsqueeze(-1)
        gram = torch.matmul(weighted.mT, rows)
        slip = _moment(rows, (lower - upper) / 2)
        drift = residual - (above - below)

        def newton(
            c_above: Tensor,
            c_below: Tensor,
            *,
            _state: tuple[Tensor, ...] = (rows, above, below, upper, lower, inverse, weighted, gram, slip, drift),
        ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            rows, above, below, upper, lower, inverse, weighted, gram, slip, drift = _state
            pull = drift - c_above / upper + c_below / lower
            d_beta = solve_gram(gram, (_moment(weighted, pull) + slip).unsqueeze(-1)).squeeze(-1)
            d_dual = inverse * (pull - _apply(rows, d_beta))
            return d_beta, d_dual, (c_above + above * d_dual) / upper, (c_below - below * d_dual) / lower

        _, d_dual, d_above, d_below = newton(-above * upper, -below * lower)
        primal = _longest(above, d_above, below, d_below)
        dual = _longest(upper, -d_dual, lower, d_dual)
        predicted = (
            (above + primal * d_above) * (upper - dual * d_dual) + (below + primal * d_below) * (lower + dual * d_dual)
        ).sum(-1)
        centre = (gap * (predicted / gap) ** 3 / (2 * R)).unsqueeze(-1)
        d_beta, d_dual, d_above, d_below = newton(
            centre - above * upper + d_above * d_dual, centre - below * lower - d_below * d_dual
        )
        primal = _longest(above, d_above, below, d_below)
        dual = _longest(upper, -d_dual, lower, d_dual)
        beta = beta + primal * d_beta
        above, below = above + primal * d_above, below + primal * d_below
        upper, lower = upper - dual * d_dual, lower + dual * d_dual
    return solution, bound, n_iter


def _longest(a: Tensor, d_a: Tensor, b: Tensor, d_b: Tensor) -> Float[Tensor, "B 1"]:
    """The longest step, at most 1, that keeps ``a`` and ``b`` positive."""
    fastest = torch.maximum((-d_a / a).amax(-1, keepdim=True), (-d_b / b).amax(-1, keepdim=True))
    return torch.where(fastest > 0.9995, 0.9995 / fastest, torch.ones_like(fastest))
