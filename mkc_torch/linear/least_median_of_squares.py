"""Least median of squares, and least quantile regression for any other quantile up to the largest residual."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_whole
from mkc_torch._support.arrays import Data
from mkc_torch._support.independent_rows import taken
from mkc_torch._support.side_by_side import at_once
from mkc_torch._support.small_factors import symmetric_eigen
from mkc_torch.linear._chebyshev import equal_heights, minimax
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._scale_search import elemental_starts, log_product, scale_of, values_of_sets
from mkc_torch.linear.least_trimmed_squares import QuantileScale, checked_h

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

EXHAUSTIVE_SETS = 30_000
"""Largest number of sets of n + 1 values that are all tried."""

_CANDIDATES = 30
"""Number of best candidates that are refined."""

_CHUNK = 1 << 22
"""Largest number of values held at once."""


class LeastMedianOfSquares(LinearEstimator):
    """Least h-th smallest absolute residual: the median (22), another quantile, or the largest residual (23).

    The optimum of one channel is the Chebyshev fit of some n + 1 values (Stromberg 1993). All such sets are tried if
    there are at most 30 000, else random sets. The best are then refined by Chebyshev fits of the h closest values
    until the quantile no longer falls. ``h = N``, the Chebyshev (minimax) fit of all values, is solved exactly. With m
    channels the product of the channels' quantiles is the objective: random sets of n values are refined until no
    channel's quantile can fall without another channel's rising.

    It withstands up to half of the samples as outliers, and is the least precise of the robust estimators (its error
    falls with the cube root of N): :class:`ReweightedLeastSquares` starts from it.

    Args:
        h: rank of the residual, p < h <= N, p = ceil(n / m); default ``N // 2 + 1``.
        starts: number of random sets, if not all are tried.
        seed: seed of the random sets.

    Attributes, after ``fit``:
        coef_: (*, n), without a gradient.
        objective_: (*, m): the h-th smallest absolute residual.
        scale_: (*, m), m being 1 for one channel: ``objective_`` divided by its expected value for standard Gaussian
            residuals, times 1 + 5 / (N - p).
        weights_: 1 for the h smallest residuals, else 0, (*, N, m).
        exact_: whether the optimum is certain: one channel, with h = N or all sets tried.
        n_iter_, converged_: number of refinements, and whether they converged, (*,).

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        Rousseeuw, "Least median of squares regression", JASA 79 (1984) 871-880.
        Stromberg, "Computing the exact least median of squares estimate and stability diagnostics in multiple linear
        regression", SIAM Journal on Scientific Computing 14 (1993) 1289-1299.
        Rousseeuw & Leroy, Robust Regression and Outlier Detection (1987), p. 202, the factor of the scale.

    Example:
        >>> X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
        >>> y = 1 + 2 * X[:, 1]
        >>> y[:4] = 100.0
        >>> LeastMedianOfSquares().fit(X, y).coef_.round(decimals=4)
        tensor([1., 2.], dtype=torch.float64)
    """

    objective_: Float[Tensor, "*batch m"]
    scale_: Float[Tensor, "*batch m"]
    exact_: bool
    n_iter_: int
    converged_: Tensor

    def __init__(self, h: int | None = None, *, starts: int = 3000, seed: int = 0) -> None:
        super().__init__()
        self.h = checked_h(h)
        self.starts = checked_whole("starts", starts, 1, "3000 is usual")
        self.seed = checked_whole("seed", seed)

    @torch.no_grad()
    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> LeastMedianOfSquares:
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. A weight of 2 is a sample that occurs twice.

        Raises:
            ValueError: ``h`` outside [p + 1, N], or bad input as in :meth:`LeastSquares.fit`.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        problem = linear_problem(X, Y, sample_weight)
        N, p = problem.num_samples, problem.coefficients_per_channel
        fewest = min(p + 1, N)
        h = max(N // 2 + 1, fewest) if self.h is None else self.h
        if not fewest <= h <= N:
            raise ValueError(f"Expected argument `h` between {fewest} and the {N} samples but got {h}.")
        n = problem.num_coefficients
        per_problem = n * max(N * problem.num_channels * _CANDIDATES, (n + 1) * _number_of_sets(problem, self.starts))
        parts = torch.arange(problem.Y.shape[0], device=problem.Y.device).split(at_once(problem.Y, per_problem, _CHUNK))
        found = [self._minimise(problem.select(part), h) for part in parts]
        beta = torch.cat([f.beta for f in found])

        rule = QuantileScale(h / N)
        residual = problem.residual(beta).unsqueeze(1)
        scale = rule.scale(problem, residual)
        self._set_common(problem, beta, rule.weight(residual, scale).squeeze(1))
        self.objective_ = problem.restore(scale.squeeze(1))
        total = problem.total_weight()
        factor = (1.0 + 5.0 / (total - p).clamp(min=1.0)) / _expected_quantile(h / N, total)
        self.scale_ = problem.restore(scale.squeeze(1) * factor)
        self.exact_ = problem.num_channels == 1 and (h == N or _few_sets(problem))
        self.n_iter_ = max(f.n_iter for f in found)
        self.converged_ = problem.restore(torch.cat([f.converged for f in found]))
        return self

    def _minimise(self, problem: LinearProblem, h: int) -> _Refined:
        rule = QuantileScale(h / problem.num_samples)
        if problem.num_channels > 1:
            starts = elemental_starts(problem, self.starts, self.seed)
        elif h == problem.num_samples:
            starts = problem.weighted_fit(torch.ones_like(problem.Y)).unsqueeze(1)
        else:
            starts = _level_starts(problem, self.starts, self.seed)
        return _refine(problem, rule, _best(problem, rule, starts))


@dataclass(frozen=True)
class _Refined:
    beta: Float[Tensor, "B n"]
    n_iter: int
    converged: Tensor


def _expected_quantile(share: float, total: Tensor) -> Tensor:
    """Approximate expected quantile ``share`` of ``total`` absolute standard Gaussian values (Blom)."""
    level = (share * total - 0.375) / (total + 0.25)
    # for weights with a sum below 1
    level = level.clamp(min=0.5 * share)
    return torch.special.ndtri(0.5 * (1.0 + level))


def _few_sets(problem: LinearProblem) -> bool:
    return math.comb(problem.num_samples, problem.num_coefficients + 1) <= EXHAUSTIVE_SETS


def _number_of_sets(problem: LinearProblem, starts: int) -> int:
    return math.comb(problem.num_samples, problem.num_coefficients + 1) if _few_sets(problem) else starts


def _level_starts(problem: LinearProblem, count: int, seed: int) -> Float[Tensor, "B S n"]:
    """Least squares, and Chebyshev fits of sets of n + 1 values: all if they are few, else ``count`` random sets."""
    N, n = problem.num_samples, problem.num_coefficients
    least_squares = problem.weighted_fit(torch.ones_like(problem.Y)).unsqueeze(1)
    if n + 1 > N:
        return least_squares
    if _few_sets(problem):
        index = torch.tensor(list(itertools.combinations(range(N), n + 1)), device=problem.Y.device)
        chosen, target = problem.basis[:, :, 0][:, index], problem.Y[..., 0][:, index]
    else:
        chosen, target = values_of_sets(problem, count, n + 1, seed)
    level = equal_heights(chosen, target)
    usable = torch.isfinite(level).all(-1, keepdim=True)
    return torch.cat([torch.where(usable, level, least_squares), least_squares], 1)


def _best(problem: LinearProblem, rule: QuantileScale, beta: Float[Tensor, "B S n"]) -> Float[Tensor, "B K n"]:
    """The candidates with the smallest objective, evaluated in parts that fit in memory."""
    values = problem.Y[0].numel() * problem.Y.shape[0]
    parts = beta.split(at_once(beta, values, _CHUNK), 1)
    objective = torch.cat([log_product(scale_of(problem, part, rule)) for part in parts], 1)
    return taken(beta, objective.topk(min(_CANDIDATES, beta.shape[1]), dim=1, largest=False).indices)


def _refine(problem: LinearProblem, rule: QuantileScale, beta: Float[Tensor, "B K n"], max_iter: int = 100) -> _Refined:
    """Refit by Chebyshev fits of the used values, each channel in units of its quantile, while the quantiles fall."""
    B, K = beta.shape[:2]
    rows, target = problem.basis.flatten(-3, -2), problem.Y.flatten(-2)
    residual = problem.residual(beta)
    scale = rule.scale(problem, residual)
    objective = log_product(scale)
    moving = torch.ones(B, K, dtype=torch.bool, device=beta.device)
    n_iter = 0
    while n_iter < max_iter and bool(moving.any()):
        n_iter += 1
        largest = scale.amax(-1, keepdim=True)
        eps = torch.finfo(scale.dtype).eps
        unit = torch.where(largest > 0, scale / largest, 1.0).clamp(min=eps)
        counts = _counted(problem, rule, residual, scale)
        used, share = counts.flatten(-2), (1.0 / unit).unsqueeze(-2).expand_as(residual).flatten(-2)
        at, of = (moving & _determined(rows, used)).nonzero(as_tuple=True)
        if at.numel() == 0:
            moving = torch.zeros_like(moving)
            break
        factor = share[at, of]
        mine = rows[0] if rows.shape[0] == 1 else rows[at]
        fit = minimax(mine * factor.unsqueeze(-1), target[at] * factor, used[at, of], beta[at, of])
        proposal = beta.index_put((at, of), fit.beta.to(beta))
        residual_to = problem.residual(proposal)
        scale_to = rule.scale(problem, residual_to)
        objective_to = log_product(scale_to)
        moving = objective_to < objective - 64 * eps
        take = (objective_to < objective).unsqueeze(-1)
        beta, scale = torch.where(take, proposal, beta), torch.where(take, scale_to, scale)
        residual = torch.where(take.unsqueeze(-1), residual_to, residual)
        objective = torch.minimum(objective, objective_to)
    best = objective.argmin(1)
    index = torch.arange(B, device=beta.device)
    return _Refined(beta[index, best], n_iter, ~moving[index, best])


def _counted(
    problem: LinearProblem, rule: QuantileScale, residual: Float[Tensor, "B K N m"], scale: Float[Tensor, "B K m"]
) -> Bool[Tensor, "B K N m"]:
    """The values within the quantile; of those equal to it but for rounding the first, as many as it needs.

    A Chebyshev fit has n + 1 residuals of this size, among which rounding would choose.
    """
    size = residual.abs()
    equal = 64 * torch.finfo(size.dtype).eps * problem.Y.abs().amax(-2)[:, None, None] + 1e-12 * scale.unsqueeze(-2)
    below, tied = size < scale.unsqueeze(-2) - equal, size <= scale.unsqueeze(-2) + equal
    weight = torch.ones_like(problem.Y) if problem.sample_weight is None else problem.sample_weight
    own = weight.unsqueeze(1)
    needed = rule.fraction * problem.total_weight()[:, None, None] - (own * below).sum(-2, keepdim=True)
    first = own * (tied & ~below)
    before = first.cumsum(-2) - first
    return (below | (tied & (before < needed * (1.0 - 1e-12)))) & (own > 0)


def _determined(rows: Float[Tensor, "#B R n"], used: Tensor) -> Tensor:
    """Whether more than n rows of (B, K, R) are in use and they have full rank."""
    count = used.to(rows.dtype)
    outer = (rows.unsqueeze(-1) * rows.unsqueeze(-2)).flatten(-2)
    gram = torch.matmul(count, outer[0] if outer.shape[0] == 1 else outer).unflatten(-1, (rows.shape[-1],) * 2)
    values, _ = symmetric_eigen(gram)
    full: Tensor = values[..., 0] > 1e2 * torch.finfo(rows.dtype).eps * values[..., -1]
    return full & (count.sum(-1) > rows.shape[-1])
