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
    """A robust scale of residuals (B, S, N, m); ``near`` is one that it is near to, where that is known."""

    def scale(self, problem: LinearProblem, residual: Tensor, near: Tensor | None = None) -> Float[Tensor, "B S m"]: ...

    def weighed(
        self, problem: LinearProblem, residual: Tensor, near: Tensor | None = None
    ) -> tuple[Float[Tensor, "B S m"], Tensor]:
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


@dataclass(frozen=True)
class Search:
    """How the minimum is looked for.

    ``starts`` elemental sets, least squares being one more, make ``screening_steps`` steps each with a rule that may be
    approximate. The best ``candidates`` of them go on with the exact rule until a step lowers the logarithm of the
    scale by less than ``tolerance``, or ``max_iter`` steps; after as many as ``narrowing`` says, only so many go on.
    """

    screening: ScaleRule
    final: ScaleRule
    starts: int = 500
    candidates: int = 10
    screening_steps: int = 2
    narrowing: tuple[tuple[int, int], ...] = ()
    tolerance: float = 0.0
    max_iter: int = 100
    seed: int = 0


def _step(problem: LinearProblem, beta: Tensor, rule: ScaleRule, near: Tensor | None) -> tuple[Tensor, Tensor]:
    """Coefficients after one concentration step, and the scale before it."""
    residual = problem.residual(beta)
    scale, weight = rule.weighed(problem, residual, near)
    if problem.num_channels > 1:
        share = weight if problem.sample_weight is None else weight * problem.sample_weight.unsqueeze(1)
        spread = (share * residual.square()).sum(-2).sqrt()  # the gradient of log(scale) has its square below
        weight = weight * relative_precision(spread).unsqueeze(-2)
    return problem.weighted_fit(weight), scale


def _of_starts(values: Float[Tensor, "B S k"], index: Float[Tensor, "B K"]) -> Float[Tensor, "B K k"]:
    return values.gather(1, index.unsqueeze(-1).expand(-1, -1, values.shape[-1]))


def _best(
    problem: LinearProblem, beta: Tensor, near: Tensor | None, rule: ScaleRule, count: int
) -> tuple[Tensor, Tensor]:
    """The coefficients of the ``count`` smallest scales, and these."""
    scale = rule.scale(problem, problem.residual(beta), near)
    order = _log_product(scale).topk(min(count, beta.shape[1]), dim=1, largest=False).indices
    return _of_starts(beta, order), _of_starts(scale, order)


def minimise_scale(problem: LinearProblem, search: Search) -> ScaleMinimum:
    """A few steps from every start on at most 1500 samples, then the best candidates to rest on all of them."""
    per_problem = min(problem.num_samples, _SCREENING_SAMPLES) * problem.num_channels * (search.starts + 1)
    parts = torch.arange(problem.Y.shape[0], device=problem.Y.device).split(max(1, _CHUNK // per_problem))
    found = [_minimise(problem.select(i) if len(parts) > 1 else problem, search) for i in parts]
    return ScaleMinimum(
        beta=torch.cat([f.beta for f in found]),
        scale=torch.cat([f.scale for f in found]),
        weight=torch.cat([f.weight for f in found]),
        n_iter=max(f.n_iter for f in found),
        converged=torch.cat([f.converged for f in found]),
    )


_RAW_COEFFICIENTS = 3
"""Fits through up to so many values are good enough to be ranked as they are."""

_RAW_SHARE = 3
"""One in so many of the starts goes on where fits are ranked as they are."""


def _screened(problem: LinearProblem, search: Search) -> tuple[Float[Tensor, "B S n"], Float[Tensor, "B S m"] | None]:
    """The candidates, and their scales where they were screened on all samples."""
    generator = torch.Generator().manual_seed(search.seed)
    small = problem
    if problem.num_samples > _SCREENING_SAMPLES:
        keep = torch.randperm(problem.num_samples, generator=generator)[:_SCREENING_SAMPLES].sort().values
        small = problem.select_samples(keep.to(problem.Y.device))
    beta = elemental_starts(small, search.starts, generator)
    near: Tensor | None = None
    if search.screening_steps and problem.num_coefficients <= _RAW_COEFFICIENTS:
        kept = max(search.candidates, -(-beta.shape[1] // _RAW_SHARE))
        beta, near = _best(small, beta, None, search.screening, kept)
    for _ in range(search.screening_steps):
        beta, near = _step(small, beta, search.screening, near)
    beta, near = _best(small, beta, near, search.screening, search.candidates)
    return beta, near if small is problem else None


def _minimise(problem: LinearProblem, search: Search) -> ScaleMinimum:
    beta, near = _screened(problem, search)
    return descend(problem, beta, near, search)


def descend(
    problem: LinearProblem, beta: Float[Tensor, "B S n"], near: Float[Tensor, "B S m"] | None, search: Search
) -> ScaleMinimum:
    """Steps from every candidate to rest, and the best end of them."""
    tolerance = max(search.tolerance, 1e2 * torch.finfo(beta.dtype).eps)
    narrowing = dict(search.narrowing)
    objective = beta.new_full(beta.shape[:2], math.inf)
    scale = beta.new_zeros(*beta.shape[:2], problem.num_channels) if near is None else near
    moving = torch.ones_like(objective, dtype=torch.bool)
    n_iter = 0
    while n_iter < search.max_iter and moving.any():
        if n_iter in narrowing and narrowing[n_iter] < beta.shape[1]:
            order = objective.topk(narrowing[n_iter], dim=1, largest=False).indices
            beta, scale = _of_starts(beta, order), _of_starts(scale, order)
            objective, moving = objective.gather(1, order), moving.gather(1, order)
        n_iter += 1
        going = torch.nonzero(moving.any(0)).flatten()
        every = going.shape[0] == beta.shape[1]
        here = beta if every else beta[:, going]
        known = n_iter > 1 or near is not None
        proposal, now = _step(problem, here, search.final, (scale if every else scale[:, going]) if known else None)
        before = _log_product(now)
        falls = objective[:, going] - before > tolerance
        objective[:, going] = torch.minimum(objective[:, going], before)
        beta, scale = (
            beta.index_copy(1, going, torch.where(falls.unsqueeze(-1), proposal, here)),
            scale.index_copy(1, going, now),
        )
        moving[:, going] = falls
    residual = problem.residual(beta)
    scale, weight = search.final.weighed(problem, residual, scale)
    best = _log_product(scale).argmin(1)
    batch = torch.arange(beta.shape[0], device=beta.device)
    return ScaleMinimum(beta[batch, best], scale[batch, best], weight[batch, best], n_iter, ~moving[batch, best])
