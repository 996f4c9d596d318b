"""Least entropy-like regression: coefficients whose relative squared residuals have the least entropy."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole, refuse_complex, refuse_no_tensor, seems_finite
from mkc_torch._support.arrays import Data
from mkc_torch._support.side_by_side import at_once, side_by_side
from mkc_torch._support.small_factors import solve
from mkc_torch._support.trust_region import Minima, Quadratic, minimise
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.losses.entropy_like import LEAST_TOTAL, orthogonal_starts

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


_CHUNK = 1 << 22
"""Largest number of values held at once: products of rows, and residuals of all descents."""

_RADIUS = 0.8
"""Largest angle of the first steps, in radians between residual vectors."""


class LeastEntropyLike(LinearEstimator):
    """Local minima of H, the normalised entropy of the relative squared residuals, and the minimum of least H.

    H is invariant to the scale of the residuals. A minimum is found from each of several starts: by default least
    squares and n - 1 vectors of its length orthogonal to it, (50)-(51). The minima are equivariant. The starts, as the
    paper defines them, are not: other units of the columns of X give other starts. Bad leverage points can cause a
    further minimum, often with the least H (the paper's Table 5): inspect all minima. With many coefficients
    and errors that are all Gaussian, a few large residuals may have less entropy than those of the truth.

    The residual is a homogeneous function of (θ, 1), so the descent is over directions, by Newton's method with the
    exact Hessian. It may pass through infinite coefficients. With m channels the mean of the
    channels' H is minimised.

    Args:
        start: initial guess θ̂0 of (50), (n,) or (*, n); default least squares.
        starts: all starts, instead of ``start``, (S, n) or (*, S, n).
        tol: predicted gain in H below which a descent ends.
        max_iter: largest number of steps tried.

    Attributes, after ``fit``:
        coef_: coefficients of least H, (*, n).
        entropy_: H at ``coef_``, (*,); 0 for an exact fit.
        starts_: (*, S, n).
        minima_: end of the descent from each start, (*, S, n).
        minima_entropy_: H at ``minima_``, (*, S).
        minima_converged_: whether each is a local minimum, (*, S).
        converged_: whether ``coef_`` is a local minimum, (*,).
        n_iter_: largest number of steps tried from a start, (*,).
        weights_: 1 where descent along the gradient (52) reduces a residual; 0 where ``log q`` exceeds its mean under
            q, so that the residual grows.

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        G. Indiveri, "An Entropy-Like Estimator for Robust Parameter Identification", Entropy 11 (2009) 560-585.

    Example:
        >>> x = torch.arange(10.0, dtype=torch.float64)
        >>> y = 1 + 2 * x
        >>> y[:2] = 50.0
        >>> fit = LeastEntropyLike().fit(torch.stack([torch.ones_like(x), x], -1), y)
        >>> fit.coef_.round(decimals=1)
        tensor([1., 2.], dtype=torch.float64)
    """

    _may_miss_clean_data = True

    entropy_: Float[Tensor, "*batch"]
    starts_: Float[Tensor, "*batch S n"]
    minima_: Float[Tensor, "*batch S n"]
    minima_entropy_: Float[Tensor, "*batch S"]
    minima_converged_: Bool[Tensor, "*batch S"]
    converged_: Bool[Tensor, "*batch"]
    n_iter_: Int[Tensor, "*batch"]

    def __init__(
        self,
        start: Float[Tensor, "*batch n"] | None = None,
        *,
        starts: Float[Tensor, "*batch S n"] | None = None,
        tol: float = 1e-12,
        max_iter: int = 200,
    ) -> None:
        super().__init__()
        if start is not None and starts is not None:
            raise ValueError("Expected argument `start` or `starts` but got both; pass one argument only.")
        self.start = _checked_start("start", start, 1)
        self.starts = _checked_start("starts", starts, 2)
        self.tol = checked_number("tol", tol, 0.0, 1.0, advice="1e-12 gives the coefficients nine digits")
        self.max_iter = checked_whole("max_iter", max_iter, 1, "200 is ample")

    @torch.no_grad()
    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> LeastEntropyLike:
        """Fit ``Y ~ X coef`` in float64; shapes as in :meth:`LeastSquares.fit`. A weight of 2 is a sample twice.

        Raises:
            ValueError: fewer than n + 2 values (with n + 1 values any fit through n of them has H = 0), weights that
                total at most 1, a start of the wrong shape, or bad input as in :meth:`LeastSquares.fit`.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        problem = linear_problem(X, Y, sample_weight).double()
        _check_counts(problem)
        least_squares = _least_squares(problem)
        starts = self._starts(problem, least_squares)
        remainder, length = _remainder(problem, least_squares, torch.finfo(Y.dtype).eps)
        exact = length <= 0
        length = torch.where(exact, 1.0, length)
        remainder = remainder / length[:, None, None]

        S, n = starts.shape[1:]
        away = (starts - least_squares.unsqueeze(1)) / -length[:, None, None]
        directions = torch.cat([away, torch.ones_like(away[..., :1])], dim=-1)
        per_problem = problem.Y[0].numel() * (n + 1) * (n + 4) // 2
        parts = torch.arange(starts.shape[0], device=starts.device).split(at_once(starts, per_problem, _CHUNK))
        found = [self._descend(problem.select(part), remainder[part], directions[part]) for part in parts]
        minima = Minima(*(torch.cat([getattr(f, field.name) for f in found]) for field in fields(Minima)))
        # the last component is 0 only if the coefficients are infinite
        last = minima.point[:, -1:]
        last = torch.where(last.abs() > 1e-12, last, torch.where(last < 0, -1e-12, 1e-12))
        beta = (minima.point[:, :-1] / last).unflatten(0, (-1, S)) * -length[:, None, None]
        beta = torch.where(exact[:, None, None], 0.0, beta) + least_squares.unsqueeze(1)
        entropy = torch.where(exact.unsqueeze(1), 0.0, minima.value.unflatten(0, (-1, S)))
        converged = minima.converged.unflatten(0, (-1, S)) | exact.unsqueeze(1)

        best = torch.where(converged | ~converged.any(1, keepdim=True), entropy, torch.inf).argmin(1)
        problems = torch.arange(best.shape[0], device=best.device)
        chosen = beta[problems, best]
        reduced = torch.where(exact[:, None, None], 1.0, _reduced(problem, chosen).to(Y.dtype))
        self._set_common(problem, chosen, reduced)
        self.coef_ = self.coef_.to(Y.dtype)
        self.entropy_ = problem.restore(entropy[problems, best].to(Y.dtype))
        self.starts_ = problem.restore(_coefficients(problem, starts).to(Y.dtype))
        self.minima_ = problem.restore(_coefficients(problem, beta).to(Y.dtype))
        self.minima_entropy_ = problem.restore(entropy.to(Y.dtype))
        self.minima_converged_ = problem.restore(converged)
        self.converged_ = problem.restore(converged[problems, best])
        self.n_iter_ = problem.restore(minima.n_iter.unflatten(0, (-1, S)).amax(1))
        return self

    def _descend(
        self, problem: LinearProblem, remainder: Float[Tensor, "B N m"], start: Float[Tensor, "B S n+1"]
    ) -> Minima:
        function = _Directions(problem, remainder, start.shape[1])
        start = _unit(start.flatten(0, 1))
        return minimise(
            function.quadratic,
            start,
            start.new_full((start.shape[0],), _RADIUS),
            tol=self.tol,
            max_iter=self.max_iter,
            retract=_unit,
        )

    def _starts(self, problem: LinearProblem, least_squares: Tensor) -> Float[Tensor, "B S n"]:
        """Return the starts in the basis."""
        n = problem.num_coefficients
        _checked_start("start", self.start, 1, n)
        _checked_start("starts", self.starts, 2, n)
        if self.starts is not None:
            coef = self.starts.to(problem.Y)
            coef = coef.expand(*problem.batch, *coef.shape[-2:]).reshape(-1, *coef.shape[-2:])
        elif self.start is not None:
            first = self.start.to(problem.Y).expand(*problem.batch, n).reshape(-1, n)
            coef = orthogonal_starts(first)
        else:
            coef = orthogonal_starts(_coefficients(problem, least_squares.unsqueeze(1)).squeeze(1))
        return solve(problem.to_coef, coef.mT).mT


def _checked_start(name: str, value: Tensor | None, least: int, n: int | None = None) -> Tensor | None:
    """Return starts of at least ``least`` dimensions and, where known, n columns if they are valid, else raise."""
    if value is None:
        return None
    refuse_no_tensor(name, value, "a tensor")
    refuse_complex(name, value)
    fits = value.dim() >= least and n in (None, value.shape[-1])
    if not fits or not (seems_finite(value) if n is None else bool(torch.isfinite(value).all())):
        raise ValueError(
            f"Expected argument `{name}` of finite values of shape (*, {'S, ' * (least - 1)}{'n' if n is None else n}) "
            f"but got {tuple(value.shape) if not fits else 'NaN or infinity'}."
        )
    return value


def _least_squares(problem: LinearProblem) -> Float[Tensor, "B n"]:
    if problem.sample_weight is not None:
        return problem.weighted_fit(torch.ones_like(problem.Y))
    # the columns of the basis are orthonormal
    return torch.matmul(problem.basis.flatten(-3, -2).mT, problem.Y.flatten(-2).unsqueeze(-1)).squeeze(-1)


def _remainder(
    problem: LinearProblem, least_squares: Float[Tensor, "B n"], eps: float
) -> tuple[Float[Tensor, "B N m"], Float[Tensor, " B"]]:
    """Least-squares residuals and their length; 0 for a channel fitted to rounding and for values of weight 0."""
    residual, target = problem.residual(least_squares), problem.Y
    if problem.sample_weight is not None:
        used = problem.sample_weight > 0
        residual, target = torch.where(used, residual, 0.0), torch.where(used, target, 0.0)
    rounding = 64.0 * eps * target.abs().amax((-2, -1)) * target[0].numel() ** 0.5
    seen = torch.linalg.vector_norm(residual, dim=-2, keepdim=True) > rounding[:, None, None]
    residual = torch.where(seen, residual, 0.0)
    return residual, torch.linalg.vector_norm(residual, dim=(-2, -1))


def _coefficients(problem: LinearProblem, beta: Float[Tensor, "B S n"]) -> Float[Tensor, "B S n"]:
    return torch.matmul(beta, problem.to_coef.mT)


def _check_counts(problem: LinearProblem) -> None:
    n, m = problem.num_coefficients, problem.num_channels
    used = torch.full((1, 1), float(problem.num_samples))
    if problem.sample_weight is not None:
        used = (problem.sample_weight > 0).sum(-2)
    if bool((used.expand(-1, m).sum(-1) < n + 2).any()):
        raise ValueError(
            f"Expected at least {n + 2} values for {n} coefficients but got {int(used.expand(-1, m).sum(-1).min())}: "
            f"through any {n} of {n + 1} values H is 0; add samples."
        )
    total = problem.total_weight()
    if bool((total <= LEAST_TOTAL).any()):
        raise ValueError(
            "Expected argument `sample_weight` to count repetitions and to total more than 1 in every channel "
            f"but got {float(total.min()):.3g}; multiply it by the number of samples."
        )


def _unit(direction: Float[Tensor, "K p"]) -> Float[Tensor, "K p"]:
    return direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)


class _Directions:
    """H of the residuals ``[basis, remainder] c`` over directions c with p = n + 1 components, S a problem."""

    def __init__(self, problem: LinearProblem, remainder: Float[Tensor, "B N m"], descents: int) -> None:
        self.descents = descents
        self._index: Tensor | None = None
        B, m = problem.Y.shape[0], problem.num_channels
        # samples last, where sums over them are fastest
        columns = torch.cat([problem.basis.permute(0, 2, 3, 1).expand(B, -1, -1, -1), remainder.mT.unsqueeze(2)], dim=2)
        if m > 1:
            # H of a channel does not depend on its unit
            size = torch.linalg.vector_norm(columns[:, :, -1], dim=-1)[..., None, None]
            columns = columns / torch.where(size > 0, size, 1.0)
        p = columns.shape[2]
        self.columns = self.counted = columns
        self.weight = None
        if problem.sample_weight is not None:
            self.weight = problem.sample_weight.mT.unsqueeze(2)
            self.counted = self.weight * columns
        upper = torch.triu_indices(p, p, device=columns.device)
        self.outer = self.counted[:, :, upper[0]] * columns[:, :, upper[1]]
        self.gram = self.outer.sum(-1)
        self.place = torch.zeros(p, p, dtype=torch.long, device=columns.device)
        self.place[upper[0], upper[1]] = self.place[upper[1], upper[0]] = torch.arange(upper.shape[1]).to(self.place)
        self.unit = 1.0 / (m * problem.total_weight().log())[:, :, None, None]

    def quadratic(self, c: Float[Tensor, "K p"], index: Int[Tensor, " K"]) -> Quadratic:
        """H with gradient and Hessian at directions ``c`` of the descents ``index``."""
        if self.columns.shape[0] == 1:
            return self._of(c.unsqueeze(0), slice(None))
        # the running descents change only when some have ended
        if self._index is not index:
            under_way, place = (index // self.descents).unique(return_inverse=True)
            place = place * self.descents + index % self.descents
            # descents that have ended get a copy of an active descent, which is dropped again
            source = torch.zeros(under_way.shape[0] * self.descents, dtype=torch.long, device=c.device)
            source[place] = torch.arange(c.shape[0], device=c.device)
            self._index, self._stacks = index, (under_way, place, source)
        under_way, place, source = self._stacks
        stacks = c[source].unflatten(0, (-1, self.descents))
        return self._of(stacks, under_way).select(place)

    def _of(self, c: Float[Tensor, "b S p"], problem: Tensor | slice) -> Quadratic:
        """Mean H of the channels, its gradient (52) and Hessian.

        With ``D = Σ w r²``, E = -Σ q log q of one channel and a = 2 Jᵀ w r / D, the gradient of E is
        ``g = -2 Jᵀ w r (log q + E) / D``, its Hessian ``2 Jᵀ diag(w (-E - log q - 2)) J / D + a aᵀ - a gᵀ - g aᵀ``.
        """
        columns, rows = self.columns[problem], self.counted[problem].mT
        residual = torch.matmul(c.unsqueeze(1), columns)  # (b, m, S, N)
        square = residual.square()
        counted = square if self.weight is None else square * self.weight[problem]
        size = counted.sum(-1, keepdim=True)
        # a channel that is fitted exactly has H = 0 and gradient 0
        unit, present = self.unit[problem], size > 0
        if side_by_side(size) or not bool(present.all()):
            unit, size = unit * present, torch.where(present, size, 1.0)
        log_size = size.log()
        log_square = square.clamp_(min=torch.finfo(square.dtype).tiny).log_()
        counted = residual * log_square if self.weight is None else counted * log_square
        # Σ w r² log r²; without weights r (r log r²) saves a pass
        sum_log = torch.linalg.vecdot(residual, counted).unsqueeze(-1) if self.weight is None else counted.sum(-1, True)
        entropy = log_size - sum_log / size
        if columns.shape[1] == 1:
            weighted_sum = torch.matmul(c.unsqueeze(1), self.gram[problem][..., self.place])
        else:  # a channel may be fitted so well that the small residuals themselves are needed
            weighted_sum = torch.matmul(residual, rows)
        log_size_slope = 2.0 / size * weighted_sum
        logs = torch.matmul(counted if self.weight is None else residual * log_square, rows)
        slope = -2.0 / size * logs - (entropy - log_size) * log_size_slope
        gram = torch.matmul(log_square, self.outer[problem].mT)
        gram = 2.0 / size * ((log_size - entropy - 2.0) * self.gram[problem].unsqueeze(-2) - gram)
        cross = log_size_slope.unsqueeze(-1) * (0.5 * log_size_slope - slope).unsqueeze(-2)
        value = (unit * entropy).sum((1, 3)).flatten()
        gradient = (unit * slope).sum(1).flatten(0, 1)
        hessian = (unit.unsqueeze(-1) * (gram[..., self.place] + cross + cross.mT)).sum(1).flatten(0, 1)
        # hessian c is -gradient, as H does not change along c: project c out, and keep steps orthogonal to c
        along = c.flatten(0, 1)
        stiff = hessian.diagonal(dim1=-2, dim2=-1).abs().sum(-1, keepdim=True)
        cross = (gradient + 0.5 * stiff * along).unsqueeze(-1) * along.unsqueeze(-2)
        hessian = hessian + cross + cross.mT
        return Quadratic(value, gradient, hessian)


def _reduced(problem: LinearProblem, beta: Float[Tensor, "B n"]) -> Float[Tensor, "B N m"]:
    """1 where ``log q + E <= 0``, else 0."""
    square = problem.residual(beta).square()
    weight = torch.ones_like(square) if problem.sample_weight is None else problem.sample_weight
    size = (weight * square).sum(-2, keepdim=True)
    q = square / torch.where(size > 0, size, 1.0)
    log_q = torch.log(q.clamp(min=torch.finfo(q.dtype).tiny))
    return (log_q <= (weight * q * log_q).sum(-2, keepdim=True)).to(q)
