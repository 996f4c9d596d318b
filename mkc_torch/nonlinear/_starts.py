"""Several starts of one problem: how they are drawn, and which result is the most likely."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.fit import fit_density
from mkc_torch.nonlinear._problem import Problem, ProblemPoint
from mkc_torch.nonlinear._quadratic import prior_value

if TYPE_CHECKING:
    from jaxtyping import Float, Int

AGREE = 0.01
"""Difference of log-likelihoods of all residuals, in nats, up to which two results count as the same minimum."""

_REACH = 1e-6
"""Share of a prior's distribution at each end from which no start is drawn, since it extends to infinity."""


def draw_starts(problem: Problem, theta: Float[Tensor, "B p"], starts: int, seed: int) -> Float[Tensor, "B S p"]:
    """Draw starts uniformly between the bounds, or from the prior where a bound is missing; the first is ``theta``.

    They follow a scrambled Sobol sequence (Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995). A start
    at which the residual is not finite is replaced by ``theta``.

    Raises:
        ValueError: a parameter has neither two bounds nor a prior.
    """
    p = theta.shape[-1]
    infinite = theta.new_full((p,), math.inf)
    low, high = (-infinite, infinite) if problem.box is None else problem.box
    precision = theta.new_zeros(p) if problem.prior_precision is None else problem.prior_precision.diagonal()
    mean = theta.new_zeros(p) if problem.prior_mean is None else problem.prior_mean
    boxed, known = torch.isfinite(low) & torch.isfinite(high), precision > 0
    missing = (~(boxed | known)).nonzero().squeeze(-1).tolist()
    if missing:
        raise ValueError(
            f"Expected arguments `lower` and `upper`, or `prior`, for every parameter with `starts`={starts} but got "
            f"neither for the parameters {missing}; pass them, or leave `starts` out."
        )
    engine = torch.quasirandom.SobolEngine(p, scramble=True, seed=seed)
    even = engine.draw(starts - 1, dtype=torch.float64).to(theta)
    between = torch.where(boxed, low, 0.0) + even * torch.where(boxed, high - low, 0.0)
    spread = torch.where(known, precision, 1.0).rsqrt()
    normal = mean + spread * torch.special.ndtri(even.clamp(_REACH, 1.0 - _REACH))
    others = torch.minimum(torch.maximum(torch.where(boxed, between, normal), low), high)
    found = torch.cat([theta.unsqueeze(1), others.expand(len(theta), -1, -1)], 1)

    def finite(at: Tensor) -> Tensor:
        residual = problem.residual(at)
        seen = torch.cat([residual.flatten(1), problem.tangents(at, residual.numel()).flatten(1)], -1)
        return torch.isfinite(seen).all(-1, keepdim=True)

    usable = torch.stack([finite(found[:, i]) for i in range(starts)], 1)
    return torch.where(usable, found, theta.unsqueeze(1))


def repeat_problem(problem: Problem, starts: Float[Tensor, "B S p"]) -> tuple[Problem, ProblemPoint]:
    """Repeat the problem for each start: B S problems and their starting points."""
    count = starts.shape[1]

    def repeated(value: Tensor) -> Tensor:
        return value.repeat_interleave(count, 0)

    many = replace(
        problem,
        data=None if problem.data is None else tree_map(repeated, problem.data),
        weight=None if problem.weight is None else repeated(problem.weight),
        used=None if problem.used is None else repeated(problem.used),
        batch=torch.Size((len(starts) * count,)),
    )
    return many, many.at(starts.flatten(0, 1))


class Ends(NamedTuple):
    """Index of the most likely result of each problem, (B,), and the number of results that are as likely."""

    best: Int[Tensor, " B"]
    agreeing: Int[Tensor, " B"]


def most_likely(
    problem: Problem,
    theta: Float[Tensor, "B S p"],
    residual: Float[Tensor, "B S N m"],
    bound: Float[Tensor, "B S m"],
    *,
    given: Float[Tensor, "B m"] | None,
    sigma: Float[Tensor, "B m"] | None,
    d: Float[Tensor, "B m"] | None,
) -> Ends:
    """Find the most likely result, with all residuals judged on one domain.

    The domain is ``given``, or that of the result with the smallest scale.

    Args:
        problem: B problems.
        theta, residual, bound: of each result.
        given, sigma, d: fixed domain, bandwidths and scales, or None if learned.
    """
    weight = None if problem.weight is None else problem.weight.unsqueeze(1).expand_as(residual)
    scale = robust_scale(residual, weight)
    tiny = torch.finfo(scale.dtype).tiny
    first = scale.clamp(min=tiny).log().sum(-1).argmin(-1)
    rows = torch.arange(len(first), device=first.device)
    domain = bound[rows, first] if given is None else given
    # a result outside the domain is replaced by the reference result
    near = (2.0 * scale <= domain.unsqueeze(1)).all(-1)
    shape = residual.shape[:2]
    judged = torch.where(near[..., None, None], residual, residual[rows, first].unsqueeze(1))
    if not bool(near[rows, first].all()):
        return Ends(first, torch.ones_like(first))

    def each(value: Tensor | None) -> Tensor | None:
        return None if value is None else value.unsqueeze(1).expand(*shape, value.shape[-1])

    density = fit_density(judged, sigma=each(sigma), d=each(d), bound=each(domain), weight=weight)
    count = residual.new_full(residual.shape[:1] + residual.shape[-1:], residual.shape[-2])
    count = count if problem.weight is None else problem.weight.sum(-2)
    total = (density.log_likelihood * count.unsqueeze(1)).sum(-1)
    flat = theta.flatten(0, 1)
    total = total - prior_value(problem, flat).reshape(shape)
    total = torch.where(near, total, -torch.inf)
    best = total.argmax(-1)
    most = total[rows, best]
    rounding = 64.0 * torch.finfo(total.dtype).eps * most.abs()
    return Ends(best, (total >= (most - AGREE - rounding).unsqueeze(-1)).sum(-1))
