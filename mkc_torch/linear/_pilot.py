"""The pilot of a large fit: MKC-EM on rows drawn by chance, and whether they can stand for all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._maximum import HalfWidth, Known, Maximum, maximise
from mkc_torch.linear._mkc import kernel_weight
from mkc_torch.linear._problem import CanonicalShapes, LinearProblem, RankDeficientError, linear_problem

if TYPE_CHECKING:
    from jaxtyping import Bool, Float64, Int

ROWS = 8000
"""Rows of a pilot: coefficients within a few hundredths of the noise, curvature within a tenth, in 30 ms."""

_LEVERAGE = 0.05
"""A row of more pins a direction that fewer than twenty others share; the pilot has to do without such rows."""

_TOLERANCE = 1e-6
"""Of the pilot's alternation in nats per sample: it ends nearer to its maximum than that is to the one of all rows."""


@dataclass(frozen=True)
class Pilot:
    """Where the pilot ended, in the basis of its problem, with sums per unit of weight of what a step goes by."""

    problem: LinearProblem
    maximum: Maximum
    curvature: Float64[Tensor, "n n"]
    majoriser: Float64[Tensor, "n n"]
    grams: Float64[Tensor, "m n n"]


def drawn_rows(
    count: int, total: int, used: Bool[Tensor, " N"] | None, seed: int, device: torch.device
) -> Int[Tensor, " k"]:
    """About ``count`` of the rows in use, each at most once and in their order."""
    generator = torch.Generator().manual_seed(seed)
    among = None if used is None else used.nonzero().squeeze(-1)
    drawn = torch.randint(total if among is None else among.shape[0], (count,), generator=generator).unique().to(device)
    return drawn if among is None else among[drawn]


def pilot_problem(values: CanonicalShapes, seed: int) -> LinearProblem | None:
    """The problem of the pilot's rows in float64; None where they cannot stand for all."""
    weight = values.sample_weight
    used = None if weight is None else (weight > 0).any(-1).flatten()
    index = drawn_rows(ROWS, values.Y.shape[-2], used, seed, values.Y.device)
    try:
        problem = linear_problem(
            values.X[..., index, :, :].double(),
            values.Y[..., index, :].double(),
            None if weight is None else weight[..., index, :].double(),
        )
    except (RankDeficientError, ValueError):
        return None
    return problem if _spans(problem) else None


def _spans(problem: LinearProblem) -> bool:
    """Whether the rows determine every coefficient without the few of most leverage."""
    basis = problem.basis[0]
    if problem.sample_weight is not None:
        basis = basis * (problem.sample_weight[0] > 0).unsqueeze(-1)
    ordinary = basis.square().sum(-1) <= _LEVERAGE
    kept = (basis * ordinary.unsqueeze(-1)).flatten(0, 1)
    least = torch.linalg.eigvalsh(torch.matmul(kept.mT, kept))[0]
    return bool(least > 1e-6)


def pilot_fit(problem: LinearProblem, known: Known, *, max_iter: int, seed: int, half_width: HalfWidth) -> Pilot | None:
    """MKC-EM on the pilot's rows and the domain of all; None without rest, or where it fits most of them exactly."""
    begin, maximum = maximise(problem, known, max_iter=max_iter, tol=_TOLERANCE, seed=seed, half_width=half_width)
    state = maximum.state
    pinned = state.free_d & (state.log_d <= state.log_d_min)
    if bool(begin.exact.any()) or not bool(maximum.converged.all()) or bool(pinned.any()):
        return None
    d, kappa = torch.exp(state.log_d), state.kappa
    error = problem.residual(maximum.beta)
    precision = d.pow(-2).unsqueeze(-2)
    w = kernel_weight(error, kappa, d) * precision
    total = problem.total_weight().sum()
    bend = w * (1.0 - kappa.unsqueeze(-2) * error.square() * precision)
    channels = torch.eye(problem.num_channels, dtype=w.dtype, device=w.device).unsqueeze(-2).expand(-1, *w.shape[1:])
    curvature, majoriser = (problem.normal_equations(v)[0][0] / total for v in (bend, w))
    grams = problem.normal_equations(channels.unsqueeze(0))[0][0] / total
    return Pilot(problem, maximum, curvature, majoriser, grams)
