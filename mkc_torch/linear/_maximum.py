"""Maximisation of the MKC likelihood of a linear problem, in its basis: Algorithm 3 of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mkc_torch._support.side_by_side import steps_between_tests
from mkc_torch.density.domain import domain_rule, refuse_bad_bound
from mkc_torch.density.em import gaussian_state, normalised, replace_problems, weighted_rms
from mkc_torch.density.likelihood import DensityState, conclusive, initial_state, newton_step
from mkc_torch.linear._alternation import alternate_by_kernel
from mkc_torch.linear._concentration import runs_kernel
from mkc_torch.linear._mkc import channel_parameter, fixed_point_step
from mkc_torch.linear._problem import LinearProblem
from mkc_torch.linear._robust_start import RobustStart, Start, robust_start, small_sample_factor

_FLOOR = 0.3
"""Least d in robust scales. Outliers at most double a scale; the d of a fit that interpolates is far smaller."""

TAILS = (0.1, 0.4, 1.5)
"""κ of the candidate densities at the start of a fit."""

TIGHT = 5.0
"""Least half-width of the domain of a rough fit, in robust scales."""


@dataclass(frozen=True)
class LikelihoodMaximum:
    beta: Tensor
    state: DensityState
    value: Tensor
    converged: Tensor
    history: list[Tensor]


def _alternate(
    problem: LinearProblem, beta: Tensor, state: DensityState, *, max_iter: int, tol: float, patience: int = 2
) -> LikelihoodMaximum:
    """Alternate E-steps and M-steps; a problem leaves the batch after ``patience`` of them without progress."""
    if runs_kernel(problem):
        found = alternate_by_kernel(problem, beta, state, max_iter=max_iter, tol=tol, patience=patience)
        return LikelihoodMaximum(found.beta, found.state, found.history[-1], found.ended, found.history)
    size = beta.shape[0]
    index = torch.arange(size, device=beta.device)
    out_beta, out_state = beta.clone(), state
    value = state.value.sum(-1)
    converged = torch.zeros(size, dtype=torch.bool, device=beta.device)
    history = [value]
    weight = normalised(problem.sample_weight)
    stalled = torch.zeros(size, dtype=torch.int64, device=beta.device)
    done = torch.zeros_like(stalled, dtype=torch.bool)
    every = steps_between_tests(beta)
    for step in range(1, max_iter + 1):
        residual = problem.residual(beta)
        last, before = beta, state
        state = newton_step(residual, weight, before)
        kappa, d = state.kappa, torch.exp(state.log_d)
        for _ in range(2):
            beta = fixed_point_step(problem, residual, kappa, d)
            residual = problem.residual(beta)
        if every > 1:
            # problems that have ended wait for the next test
            beta, state = torch.where(done.unsqueeze(-1), last, beta), before.moved(~done, state)
        now = state.value.sum(-1)
        rounding = 8 * torch.finfo(beta.dtype).eps * now.abs()
        improved = history[-1][index] - now > tol + rounding
        stalled = torch.where(improved, 0, stalled + conclusive(before, state).all(-1).to(stalled.dtype))
        current = history[-1].clone()
        current[index] = now
        history.append(current)
        done = done | (stalled >= patience)
        if (step % every == 0 and bool(done.any())) or step == max_iter:
            out_beta[index] = beta
            out_state = replace_problems(out_state, index, state)
            converged[index] = done & torch.isfinite(now)
            keep = (~done).nonzero().squeeze(-1)
            if keep.numel() == 0:
                break
            index, beta, stalled, done = index[keep], beta[keep], stalled[keep], done[keep]
            state, problem = state.select(keep), problem.select(keep)
            weight = None if weight is None else weight[keep]
    return LikelihoodMaximum(out_beta, out_state, history[-1], converged, history)


def _gaussian_candidate(
    problem: LinearProblem, maximum: LikelihoodMaximum, *, max_iter: int, tol: float
) -> LikelihoodMaximum:
    """Continue from a Gaussian density at weighted least squares where it has a higher likelihood than the result."""
    state = maximum.state
    beta = problem.weighted_fit(torch.ones_like(problem.Y))
    weight = normalised(problem.sample_weight)
    for _ in range(2 if problem.num_channels > 1 else 0):
        d = weighted_rms(problem.residual(beta), weight, torch.exp(state.log_d_min))
        beta = fixed_point_step(problem, problem.Y, torch.zeros_like(d), d)
    gaussian = gaussian_state(problem.residual(beta), weight, state)
    better = (gaussian.value.sum(-1) < maximum.value).nonzero().squeeze(-1)
    if better.numel() == 0:
        return maximum
    initial = replace(gaussian.select(better), free_kappa=True)
    again = _alternate(problem.select(better), beta[better], initial, max_iter=max_iter, tol=tol)
    steps = max(len(maximum.history), len(again.history))
    history = []
    for i in range(steps):
        now = maximum.history[min(i, len(maximum.history) - 1)].clone()
        now[better] = again.history[min(i, len(again.history) - 1)]
        history.append(now)
    return LikelihoodMaximum(
        beta=maximum.beta.index_copy(0, better, again.beta),
        state=replace_problems(state, better, again.state),
        value=maximum.value.index_copy(0, better, again.value),
        converged=maximum.converged.index_copy(0, better, again.converged),
        history=history,
    )


@dataclass(frozen=True)
class FixedParameters:
    """The parameters and the start that the user gave."""

    sigma: float | Tensor | None
    d: float | Tensor | None
    bound: float | Tensor | None
    start: Start | Tensor

    def in_basis_of(self, problem: LinearProblem) -> FixedParameters:
        """The same for a problem whose X is the basis of ``problem``."""
        if not isinstance(self.start, Tensor):
            return self
        return replace(self, start=problem.restore(problem.in_basis(self.start.to(problem.Y))))

    def initial_state(
        self,
        problem: LinearProblem,
        beta: Tensor,
        scale: Tensor,
        bound: Tensor,
        d_min: Tensor,
        tails: Sequence[float | Tensor] = TAILS,
    ) -> DensityState:
        """The most likely of a few densities at coefficients ``beta``."""
        d = None if self.d is None else channel_parameter("d", self.d, problem)
        sigma = None if self.sigma is None else channel_parameter("sigma", self.sigma, problem, infinite=True)
        if d is not None:
            d_min = torch.minimum(d, d_min)
        return initial_state(
            problem.residual(beta),
            normalised(problem.sample_weight),
            scale,
            bound,
            d_min,
            kappa=None if sigma is None else sigma.pow(-2),
            d=d,
            tails=tails,
        )


def maximise(
    problem: LinearProblem, known: FixedParameters, *, max_iter: int, tol: float, seed: int
) -> tuple[RobustStart, LikelihoodMaximum]:
    """Return the robust start and the maximum of the likelihood."""
    begin = robust_start(problem, known.start, seed=seed)
    d_min = lower_limit_of_d(problem, begin)
    if known.bound is None:
        rough = rough_fit(problem, known, begin, max_iter=max_iter)
        beta, kappa, d = rough.beta, rough.state.kappa, torch.exp(rough.state.log_d)
        bound = domain_rule(problem.residual(beta), d, _used(problem))
        state = known.initial_state(problem, beta, d, bound, d_min, tails=(kappa,))
    else:
        beta, bound = begin.beta, given_bound(problem, known, begin)
        state = known.initial_state(problem, beta, begin.scale, bound, d_min)
    maximum = _alternate(problem, beta, state, max_iter=max_iter, tol=tol)
    if state.free_kappa and state.free_d:
        maximum = _gaussian_candidate(problem, maximum, max_iter=max_iter, tol=tol)
    return begin, maximum


def lower_limit_of_d(problem: LinearProblem, begin: RobustStart) -> Tensor:
    """Lower bound of d; a whole-number weight counts as so many samples in its small-sample factor."""
    weight, N, p = problem.sample_weight, problem.num_samples, problem.coefficients_per_channel
    if weight is None:
        return _FLOOR * begin.scale
    # d often ends at this bound, so that a weight of 2 and two samples need the same
    count = torch.where((weight == weight.round()).all(-2), weight.sum(-2), float(N))
    return _FLOOR * begin.scale * small_sample_factor(count, p) / small_sample_factor(weight.new_tensor(float(N)), p)


def given_bound(problem: LinearProblem, known: FixedParameters, begin: RobustStart) -> Tensor:
    """The given domain of every channel.

    Raises:
        ValueError: the head of the density does not fit in it.
    """
    assert known.bound is not None
    bound = channel_parameter("bound", known.bound, problem)
    refuse_bad_bound(bound, begin.scale)
    return bound


def rough_fit(
    problem: LinearProblem,
    known: FixedParameters,
    begin: RobustStart,
    *,
    max_iter: int,
    tails: Sequence[float] = TAILS,
) -> LikelihoodMaximum:
    """Fit from which the rule derives the domain, and which is close to the final fit.

    The scale of a robust start is up to twice that of the head where outliers are many and one-sided. The rough fit
    therefore uses a tight domain, on which it finds the head, or the given domain.
    """
    if known.bound is None:
        bound = domain_rule(problem.residual(begin.beta), begin.scale, _used(problem), scales=TIGHT)
    else:
        bound = given_bound(problem, known, begin)
    state = known.initial_state(problem, begin.beta, begin.scale, bound, lower_limit_of_d(problem, begin), tails=tails)
    return _alternate(problem, begin.beta, state, max_iter=max_iter, tol=1e-4, patience=1)


def _used(problem: LinearProblem) -> Tensor | None:
    return None if problem.sample_weight is None else problem.sample_weight > 0
