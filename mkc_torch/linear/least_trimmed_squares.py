"""Least trimmed squares."""

from __future__ import annotations

import itertools
import math
import numbers
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_whole
from mkc_torch._support.arrays import Data
from mkc_torch._support.independent_rows import taken
from mkc_torch._support.order_statistic import order_statistic
from mkc_torch._support.side_by_side import at_once, steps_between_tests
from mkc_torch._support.small_factors import symmetric_pinv
from mkc_torch.linear._concentration import QUANTILE, TRIMMED, ScaleOptions
from mkc_torch.linear._inference import RobustInference
from mkc_torch.linear._influence import Scores, coefficients_a_value
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._scale_search import ScaleSearch, minimise_scale, relative_precision, rounding_scale
from mkc_torch.linear.covariance import RobustCovarianceKind

if TYPE_CHECKING:
    from jaxtyping import Float


def stacked(weight: Tensor | None) -> Tensor | None:
    """Sample weights (B, N, m) with a dimension for candidates, (B, 1, N, m)."""
    return None if weight is None else weight.unsqueeze(1)


def checked_h(h: object) -> int | None:
    """Return ``h`` if it is valid, else raise; its lower bound is checked in ``fit``."""
    if h is not None and (isinstance(h, bool) or not isinstance(h, numbers.Integral)):
        raise TypeError(f"Expected argument `h` to be a whole number but got {h!r}; pass a number of values.")
    return None if h is None else checked_whole("h", h, 1, "it counts values; None takes the default")


def default_coverage(problem: LinearProblem) -> int:
    """``(N + p + 1) // 2``, the coverage with the highest breakdown point, for p coefficients per channel."""
    return min(problem.num_samples, (problem.num_samples + problem.coefficients_per_channel + 1) // 2)


@dataclass(frozen=True)
class _FractionScale:
    """A scale of the smallest ``fraction`` of the residuals."""

    fraction: float
    rule: ClassVar[int]

    def _count(self, problem: LinearProblem) -> int:
        return max(1, round(self.fraction * problem.num_samples))

    def options(self, problem: LinearProblem) -> ScaleOptions:
        return ScaleOptions(self.rule, self._count(problem))


class TrimmedScale(_FractionScale):
    """Root mean square of the smallest ``fraction`` of each channel's residuals, and the mask of these residuals."""

    rule = TRIMMED

    def scale(self, problem: LinearProblem, residual: Tensor, _near: Tensor | None = None) -> Float[Tensor, "B S m"]:
        return self.weighted(problem, residual)[0]

    def weighted(
        self, problem: LinearProblem, residual: Tensor, _near: Tensor | None = None
    ) -> tuple[Float[Tensor, "B S m"], Tensor]:
        square = residual.square()
        h = self._count(problem)
        weight = stacked(problem.sample_weight)
        threshold = order_statistic(square, weight, h)
        counts = (square <= threshold.unsqueeze(-2)).to(square.dtype)
        total, w = square.new_tensor(float(h)), counts
        if weight is not None:
            total, w = h / problem.num_samples * problem.total_weight().unsqueeze(1), weight * counts
        # of tied values only as many as needed enter
        trimmed = (w * square).sum(-2) - (w.sum(-2) - total) * threshold
        return torch.sqrt(trimmed.clamp(min=0.0) / total), counts


class QuantileScale(_FractionScale):
    """Quantile ``fraction`` of the absolute residuals: a cheap scale for ranking many starts."""

    rule = QUANTILE

    def scale(self, problem: LinearProblem, residual: Tensor, _near: Tensor | None = None) -> Float[Tensor, "B S m"]:
        return order_statistic(residual.abs(), stacked(problem.sample_weight), self._count(problem))

    def weighted(
        self, problem: LinearProblem, residual: Tensor, _near: Tensor | None = None
    ) -> tuple[Float[Tensor, "B S m"], Tensor]:
        scale = self.scale(problem, residual)
        return scale, self.weight(residual, scale)

    def weight(self, residual: Tensor, scale: Tensor) -> Float[Tensor, "B S N m"]:
        """1 for residuals within the quantile, else 0."""
        return (residual.abs() <= scale.unsqueeze(-2)).to(residual.dtype)


def gaussian_consistency(fraction: float) -> float:
    """Factor that makes the root mean square of the smallest ``fraction`` of Gaussian residuals estimate their σ."""
    return float(_gaussian_slope(torch.tensor(fraction, dtype=torch.float64)).rsqrt())


def _gaussian_slope(fraction: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``1 - 2 q φ(q) / fraction`` with P(|Z| <= q) = fraction: mean square of the Gaussian values within q.

    It is also the mean slope of a trimmed score, since a change of the fit moves values across the edge.
    """
    q = torch.special.ndtri(0.5 + 0.5 * fraction.clamp(max=1.0 - 1e-12))
    density = torch.exp(-0.5 * q.square()) / math.sqrt(2.0 * math.pi)
    return torch.where(fraction < 1.0, 1.0 - 2.0 * q * density / fraction, 1.0)


_GOOD = 2.5
"""Scales within which a value counts as an inlier; 98.8 % of Gaussian values are."""


def trimmed_equation(
    problem: LinearProblem, beta: Float[Tensor, "B n"], weight: Float[Tensor, "B N m"], fraction: float
) -> Scores:
    """Estimating equation of least trimmed squares, with the slope for Gaussian inliers.

    Outliers are trimmed first, so the used values are a larger share of the inliers than of all values. The number of
    inliers depends on the scale and the scale on that number, so both are iterated.
    """
    residual = problem.residual(beta)
    w = weight if problem.sample_weight is None else weight * problem.sample_weight
    raw = ((w * residual.square()).sum(-2) / (fraction * problem.total_weight())).sqrt()
    raw = torch.maximum(raw, rounding_scale(problem))
    share = torch.full_like(raw, fraction)
    inside = math.erf(_GOOD / math.sqrt(2.0))
    for _ in range(3):
        scale = raw / _gaussian_slope(share).sqrt()
        near = (residual.abs() <= _GOOD * scale.unsqueeze(-2)).to(raw.dtype)
        counted = near if problem.sample_weight is None else near * problem.sample_weight
        good = (counted.sum(-2) / problem.total_weight() / inside).clamp(min=fraction, max=1.0)
        share = fraction / good
    slope = _gaussian_slope(share)
    scale = raw / slope.sqrt()
    z = residual / scale.unsqueeze(-2)
    return Scores(z * weight, weight * slope.unsqueeze(-2), z, scale)


_SMALL_SAMPLE = 26.0
"""Standard errors grow by the square of this times the trimmed share times n / N.

From Gaussian draws of 2, 4 and 8 coefficients with 10 to 80 samples each and half of them trimmed. Their errors are
2.8, 1.4, 1.0 and 0.9 times the large-sample values, since the fit was chosen to make its residuals small.
"""


class LeastTrimmedSquares(RobustInference):
    """Least sum of the h smallest squared residuals, (24) of Indiveri (2009).

    One channel of few samples is solved exactly: where there are at most 20 000 choices of h of N samples (N = 16), all
    are tried. Otherwise concentration steps run from many elemental starts. Up to 400 samples of one channel without
    weights, the best fit is then improved by exchanging a used value for an unused one as long as that lowers the sum.
    With m channels every channel keeps its h smallest residuals and the product of the channels' trimmed scales is
    minimised, so that no channel's unit matters.

    Each start is a fit through n values, and one start through clean values is enough. At a share ε of outliers all
    ``starts`` miss with probability ``(1 - (1 - ε)^n)^starts``, which is 1e-6 at ε = 0.45 and 4e-4 at 0.5 for the
    default and n = 6. Take more starts for more coefficients.

    Args:
        h: number of values of each channel in the sum, p < h <= N; default ``(N + p + 1) // 2`` with p = ceil(n / m),
            the coverage with the highest breakdown point.
        starts: number of elemental starts, each through n values.
        covariance: "sandwich" for independent samples, "hac" for a time series, "homoscedastic" where errors have the
            same distribution at every X and no outlier lies far out in X. Inliers are assumed Gaussian at the edge of
            the used values.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        seed: seed of the elemental starts.

    Attributes, after ``fit``:
        coef_: (*, n); its gradient is that of least squares on the used values.
        covariance_, dof_: (*, n, n), (*,); the asymptotic covariance (Butler, "Nonparametric interval and point
            prediction using data trimmed by a Grubbs-type outlier rule", 1982), widened in small samples.
        scale_: (*, m), m being 1 for one channel: trimmed root mean square, made consistent for Gaussian residuals.
        objective_: (*, m): sum of the h smallest squared residuals.
        weights_: 1 for the used values, else 0, (*, N, m).
        exact_: whether the optimum is certain: all choices were tried, or h = N in one channel.
        n_iter_, converged_: number of steps, and whether they converged, (*,).

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        Rousseeuw, "Least median of squares regression", JASA 79 (1984) 871-880.
        Rousseeuw & Van Driessen, "Computing LTS regression for large data sets", DMKD 12 (2006) 29-45.
        Hawkins, "The feasible solution algorithm for least trimmed squares regression", Computational Statistics & Data
        Analysis 17 (1994) 185-196: the exchange.

    Example:
        >>> X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
        >>> y = 1 + 2 * X[:, 1]
        >>> y[:4] = 100.0
        >>> LeastTrimmedSquares().fit(X, y).coef_
        tensor([1.0000, 2.0000], dtype=torch.float64)
    """

    scale_: Float[Tensor, "*batch m"]
    objective_: Float[Tensor, "*batch m"]
    exact_: bool
    n_iter_: int
    converged_: Tensor

    def __init__(
        self,
        h: int | None = None,
        *,
        starts: int = 500,
        covariance: RobustCovarianceKind = "sandwich",
        bandwidth: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self._set_covariance(covariance, bandwidth)
        self.h = checked_h(h)
        self.starts = checked_whole("starts", starts, 1, "500 is usual")
        self.seed = checked_whole("seed", seed)

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> LeastTrimmedSquares:
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. A weight of 2 is a sample that occurs twice.

        Raises:
            ValueError: ``h`` outside [p + 1, N], or bad input as in :meth:`LeastSquares.fit`.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        problem = linear_problem(X, Y, sample_weight)
        N, p = problem.num_samples, problem.coefficients_per_channel
        h = default_coverage(problem) if self.h is None else self.h
        if not min(p + 1, N) <= h <= N:
            raise ValueError(f"Expected argument `h` between {p + 1} and the {N} samples but got {h}.")
        rule = TrimmedScale(h / N)
        with torch.no_grad():
            beta, n_iter, converged = self._minimise(problem, rule, h)
            residual = problem.residual(beta).unsqueeze(1)
            trimmed, weight = rule.weighted(problem, residual)
            weight = weight.squeeze(1)
        if problem.basis.requires_grad or problem.Y.requires_grad:
            # the choice of the used values is a constant
            beta = problem.weighted_fit(weight * relative_precision(trimmed.squeeze(1)).unsqueeze(-2))
            trimmed = rule.scale(problem, problem.residual(beta).unsqueeze(1))
        self._set_common(problem, beta, weight)
        scale = problem.restore(trimmed.squeeze(1))
        total = problem.restore(problem.total_weight())
        self.objective_ = scale.square() * h / N * total
        self.scale_ = scale * gaussian_consistency(h / N)
        equation = trimmed_equation(problem, beta, weight, h / N)
        wider = 1.0 + (_SMALL_SAMPLE * (N - h) / N * coefficients_a_value(problem)).square()
        self._infer(problem, beta, weight, equation, gaussian_consistency(h / N) ** 2, widening=wider)
        self.exact_ = problem.num_channels == 1 and (h == N or _few_choices(problem, h))
        self.n_iter_ = n_iter
        self.converged_ = problem.restore(converged)
        return self

    def _minimise(self, problem: LinearProblem, rule: TrimmedScale, h: int) -> tuple[Tensor, int, Tensor]:
        if _few_choices(problem, h):
            beta = _best_choice(problem, rule, h)
            return beta, 0, torch.ones(beta.shape[0], dtype=torch.bool, device=beta.device)
        N = problem.num_samples
        # a small sample has more local minima than a ranking after two steps distinguishes
        candidates = 200 if N <= _EXCHANGE_SAMPLES else 10
        search = ScaleSearch(rule, rule, starts=self.starts, candidates=candidates, seed=self.seed)
        found = minimise_scale(problem, search)
        beta = found.beta
        if _plain(problem) and h < N <= _EXCHANGE_SAMPLES:
            beta = _exchange(problem, beta, h)
        return beta, found.n_iter, found.converged


EXHAUSTIVE_CHOICES = 20_000
"""Largest number of choices of h samples that are all tried."""

_EXCHANGE_SAMPLES = 400
"""Largest number of samples for which values are exchanged."""

_CHUNK = 1 << 22
"""Largest number of values held at once."""


def _plain(problem: LinearProblem) -> bool:
    return problem.num_channels == 1 and problem.sample_weight is None


def _few_choices(problem: LinearProblem, h: int) -> bool:
    return _plain(problem) and math.comb(problem.num_samples, h) <= EXHAUSTIVE_CHOICES


def _best_choice(problem: LinearProblem, rule: TrimmedScale, h: int) -> Float[Tensor, "B n"]:
    """Least squares on every choice of h samples of one channel; the fit with the smallest sum of squares."""
    N, n = problem.num_samples, problem.num_coefficients
    choice = torch.tensor(list(itertools.combinations(range(N), h)), device=problem.Y.device)
    mask = torch.zeros(choice.shape[0], N, dtype=problem.Y.dtype, device=problem.Y.device).scatter_(1, choice, 1.0)
    per_problem = mask.shape[0] * max(N, n * n)
    best = []
    for part in torch.arange(problem.Y.shape[0], device=choice.device).split(at_once(problem.Y, per_problem, _CHUNK)):
        some = problem.select(part)
        beta = some.weighted_fit(mask.unsqueeze(-1).expand(part.shape[0], -1, -1, -1))
        first = rule.scale(some, some.residual(beta)).squeeze(-1).argmin(1)
        best.append(beta[torch.arange(part.shape[0], device=part.device), first])
    return torch.cat(best)


def _exchange(problem: LinearProblem, beta: Float[Tensor, "B n"], h: int) -> Float[Tensor, "B n"]:
    """Exchange a used sample for an unused one while the sum of squares after the refit falls."""
    N = problem.num_samples
    parts = torch.arange(beta.shape[0], device=beta.device).split(at_once(beta, h * (N - h), _CHUNK))
    return torch.cat([_exchange_part(problem.select(part), beta[part], h) for part in parts])


def _exchange_part(problem: LinearProblem, beta: Float[Tensor, "B n"], h: int) -> Float[Tensor, "B n"]:
    N = problem.num_samples
    rows = problem.basis[:, :, 0]
    eps = torch.finfo(beta.dtype).eps
    first = problem.residual(beta)[..., 0].abs().topk(h, dim=-1, largest=False).indices
    keep = torch.zeros_like(problem.Y[..., 0], dtype=torch.bool).scatter(1, first, True)
    magnitude = problem.Y.square().sum((-2, -1))
    active = torch.arange(beta.shape[0], device=beta.device)
    falls, some, step, every = torch.ones_like(active, dtype=torch.bool), problem, 0, steps_between_tests(beta)
    while True:
        if step % every == 0:
            left = falls.nonzero().squeeze(-1)
            if len(left) == 0:
                break
            if len(left) < len(active):
                active = active[left]
                some, falls = problem.select(active), torch.ones_like(left, dtype=torch.bool)
        step += 1
        counts = keep[active].to(beta.dtype).unsqueeze(-1)
        gram, _ = some.normal_equations(counts)
        beta[active] = some.weighted_fit(counts)
        error = some.residual(beta[active])[..., 0]
        inverse = symmetric_pinv(gram)
        order = keep[active].to(torch.uint8).argsort(dim=-1, descending=True, stable=True)
        used, unused = order[:, :h], order[:, h:]
        mine = (rows if rows.shape[0] == 1 else rows[active]).expand(len(active), -1, -1)
        projected = torch.matmul(mine, inverse)
        own = (projected * mine).sum(-1)
        leverage = torch.matmul(taken(projected, used), taken(mine, unused).mT)
        lost, gained = error.gather(1, used).unsqueeze(-1), error.gather(1, unused).unsqueeze(-2)
        out = (1.0 - own.gather(1, used)).clamp(min=0.0).unsqueeze(-1)
        into = (1.0 + own.gather(1, unused)).unsqueeze(-2)
        change = gained.square() * out - lost.square() * into + 2.0 * lost * gained * leverage
        # a sample of leverage 1 cannot be removed
        change = change / (out * into + leverage.square()).clamp(min=eps)
        gain, pair = change.flatten(-2).min(-1)
        total = (counts[..., 0] * error.square()).sum(-1)
        falls = falls & (gain < -(1e3 * eps * total + eps * eps * magnitude[active]))
        out_of = used.gather(1, (pair // (N - h)).unsqueeze(-1))
        into_it = unused.gather(1, (pair % (N - h)).unsqueeze(-1))
        mask = keep[active].scatter(-1, out_of, False).scatter(-1, into_it, True)
        keep[active] = torch.where(falls.unsqueeze(-1), mask, keep[active])
    return beta
