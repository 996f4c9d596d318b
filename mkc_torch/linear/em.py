"""MKC-EM: coefficients, bandwidths and scales by maximum likelihood, alternately: Algorithm 3 of the paper."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole, refuse_out_of_range
from mkc_torch._support.arrays import Data
from mkc_torch.density.em import normalised
from mkc_torch.density.energy import SIGMA_LEAST
from mkc_torch.density.likelihood import negative_log_likelihood
from mkc_torch.linear._implicit.layer import GivenParameters, fit_layer, needs_derivatives
from mkc_torch.linear._implicit.stationary import FitState
from mkc_torch.linear._inference import Inference
from mkc_torch.linear._large import is_large, large_maximum, problem_in_basis
from mkc_torch.linear._leverage import warn_of_followed_rows
from mkc_torch.linear._many_rows import RowsMaximum
from mkc_torch.linear._maximum import FixedParameters, LikelihoodMaximum, maximise
from mkc_torch.linear._mkc import coefficient_covariance, kernel_weight, residual_dof
from mkc_torch.linear._one_sided import one_sided_bias
from mkc_torch.linear._problem import CanonicalShapes, LinearProblem, checked_shapes, linear_problem
from mkc_torch.linear._robust_start import RobustStart, Start, checked_start
from mkc_torch.linear.covariance import CovarianceKind, checked_bandwidth, checked_kind

if TYPE_CHECKING:
    from jaxtyping import Float


class MKCRegression(Inference):
    """Linear regression with learned bandwidths and scales, MKC-EM: Algorithm 3 of the paper.

    Maximises the likelihood of the MKC density over the coefficients and, for each channel, σ and d. An E-step is a
    Newton step on (σ, d), an M-step two applications of the fixed point (15). The fit starts from robust coefficients;
    where the Gaussian likelihood at least squares is higher than that of the result, the fit continues from there.

    The domain ``a`` of each channel is fixed beforehand: ``bound``, or from a rough fit half the range of its
    residuals, and at least ten of its d (reason: :func:`mkc_torch.density.fit.domain_rule`). d stays above 0.3 robust
    scales, since the likelihood of residuals that a fit interpolates grows without limit; weights that are all whole
    numbers count repetitions in the small-sample factor of this scale.

    From 20 000 values on, a single problem starts from a pilot fit to some of its rows, drawn by ``seed``.
    Joint Newton steps in all unknowns over all rows follow, in float64 whatever the dtype of the data: about eight
    passes, and no copy of X. They end where the next step is less than a millionth of a standard error. If they do not
    reach a maximum, for example where most values are fitted exactly, the fit is made as for fewer values.

    Bad leverage points, rows far out in X with wrong targets, can have the highest likelihood: 4 of the 47 stars of
    starsCYG do. A fit of a single problem of up to 20,000 rows that follows such rows, against an MM fit, warns and
    names them.

    The fit is a differentiable layer: where X, Y, ``sample_weight`` or a given σ, d or bound require a gradient, or
    under a transform of ``torch.func``, ``coef_``, ``sigma_``, ``d_``, ``weights_`` and ``log_likelihood_`` carry the
    derivatives of the maximum by implicit differentiation, jointly in all its unknowns: first and second order, in
    reverse and forward mode and under ``vmap``. Newton steps then polish the solution until the gradient of the
    likelihood is rounding. A domain that follows from the data counts as a constant, and so does an unknown that ends
    at a limit: σ at ``inf`` or 0.05, d at its least. A fit that has not converged, or that ended at a point other than
    a strict maximum, has no derivative: taking it raises. The start, ``covariance_`` and ``history_`` are constants.

    Args:
        sigma: None learns σ; a number in [0.05, inf], (m,) or (*, m) fixes it: ``inf`` is least squares with learned
            channel weights (Remark 7).
        d: None learns d; a value fixes it (Remark 6).
        bound: half-width of the domain in the unit of Y, at least two robust scales of the residuals, a number, (m,) or
            (*, m); None takes the rule above. A residual beyond it counts as being on the flat tail.
        start: "lts", "s", "least_squares", or a tensor of coefficients.
        max_iter: largest number of alternations, or of steps over all rows where they are many.
        tol: converged when two successive alternations each raise the mean log-likelihood by less (nats per sample).
        covariance: "sandwich" for independent samples, "hac" for a time series.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        seed: seed of the robust start.

    Attributes, after ``fit`` (``*`` batch dimensions; m is 1 for one channel given as (*, N)):
        coef_: (*, n).
        sigma_, d_, bound_: (*, m): bandwidth (``inf`` for a Gaussian channel), scale and half-width of the domain.
        log_likelihood_: sum over samples and channels, (*,); compare only at equal ``bound_``.
        weights_: ``exp(-e² / (2 d² σ²))`` of each value.
        covariance_: covariance of the coefficients at the learned σ and d, (*, n, n).
        one_sided_bias_: bound of the bias by one-sided outliers within three or four scales, which the intervals
            contain, (*, n); 0 where the residuals are not skewed, for several channels, and from 20 000 values on. Not
            of a fit with covariance "hac" or with derivatives.
        history_: mean negative log-likelihood per sample, summed over channels, at every alternation or step.
        exact_fit_: whether more than half of the values lie on the fit to rounding, (*,).
        n_iter_, converged_: number of alternations or steps, and whether each problem converged; an exact fit has.
        differentiable_: whether each problem's solution has a derivative, (*,); only if derivatives were recorded.

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17), (29)-(31), Algorithms 2 and 3, Remarks 6 and 7.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> X = torch.stack([torch.ones(100), torch.linspace(-5, 5, 100)], -1).double()
        >>> y = X.sum(-1) + 0.1 * torch.randn(100, generator=generator, dtype=torch.float64)
        >>> y[:20] += 20.0
        >>> MKCRegression().fit(X, y).coef_
        tensor([0.9992, 1.0072], dtype=torch.float64)

        As the last layer of a network, fitted to samples with outliers; a loss on other samples trains the features.

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
            refuse_out_of_range("sigma", sigma, SIGMA_LEAST, math.inf, "[]", "pass None to learn it")
        for name, value in (("d", d), ("bound", bound)):
            if value is not None:
                refuse_out_of_range(name, value, advice="it is in the unit of Y; pass None to estimate it")
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
        """Fit ``Y ~ X coef``; shapes as in :meth:`LeastSquares.fit`. Weights multiply the log-density of each value.

        Warns:
            UserWarning: the fit follows bad leverage points; the message names their rows.

        Raises:
            ValueError: a parameter out of range or of the wrong shape, or bad input as in :meth:`LeastSquares.fit`.
            NotDifferentiableError: in the backward pass, for a fit that has no derivative.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        if needs_derivatives(X, Y, sample_weight, self.sigma, self.d, self.bound):
            return self._fit_as_layer(X, Y, sample_weight)
        self.__dict__.pop("differentiable_", None)
        self.__dict__.pop("one_sided_bias_", None)
        with torch.no_grad():
            values = checked_shapes(X, Y, sample_weight)
            known = FixedParameters(self.sigma, self.d, self.bound, self.start)
            # a time series needs the scores in their order
            suits = is_large(values) and self.covariance == "sandwich"
            found = large_maximum(values, known, max_iter=self.max_iter, seed=self.seed) if suits else None
            if found is not None:
                self._keep_large(values, *found)
                return self
            problem = linear_problem(X, Y, sample_weight)
            self._keep(problem, *self._maximise(problem, known))
            if Y.dim() == 1 and sample_weight is None:
                warn_of_followed_rows("MKCRegression", X, Y, self.coef_, self.weights_.squeeze(-1))
        return self

    def _maximise(self, problem: LinearProblem, known: FixedParameters) -> tuple[RobustStart, LikelihoodMaximum]:
        return maximise(problem, known, max_iter=self.max_iter, tol=self.tol, seed=self.seed)

    def _fit_as_layer(self, X: Tensor, Y: Tensor, sample_weight: Tensor | None) -> MKCRegression:
        def solve(problem: LinearProblem, given: GivenParameters) -> FitState:
            known = FixedParameters(
                given.sigma, given.d, given.bound, self.start if given.start is None else given.start
            )
            values, in_basis = problem_in_basis(problem), known.in_basis_of(problem)
            suits = is_large(values)
            found = large_maximum(values, in_basis, max_iter=self.max_iter, seed=self.seed) if suits else None
            if found is not None:
                rows_maximum, _ = found
                self.n_iter_ = len(rows_maximum.history) - 1
                flag = torch.ones_like(problem.Y[:, 0, 0], dtype=torch.bool)
                extras = (~flag, rows_maximum.history.unsqueeze(0).to(flag.device))
                return replace(rows_maximum.fit_state.to(flag.device), converged=flag, extras=extras)
            begin, maximum = self._maximise(problem, known)
            self.n_iter_ = len(maximum.history) - 1
            extras = (begin.exact, torch.stack(maximum.history, -1))
            return FitState.of(maximum.beta, maximum.state, maximum.converged | begin.exact, extras)

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
        # the rsqrt is taken of 1 for Gaussian channels: the slope of 0 ** -0.5 times a gradient of 0 is NaN
        gaussian = layer.kappa <= 0
        self.sigma_ = torch.where(gaussian, torch.inf, torch.where(gaussian, 1.0, layer.kappa).rsqrt())
        self.d_, self.bound_ = layer.d, layer.bound
        self.log_likelihood_ = layer.log_likelihood
        self.exact_fit_, history = layer.extras
        self.history_ = history.movedim(-1, 0)
        return self

    def _keep_large(self, values: CanonicalShapes, found: RowsMaximum, weights: Tensor) -> None:
        def restored(value: Tensor) -> Tensor:
            return value.to(values.Y).expand((*values.batch, *value.shape))

        self._single_channel = values.single_channel
        for name, value in found.attributes().items():
            setattr(self, name, restored(value))
        self.weights_ = restored(weights)
        self.history_ = torch.stack([restored(h) for h in found.history])
        self.n_iter_ = len(found.history) - 1
        self.one_sided_bias_ = torch.zeros_like(self.coef_)
        flag = torch.ones(values.batch, dtype=torch.bool, device=values.Y.device)
        self.converged_, self.exact_fit_ = flag, ~flag

    def _keep(self, problem: LinearProblem, begin: RobustStart, maximum: LikelihoodMaximum) -> None:
        kappa, d = maximum.state.kappa, torch.exp(maximum.state.log_d)
        residual = problem.residual(maximum.beta)
        self._set_common(problem, maximum.beta, kernel_weight(residual, kappa, d))
        nll = negative_log_likelihood(residual, normalised(problem.sample_weight), maximum.state)
        self.sigma_ = problem.restore(kappa.rsqrt())
        self.d_ = problem.restore(d)
        self.bound_ = problem.restore(torch.exp(maximum.state.log_bound))
        self.log_likelihood_ = problem.restore(-(problem.total_weight() * nll).sum(-1))
        self.history_ = torch.stack([problem.restore(h) for h in maximum.history])
        self.exact_fit_ = problem.restore(begin.exact)
        self.n_iter_ = len(maximum.history) - 1
        self.converged_ = problem.restore(maximum.converged | begin.exact)
        self.dof_ = problem.restore(residual_dof(problem))
        self.covariance_ = coefficient_covariance(problem, maximum.beta, kappa, d, self.covariance, self.bandwidth)
        if self.covariance == "sandwich":  # the skewness of a time series has another standard error
            self.one_sided_bias_ = problem.restore(one_sided_bias(problem, maximum.beta))

    def confidence_interval(self, level: float = 0.95) -> Float[Tensor, "*batch n 2"]:
        """Confidence interval of each coefficient; see :meth:`Inference.confidence_interval`.

        ``one_sided_bias_`` is added to the standard error in quadrature, because outliers of about three scales on one
        side move the estimate without a trace in ``covariance_``.
        """
        narrow = super().confidence_interval(level)
        error, bias = self.standard_error_, getattr(self, "one_sided_bias_", None)
        if bias is None:
            return narrow
        ratio = torch.where(error > 0, torch.hypot(error, bias) / torch.where(error > 0, error, 1.0), 1.0)
        half = torch.where(error > 0, ratio * 0.5 * (narrow[..., 1] - narrow[..., 0]), 0.0)
        return torch.stack([self.coef_ - half, self.coef_ + half], -1)
