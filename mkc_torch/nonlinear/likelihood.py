"""Maximum-likelihood parameters, with σ and d of each channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole
from mkc_torch._support.forward_mode import Residual
from mkc_torch.density.domain import domain_rule
from mkc_torch.density.energy import SIGMA_LEAST
from mkc_torch.density.likelihood import DensityState, initial_state
from mkc_torch.linear.covariance import CovarianceKind, checked_bandwidth, checked_kind
from mkc_torch.nonlinear._alternate import AlternatingMaximum, alternate, gaussian_candidate, likelihood_of
from mkc_torch.nonlinear._arguments import per_channel, prepare, refuse_out_of_reach
from mkc_torch.nonlinear._covariance import parameter_covariance
from mkc_torch.nonlinear._explained_share import explained
from mkc_torch.nonlinear._graduated_start import LEAST_SCALE, graduated, residual_scale
from mkc_torch.nonlinear._problem import Constraint, Problem, ProblemPoint, kernel_weights, shaped_jacobian
from mkc_torch.nonlinear._starts import draw_starts, most_likely, repeat_problem
from mkc_torch.nonlinear.prior import GaussianPrior

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class NonlinearFit:
    """Result of :func:`fit`.

    Attributes:
        theta: (*, p).
        sigma, d, bound: bandwidth (``inf`` for a Gaussian channel), scale and half-width of the domain, (*, m).
        log_likelihood: nats per sample: the mean over the samples of each channel, summed over the channels, (*,),
            without the prior; compare only at equal ``bound``.
        weights: ``exp(-e² / (2 d² σ²))`` of each residual, (*, N, m).
        residual: (*, N, m) at ``theta``; 0 where the weight is 0.
        covariance: covariance of ``theta`` at the learned σ and d, (*, p, p), or None. It is 0 along active bounds and
            constraints, and infinite for parameters that the residual does not determine.
        jacobian: Jacobian of the residual at ``theta``, (*, N, m, p).
        n_iter: number of trial steps.
        converged: whether each problem converged, (*,), to a minimum that may be a local one: see ``agreeing`` and
            :meth:`explained`.
        starts: number of starts.
        agreeing: number of starts that ended at this minimum, or at others within 0.01 nats of all residuals, (*,). A
            single start of many suggests that a better minimum exists: use more starts.
    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> y = 2.0 + 0.1 * torch.randn(200, generator=generator, dtype=torch.float64)
        >>> found = fit(lambda theta: (y - theta).unsqueeze(-1), torch.tensor([0.0]).double())
        >>> round(float(found.theta), 1), round(float(found.d), 1), round(float(found.standard_error()), 3)
        (2.0, 0.1, 0.007)
    """

    theta: Float[Tensor, "*batch p"]
    sigma: Float[Tensor, "*batch m"]
    d: Float[Tensor, "*batch m"]
    bound: Float[Tensor, "*batch m"]
    log_likelihood: Float[Tensor, " *batch"]
    weights: Float[Tensor, "*batch N m"]
    residual: Float[Tensor, "*batch N m"]
    covariance: Float[Tensor, "*batch p p"] | None
    jacobian: Float[Tensor, "*batch N m p"]
    n_iter: int
    converged: Bool[Tensor, " *batch"]
    starts: int
    agreeing: Int[Tensor, " *batch"]

    def standard_error(self) -> Float[Tensor, "*batch p"]:
        """Square root of the diagonal of ``covariance``, in the units of the parameters.

        Raises:
            ValueError: the fit was made without a covariance.
        """
        if self.covariance is None:
            raise ValueError(
                "Expected a fit with a covariance but got covariance=None; fit with covariance='sandwich'."
            )
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()

    def explained(self, target: Float[Tensor, "*batch N m"]) -> Float[Tensor, "*batch m"]:
        """Robust share of the targets' variation that the fit explains: 1 minus the squared ratio of scales, (*, m).

        The scales are 1.4826 times the median absolute value of the residuals, and of the targets about their median,
        without weights. A value below 0.8 for a model that should describe its targets shows a wrong local minimum. A
        robust fit may choose half of the targets, and a wrong fit explains up to 0.69 in that way (sines of unknown
        frequency, noise of 0.1, one target in ten a gross outlier: 239 wrong minima, 61 right minima above 0.97).

        Args:
            target: targets of the residual, (N,), (N, m) or (*, N, m).

        Raises:
            TypeError, ValueError: not a real tensor, of another shape, not finite, or targets of which more than half
                are equal.

        Example:
            >>> x = torch.linspace(0.0, 6.0, 60, dtype=torch.float64)
            >>> y = torch.sin(5.0 * x)
            >>> residual = lambda k: (y - torch.sin(k * x)).unsqueeze(-1)
            >>> far, near = (fit(residual, torch.tensor([at], dtype=torch.float64)) for at in (2.0, 4.8))
            >>> bool(far.converged), bool(far.explained(y) < 0.8), bool(near.explained(y) > 0.99)
            (True, True, True)
        """
        return explained(self.residual, target)


@torch.no_grad()
def fit(
    residual: Residual,
    start: Float[Tensor, "*batch p"],
    *,
    bound: float | Tensor | None = None,
    sigma: float | Tensor | None = None,
    d: float | Tensor | None = None,
    graduate: bool = True,
    data: Any = None,
    weight: Tensor | None = None,
    prior: GaussianPrior | None = None,
    lower: Float[Tensor, " p"] | None = None,
    upper: Float[Tensor, " p"] | None = None,
    equality: Constraint | None = None,
    inequality: Constraint | None = None,
    max_iter: int = 200,
    tol: float = 1e-10,
    jacobian: Literal["forward", "reverse", "reverse twice"] = "forward",
    covariance: CovarianceKind | None = "sandwich",
    bandwidth: float | None = None,
    starts: int = 1,
    seed: int = 0,
) -> NonlinearFit:
    """Fit parameters, bandwidths and scales of a residual by maximum likelihood of the MKC density: MKC-EM.

    Alternates Newton steps on (σ, d) of each channel and a damped step on θ, as :class:`mkc_torch.linear.MKCRegression`
    does and with its safeguards: a fixed domain, d of at least 0.3 robust scales, and a second attempt from weighted
    least squares where a Gaussian has a higher likelihood than the result. The start is graduated: fits with a kernel
    of ten robust scales of the residuals, then of fewer and fewer, so that a start with mostly large residuals is
    allowed.

    The prior is weighed against the likelihood of all residuals; the E-step does not use it.

    Args:
        residual: as in :func:`minimise`.
        start: starting parameters (*, p).
        bound: half-width of the domain in the unit of the residual, at least two robust scales: a number, (m,) or
            (*, m); None takes :func:`mkc_torch.density.fit.domain_rule` on a rough robust fit.
        sigma: None learns σ; a value in [0.05, inf] fixes it.
        d: None learns d; a value fixes it.
        graduate: False starts at ``start`` without graduation; only for starts near the solution.
        data, weight, prior, lower, upper, equality, inequality, jacobian: as in :func:`minimise`.
        max_iter: largest number of trial steps in each of the rough and the final fit.
        tol: converged when two successive alternations each raise the mean log-likelihood by less (nats per sample).
        covariance: "sandwich" for independent samples, "hac" for a time series, None for no covariance. The curvature
            is that of the objective, without the residual's second derivatives; the scores of a sample's channels are
            summed.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.
        starts: number of starts, for a residual with many minima; the most likely result is kept, all judged on one
            domain. ``start`` is the first; the others are drawn uniformly between ``lower`` and ``upper``, or from the
            prior where a bound is missing. The result reports how many agree. Memory grows with this number.
        seed: seed of the starts.

    Raises:
        TypeError, ValueError: as :func:`minimise`; or ``starts`` > 1 and a parameter has neither two bounds nor a
            prior.
        NoFitError: residual or derivatives are not finite at ``start``, or the head of the density does not fit in the
            domain.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17), (29)-(31), Algorithm 2.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> t = torch.linspace(0, 4, 200, dtype=torch.float64)
        >>> y = 3.0 * torch.exp(-0.7 * t) + 0.05 * torch.randn(200, generator=generator, dtype=torch.float64)
        >>> y[::4] += 2.0
        >>> found = fit(lambda a: (a[0] * torch.exp(-a[1] * t) - y).unsqueeze(-1), torch.tensor([1.0, 0.1]).double())
        >>> [round(v, 1) for v in found.theta.tolist()], bool(found.standard_error().max() < 0.05)
        ([3.0, 0.7], True)
    """
    checked_whole("max_iter", max_iter, 1, "200 is usual")
    checked_number("tol", tol, ends="[)", advice="1e-10 suits float64")
    kind = None if covariance is None else checked_kind(covariance)
    checked_bandwidth(bandwidth)
    problem, point = prepare(
        residual,
        start,
        data=data,
        weight=weight,
        prior=prior,
        lower=lower,
        upper=upper,
        equality=equality,
        inequality=inequality,
        jacobian=jacobian,
    )
    like, size = point.residual, problem.batch
    given = _FixedParameters(
        None if sigma is None else per_channel("sigma", sigma, like, size, infinite=True, least=SIGMA_LEAST),
        None if d is None else per_channel("d", d, like, size, infinite=False),
        None if bound is None else per_channel("bound", bound, like, size, infinite=False),
    )
    if checked_whole("starts", starts, 1, "32 is usual where there are many minima") == 1:
        found = _from_start(problem, point, given, graduate=graduate, max_iter=max_iter, tol=tol)
        return _result(problem, found, kind, bandwidth)
    places = draw_starts(problem, point.theta, starts, checked_whole("seed", seed, 0))
    many, at = repeat_problem(problem, places)
    ends = _from_start(
        many, at, given.repeated(starts)._replace(bound=None), graduate=graduate, max_iter=max_iter, tol=tol
    )
    at, reach = ends.point, torch.exp(ends.state.log_bound)
    theta, left, reach = (value.unflatten(0, places.shape[:2]) for value in (at.theta, at.residual, reach))
    best, agreeing = most_likely(problem, theta, left, reach, given=given.bound, sigma=given.sigma, d=given.d)
    point = problem.at(theta[torch.arange(len(best), device=best.device), best])
    found = _from_start(problem, point, given, graduate=False, max_iter=max_iter, tol=tol)
    result = _result(problem, found, kind, bandwidth)
    return replace(result, n_iter=ends.n_iter + found.n_iter, starts=starts, agreeing=problem.restore(agreeing))


class _FixedParameters(NamedTuple):
    """Parameters that are fixed, (B, m) each, or None if learned."""

    sigma: Tensor | None
    d: Tensor | None
    bound: Tensor | None

    def repeated(self, starts: int) -> _FixedParameters:
        return _FixedParameters(*(None if value is None else value.repeat_interleave(starts, 0) for value in self))


def _from_start(
    problem: Problem, point: ProblemPoint, given: _FixedParameters, *, graduate: bool, max_iter: int, tol: float
) -> AlternatingMaximum:
    """Maximise from one start; ``n_iter`` counts all steps."""
    fixed_sigma, fixed_d, fixed_bound = given
    steps = 0
    if graduate:
        point, steps = graduated(problem, point, max_iter)
    likelihood = likelihood_of(problem, point.residual)
    scale = residual_scale(problem, point)
    d_min = LEAST_SCALE * scale if fixed_d is None else torch.minimum(fixed_d, LEAST_SCALE * scale)

    def initial(at: ProblemPoint, size: Tensor, domain: Tensor, tails: Sequence[float | Tensor]) -> DensityState:
        return initial_state(
            at.residual,
            likelihood.weight,
            size,
            domain,
            d_min,
            kappa=None if fixed_sigma is None else fixed_sigma.pow(-2),
            d=fixed_d,
            tails=tails,
        )

    if fixed_bound is None:
        tight = domain_rule(point.residual, scale, problem.used, scales=5.0)
        rough = alternate(
            problem,
            likelihood,
            point,
            initial(point, scale, tight, (0.1, 0.4, 1.5)),
            max_iter=max_iter,
            tol=1e-4,
            exact=False,
        )
        steps += rough.n_iter
        point = rough.point
        size = torch.exp(rough.state.log_d)
        domain = domain_rule(point.residual, size, problem.used)
        state = initial(point, size, domain, (rough.state.kappa,))
        penalty = rough.penalty
    else:
        refuse_out_of_reach(fixed_bound, scale)
        state = initial(point, scale, fixed_bound, (0.1, 0.4, 1.5))
        penalty = None
    maximum = alternate(problem, likelihood, point, state, max_iter=max_iter, tol=tol, penalty=penalty)
    if state.free_kappa and state.free_d:
        maximum = gaussian_candidate(problem, likelihood, maximum, max_iter=max_iter, tol=tol)
    return replace(maximum, n_iter=steps + maximum.n_iter)


def _result(
    problem: Problem, maximum: AlternatingMaximum, kind: CovarianceKind | None, bandwidth: float | None
) -> NonlinearFit:
    point = problem.refreshed(maximum.point)
    kappa, scale = maximum.state.kappa, torch.exp(maximum.state.log_d)
    found = None
    if kind is not None:
        found = problem.restore(parameter_covariance(problem, point, kappa, scale, maximum.penalty, kind, bandwidth))
    return NonlinearFit(
        theta=problem.restore(point.theta),
        sigma=problem.restore(kappa.rsqrt()),
        d=problem.restore(scale),
        bound=problem.restore(torch.exp(maximum.state.log_bound)),
        log_likelihood=problem.restore(-maximum.state.value.sum(-1)),
        weights=problem.restore(kernel_weights(point.residual, kappa, scale)),
        residual=problem.restore(point.residual),
        covariance=found,
        jacobian=shaped_jacobian(problem, point),
        n_iter=maximum.n_iter,
        converged=problem.restore(maximum.converged),
        starts=1,
        agreeing=problem.restore(torch.ones_like(maximum.converged, dtype=torch.int64)),
    )
