"""The fixed point of linear regression under the MKC loss with given σ and d: Algorithm 1 of the paper."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.arguments import (
    checked_number,
    checked_whole,
    format_value,
    refuse_complex,
    refuse_no_tensor,
    refuse_not_real,
    refuse_out_of_range,
)
from mkc_torch._support.arrays import Data
from mkc_torch._support.side_by_side import steps_between_tests
from mkc_torch._support.torch_internals import functorch_is_active
from mkc_torch.linear._implicit.layer import GivenParameters, fit_layer, needs_derivatives
from mkc_torch.linear._implicit.stationary import FitState
from mkc_torch.linear._inference import Inference
from mkc_torch.linear._leverage import warn_of_followed_rows
from mkc_torch.linear._mkc import (
    channel_parameter,
    coefficient_covariance,
    fixed_point_step,
    kernel_weight,
    mean_energy,
    residual_dof,
)
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._robust_start import Start, checked_start, robust_start
from mkc_torch.linear.covariance import CovarianceKind, checked_bandwidth, checked_kind

if TYPE_CHECKING:
    from jaxtyping import Float


_GRADUATION = 10


def whitened(X: Tensor, Y: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """X and Y multiplied by the inverse Cholesky factor of the channels' noise covariance (m, m)."""
    refuse_not_real("X", X)
    refuse_not_real("Y", Y)
    if X.dim() < 3 or Y.dim() < 2:
        raise ValueError(
            "Expected `X` (*, N, m, n) and `Y` (*, N, m) with `noise_covariance`; a single channel takes `d`."
        )
    m = Y.shape[-1]
    if covariance.shape != (m, m):
        raise ValueError(
            f"Expected argument `noise_covariance` of shape ({m}, {m}), a row for each channel of `Y`, but got "
            f"{tuple(covariance.shape)}."
        )
    factor = _cholesky_factor(covariance.to(Y))
    return (
        torch.linalg.solve_triangular(factor, X, upper=False),
        torch.linalg.solve_triangular(factor, Y.unsqueeze(-1), upper=False).squeeze(-1),
    )


def _cholesky_factor(covariance: Float[Tensor, "m m"]) -> Float[Tensor, "m m"]:
    factor, info = torch.linalg.cholesky_ex(covariance)
    if int(info) != 0 or not torch.allclose(covariance, covariance.mT, rtol=1e-5, atol=0.0):
        raise ValueError(
            "Expected argument `noise_covariance` to be symmetric and positive definite but got "
            f"{format_value(covariance.tolist())}; variances alone are `d` squared."
        )
    return factor


def _refuse_no_covariance(covariance: Tensor) -> None:
    """Refuse a tensor that is not a covariance, as far as its shape and, on a CPU, its values show."""
    refuse_no_tensor("noise_covariance", covariance, "a tensor")
    refuse_complex("noise_covariance", covariance)
    if covariance.dim() != 2 or covariance.shape[0] != covariance.shape[1]:
        raise ValueError(
            f"Expected argument `noise_covariance` of shape (m, m) but got {tuple(covariance.shape)}; variances alone "
            "are `d` squared."
        )
    if covariance.device.type == "cpu" and not functorch_is_active():
        _cholesky_factor(covariance.detach().double())


def descend(
    problem: LinearProblem,
    beta: Float[Tensor, "B n"],
    kappa: Float[Tensor, "B m"],
    d: Float[Tensor, "B m"],
    *,
    max_iter: int,
    tol: float,
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Apply (15) until a step lowers the loss by a share below ``tol``. Returns coefficients, convergence, losses."""
    tol = max(tol, 4 * torch.finfo(beta.dtype).eps)
    every = steps_between_tests(beta)
    history: list[Tensor] = []
    previous = beta.new_full(beta.shape[:-1], math.inf)
    moving = torch.ones_like(previous, dtype=torch.bool)
    for _ in range(max_iter + 1):
        residual = problem.residual(beta)
        loss = mean_energy(problem, residual, kappa, d)
        history.append(loss)
        moving = moving & (previous - loss > tol * loss.abs())
        if len(history) > max_iter or (len(history) % every == 0 and not bool(moving.any())):
            break
        beta = torch.where(moving.unsqueeze(-1), fixed_point_step(problem, residual, kappa, d), beta)
        previous = loss
    return beta, ~moving, history


class _End(NamedTuple):
    beta: Tensor
    kappa: Tensor
    d: Tensor
    converged: Tensor
    history: list[Tensor]


class FixedPointLinear(Inference):
    """Linear regression under the MKC loss (13) with given σ and d by the fixed point (15): Algorithm 1 of the paper.

    The loss has many local minima when ``h = σ d`` is small, and leverage points can make a wrong minimum the lowest.
    The fit starts from robust coefficients and reduces the bandwidth in steps from three robust scales to the given h.

    The fit is a differentiable layer: where X, Y, ``sample_weight``, σ, d or the noise covariance require a gradient,
    or under a transform of ``torch.func``, ``coef_`` and ``weights_`` carry the derivatives of the solution by implicit
    differentiation, first and second order, in reverse and forward mode and under ``vmap``. Newton steps then polish
    ``coef_`` until the gradient of the loss is rounding. A fit that has not converged, or that ended at a point other
    than a strict minimum, has no derivative: taking it raises. Start, ``covariance_`` and ``history_`` are constants.

    Args:
        sigma: bandwidth of each channel, a number, (m,) or (*, m); ``inf`` is weighted least squares exactly.
        d: scale of each channel, in the unit of Y.
        noise_covariance: covariance (m, m) of the channels' noise where it is not diagonal; X and Y are whitened by it
            and σ and d refer to the whitened channels.
        start: "lts", "s", "least_squares" (as in the paper, without graduation), or coefficients, a tensor (*, n).
        max_iter: largest number of steps.
        tol: converged when a step lowers the loss by a smaller share of it.
        covariance: "sandwich" for independent samples, "hac" for a time series.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        seed: seed of the robust start.

    Attributes, after ``fit`` (``*`` batch dimensions):
        coef_: (*, n).
        weights_: ``exp(-e² / (2 d² σ²))`` of each value, (*, N, m); m is 1 for one channel.
        covariance_: covariance of the coefficients, (*, n, n).
        history_: the loss (9) before every step, (steps + 1, *).
        n_iter_: number of steps.
        converged_: whether each problem converged, (*,).
        differentiable_: whether each problem's solution has a derivative, (*,); only if derivatives were recorded.

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (13)-(16), Algorithm 1.

    Example:
        >>> X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
        >>> y = 1 + 2 * X[:, 1]
        >>> y[:4] = 100.0
        >>> FixedPointLinear(sigma=1.0, d=1.0).fit(X, y).coef_
        tensor([1.0000, 2.0000], dtype=torch.float64)

        The derivative of the slope by each target; it is 0 for the four outliers:

        >>> y = y.requires_grad_()
        >>> FixedPointLinear(sigma=1.0, d=1.0).fit(X, y).coef_[1].backward()
        >>> y.grad
        tensor([ 0.0000,  0.0000,  0.0000,  0.0000, -0.1429, -0.0857, -0.0286,  0.0286,
                 0.0857,  0.1429], dtype=torch.float64)
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
        refuse_out_of_range("sigma", sigma, ends="(]", advice="inf is least squares")
        refuse_out_of_range("d", d, advice="it is the scale of the noise, in the unit of Y")
        if noise_covariance is not None:
            _refuse_no_covariance(noise_covariance)
        self.sigma = sigma
        self.d = d
        self.noise_covariance = noise_covariance
        self.start = checked_start(start)
        self.max_iter = checked_whole("max_iter", max_iter, 1, "500 is ample")
        self.tol = checked_number("tol", tol, 0.0, 1.0, "[)", "1e-13 suits float64")
        self.covariance = checked_kind(covariance)
        self.bandwidth = checked_bandwidth(bandwidth)
        self.seed = checked_whole("seed", seed)

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> FixedPointLinear:
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. Weights multiply the loss of each value.

        Warns:
            UserWarning: the fit follows bad leverage points; the message names their rows.

        Raises:
            ValueError: σ or d not positive or of the wrong shape, or bad input as in :meth:`LeastSquares.fit`.
            NotDifferentiableError: in the backward pass, for a fit that has no derivative.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        if needs_derivatives(X, Y, sample_weight, self.sigma, self.d, self.noise_covariance):
            return self._fit_as_layer(X, Y, sample_weight)
        self.__dict__.pop("differentiable_", None)
        with torch.no_grad():
            self._fit(X, Y, sample_weight)
            if Y.dim() == 1 and sample_weight is None:
                warn_of_followed_rows("FixedPointLinear", X, Y, self.coef_, self.weights_.squeeze(-1))
        return self

    def _fit(self, X: Tensor, Y: Tensor, sample_weight: Tensor | None) -> None:
        if self.noise_covariance is not None:
            X, Y = whitened(X, Y, self.noise_covariance)
        problem = linear_problem(X, Y, sample_weight)
        end = self._solve(problem, self.sigma, self.d, self.start)
        self._set_common(problem, end.beta, kernel_weight(problem.residual(end.beta), end.kappa, end.d))
        self.history_ = torch.stack([problem.restore(h) for h in end.history])
        self.n_iter_ = len(end.history) - 1
        self.converged_ = problem.restore(end.converged)
        self.dof_ = problem.restore(residual_dof(problem))
        self.covariance_ = coefficient_covariance(problem, end.beta, end.kappa, end.d, self.covariance, self.bandwidth)

    def _fit_as_layer(self, X: Tensor, Y: Tensor, sample_weight: Tensor | None) -> FixedPointLinear:
        if self.noise_covariance is not None:
            X, Y = whitened(X, Y, self.noise_covariance)

        def solve(problem: LinearProblem, given: GivenParameters) -> FitState:
            assert given.sigma is not None
            assert given.d is not None
            end = self._solve(problem, given.sigma, given.d, self.start if given.start is None else given.start)
            self.n_iter_ = len(end.history) - 1
            return FitState(
                end.beta, end.kappa, torch.log(end.d), end.converged, extras=(torch.stack(end.history, -1),)
            )

        layer = fit_layer(
            X,
            Y,
            sample_weight,
            solve,
            sigma=self.sigma,
            d=self.d,
            start=self.start if isinstance(self.start, Tensor) else None,
            covariance=(self.covariance, self.bandwidth),
        )
        self._set_layer(layer)
        self.history_ = layer.extras[0].movedim(-1, 0)
        return self

    def _solve(self, problem: LinearProblem, sigma: float | Tensor, d: float | Tensor, start: Start | Tensor) -> _End:
        kappa = channel_parameter("sigma", sigma, problem, infinite=True).pow(-2)
        scale = channel_parameter("d", d, problem)
        begin = self._start(problem, kappa, scale, start)
        beta, converged, history = descend(problem, begin, kappa, scale, max_iter=self.max_iter, tol=self.tol)
        return _End(beta, kappa, scale, converged, history)

    def _start(self, problem: LinearProblem, kappa: Tensor, d: Tensor, start: Start | Tensor) -> Float[Tensor, "B n"]:
        """Starting coefficients: given, least squares, or robust coefficients refined at decreasing bandwidths."""
        if not isinstance(start, Tensor) and (start == "least_squares" or bool((kappa == 0).all())):
            return fixed_point_step(problem, problem.Y, torch.zeros_like(kappa), d)
        robust = robust_start(problem, start, seed=self.seed)
        if isinstance(start, Tensor):
            return robust.beta
        # three robust scales, in units of the given h = σ d, of the channel with the largest such ratio
        view = (3.0 * robust.scale / d * kappa.sqrt()).amax(-1, keepdim=True).clamp(min=1.0)
        beta = robust.beta
        for step in range(_GRADUATION):
            wider = view.pow(1.0 - step / _GRADUATION)
            beta = fixed_point_step(problem, problem.residual(beta), kappa / wider.square(), d)
        return beta
