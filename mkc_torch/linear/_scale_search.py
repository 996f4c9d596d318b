"""Minimise a robust residual scale over the coefficients: concentration steps from many elemental starts in one batch.

Least trimmed squares and S-regression differ only in the scale. With several channels the product of the channels'
scales is minimised; a step with the weights of the scale over its square never increases it (Rousseeuw & Van
Driessen, "Computing LTS regression for large data sets", 2006; Salibian-Barrera & Yohai, "A fast algorithm for
S-regression estimates", 2006).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.linear._problem import LinearProblem


class ScaleRule(Protocol):
    """A robust scale of residuals (B, S, N, m)."""

    def scale(self, problem: LinearProblem, residual: Tensor) -> Float[Tensor, "B S m"]: ...

    def weighed(self, problem: LinearProblem, residual: Tensor) -> tuple[Float[Tensor, "B S m"], Tensor]:
        """The scale, and the weights in [0, 1] of a step that lowers it, (B, S, N, m)."""
        ...


_CHUNK = 1 << 19
"""Residuals worked on at once, few enough to stay in a processor's cache."""

_SCREENING_SAMPLES = 1500


@dataclass(frozen=True)
class ScaleMinimum:
    """The best coefficients found, in the basis, with the scale, the weights and the number of steps."""

    beta: Float[Tensor, "B n"]
    scale: Float[Tensor, "B m"]
    weight: Float[Tensor, "B N m"]
    n_iter: int
    converged: Tensor


def elemental_starts(problem: LinearProblem, count: int, generator: torch.Generator) -> Float[Tensor, "B count+1 n"]:
    """Coefficients through ``count`` random sets of n values, and the least-squares ones."""
    n, B = problem.num_coefficients, problem.Y.shape[0]
    values = problem.num_samples * problem.num_channels
    keys = torch.rand(count, values, generator=generator, dtype=torch.float64).to(problem.Y.device)
    rows = problem.basis.flatten(-3, -2)
    y = problem.Y.flatten(-2)
    if problem.sample_weight is None:
        index = keys.topk(n, dim=-1).indices
        chosen, target = rows[:, index], y[:, index]
    else:
        used = (problem.sample_weight > 0).flatten(-2).unsqueeze(1)
        index = torch.where(used, keys, -1.0).topk(n, dim=-1).indices
        batch = torch.arange(B, device=y.device).view(B, 1, 1)
        chosen, target = rows.expand(B, -1, -1)[batch, index], y[batch, index]
    solution, info = torch.linalg.solve_ex(chosen.expand(B, -1, -1, -1), target)
    usable = (info == 0).unsqueeze(-1) & torch.isfinite(solution)
    least_squares = problem.weighted_fit(torch.ones_like(problem.Y))
    return torch.cat([torch.where(usable, solution, 0.0), least_squares.unsqueeze(1)], dim=1)


def _log_product(scale: Tensor) -> Tensor:
    return torch.log(scale.clamp(min=torch.finfo(scale.dtype).tiny)).sum(-1)


def relative_precision(scale: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
    """``1 / scale²`` up to a factor, at most 1; a channel fitted exactly gets a finite share."""
    largest = scale.amax(-1, keepdim=True)
    ratio = torch.where(largest > 0, scale / largest, 1.0).clamp(min=torch.finfo(scale.dtype).eps)
    return (ratio.amin(-1, keepdim=True) / ratio).square()


def rounding_scale(problem: LinearProblem) -> Float[Tensor, "B m"]:
    """A scale that stands for 0: where a fit is exact, its rounding errors keep weight 1 and the others lose theirs."""
    magnitude = problem.Y.abs().amax(-2)
    return 1e3 * torch.finfo(problem.Y.dtype).eps * torch.where(magnitude > 0, magnitude, 1.0)


def _step(problem: LinearProblem, beta: Tensor, rule: ScaleRule) -> tuple[Tensor, Tensor]:
    """Coefficients after one concentration step, and the objective before it."""
    residual = problem.residual(beta)
    scale, weight = rule.weighed(problem, residual)
    objective = _log_product(scale)
    share = weight if problem.sample_weight is None else weight * problem.sample_weight.unsqueeze(1)
    spread = (share * residual.square()).sum(-2).sqrt()  # the gradient of log(scale) has its square below
    return problem.weighted_fit(weight * relative_precision(spread).unsqueeze(-2)), objective


def _best(problem: LinearProblem, beta: Tensor, rule: ScaleRule, count: int) -> Tensor:
    scale = rule.scale(problem, problem.residual(beta))
    order = _log_product(scale).topk(min(count, beta.shape[1]), dim=1, largest=False).indices
    return beta.gather(1, order.unsqueeze(-1).expand(-1, -1, beta.shape[-1]))


def minimise_scale(
    problem: LinearProblem,
    screening: ScaleRule,
    final: ScaleRule,
    *,
    starts: int = 500,
    candidates: int = 10,
    screening_steps: int = 2,
    max_iter: int = 100,
    seed: int = 0,
) -> ScaleMinimum:
    """A few steps from every start on at most 1500 samples, then the best candidates to convergence on all of them.

    Args:
        problem: the regression.
        screening: scale rule for the many starts, which may be approximate.
        final: exact scale rule.
        starts: number of elemental starts; least squares is one more.
        candidates: how many are followed to convergence.
        screening_steps: steps before the candidates are chosen.
        max_iter: steps at most.
        seed: of the elemental starts.
    """
    per_problem = min(problem.num_samples, _SCREENING_SAMPLES) * problem.num_channels * (starts + 1)
    parts = torch.arange(problem.Y.shape[0], device=problem.Y.device).split(max(1, _CHUNK // per_problem))
    found = [
        _minimise(problem.select(i), screening, final, starts, candidates, screening_steps, max_iter, seed)
        for i in parts
    ]
    return ScaleMinimum(
        beta=torch.cat([f.beta for f in found]),
        scale=torch.cat([f.scale for f in found]),
        weight=torch.cat([f.weight for f in found]),
        n_iter=max(f.n_iter for f in found),
        converged=torch.cat([f.converged for f in found]),
    )


def _minimise(
    problem: LinearProblem,
    screening: ScaleRule,
    final: ScaleRule,
    starts: int,
    candidates: int,
    screening_steps: int,
    max_iter: int,
    seed: int,
) -> ScaleMinimum:
    generator = torch.Generator().manual_seed(seed)
    small = problem
    if problem.num_samples > _SCREENING_SAMPLES:
        keep = torch.randperm(problem.num_samples, generator=generator)[:_SCREENING_SAMPLES].sort().values
        small = problem.select_samples(keep.to(problem.Y.device))
    beta = elemental_starts(small, starts, generator)
    for _ in range(screening_steps):
        beta, _ = _step(small, beta, screening)
    beta = _best(small, beta, screening, candidates)

    tolerance = 1e2 * torch.finfo(beta.dtype).eps
    objective = beta.new_full(beta.shape[:2], math.inf)
    moving = torch.ones_like(objective, dtype=torch.bool)
    n_iter = 0
    while n_iter < max_iter and moving.any():
        n_iter += 1
        going = torch.nonzero(moving.any(0)).flatten()
        here = beta[:, going]
        proposal, before = _step(problem, here, final)
        falls = objective[:, going] - before > tolerance
        objective[:, going] = torch.minimum(objective[:, going], before)
        beta[:, going] = torch.where(falls.unsqueeze(-1), proposal, here)
        moving[:, going] = falls
    residual = problem.residual(beta)
    scale, weight = final.weighed(problem, residual)
    best = _log_product(scale).argmin(1)
    batch = torch.arange(beta.shape[0], device=beta.device)
    return ScaleMinimum(beta[batch, best], scale[batch, best], weight[batch, best], n_iter, ~moving[batch, best])
