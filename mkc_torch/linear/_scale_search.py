"""Minimise a robust residual scale over the coefficients: concentration steps from many elemental starts in one batch.

Least trimmed squares and S-regression differ only in the scale. With several channels the product of their scales is
minimised; a step with the weights of the scale over its square never increases it (Rousseeuw & Van
Driessen, "Computing LTS regression for large data sets", 2006; Salibian-Barrera & Yohai, "A fast algorithm for
S-regression estimates", 2006).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from mkc_torch._support.elemental_sets import drawn_of_used, drawn_samples
from mkc_torch._support.independent_rows import taken
from mkc_torch._support.side_by_side import at_once, side_by_side, steps_between_tests
from mkc_torch._support.small_factors import solve
from mkc_torch.linear._concentration import ScaleOptions, concentrate, runs_kernel

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.linear._problem import LinearProblem


class ScaleRule(Protocol):
    """A robust scale of residuals (B, S, N, m); ``near`` is a first guess of the scale, if known."""

    def options(self, problem: LinearProblem) -> ScaleOptions:
        """Arguments of the kernel for this scale."""
        ...

    def scale(self, problem: LinearProblem, residual: Tensor, near: Tensor | None = None) -> Float[Tensor, "B S m"]: ...

    def weighted(
        self, problem: LinearProblem, residual: Tensor, near: Tensor | None = None
    ) -> tuple[Float[Tensor, "B S m"], Tensor]:
        """Return the scale and the weights in [0, 1] of a step that lowers it, (B, S, N, m)."""
        ...


_CHUNK = 1 << 16
"""Residuals of one problem processed at once, few enough to stay in a processor's cache."""

_BATCH = 1 << 18
"""Residuals of many problems processed at once, so many that the overhead of the calls is small."""

SCREENED = 1500
"""Largest number of samples on which starts are screened."""


@dataclass(frozen=True)
class ScaleMinimum:
    """The best coefficients, in the basis, with scale, weights, number of steps and convergence."""

    beta: Float[Tensor, "B n"]
    scale: Float[Tensor, "B m"]
    weight: Float[Tensor, "B N m"]
    n_iter: int
    converged: Tensor


def elemental_starts(problem: LinearProblem, count: int, seed: int) -> Float[Tensor, "B count+1 n"]:
    """Coefficients through ``count`` random sets of n values, and the least-squares coefficients."""
    B = problem.Y.shape[0]
    chosen, target = values_of_sets(problem, count, problem.num_coefficients, seed)
    solution = solve(chosen.expand(B, -1, -1, -1), target.unsqueeze(-1)).squeeze(-1)
    usable = torch.isfinite(solution).all(-1, keepdim=True)
    least_squares = problem.weighted_fit(torch.ones_like(problem.Y))
    return torch.cat([torch.where(usable, solution, 0.0), least_squares.unsqueeze(1)], dim=1)


def values_of_sets(
    problem: LinearProblem, count: int, size: int, seed: int
) -> tuple[Float[Tensor, "#B count size n"], Float[Tensor, "B count size"]]:
    """Rows of the basis and targets of ``count`` random sets of ``size`` values of positive weight."""
    rows, y, weight = problem.basis.flatten(-3, -2), problem.Y.flatten(-2), problem.sample_weight
    used = None if weight is None else (weight > 0).flatten(-2)
    index = drawn_of_used(seed, count, size, used, y.shape[-1], y.device)
    if used is None:
        return rows[:, index], y[:, index]
    batch = torch.arange(y.shape[0], device=y.device).view(-1, 1, 1)
    return rows.expand(y.shape[0], -1, -1)[batch, index], y[batch, index]


def log_product(scale: Tensor) -> Tensor:
    return torch.log(scale.clamp(min=torch.finfo(scale.dtype).tiny)).sum(-1)


def relative_precision(scale: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
    """``1 / scale²`` up to a factor, at most 1; finite for a channel that is fitted exactly."""
    largest = scale.amax(-1, keepdim=True)
    ratio = torch.where(largest > 0, scale / largest, 1.0).clamp(min=torch.finfo(scale.dtype).eps)
    return (ratio.amin(-1, keepdim=True) / ratio).square()


def rounding_scale(problem: LinearProblem) -> Float[Tensor, "B m"]:
    """Replacement of a scale of 0: values on an exact fit keep weight 1, the others lose theirs."""
    magnitude = problem.Y.abs().amax(-2)
    return 1e3 * torch.finfo(problem.Y.dtype).eps * torch.where(magnitude > 0, magnitude, 1.0)


@dataclass(frozen=True)
class ScaleSearch:
    """Options of a scale search.

    ``starts`` elemental sets and least squares are screened on at most ``screened`` samples, ``screening_steps`` steps
    each. With ``ranking`` only the best 1 in ``raw`` of them make these steps. The best ``candidates`` continue; each
    pair of ``narrowing`` is a number of steps and the number of candidates kept after them. All of this may use an
    approximate scale. The last candidates continue with the ``final`` rule until a step lowers the log scale by less
    than ``tolerance``, or for ``max_iter`` steps.
    """

    screening: ScaleRule
    final: ScaleRule
    starts: int = 500
    ranking: ScaleRule | None = None
    raw: int = 3
    candidates: int = 10
    screening_steps: int = 2
    narrowing: tuple[tuple[int, int], ...] = ()
    tolerance: float = 0.0
    max_iter: int = 100
    seed: int = 0
    screened: int = SCREENED


def _step(problem: LinearProblem, beta: Tensor, rule: ScaleRule, near: Tensor | None) -> tuple[Tensor, Tensor]:
    """Make a concentration step: return the new coefficients, and the scale before the step."""
    residual = problem.residual(beta)
    scale, weight = rule.weighted(problem, residual, near)
    if problem.num_channels > 1:
        share = weight if problem.sample_weight is None else weight * problem.sample_weight.unsqueeze(1)
        # the gradient of log(scale) has the square of this spread in its denominator
        spread = (share * residual.square()).sum(-2).sqrt()
        weight = weight * relative_precision(spread).unsqueeze(-2)
    return problem.weighted_fit(weight), scale


def scale_of(
    problem: LinearProblem, beta: Float[Tensor, "B S n"], rule: ScaleRule, near: Tensor | None = None
) -> Float[Tensor, "B S m"]:
    """The scale of the residuals of each start."""
    if runs_kernel(problem):
        return concentrate(problem, beta, rule.options(problem), near=near).scale
    return rule.scale(problem, problem.residual(beta), near)


def _best(
    problem: LinearProblem, beta: Tensor, near: Tensor | None, rule: ScaleRule, count: int
) -> tuple[Tensor, Tensor]:
    """The coefficients with the ``count`` smallest scales, and these scales."""
    return _smallest(beta, scale_of(problem, beta, rule, near), count)


def _smallest(
    beta: Float[Tensor, "B S n"], scale: Float[Tensor, "B S m"], count: int
) -> tuple[Float[Tensor, "B K n"], Float[Tensor, "B K m"]]:
    order = log_product(scale).topk(min(count, beta.shape[1]), dim=1, largest=False).indices
    return taken(beta, order), taken(scale, order)


@dataclass(frozen=True)
class _Candidates:
    """Candidates with their scales, if known, whether they have converged, and the number of steps."""

    beta: Float[Tensor, "B S n"]
    scale: Float[Tensor, "B S m"] | None
    converged: Float[Tensor, "B S"]
    n_iter: int = 0

    def of_starts(self, index: Tensor) -> _Candidates:
        scale = None if self.scale is None else taken(self.scale, index)
        return replace(self, beta=taken(self.beta, index), scale=scale, converged=self.converged.gather(1, index))

    def select(self, index: Tensor) -> _Candidates:
        scale = None if self.scale is None else self.scale[index]
        return replace(self, beta=self.beta[index], scale=scale, converged=self.converged[index])

    def narrowed(self, count: int) -> _Candidates:
        """The ``count`` candidates with the smallest scales."""
        if self.scale is None or count >= self.beta.shape[1]:
            return self
        return self.of_starts(log_product(self.scale).topk(count, dim=1, largest=False).indices)


def _in_parts(problem: LinearProblem, values: int, work: Callable[[LinearProblem, Tensor], _Candidates]) -> _Candidates:
    """Apply ``work`` to parts of the problems, sized so that ``values`` of each problem stay in the cache."""
    every = torch.arange(problem.Y.shape[0], device=problem.Y.device)
    parts = every.split(at_once(problem.Y, values, _BATCH))
    if len(parts) == 1:
        return work(problem, every)
    found = [work(problem.select(part), part) for part in parts]
    scales = [f.scale for f in found if f.scale is not None]
    return _Candidates(
        beta=torch.cat([f.beta for f in found]),
        scale=torch.cat(scales) if scales else None,
        converged=torch.cat([f.converged for f in found]),
        n_iter=max(f.n_iter for f in found),
    )


def minimise_scale(problem: LinearProblem, search: ScaleSearch) -> ScaleMinimum:
    """Iterate a few steps from every start on some samples, then the best candidates on all until they converge."""
    size = problem.num_samples * problem.num_channels
    screened = min(size, search.screened * problem.num_channels) * (search.starts + 1)
    small = problem
    if problem.num_samples > search.screened:
        small = problem.select_samples(
            drawn_samples(search.seed, search.screened, problem.num_samples, problem.Y.device)
        )
    found = _in_parts(small, screened, lambda some, _: _screened(some, search))
    if small is not problem:
        found = replace(found, scale=None)
    for steps, left in search.narrowing:
        short = replace(search, final=search.screening, max_iter=min(steps, search.max_iter))
        found = _descended(problem, found, short).narrowed(left)
    # convergence judged by an approximate scale is not final
    found = replace(found, converged=torch.zeros_like(found.converged))
    return _scale_minimum(problem, _descended(problem, found, search), search)


def descend(problem: LinearProblem, beta: Float[Tensor, "B n"], search: ScaleSearch) -> ScaleMinimum:
    """Iterate from given coefficients until convergence."""
    alone = beta.unsqueeze(1)
    found = _Candidates(alone, None, torch.zeros(alone.shape[:2], dtype=torch.bool, device=beta.device))
    return _scale_minimum(problem, _descended(problem, found, search), search)


def _scale_minimum(problem: LinearProblem, found: _Candidates, search: ScaleSearch) -> ScaleMinimum:
    best = found.narrowed(1)
    scale, weight = search.final.weighted(problem, problem.residual(best.beta), best.scale)
    return ScaleMinimum(best.beta[:, 0], scale[:, 0], weight[:, 0], found.n_iter, best.converged[:, 0])


def _screened(problem: LinearProblem, search: ScaleSearch) -> _Candidates:
    """Screen the starts, in parts that stay in the cache for a large problem, and return the candidates."""
    beta = elemental_starts(problem, search.starts, search.seed)
    together = max(search.candidates, _CHUNK // (problem.num_samples * problem.num_channels))
    together = beta.shape[1] if side_by_side(beta) else together
    found = [_screened_part(problem, part, search) for part in beta.split(together, dim=1)]
    beta, scale = (torch.cat(parts, dim=1) for parts in zip(*found, strict=True))
    converged = torch.zeros(beta.shape[:2], dtype=torch.bool, device=beta.device)
    return _Candidates(beta, scale, converged).narrowed(search.candidates)


def _screened_part(problem: LinearProblem, beta: Float[Tensor, "B S n"], search: ScaleSearch) -> tuple[Tensor, Tensor]:
    """The best of some starts, and their scales."""
    near: Tensor | None = None
    if search.ranking is not None:
        beta, near = _best(problem, beta, None, search.ranking, max(search.candidates, beta.shape[1] // search.raw))
    # without ranking a step may lower the scale so much that the last scale is not a good guess
    keeps = near is not None
    if runs_kernel(problem):
        options, steps = search.screening.options(problem), search.screening_steps
        found = concentrate(problem, beta, options, near=near, max_iter=steps, keeps=keeps)
        return _smallest(found.beta, found.scale, search.candidates)
    for _ in range(search.screening_steps):
        beta, now = _step(problem, beta, search.screening, near)
        near = now if keeps else None
    return _best(problem, beta, near, search.screening, search.candidates)


def _descended(problem: LinearProblem, found: _Candidates, search: ScaleSearch) -> _Candidates:
    """Iterate every candidate that has not converged."""
    if runs_kernel(problem):
        end = concentrate(
            problem,
            found.beta,
            search.final.options(problem),
            near=found.scale,
            max_iter=search.max_iter,
            tolerance=_tolerance(found.beta, search),
        )
        return _Candidates(end.beta, end.scale, end.converged, found.n_iter + end.n_iter)
    values = problem.num_samples * problem.num_channels * found.beta.shape[1]
    return _in_parts(problem, values, lambda some, part: _descend(some, found.select(part), search))


def _tolerance(beta: Tensor, search: ScaleSearch) -> float:
    """Decrease of the log scale that is not rounding."""
    return max(search.tolerance, 1e2 * torch.finfo(beta.dtype).eps)


def _descend(problem: LinearProblem, found: _Candidates, search: ScaleSearch) -> _Candidates:
    """As :func:`_descended`, for a part; problems whose candidates have all converged leave it."""
    tolerance = _tolerance(found.beta, search)
    beta, near, moving = found.beta.clone(), found.scale, ~found.converged
    objective = torch.full(beta.shape[:2], math.inf, dtype=beta.dtype, device=beta.device)
    scale = beta.new_zeros(*beta.shape[:2], problem.num_channels) if near is None else near.clone()
    active = torch.arange(beta.shape[0], device=beta.device)
    going = torch.arange(beta.shape[1], device=beta.device)
    some, n_iter, every = problem, 0, steps_between_tests(beta)
    while n_iter < search.max_iter:
        if n_iter % every == 0:
            left = moving[active].any(1).nonzero().squeeze(-1)
            if 2 * len(left) <= len(active):
                active = active[left]
                if len(active) == 0:
                    break
                some = problem.select(active)
            if every == 1:
                going = moving[active].any(0).nonzero().squeeze(-1)
        # copies, not views: what is written below may be part of a derivative
        at = (active.unsqueeze(-1), going)
        n_iter += 1
        here = beta[at]
        known = scale[at] if near is not None or n_iter > 1 else None
        proposal, now = _step(some, here, search.final, known)
        before = log_product(now)
        falls = (objective[at] - before > tolerance) & moving[at]
        objective[at] = torch.minimum(objective[at], before)
        beta[at] = torch.where(falls.unsqueeze(-1), proposal, here)
        scale[at] = now
        moving[at] = falls
    if n_iter and bool(moving.any()):
        # the scale of the last step's coefficients
        scale = search.final.scale(problem, problem.residual(beta), scale)
    return _Candidates(beta, scale, ~moving, found.n_iter + n_iter)
