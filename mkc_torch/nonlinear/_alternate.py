"""MKC-EM: alternating updates of the residual's density and of the parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mkc_torch.density.em import gaussian_state, normalised, replace_problems, weighted_rms
from mkc_torch.density.likelihood import DensityState, conclusive, newton_step
from mkc_torch.nonlinear._constraints import descend_constrained
from mkc_torch.nonlinear._descent import damped_step
from mkc_torch.nonlinear._problem import Problem, ProblemPoint
from mkc_torch.nonlinear._quadratic import Penalty, positive, prior_value, quadratic_about


@dataclass(frozen=True)
class _Likelihood:
    """Data of the E-step: normalised weights (B, N, m) and the total weight of each channel (B, m)."""

    weight: Tensor | None
    total: Tensor

    def select(self, index: Tensor) -> _Likelihood:
        return _Likelihood(None if self.weight is None else self.weight[index], self.total[index])


def likelihood_of(problem: Problem, residual: Tensor) -> _Likelihood:
    if problem.weight is None:
        count = residual.new_full((residual.shape[0], residual.shape[2]), residual.shape[1])
        return _Likelihood(None, count)
    total = problem.weight.sum(-2)
    return _Likelihood(normalised(problem.weight), total)


@dataclass(frozen=True)
class AlternatingMaximum:
    point: ProblemPoint
    state: DensityState
    value: Tensor  # mean negative log-likelihood and prior, in nats per sample
    converged: Tensor
    n_iter: int
    penalty: Penalty | None


def alternate(
    problem: Problem,
    likelihood: _Likelihood,
    point: ProblemPoint,
    state: DensityState,
    *,
    max_iter: int,
    tol: float,
    exact: bool = True,
    penalty: Penalty | None = None,
) -> AlternatingMaximum:
    """Alternate E-steps on (σ, d) and damped steps on θ until gain and predicted gain are below ``tol`` nats."""
    eps = torch.finfo(point.theta.dtype).eps
    share = likelihood.total / likelihood.total.mean(-1, keepdim=True)
    samples = likelihood.total.mean(-1)
    previous = torch.full_like(samples, torch.inf)
    done = torch.zeros_like(samples, dtype=torch.bool)
    stepped = done
    calm = settled = torch.zeros_like(state.value, dtype=torch.bool)
    damping: Tensor | None = None
    n_iter = 0
    while n_iter < max_iter:
        before = state
        state = newton_step(point.residual, likelihood.weight, before)
        value = (share * state.value).sum(-1) + prior_value(problem, point.theta) / samples
        change = (previous - value).abs() if problem.is_inequality is not None else previous - value
        improved = change > tol + 8 * eps * value.abs()
        # rounding can make a Newton step at the optimum look like a failed step
        earlier, settled = settled, conclusive(before, state)
        calm = ~improved.unsqueeze(-1) & (calm | settled | earlier)
        done = calm.all(-1) & stepped
        previous = value
        if bool(done.all()):
            break
        kappa, d = state.kappa, torch.exp(state.log_d)
        found, penalty = descend_constrained(
            problem,
            point,
            kappa,
            d,
            max_iter=1 if penalty is None and problem.is_inequality is None else 30,
            tol=0.0,
            penalty=penalty,
            damping=damping,
            allowance=tol * samples,
            exact=exact,
        )
        n_iter += found.n_iter
        damping, stepped, point = found.damping, found.converged, found.point
        if found.needs_refresh:
            point = problem.refreshed(point)
    return AlternatingMaximum(point, state, previous, done, n_iter, penalty)


def gaussian_candidate(
    problem: Problem, likelihood: _Likelihood, maximum: AlternatingMaximum, *, max_iter: int, tol: float
) -> AlternatingMaximum:
    """Continue from a Gaussian density at weighted least squares where it has a higher likelihood than the result."""
    state = maximum.state
    point = problem.refreshed(maximum.point)
    tailed = (state.kappa > 0).any(-1)
    if not bool(tailed.any()):
        return replace(maximum, point=point)
    d_min = torch.exp(state.log_d_min)

    # the linearised residual shows whether a Gaussian can have a higher likelihood, before a fit is made
    d = weighted_rms(point.residual, likelihood.weight, d_min)
    residual = point.residual
    for _ in range(1 if d.shape[-1] == 1 else 2):
        quadratic = quadratic_about(problem, point, torch.zeros_like(d), d, None)
        scaling = positive(quadratic.majoriser.diagonal(dim1=-2, dim2=-1))
        step, _, _ = damped_step(
            replace(problem, box=None),
            point.theta,
            quadratic.gradient,
            quadratic.majoriser,
            scaling,
            torch.full_like(scaling[:, 0], 1e-9),
        )
        change = torch.matmul(step.unsqueeze(-2), point.tangents).squeeze(-2).unflatten(-1, residual.shape[1:])
        residual = point.residual + change
        d = weighted_rms(residual, likelihood.weight, d_min)
    share = likelihood.total / likelihood.total.mean(-1, keepdim=True)
    gaussian = gaussian_state(residual, likelihood.weight, state)
    better = tailed & ((share * gaussian.value).sum(-1) < maximum.value + tol)
    index = better.nonzero().squeeze(-1)
    if index.numel() == 0:
        return replace(maximum, point=point)
    part, part_likelihood = problem.select(index), likelihood.select(index)
    initial = replace(gaussian.select(index), free_kappa=False)
    again = alternate(part, part_likelihood, point.select(index), initial, max_iter=max_iter, tol=tol)
    released = replace(again.state, free_kappa=True, damping=torch.full_like(again.state.damping, 1e-3))
    again = alternate(part, part_likelihood, again.point, released, max_iter=max_iter, tol=tol, penalty=again.penalty)
    won = (again.value < maximum.value[index]).nonzero().squeeze(-1)
    if won.numel() == 0:
        return replace(maximum, point=point, n_iter=maximum.n_iter + again.n_iter)
    index, winner = index[won], problem.select(index).refreshed(again.point).select(won)
    penalty = maximum.penalty
    if penalty is not None and again.penalty is not None:
        penalty = Penalty(
            penalty.multiplier.index_copy(0, index, again.penalty.multiplier[won]),
            penalty.rho.index_copy(0, index, again.penalty.rho[won]),
        )
    return AlternatingMaximum(
        point=point.write(index, winner),
        state=replace_problems(state, index, again.state.select(won)),
        value=maximum.value.index_copy(0, index, again.value[won]),
        converged=maximum.converged.index_copy(0, index, again.converged[won]),
        n_iter=maximum.n_iter + again.n_iter,
        penalty=penalty,
    )
