"""MKC-EM: coefficients, bandwidths and scales by maximum likelihood, alternately: Algorithm 3 of the paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole, refuse_out_of_range
from mkc_torch._support.arrays import Data
from mkc_torch.density.energy import SIGMA_LEAST
from mkc_torch.density.fit import (
    DensityState,
    conclusive,
    domain_rule,
    initial_state,
    negative_log_likelihood,
    newton_step,
    refuse_narrow_bound,
)
from mkc_torch.linear._implicit.at_rest import Rest
from mkc_torch.linear._implicit.layer import Given, fit_layer, wanted
from mkc_torch.linear._inference import Inference
from mkc_torch.linear._mkc import (
    channel_parameter,
    coefficient_covariance,
    fixed_point_step,
    kernel_weight,
    values_left,
)
from mkc_torch.linear._problem import LinearProblem, linear_problem
from mkc_torch.linear._robust_start import RobustStart, Start, checked_start, robust_start
from mkc_torch.linear.covariance import CovarianceKind, checked_bandwidth, checked_kind

_FLOOR = 0.3
"""Least d in robust scales: a scale is at most doubled by outliers, and a fit that interpolates ends far below."""


@dataclass(frozen=True)
class _Maximum:
    beta: Tensor
    state: DensityState
    value: Tensor
    converged: Tensor
    history: list[Tensor]


def _normalised_weight(problem: LinearProblem) -> Tensor | None:
    w = problem.sample_weight
    return None if w is None else w / w.sum(-2, keepdim=True)


def _alternate(
    problem: LinearProblem, beta: Tensor, state: DensityState, *, max_iter: int, tol: float, patience: int = 2
) -> _Maximum:
    """E-steps and M-steps in turn; a problem leaves the batch after ``patience`` of them without progress."""
    size = beta.shape[0]
    index = torch.arange(size, device=beta.device)
    out_beta, out_state = beta.clone(), state
    value = state.value.sum(-1)
    converged = torch.zeros(size, dtype=torch.bool, device=beta.device)
    history = [value]
    weight = _normalised_weight(problem)
    quiet = torch.zeros(size, dtype=torch.int64, device=beta.device)
    for _ in range(max_iter):
        residual = problem.residual(beta)
        before = state
        state = newton_step(residual, weight, before)
        kappa, d = state.kappa, torch.exp(state.log_d)
        for _ in range(2):
            beta = fixed_point_step(problem, residual, kappa, d)
            residual = problem.residual(beta)
        now = state.value.sum(-1)
        rounding = 8 * torch.finfo(beta.dtype).eps * now.abs()
        improved = history[-1][index] - now > tol + rounding
        quiet = torch.where(improved, 0, quiet + conclusive(before, state).all(-1).to(quiet.dtype))
        current = history[-1].clone()
        current[index] = now
        history.append(current)
        done = quiet >= patience
        if bool(done.any()) or len(history) > max_iter:
            out_beta[index] = beta
            out_state = _write(out_state, index, state)
            converged[index] = done & torch.isfinite(now)
            keep = (~done).nonzero().squeeze(-1)
            if keep.numel() == 0:
                break
            index, beta, quiet = index[keep], beta[keep], quiet[keep]
            state, problem = state.select(keep), problem.select(keep)
            weight = None if weight is None else weight[keep]
    return _Maximum(out_beta, out_state, history[-1], converged, history)


def _write(whole: DensityState, index: Tensor, part: DensityState) -> DensityState:
    fields = {}
    for name in ("kappa", "log_d", "log_bound", "log_d_min", "damping", "value"):
        fields[name] = getattr(whole, name).index_copy(0, index, getattr(part, name))
    return DensityState(**fields, free_kappa=whole.free_kappa, free_d=whole.free_d)


def _gaussian_candidate(problem: LinearProblem, maximum: _Maximum, *, max_iter: int, tol: float) -> _Maximum:
    """Where a Gaussian density at weighted least squares is likelier than what was found, go on from there instead."""
    state = maximum.state
    beta = problem.weighted_fit(torch.ones_like(problem.Y))
    weight = _normalised_weight(problem)
    for _ in range(2 if problem.num_channels > 1 else 0):
        square = problem.residual(beta).square()
        variance = square.mean(-2) if weight is None else (weight * square).sum(-2)
        d = torch.maximum(variance.sqrt(), torch.exp(state.log_d_min))
        beta = fixed_point_step(problem, problem.Y, torch.zeros_like(d), d)
    residual = problem.residual(beta)
    d_min = torch.exp(state.log_d_min)
    gaussian = initial_state(residual, weight, d_min, torch.exp(state.log_bound), d_min, kappa=torch.zeros_like(d_min))
    better = (gaussian.value.sum(-1) < maximum.value).nonzero().squeeze(-1)
    if better.numel() == 0:
        return maximum
    begun = replace(gaussian.select(better), free_kappa=True)
    again = _alternate(problem.select(better), beta[better], begun, max_iter=max_iter, tol=tol)
    steps = max(len(maximum.history), len(again.history))
    history = []
    for i in range(steps):
        now = maximum.history[min(i, len(maximum.history) - 1)].clone()
        now[better] = again.history[min(i, len(again.history) - 1)]
        history.append(now)
    return _Maximum(
        beta=maximum.beta.index_copy(0, better, again.beta),
        state=_write(state, better, again.state),
        value=maximum.value.index_copy(0, better, again.value),
        converged=maximum.converged.index_copy(0, better, again.converged),
        history=history,
    )


@dataclass(frozen=True)
class _Known:
    """What a fit is given beside the data, as it was given."""

    sigma: float | Tensor | None
    d: float | Tensor | None
    bound: float | Tensor | None
    start: Start | Tensor

    def initial_state(
        self,
        problem: LinearProblem,
        beta: Tensor,
        scale: Tensor,
        bound: Tensor,
        d_min: Tensor,
        tails: Sequence[float | Tensor] = (0.1, 0.4, 1.5),
    ) -> DensityState:
        """The likeliest of a few densities to start from at coefficients ``beta``."""
        d = None if self.d is None else channel_parameter("d", self.d, problem)
        sigma = None if self.sigma is None else channel_parameter("sigma", self.sigma, problem, infinite=True)
        if d is not None:
            d_min = torch.minimum(d, d_min)
        return initial_state(
            problem.residual(beta),
            _normalised_weight(problem),
            scale,
            bound,
            d_min,
            kappa=None if sigma is None else sigma.pow(-2),
            d=d,
            tails=tails,
        )


class MKCRegression(Inference):
    """Linear regression with learned bandwidths and scales, MKC-EM: Algorithm 3 of the paper.

    Maximises the likelihood of the MKC density over the coefficients and, for each channel, σ and d. An E-step is a
    Newton step on (σ, d), an M-step two applications of the fixed point (15). The fit starts from robust coefficients;
    where the Gaussian likelihood at least squares is higher than what it ends at, it goes on from there.

    The domain ``a`` of each channel is fixed before, from a rough fit: half the range of its residuals, and no less
    than ten of its d (:func:`mkc_torch.density.fit.domain_rule` says why), or what ``bound`` says. d stays above 0.3
    robust scales, since the likelihood of residuals that a fit interpolates grows without limit.

    The fit is a differentiable layer: where X, Y, ``sample_weight`` or a given σ, d or bound require a gradient, or
    under a transform of ``torch.func``, ``coef_``, ``sigma_``, ``d_``, ``weights_`` and ``log_likelihood_`` carry the
    derivatives of the maximum by implicit differentiation, jointly in all its unknowns: first and second ones, in
    reverse and forward mode and under ``vmap``. The solution is then polished by Newton steps to where the gradient of
    the likelihood is rounding. A domain that follows from the data counts as a constant, and so does what ends at a
    limit: σ at ``inf`` or 0.05, d at its least. There is no derivative where a fit did not come to rest or ended at no
    strict maximum: asking for one raises. The start, ``covariance_`` and ``history_`` are constants.

    Args:
        sigma: None learns σ; a number in [0.05, inf], (m,) or (*, m) keeps it: ``inf`` is least squares with learned
            channel weights (Remark 7).
        d: None learns d; a value keeps it (Remark 6).
        bound: half-width of the domain in the unit of Y, at least two robust scales of the residuals, a number, (m,) or
            (*, m); None takes the rule above. A residual beyond it counts as one on the flat tail.
        start: "lts", "s", "least_squares", or a tensor of coefficients.
        max_iter: alternations at most.
        tol: converged when two alternations in a row each raise the mean log-likelihood by less (nats per sample).
        covariance: "sandwich" for independent samples, "hac" for a time series.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        seed: of the robust start.

    Attributes, after ``fit`` (``*`` batch dimensions; m is 1 for one channel given as (*, N)):
        coef_: (*, n).
        sigma_, d_, bound_: (*, m): bandwidth (``inf`` for a Gaussian channel), scale and half-width of the domain.
        log_likelihood_: sum over samples and channels, (*,); compare only at equal ``bound_``.
        weights_: ``exp(-e² / (2 d² σ²))`` of each value.
        covariance_: of the coefficients at the learned σ and d, (*, n, n).
        history_: mean negative log-likelihood per sample, summed over channels, at every alternation.
        exact_fit_: more than half of the values lie on the fit to rounding, (*,).
        n_iter_, converged_: alternations made, and whether each problem came to rest, as an exact fit has.
        differentiable_: after a fit as a layer, whether each problem's solution has a derivative, (*,).

    Raises:
        TypeError, ValueError: an argument of another kind, or out of range.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17), (29)-(31), Algorithms 2 and 3, Remarks 6 and 7.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> X = torch.stack([torch.ones(100), torch.linspace(-5, 5, 100)], -1).double()
        >>> y = X.sum(-1) + 0.1 * torch.randn(100, generator=generator, dtype=torch.float64)
        >>> y[:20] += 20.0
        >>> MKCRegression().fit(X, y).coef_
        tensor([0.9992, 1.0072], dtype=torch.float64)

        The last layer of a network: fitted to samples with outliers, it is judged on others, and the features learn.

        >>> class Features(torch.nn.Module):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.hidden = torch.nn.Linear(1, 3, dtype=torch.float64)
        ...         self.solve = MKCRegression(bound=30.0)
        ...
        ...     def forward(self, x, y, x_new):
        ...         return self.solve.fit(self.hidden(x).tanh(), y).predict(self.hidden(x_new).tanh())
        >>> model, x = Features(), X[:, 1:]
        >>> (model(x[::2], y[::2], x[1::2]) - y[1::2]).abs().mean().backward()
        >>> bool((model.hidden.weight.grad != 0).all())
        True
    """

    def __init__(
        self,
        *,
        sigma: float | Tensor | None = None,
        d: float | Tensor | None = None,
        bound: float | Tensor | None = None,
        start: Start | Tensor = "lts",
        max_iter: int = 200,
        tol: float = 1e-10,
        covariance: CovarianceKind = "sandwich",
        bandwidth: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if sigma is not None:
            refuse_out_of_range("sigma", sigma, SIGMA_LEAST, math.inf, "[]", "None learns it")
        for name, value in (("d", d), ("bound", bound)):
            if value is not None:
                refuse_out_of_range(name, value, advice="it is in the unit of Y; None finds it")
        self.sigma = sigma
        self.d = d
        self.bound = bound
        self.start = checked_start(start)
        self.max_iter = checked_whole("max_iter", max_iter, 1, "200 is ample")
        self.tol = checked_number("tol", tol, ends="[)", advice="1e-10 suits float64")
        self.covariance = checked_kind(covariance)
        self.bandwidth = checked_bandwidth(bandwidth)
        self.seed = checked_whole("seed", seed)

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> MKCRegression:
        """Fit ``Y ~ X coef``.

        Args:
            X: (*, N, m, n) with Y (*, N, m), the paper's X_k; or (*, N, n) with Y (*, N) for one channel.
            Y: targets.
            sample_weight: non-negative weights (*, N) or (*, N, m), multiplied to the log-density of each value.

        Raises:
            ValueError: a parameter out of range or of the wrong shape, or bad input as in :meth:`LeastSquares.fit`.
            NotDifferentiableError: when a derivative is taken of a fit that has none, in the backward pass.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        if wanted(X, Y, sample_weight, self.sigma, self.d, self.bound):
            return self._fit_as_layer(X, Y, sample_weight)
        self.__dict__.pop("differentiable_", None)
        with torch.no_grad():
            problem = linear_problem(X, Y, sample_weight)
            self._keep(problem, *self._maximise(problem, _Known(self.sigma, self.d, self.bound, self.start)))
        return self

    def _maximise(self, problem: LinearProblem, known: _Known) -> tuple[RobustStart, _Maximum]:
        begin = robust_start(problem, known.start, seed=self.seed)
        d_min = _FLOOR * begin.scale
        if known.bound is None:
            beta, state = self._on_its_domain(problem, known, begin, d_min)
        else:
            beta = begin.beta
            bound = channel_parameter("bound", known.bound, problem)
            refuse_narrow_bound(bound, begin.scale)
            state = known.initial_state(problem, beta, begin.scale, bound, d_min)
        maximum = _alternate(problem, beta, state, max_iter=self.max_iter, tol=self.tol)
        if state.free_kappa and state.free_d:
            maximum = _gaussian_candidate(problem, maximum, max_iter=self.max_iter, tol=self.tol)
        return begin, maximum

    def _on_its_domain(
        self, problem: LinearProblem, known: _Known, begin: RobustStart, d_min: Tensor
    ) -> tuple[Tensor, DensityState]:
        """Coefficients and state to start from on the domain of the rule, which a rough fit gives.

        A robust start's scale is up to twice that of the head when outliers are many and on one side, so the rough fit
        is made on a tight domain, where it finds the head.
        """
        used = None if problem.sample_weight is None else problem.sample_weight > 0
        tight = domain_rule(problem.residual(begin.beta), begin.scale, used, scales=5.0)
        state = known.initial_state(problem, begin.beta, begin.scale, tight, d_min)
        rough = _alternate(problem, begin.beta, state, max_iter=self.max_iter, tol=1e-4, patience=1)
        kappa, d = rough.state.kappa, torch.exp(rough.state.log_d)
        bound = domain_rule(problem.residual(rough.beta), d, used)
        return rough.beta, known.initial_state(problem, rough.beta, d, bound, d_min, tails=(kappa,))

    def _fit_as_layer(self, X: Tensor, Y: Tensor, sample_weight: Tensor | None) -> MKCRegression:
        def solve(problem: LinearProblem, given: Given) -> Rest:
            start = self.start if given.start is None else given.start
            begin, maximum = self._maximise(problem, _Known(given.sigma, given.d, given.bound, start))
            self.n_iter_ = len(maximum.history) - 1
            state = maximum.state
            return Rest(
                beta=maximum.beta,
                kappa=state.kappa,
                log_d=state.log_d,
                converged=maximum.converged | begin.exact,
                log_bound=state.log_bound,
                log_d_min=state.log_d_min,
                free_kappa=state.free_kappa,
                free_d=state.free_d,
                extras=(begin.exact, torch.stack(maximum.history, -1)),
            )

        layer = fit_layer(
            X,
            Y,
            sample_weight,
            solve,
            sigma=self.sigma,
            d=self.d,
            bound=self.bound,
            start=self.start if isinstance(self.start, Tensor) else None,
            covariance=(self.covariance, self.bandwidth),
        )
        assert layer.log_likelihood is not None
        self._set_layer(layer)
        # at a finite stand-in, since the slope of 0 ** -0.5 times a gradient of 0 is NaN
        gaussian = layer.kappa <= 0
        self.sigma_ = torch.where(gaussian, torch.inf, torch.where(gaussian, 1.0, layer.kappa).rsqrt())
        self.d_, self.bound_ = layer.d, layer.bound
        self.log_likelihood_ = layer.log_likelihood
        self.exact_fit_, history = layer.extras
        self.history_ = history.movedim(-1, 0)
        return self

    def _keep(self, problem: LinearProblem, begin: RobustStart, maximum: _Maximum) -> None:
        kappa, d = maximum.state.kappa, torch.exp(maximum.state.log_d)
        residual = problem.residual(maximum.beta)
        self._set_common(problem, maximum.beta, kernel_weight(residual, kappa, d))
        nll = negative_log_likelihood(residual, _normalised_weight(problem), maximum.state)
        self.sigma_ = problem.restore(kappa.rsqrt())
        self.d_ = problem.restore(d)
        self.bound_ = problem.restore(torch.exp(maximum.state.log_bound))
        self.log_likelihood_ = problem.restore(-(problem.total_weight() * nll).sum(-1))
        self.history_ = torch.stack([problem.restore(h) for h in maximum.history])
        self.exact_fit_ = problem.restore(begin.exact)
        self.n_iter_ = len(maximum.history) - 1
        self.converged_ = problem.restore(maximum.converged | begin.exact)
        self.dof_ = problem.restore(values_left(problem))
        self.covariance_ = coefficient_covariance(problem, maximum.beta, kappa, d, self.covariance, self.bandwidth)
