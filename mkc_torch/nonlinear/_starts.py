"""Many starts of one problem: where they lie, and which end is the likeliest."""

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

__all__ = ["Ends", "at_each", "drawn", "likeliest"]

AGREE = 0.01
"""Nats of all residuals by which two ends may differ and be the same minimum: a fit that has come to rest is nearer."""

_REACH = 1e-6
"""Share of a prior's distribution at each side that no start is drawn from, for infinity lies there."""


def drawn(problem: Problem, theta: Float[Tensor, "B p"], starts: int, seed: int) -> Float[Tensor, "B S p"]:
    """The start itself, and others evenly between the bounds, or over the prior where a bound is missing.

    Even means a scrambled Sobol sequence (Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995). A start
    at which the residual is not finite gives way to the given one.

    Raises:
        ValueError: a parameter has neither two bounds nor a prior.
    """
    p = theta.shape[-1]
    endless = theta.new_full((p,), math.inf)
    low, high = (-endless, endless) if problem.box is None else problem.box
    precision = theta.new_zeros(p) if problem.prior_precision is None else problem.prior_precision.diagonal()
    mean = theta.new_zeros(p) if problem.prior_mean is None else problem.prior_mean
    boxed, known = torch.isfinite(low) & torch.isfinite(high), precision > 0
    missing = (~(boxed | known)).nonzero().squeeze(-1).tolist()
    if missing:
        raise ValueError(
            f"Expected arguments `lower` and `upper`, or `prior`, for every parameter with `starts`={starts} but got "
            f"neither for the parameters {missing}; say where to draw starts, or leave `starts` out."
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

    fit_for_a_start = torch.stack([finite(found[:, i]) for i in range(starts)], 1)
    return torch.where(fit_for_a_start, found, theta.unsqueeze(1))


def at_each(problem: Problem, starts: Float[Tensor, "B S p"]) -> tuple[Problem, ProblemPoint]:
    """The problem once for each start, B S problems in all, and their starts."""
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
    """The likeliest end of each problem, (B,), and how many ended as likely."""

    best: Int[Tensor, " B"]
    agreeing: Int[Tensor, " B"]


def likeliest(
    problem: Problem,
    theta: Float[Tensor, "B S p"],
    residual: Float[Tensor, "B S N m"],
    bound: Float[Tensor, "B S m"],
    *,
    given: Float[Tensor, "B m"] | None,
    sigma: Float[Tensor, "B m"] | None,
    d: Float[Tensor, "B m"] | None,
) -> Ends:
    """Of ends whose residuals are judged on one domain: the given one, or that of the end of the smallest scale.

    Args:
        problem: of B problems.
        theta, residual, bound: of each end.
        given, sigma, d: what is not learned.
    """
    weight = None if problem.weight is None else problem.weight.unsqueeze(1).expand_as(residual)
    scale = robust_scale(residual, weight)
    tiny = torch.finfo(scale.dtype).tiny
    first = scale.clamp(min=tiny).log().sum(-1).argmin(-1)
    one = torch.arange(len(first), device=first.device)
    domain = bound[one, first] if given is None else given
    # what is not within reach of the domain is no candidate, and the reference stands in for it
    near = (2.0 * scale <= domain.unsqueeze(1)).all(-1)
    shape = residual.shape[:2]
    judged = torch.where(near[..., None, None], residual, residual[one, first].unsqueeze(1))
    if not bool(near[one, first].all()):
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
    most = total[one, best]
    rounding = 64.0 * torch.finfo(total.dtype).eps * most.abs()
    return Ends(best, (total >= (most - AGREE - rounding).unsqueeze(-1)).sum(-1))
