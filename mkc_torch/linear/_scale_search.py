"""Minimise a robust residual scale over the coefficients: concentration steps from many elemental starts in one batch.

Least trimmed squares and S-regression differ only in the scale. With several channels the product of the channels'
scales is minimised; a step with the weights of the scale over its square never increases it (Rousseeuw & Van
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


_CHUNK = 1 << 16
"""Residuals of one problem worked on at once, few enough to stay in a processor's cache."""

_BATCH = 1 << 18
"""Residuals of many problems worked on at once: so many that the calls themselves take little beside."""

SCREENED = 1500
"""Samples that starts are screened on."""


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
    return _fits_through(problem, _drawn(problem, count, generator))


def _drawn(problem: LinearProblem, count: int, generator: torch.Generator) -> Tensor:
    """The numbers of the values of each set, (count, n); where weights say which can be, random keys of all values."""
    values = problem.num_samples * problem.num_channels
    keys = torch.rand(count, values, generator=generator, dtype=torch.float64)
    if problem.sample_weight is None:
        keys = keys.topk(problem.num_coefficients, dim=-1).indices
    return keys.to(problem.Y.device)


def _fits_through(problem: LinearProblem, drawn: Tensor) -> Float[Tensor, "B count+1 n"]:
    n, B = problem.num_coefficients, problem.Y.shape[0]
    rows = problem.basis.flatten(-3, -2)
    y = problem.Y.flatten(-2)
    if problem.sample_weight is None:
        chosen, target = rows[:, drawn], y[:, drawn]
    else:
        used = (problem.sample_weight > 0).flatten(-2).unsqueeze(1)
        index = torch.where(used, drawn, -1.0).topk(n, dim=-1).indices
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
class ScaleSearch:
    """How the minimum is looked for.

    ``starts`` elemental sets, least squares being one more, make ``screening_steps`` steps each on ``screened`` samples
    at most; one in ``raw`` of them does where ``ranking`` orders them before. The best ``candidates`` go on: of each of
    ``narrowing`` so many steps, after which so many candidates are left. All that may be approximate. The last go on
    with the exact rule until a step lowers the log of the scale by less than ``tolerance``, or ``max_iter`` steps.
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


@dataclass(frozen=True)
class _Candidates:
    """Candidates with their scales, where these are known, and whether and when they came to rest."""

    beta: Float[Tensor, "B S n"]
    scale: Float[Tensor, "B S m"] | None
    rest: Float[Tensor, "B S"]
    n_iter: int = 0

    def of_starts(self, index: Tensor) -> _Candidates:
        scale = None if self.scale is None else _of_starts(self.scale, index)
        return replace(self, beta=_of_starts(self.beta, index), scale=scale, rest=self.rest.gather(1, index))

    def select(self, index: Tensor) -> _Candidates:
        scale = None if self.scale is None else self.scale[index]
        return replace(self, beta=self.beta[index], scale=scale, rest=self.rest[index])

    def narrowed(self, count: int) -> _Candidates:
        """The ``count`` candidates of the smallest scales."""
        if self.scale is None or count >= self.beta.shape[1]:
            return self
        return self.of_starts(_log_product(self.scale).topk(count, dim=1, largest=False).indices)


def _in_parts(problem: LinearProblem, values: int, work: Callable[[LinearProblem, Tensor], _Candidates]) -> _Candidates:
    """``work`` on so many problems at once that ``values`` of each stay in the cache."""
    every = torch.arange(problem.Y.shape[0], device=problem.Y.device)
    parts = every.split(max(1, _BATCH // values))
    if len(parts) == 1:
        return work(problem, every)
    found = [work(problem.select(part), part) for part in parts]
    scales = [f.scale for f in found if f.scale is not None]
    return _Candidates(
        beta=torch.cat([f.beta for f in found]),
        scale=torch.cat(scales) if scales else None,
        rest=torch.cat([f.rest for f in found]),
        n_iter=max(f.n_iter for f in found),
    )


def minimise_scale(problem: LinearProblem, search: ScaleSearch) -> ScaleMinimum:
    """A few steps from every start on some of the samples, then the best candidates to rest on all of them."""
    size = problem.num_samples * problem.num_channels
    screened = min(size, search.screened * problem.num_channels) * (search.starts + 1)
    generator = torch.Generator().manual_seed(search.seed)
    some_samples: Tensor | None = None
    if problem.num_samples > search.screened:
        keep = torch.randperm(problem.num_samples, generator=generator)[: search.screened].sort().values
        some_samples = keep.to(problem.Y.device)
    small = problem if some_samples is None else problem.select_samples(some_samples)
    drawn = _drawn(small, search.starts, generator)
    found = _in_parts(small, screened, lambda some, _: _screened(some, drawn, search))
    if some_samples is not None:
        found = replace(found, scale=None)
    for steps, left in search.narrowing:
        short = replace(search, final=search.screening, max_iter=min(steps, search.max_iter))
        found = _descended(problem, found, short).narrowed(left)
    # what an approximate scale says of rest is not the last word
    found = replace(found, rest=torch.zeros_like(found.rest))
    return _ended(problem, _descended(problem, found, search), search)


def descend(problem: LinearProblem, beta: Float[Tensor, "B n"], search: ScaleSearch) -> ScaleMinimum:
    """Steps from coefficients to rest."""
    alone = beta.unsqueeze(1)
    found = _Candidates(alone, None, torch.zeros(alone.shape[:2], dtype=torch.bool, device=beta.device))
    return _ended(problem, _descended(problem, found, search), search)


def _ended(problem: LinearProblem, found: _Candidates, search: ScaleSearch) -> ScaleMinimum:
    best = found.narrowed(1)
    scale, weight = search.final.weighed(problem, problem.residual(best.beta), best.scale)
    return ScaleMinimum(best.beta[:, 0], scale[:, 0], weight[:, 0], found.n_iter, best.rest[:, 0])


def _screened(problem: LinearProblem, drawn: Tensor, search: ScaleSearch) -> _Candidates:
    """The candidates; the starts of a large problem are worked on so many at once that they stay in the cache."""
    beta = _fits_through(problem, drawn)
    at_once = max(search.candidates, _CHUNK // (problem.num_samples * problem.num_channels))
    found = [_screened_part(problem, part, search) for part in beta.split(at_once, dim=1)]
    beta, scale = (torch.cat(parts, dim=1) for parts in zip(*found, strict=True))
    rest = torch.zeros(beta.shape[:2], dtype=torch.bool, device=beta.device)
    return _Candidates(beta, scale, rest).narrowed(search.candidates)


def _screened_part(problem: LinearProblem, beta: Float[Tensor, "B S n"], search: ScaleSearch) -> tuple[Tensor, Tensor]:
    """The best of some starts, and their scales."""
    near: Tensor | None = None
    if search.ranking is not None:
        beta, near = _best(problem, beta, None, search.ranking, max(search.candidates, beta.shape[1] // search.raw))
    for _ in range(search.screening_steps):
        beta, now = _step(problem, beta, search.screening, near)
        # fits that were not ranked fall too far for a scale to be near to the last
        near = None if near is None else now
    return _best(problem, beta, near, search.screening, search.candidates)


def _descended(problem: LinearProblem, found: _Candidates, search: ScaleSearch) -> _Candidates:
    """Steps from every candidate that is not at rest."""
    values = problem.num_samples * problem.num_channels * found.beta.shape[1]
    return _in_parts(problem, values, lambda some, part: _descend(some, found.select(part), search))


def _descend(problem: LinearProblem, found: _Candidates, search: ScaleSearch) -> _Candidates:
    """As :func:`_descended`, of one part; problems whose candidates are all at rest leave it."""
    tolerance = max(search.tolerance, 1e2 * torch.finfo(found.beta.dtype).eps)
    beta, near, moving = found.beta.clone(), found.scale, ~found.rest
    objective = torch.full(beta.shape[:2], math.inf, dtype=beta.dtype, device=beta.device)
    scale = beta.new_zeros(*beta.shape[:2], problem.num_channels) if near is None else near.clone()
    active = torch.arange(beta.shape[0], device=beta.device)
    some, n_iter = problem, 0
    while n_iter < search.max_iter:
        awake = moving[active]
        left = awake.any(1)
        if 2 * int(left.sum()) <= active.shape[0]:
            active, awake = active[left], awake[left]
            if active.numel() == 0:
                break
            some = problem.select(active)
        going = awake.any(0).nonzero().squeeze(-1)
        # copies, not views: what is written below may be part of a derivative
        at = (active.unsqueeze(-1), going)
        n_iter += 1
        here = beta[at]
        known = scale[at] if near is not None or n_iter > 1 else None
        proposal, now = _step(some, here, search.final, known)
        before = _log_product(now)
        falls = (objective[at] - before > tolerance) & awake[:, going]
        objective[at] = torch.minimum(objective[at], before)
        beta[at] = torch.where(falls.unsqueeze(-1), proposal, here)
        scale[at] = now
        moving[at] = falls
    if n_iter and bool(moving.any()):
        # of the last step's coefficients
        scale = search.final.scale(problem, problem.residual(beta), scale)
    return _Candidates(beta, scale, ~moving, found.n_iter + n_iter)
