"""The fixed point of linear regression under the MKC loss with given σ and d: Algorithm 1 of the paper."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._mkc import coefficient_covariance, fixed_point_step, mean_energy
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._robust_start import Start, robust_start
from mkc_torch.linear.covariance import CovarianceKind, checked_kind

if TYPE_CHECKING:
    from jaxtyping import Float


def channel_parameter(name: str, value: float | Tensor, problem: LinearProblem, *, infinite: bool = False) -> Tensor:
    """A positive parameter of every channel as a tensor (B, m); accepts a number, (m,) or (*, m)."""
    t = torch.as_tensor(value, dtype=problem.Y.dtype, device=problem.Y.device)
    m = problem.num_channels
    if t.dim() > 0 and t.shape[-1] not in (1, m):
        raise ValueError(f"Expected argument `{name}` to be a number or of shape ({m},) but got {tuple(t.shape)}.")
    if not bool(((t > 0) & (torch.isfinite(t) | infinite)).all()):
        kind = "positive" if infinite else "positive and finite"
        raise ValueError(f"Expected argument `{name}` to be {kind} but got {value}.")
    return t.expand(*problem.batch, m).reshape(-1, m)


def whitened(X: Tensor, Y: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """X and Y multiplied by the inverse Cholesky factor of the channels' noise covariance (m, m)."""
    if X.dim() < 3 or Y.dim() < 2:
        raise ValueError(
            "Expected `X` (*, N, m, n) and `Y` (*, N, m) with `noise_covariance`; a single channel takes `d`."
        )
    m = Y.shape[-1]
    covariance = covariance.to(Y)
    if covariance.shape != (m, m):
        raise ValueError(f"Expected argument `noise_covariance` of shape ({m}, {m}) but got {tuple(covariance.shape)}.")
    factor, info = torch.linalg.cholesky_ex(covariance)
    if int(info) != 0 or not torch.allclose(covariance, covariance.mT):
        raise ValueError("Expected argument `noise_covariance` to be symmetric and positive definite.")
    return (
        torch.linalg.solve_triangular(factor, X, upper=False),
        torch.linalg.solve_triangular(factor, Y.unsqueeze(-1), upper=False).squeeze(-1),
    )


def descend(
    problem: LinearProblem,
    beta: Float[Tensor, "B S n"],
    kappa: Float[Tensor, "B S m"],
    d: Float[Tensor, "B S m"],
    *,
    max_iter: int,
    tol: float,
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Apply (15) until a step lowers the loss by less than ``tol`` of it; with convergence and the losses."""
    tol = max(tol, 4 * torch.finfo(beta.dtype).eps)
    history = []
    previous = beta.new_full(beta.shape[:-1], math.inf)
    moving = torch.ones_like(previous, dtype=torch.bool)
    for _ in range(max_iter + 1):
        residual = problem.residual(beta)
        loss = mean_energy(problem, residual, kappa, d)
        history.append(loss)
        moving = moving & (previous - loss > tol * loss.abs())
        if len(history) > max_iter or not bool(moving.any()):
            break
        beta = torch.where(moving.unsqueeze(-1), fixed_point_step(problem, residual, kappa, d), beta)
        previous = loss
    return beta, ~moving, history


class FixedPointLinear(LinearEstimator):
    """Linear regression under the MKC loss (13) with given σ and d by the fixed point (15): Algorithm 1 of the paper.

    The loss has many local minima when ``h = σ d`` is small. The fit starts from robust coefficients and from least
    squares, is led from a large h to the given one, and keeps the end of lower loss.

    Args:
        sigma: bandwidth of each channel, a number, (m,) or (*, m); ``inf`` is weighted least squares exactly.
        d: scale of each channel, in the unit of Y.
        noise_covariance: covariance (m, m) of the channels' noise where it is not diagonal; X and Y are whitened by it
            and σ and d refer to the whitened channels.
        start: "lts" (robust, and least squares beside it), "s" (the same from S-regression), "least_squares" alone
            without being led, as in the paper, or a tensor of coefficients.
        max_iter: steps at most.
        tol: converged when a step lowers the loss by a smaller share of it.
        covariance: "sandwich" for independent samples, "hac" for a time series.
        bandwidth: lags of "hac", in samples; default by Andrews' rule.
        seed: of the robust start.

    Attributes, after ``fit`` (``*`` batch dimensions):
        coef_: (*, n).
        weights_: ``exp(-e² / (2 d² σ²))`` of each value, (*, N, m), or (*, N) for one channel.
        covariance_: of the coefficients, (*, n, n).
        history_: the loss (9) before every step, (steps + 1, *).
        n_iter_: steps made. converged_: (*,).

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (13)-(16), Algorithm 1.

    Example:
        >>> X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
        >>> y = 1 + 2 * X[:, 1]
        >>> y[:4] = 100.0
        >>> FixedPointLinear(sigma=1.0, d=1.0).fit(X, y).coef_
        tensor([1.0000, 2.0000], dtype=torch.float64)
    """

    def __init__(
        self,
        sigma: float | Tensor = 2.0,
        d: float | Tensor = 1.0,
        *,
        noise_covariance: Tensor | None = None,
        start: Start | Tensor = "lts",
        max_iter: int = 500,
        tol: float = 1e-13,
        covariance: CovarianceKind = "sandwich",
        bandwidth: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if max_iter < 1:
            raise ValueError(f"Expected argument `max_iter` to be at least 1 but got {max_iter}.")
        self.sigma = sigma
        self.d = d
        self.noise_covariance = noise_covariance
        self.start = start
        self.max_iter = max_iter
        self.tol = tol
        self.covariance = checked_kind(covariance)
        self.bandwidth = bandwidth
        self.seed = seed

    def fit(self, X: Tensor, Y: Tensor, sample_weight: Tensor | None = None) -> FixedPointLinear:
        """Fit ``Y ~ X coef``.

        Args:
            X: (*, N, m, n) with Y (*, N, m), the paper's X_k; or (*, N, n) with Y (*, N) for one channel.
            Y: targets.
            sample_weight: non-negative weights (*, N) or (*, N, m), multiplied to the loss of each value.

        Raises:
            ValueError: σ or d not positive or of the wrong shape, or bad input as in :meth:`LeastSquares.fit`.
        """
        if self.noise_covariance is not None:
            X, Y = whitened(X, Y, self.noise_covariance)
        problem = linear_problem(X, Y, sample_weight)
        kappa = channel_parameter("sigma", self.sigma, problem, infinite=True).pow(-2)
        d = channel_parameter("d", self.d, problem)
        beta, graduated = self._starts(problem, kappa, d)
        stack = beta.shape[1]
        kappa_s, d_s = kappa.unsqueeze(1).expand(-1, stack, -1), d.unsqueeze(1).expand(-1, stack, -1)
        for wide in graduated:
            beta = fixed_point_step(problem, problem.residual(beta), kappa_s * wide, d_s)
        beta, converged, history = descend(problem, beta, kappa_s, d_s, max_iter=self.max_iter, tol=self.tol)
        best = history[-1].argmin(1)
        at = torch.arange(best.shape[0], device=best.device)
        beta = beta[at, best]
        self._set_common(
            problem, beta, torch.exp(-0.5 * kappa.unsqueeze(-2) * (problem.residual(beta) / d.unsqueeze(-2)) ** 2)
        )
        self.history_ = torch.stack([problem.restore(h[at, best]) for h in history])
        self.n_iter_ = len(history) - 1
        self.converged_ = problem.restore(converged[at, best])
        self.covariance_ = coefficient_covariance(problem, beta, kappa, d, self.covariance, self.bandwidth)
        return self

    def _starts(self, problem: LinearProblem, kappa: Tensor, d: Tensor) -> tuple[Tensor, list[Tensor]]:
        """A stack of starts, and for each step of the graduation the factors (B, S, 1) on κ."""
        least_squares = fixed_point_step(problem, problem.Y, torch.zeros_like(kappa), d)
        if isinstance(self.start, Tensor):
            return problem.in_basis(self.start.to(problem.Y)).unsqueeze(1), []
        if self.start == "least_squares" or bool((kappa == 0).all()):
            return least_squares.unsqueeze(1), []
        robust = robust_start(problem, self.start, seed=self.seed)
        residual = problem.residual(least_squares)
        spread = torch.sqrt(mean_energy(problem, residual, torch.zeros_like(kappa), d) * 2.0 / problem.num_channels)
        h = kappa.clamp(min=torch.finfo(kappa.dtype).tiny).rsqrt()
        # bandwidths at which the start's own residuals are in view, brought down to the given one
        view = torch.stack([(3.0 * robust.scale / d / h).amax(-1), (3.0 * spread.unsqueeze(-1) / h).amax(-1)], 1)
        steps = 10
        factors = [view.clamp(min=1.0).pow(-2.0 * (1.0 - i / steps)).unsqueeze(-1) for i in range(steps)]
        return torch.stack([robust.beta, least_squares], 1), factors
