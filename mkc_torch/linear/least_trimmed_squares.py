"""Least trimmed squares."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._scale_search import minimise_scale
from mkc_torch.order_statistic import order_statistic

if TYPE_CHECKING:
    from jaxtyping import Float


def stacked(weight: Tensor | None) -> Tensor | None:
    """Sample weights (B, N, m) beside a stack of candidates, (B, 1, N, m)."""
    return None if weight is None else weight.unsqueeze(1)


def default_coverage(problem: LinearProblem) -> int:
    """``(N + p + 1) // 2``, the coverage of highest breakdown point, p being the coefficients of one channel."""
    return min(problem.num_samples, (problem.num_samples + problem.coefficients_per_channel + 1) // 2)


@dataclass(frozen=True)
class TrimmedScale:
    """Root mean square of the smallest ``fraction`` of each channel's residuals, and the indicator of those."""

    fraction: float

    def _count(self, problem: LinearProblem) -> int:
        return max(1, round(self.fraction * problem.num_samples))

    def scale(self, problem: LinearProblem, residual: Tensor) -> Float[Tensor, "B S m"]:
        square = residual.square()
        h = self._count(problem)
        weight = problem.sample_weight
        if weight is None:
            return torch.sqrt(square.topk(h, dim=-2, largest=False, sorted=False).values.mean(-2))
        threshold = order_statistic(square, stacked(weight), h)
        w = torch.where(square <= threshold.unsqueeze(-2), weight.unsqueeze(1), 0.0)
        total = h / problem.num_samples * problem.total_weight().unsqueeze(1)
        # ties beyond h enter once
        trimmed = (w * square).sum(-2) - (w.sum(-2) - total) * threshold
        return torch.sqrt(trimmed.clamp(min=0.0) / total)

    def weight(self, problem: LinearProblem, residual: Tensor, scale: Tensor) -> Float[Tensor, "B S N m"]:  # noqa: ARG002
        size = residual.abs()
        threshold = order_statistic(size, stacked(problem.sample_weight), self._count(problem))
        return (size <= threshold.unsqueeze(-2)).to(size.dtype)


@dataclass(frozen=True)
class QuantileScale:
    """The absolute residual below which ``fraction`` of them lie: a cheap stand-in for ranking many starts."""

    fraction: float

    def scale(self, problem: LinearProblem, residual: Tensor) -> Float[Tensor, "B S m"]:
        h = max(1, round(self.fraction * problem.num_samples))
        return order_statistic(residual.abs(), stacked(problem.sample_weight), h)

    def weight(self, problem: LinearProblem, residual: Tensor, scale: Tensor) -> Float[Tensor, "B S N m"]:  # noqa: ARG002
        return (residual.abs() <= scale.unsqueeze(-2)).to(residual.dtype)


def gaussian_consistency(fraction: float) -> float:
    """Factor that makes the root mean square of the smallest ``fraction`` of Gaussian residuals estimate their σ."""
    if fraction >= 1.0:
        return 1.0
    q = torch.special.ndtri(torch.tensor((1.0 + fraction) / 2.0, dtype=torch.float64)).item()
    variance = 1.0 - 2.0 * q * math.exp(-0.5 * q * q) / math.sqrt(2.0 * math.pi) / fraction
    return variance**-0.5


class LeastTrimmedSquares(LinearEstimator):
    """Least sum of the h smallest squared residuals, by concentration steps from many elemental starts.

    With m channels every channel keeps its h smallest residuals and the product of the channels' trimmed scales is
    minimised, so that no channel's unit matters.

    Args:
        h: values of each channel that count, n < h <= N; default ``(N + p + 1) // 2`` with p = ceil(n / m), the
            coverage of highest breakdown point.
        starts: number of elemental starts.
        seed: of the elemental starts.

    Attributes, after ``fit``:
        coef_: (*, n).
        scale_: (*, m), m being 1 for one channel: trimmed root mean square, made consistent for Gaussian residuals.
        objective_: (*, m): sum of the h smallest squared residuals.
        weights_: 1 for the values that count, else 0.
        n_iter_, converged_: steps made, and whether they had come to rest, (*,).

    References:
        Rousseeuw, "Least median of squares regression", JASA 79 (1984) 871-880.
        Rousseeuw & Van Driessen, "Computing LTS regression for large data sets", DMKD 12 (2006) 29-45.

    Example:
        >>> X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
        >>> y = 1 + 2 * X[:, 1]
        >>> y[:4] = 100.0
        >>> LeastTrimmedSquares().fit(X, y).coef_
        tensor([1.0000, 2.0000], dtype=torch.float64)
    """

    def __init__(self, h: int | None = None, *, starts: int = 500, seed: int = 0) -> None:
        super().__init__()
        if h is not None and (isinstance(h, bool) or not isinstance(h, int)):
            raise TypeError(f"Expected argument `h` to be a whole number but got {h!r}.")
        if starts < 1:
            raise ValueError(f"Expected argument `starts` to be at least 1 but got {starts}.")
        self.h = h
        self.starts = starts
        self.seed = seed

    def fit(self, X: Tensor, Y: Tensor, sample_weight: Tensor | None = None) -> LeastTrimmedSquares:
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. A weight of 2 is a sample that occurs twice.

        Raises:
            ValueError: ``h`` outside [p + 1, N], or bad input as in :meth:`LeastSquares.fit`.
        """
        problem = linear_problem(X, Y, sample_weight)
        N, p = problem.num_samples, problem.coefficients_per_channel
        h = default_coverage(problem) if self.h is None else self.h
        if not min(p + 1, N) <= h <= N:
            raise ValueError(f"Expected argument `h` between {p + 1} and the {N} samples but got {h}.")
        rule = TrimmedScale(h / N)
        minimum = minimise_scale(problem, rule, rule, starts=self.starts, seed=self.seed)
        self._set_common(problem, minimum.beta, minimum.weight)
        scale = problem.restore(minimum.scale)
        total = problem.restore(problem.total_weight())
        self.objective_ = scale.square() * h / N * total
        self.scale_ = scale * gaussian_consistency(h / N)
        self.n_iter_ = minimum.n_iter
        self.converged_ = problem.restore(minimum.converged)
        return self
