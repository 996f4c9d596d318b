"""Least trimmed squares."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._scale_search import ScaleMinimum, ScaleRule, minimise_scale

if TYPE_CHECKING:
    from jaxtyping import Float


def order_statistic(
    values: Float[Tensor, "B *S N m"], weight: Float[Tensor, "B N m"] | None, h: float
) -> Float[Tensor, "B *S m"]:
    """The h-th smallest value of each channel; with weights, the value at which their cumulated share reaches h/N."""
    if weight is None:
        return values.kthvalue(int(h), dim=-2).values
    weight = weight if values.dim() == 3 else weight.unsqueeze(1)
    ordered, index = values.sort(dim=-2)
    cumulated = weight.expand_as(values).gather(-2, index).cumsum(-2)
    share = h / values.shape[-2] * cumulated[..., -1:, :]
    position = (cumulated < share * (1 - 1e-12)).sum(-2, keepdim=True)
    return ordered.gather(-2, position).squeeze(-2)


def default_coverage(problem: LinearProblem) -> int:
    """``(N + p + 1) // 2``, the coverage of highest breakdown point, p being the coefficients of one channel."""
    return (problem.num_samples + problem.coefficients_per_channel + 1) // 2


def trimmed_scale(h: int) -> ScaleRule:
    """Root mean square of the h smallest residuals of each channel, and the indicator of those."""

    def rule(problem: LinearProblem, residual: Tensor) -> tuple[Tensor, Tensor]:
        square = residual.square()
        weight = problem.sample_weight
        threshold = order_statistic(square, weight, h)
        inside = (square <= threshold.unsqueeze(-2)).to(square.dtype)
        w = inside if weight is None else inside * weight.unsqueeze(1)
        total = float(h) if weight is None else h / problem.num_samples * problem.total_weight().unsqueeze(1)
        # ties beyond h enter once
        trimmed = (w * square).sum(-2) - (w.sum(-2) - total) * threshold
        return torch.sqrt(trimmed.clamp(min=0.0) / total), inside

    return rule


def gaussian_consistency(fraction: float) -> float:
    """Factor that makes the root mean square of the smallest ``fraction`` of Gaussian residuals estimate their σ."""
    if fraction >= 1.0:
        return 1.0
    q = torch.special.ndtri(torch.tensor((1.0 + fraction) / 2.0, dtype=torch.float64)).item()
    variance = 1.0 - 2.0 * q * math.exp(-0.5 * q * q) / math.sqrt(2.0 * math.pi) / fraction
    return variance**-0.5


def minimise_trimmed_squares(
    problem: LinearProblem, h: int, *, starts: int = 500, candidates: int = 10, seed: int = 0
) -> ScaleMinimum:
    """Least trimmed squares of coverage ``h`` on a checked problem."""

    def at_fraction(part: LinearProblem, residual: Tensor) -> tuple[Tensor, Tensor]:
        count = max(1, round(h * part.num_samples / problem.num_samples))
        return trimmed_scale(count)(part, residual)

    return minimise_scale(problem, at_fraction, trimmed_scale(h), starts=starts, candidates=candidates, seed=seed)


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
        scale_: (*, m), or (*,) for one channel: trimmed root mean square, made consistent for Gaussian residuals.
        objective_: (*, m) or (*,): sum of the h smallest squared residuals.
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
        h = min(N, default_coverage(problem)) if self.h is None else self.h
        if not min(p + 1, N) <= h <= N:
            raise ValueError(f"Expected argument `h` between {p + 1} and the {N} samples but got {h}.")
        minimum = minimise_trimmed_squares(problem, h, starts=self.starts, seed=self.seed)
        self._set_common(problem, minimum.beta, minimum.weight)
        scale = problem.restore(minimum.scale)
        total = problem.restore(problem.total_weight())
        self.objective_ = self._by_channel(scale.square() * h / N * total)
        self.scale_ = self._by_channel(scale * gaussian_consistency(h / N))
        self.n_iter_ = minimum.n_iter
        self.converged_ = problem.restore(minimum.converged)
        return self
