"""Minimum-entropy regression: coefficients whose residuals have the least entropy by a kernel estimate."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_whole, refuse_out_of_range
from mkc_torch._support.arrays import Data
from mkc_torch._support.order_statistic import order_statistic
from mkc_torch._support.side_by_side import at_once
from mkc_torch._support.small_factors import pinv, symmetric_eigen
from mkc_torch._support.trust_region import Quadratic, minimise
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._mkc import channel_parameter
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._robust_start import Start, checked_start, robust_start

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

Entropy = Literal["shannon", "renyi"]
Location = Literal["median", "symmetric"]

_WIDTHS = (4.0, 2.0, 1.0)
"""Successive bandwidths in units of the last: wide kernels have few local minima."""

_ROOT = (2.0 * math.pi) ** 0.5

_PAIRS = 1 << 18
"""Largest number of pairs of residuals held at once."""


class MinimumEntropy(LinearEstimator):
    """Coefficients with the least entropy of the residuals, by a Gaussian kernel estimate of their density.

    The Shannon entropy is estimated as the mean of ``-log p̂(r_i)``; Rényi's of order 2 is ``-log ∫ p̂²``, in closed
    form. The entropies of channels are added. The bandwidth stays fixed while the coefficients change. The descent is
    local, from a robust start through wider bandwidths.

    Entropy does not change if the density is shifted. With ``location="median"`` a combination of columns that is
    constant within each channel is therefore set so that the residuals have median 0. Without such a combination the
    location of the residuals stays free, and the other coefficients are fitted as if there were an intercept.
    ``location="symmetric"`` takes the density of the residuals and their negatives, whose location is 0: for
    symmetric noise, with or without an intercept.

    Each step uses all pairs of residuals: suited to thousands of samples.

    Args:
        entropy: "shannon", or "renyi" of order 2.
        bandwidth: bandwidth of the kernel, in the unit of Y, a number or (m,); default 1.06 N^(-1/5) times the scale of
            the start's residuals (Silverman's rule).
        location: "median" or "symmetric".
        start: "lts", "s", "least_squares", or coefficients (n,).
        max_iter: largest number of steps tried at each bandwidth.
        seed: seed of the robust start.

    Attributes, after ``fit``:
        coef_: (*, n).
        entropy_: in nats, for Y in its unit, summed over channels, (*,); -inf where most values are fitted exactly.
        bandwidth_: (*, m).
        weights_: density of each residual divided by the largest, (*, N, m).
        n_iter_, converged_: number of steps tried, and whether a local minimum was reached, (*,).

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        E. Wolsztynski, E. Thierry, L. Pronzato, "Minimum-entropy estimation in semi-parametric models", Signal
        Processing 85 (2005) 937-949; B. W. Silverman, Density Estimation (1986), p. 45.

    Example:
        >>> x = torch.linspace(0, 1, 40, dtype=torch.float64)
        >>> y = 1 + 2 * x + 0.01 * torch.cos(50 * x)
        >>> y[30:] += 3.0
        >>> MinimumEntropy().fit(torch.stack([torch.ones_like(x), x], -1), y).coef_.round(decimals=1)
        tensor([1., 2.], dtype=torch.float64)
    """

    entropy_: Float[Tensor, "*batch"]
    bandwidth_: Float[Tensor, "*batch m"]
    n_iter_: Int[Tensor, "*batch"]
    converged_: Bool[Tensor, "*batch"]

    def __init__(
        self,
        entropy: Entropy = "shannon",
        *,
        bandwidth: float | Float[Tensor, " m"] | None = None,
        location: Location = "median",
        start: Start | Tensor = "lts",
        max_iter: int = 100,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if entropy not in ("shannon", "renyi"):
            raise ValueError(f"Expected argument `entropy` to be 'shannon' or 'renyi' but got {entropy!r}.")
        if location not in ("median", "symmetric"):
            raise ValueError(f"Expected argument `location` to be 'median' or 'symmetric' but got {location!r}.")
        if bandwidth is not None:
            refuse_out_of_range("bandwidth", bandwidth, advice="it is in the unit of Y; None takes Silverman's rule")
        self.entropy = entropy
        self.bandwidth = bandwidth
        self.location = location
        self.start = checked_start(start)
        self.max_iter = checked_whole("max_iter", max_iter, 1, "100 is ample")
        self.seed = checked_whole("seed", seed)

    @torch.no_grad()
    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> MinimumEntropy:
        """Fit ``Y ~ X coef`` in float64; shapes and errors as in :meth:`LeastSquares.fit`.

        A weight of 2 is a sample that occurs twice.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        given = linear_problem(X, Y, sample_weight)
        begin = robust_start(given, self.start, seed=self.seed)
        problem = given.double()
        total = problem.total_weight()
        if self.bandwidth is None:
            h = 1.06 * begin.scale.double() * total.pow(-0.2)
        else:
            h = channel_parameter("bandwidth", self.bandwidth, problem)
        free = self._identified(problem)
        beta = begin.beta.double()
        converged, n_iter = torch.ones_like(begin.exact), torch.zeros_like(begin.exact, dtype=torch.long)
        for width in _WIDTHS:
            kernel = _Kernel(problem, width * h, free, self.entropy, self.location == "symmetric")
            radius = width * torch.linalg.vector_norm(h, dim=-1) * problem.num_samples**0.5
            minima = minimise(kernel.quadratic, beta, radius, tol=1e-13, max_iter=self.max_iter)
            beta, converged, n_iter = minima.point, minima.converged, n_iter + minima.n_iter
        beta = torch.where(begin.exact.unsqueeze(-1), begin.beta.double(), beta)
        if self.location == "median":
            beta = torch.where(begin.exact.unsqueeze(-1), beta, beta + self._shift(problem, beta, free))

        value, density = _Kernel(problem, h, free, self.entropy, self.location == "symmetric").at(beta)
        self._set_common(problem, beta, (density / density.amax(-2, keepdim=True)).to(Y.dtype))
        self.coef_ = self.coef_.to(Y.dtype)
        self.entropy_ = problem.restore(torch.where(begin.exact, -math.inf, value).to(Y.dtype))
        self.bandwidth_ = problem.restore(h.to(Y.dtype))
        self.n_iter_ = problem.restore(n_iter)
        self.converged_ = problem.restore(converged | begin.exact)
        return self

    def _identified(self, problem: LinearProblem) -> Float[Tensor, "#B n n"]:
        """Projector of coefficients in the basis onto the directions that change the entropy."""
        n = problem.num_coefficients
        rows = problem.basis
        if self.location == "symmetric":
            return torch.eye(n, dtype=rows.dtype, device=rows.device).unsqueeze(0)
        used = _used(problem)
        rows = used * (rows - _mean_row(problem).unsqueeze(-3))
        gram = torch.matmul(rows.flatten(-3, -2).mT, rows.flatten(-3, -2))
        values, vectors = symmetric_eigen(gram)
        # the basis is orthonormal, so a direction without a constant part has eigenvalue 1
        seen = (values > 1e3 * torch.finfo(torch.float32).eps ** 2).to(rows)
        return torch.matmul(vectors * seen.unsqueeze(-2), vectors.mT)

    def _shift(self, problem: LinearProblem, beta: Tensor, free: Tensor) -> Float[Tensor, "B n"]:
        """Change of the constant combination that gives the residuals median 0, or nearly so if channels share it."""
        residual, weight = problem.residual(beta), problem.sample_weight
        half = 0.5 * problem.num_samples
        median = 0.5 * (order_statistic(residual, weight, half) - order_statistic(-residual, weight, half))
        hidden = torch.eye(problem.num_coefficients, dtype=free.dtype, device=free.device) - free
        constant = torch.matmul(_mean_row(problem), hidden)
        shift = torch.matmul(pinv(constant, rtol=1e-6), median.unsqueeze(-1)).squeeze(-1)
        return torch.matmul(hidden, shift.unsqueeze(-1)).squeeze(-1)


def _used(problem: LinearProblem) -> Float[Tensor, "B N m 1"]:
    """1 for values of positive weight, else 0."""
    weight = problem.sample_weight
    used = torch.ones_like(problem.Y[:1]) if weight is None else (weight > 0).to(problem.basis)
    return used.unsqueeze(-1)


def _mean_row(problem: LinearProblem) -> Float[Tensor, "#B m n"]:
    """Mean of the rows of the basis in use, of each channel."""
    used = _used(problem)
    return (used * problem.basis).sum(-3) / used.sum(-3)


class _Kernel:
    """Entropy as a function of coefficients in the basis, for bandwidths (B, m)."""

    def __init__(self, problem: LinearProblem, h: Tensor, free: Tensor, entropy: Entropy, symmetric: bool) -> None:
        self.problem = problem
        # the integral of p̂² is the mean of the density at √2 times the bandwidth
        self.h = h * 2.0**0.5 if entropy == "renyi" else h
        self.free = free
        self.shannon = entropy == "shannon"
        self.signs = (1.0, -1.0) if symmetric else (1.0,)

    def at(self, beta: Float[Tensor, "B n"]) -> tuple[Float[Tensor, " B"], Float[Tensor, "B N m"]]:
        """Return the entropy, and the density of each residual."""
        index = torch.arange(beta.shape[0], device=beta.device)
        value, density = beta.new_zeros(beta.shape[0]), []
        for channel in range(self.problem.num_channels):
            r, w, _ = self._channel(self.problem, beta, channel)
            p = torch.cat([self._density(r, w, r[:, i], self.h[index, channel]) for i in _chunks(r)], dim=-1)
            value = value + self._entropy(p, w)
            density.append(p)
        return value, torch.stack(density, dim=-1)

    @staticmethod
    def _channel(problem: LinearProblem, beta: Tensor, channel: int) -> tuple[Tensor, Tensor, Tensor]:
        r = problem.residual(beta)[..., channel]
        w = torch.ones_like(r) if problem.sample_weight is None else problem.sample_weight[..., channel]
        return r, w / w.sum(-1, keepdim=True), problem.basis[..., channel, :].expand(r.shape[0], -1, -1)

    def _density(self, r: Tensor, w: Tensor, where: Tensor, h: Tensor) -> Float[Tensor, "B R"]:
        p = sum(
            (w.unsqueeze(1) * _gauss((where.unsqueeze(2) - sign * r.unsqueeze(1)) / h[:, None, None])).sum(-1)
            for sign in self.signs
        )
        assert isinstance(p, Tensor)
        return p / (len(self.signs) * h.unsqueeze(-1))

    def _entropy(self, density: Tensor, w: Tensor) -> Float[Tensor, " B"]:
        if self.shannon:
            return -(w * density.log()).sum(-1)
        return -(w * density).sum(-1).log()

    def quadratic(self, beta: Float[Tensor, "K n"], index: Int[Tensor, " K"]) -> Quadratic:
        """Entropy, gradient and Hessian; directions that do not change the entropy get a zero gradient."""
        N = self.problem.num_samples
        step = at_once(beta, N * N, _PAIRS)
        parts = [
            self._of(self.problem.select(i), self.h[i], beta[j])
            for i, j in zip(index.split(step), torch.arange(len(index), device=index.device).split(step), strict=True)
        ]
        gradient = torch.cat([q.gradient for q in parts])
        hessian = torch.cat([q.hessian for q in parts])
        free = self.free if self.free.shape[0] == 1 else self.free[index]
        eye = torch.eye(beta.shape[-1], dtype=free.dtype, device=free.device)
        stiff = hessian.diagonal(dim1=-2, dim2=-1).abs().sum(-1)[:, None, None]
        gradient = torch.matmul(free, gradient.unsqueeze(-1)).squeeze(-1)
        hessian = free @ hessian @ free + stiff * (eye - free)
        return Quadratic(torch.cat([q.value for q in parts]), gradient, hessian)

    def _of(self, problem: LinearProblem, h: Tensor, beta: Tensor) -> Quadratic:
        k, n = beta.shape
        value, gradient, hessian = beta.new_zeros(k), beta.new_zeros(k, n), beta.new_zeros(k, n, n)
        for channel in range(problem.num_channels):
            r, w, x = self._channel(problem, beta, channel)
            density, slope, second_derivative = [], beta.new_zeros(k, n), beta.new_zeros(k, n, n)
            for rows in _chunks(r):
                p, first, second = self._rows(r, w, x, rows, h[:, channel])
                density.append(p)
                slope, second_derivative = slope + first, second_derivative + second
            p = torch.cat(density, dim=-1)
            if not self.shannon:
                mean = (w * p).sum(-1)
                slope, second_derivative = slope / mean[:, None], second_derivative / mean[:, None, None]
                second_derivative = second_derivative - slope.unsqueeze(-1) * slope.unsqueeze(-2)
            value = value + self._entropy(p, w)
            gradient, hessian = gradient - slope, hessian - second_derivative
        return Quadratic(value, gradient, hessian)

    def _rows(self, r: Tensor, w: Tensor, x: Tensor, rows: slice, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Density at some residuals; weighted sums of the gradients and Hessians of their (log) densities."""
        here, own, h = x[:, rows], w[:, rows], h.unsqueeze(-1)
        mass = (w / (len(self.signs) * _ROOT * h)).unsqueeze(1)
        scaled = r / h
        kernels = []
        p = torch.zeros_like(own)
        for sign in self.signs:
            u = scaled[:, rows].unsqueeze(2) - sign * scaled.unsqueeze(1)
            square = u.square()
            g = torch.exp(-0.5 * square).mul_(mass)
            kernels.append((sign, u, square, g))
            p = p + g.sum(-1)
        share = own / p if self.shannon else own
        slopes, second_derivative = torch.zeros_like(here), torch.zeros_like(torch.matmul(here.mT, here))
        # the factors of the second derivatives are applied to the rows, not to all pairs
        heavy = (share / h.square()).unsqueeze(-1) * here
        for sign, u, square, g in kernels:
            first = u.mul_(g)
            slopes = slopes + (first.sum(-1, keepdim=True) * here - sign * torch.matmul(first, x)) / h.unsqueeze(-1)
            second = square.sub_(1.0).mul_(g)
            mixed = torch.matmul(heavy.mT, torch.matmul(second, x))
            second_derivative = second_derivative + torch.matmul(heavy.mT * second.sum(-1).unsqueeze(-2), here)
            received = torch.matmul((share / h.square()).unsqueeze(-2), second)
            second_derivative = second_derivative + torch.matmul(x.mT * received, x) - sign * (mixed + mixed.mT)
        slope = (share.unsqueeze(-1) * slopes).sum(-2)
        if self.shannon:
            relative = slopes / p.unsqueeze(-1)
            second_derivative = second_derivative - torch.matmul(relative.mT * own.unsqueeze(-2), relative)
        return p, slope, second_derivative


def _gauss(u: Tensor) -> Tensor:
    return torch.exp(-0.5 * u * u) / _ROOT


def _chunks(r: Float[Tensor, "K N"]) -> list[slice]:
    K, N = r.shape
    step = at_once(r, K * N, _PAIRS)
    return [slice(first, first + step) for first in range(0, N, step)]
