"""Random subsets of rows for the pilot of a large fit, with a check that they represent all rows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._blocks import triangle
from mkc_torch.linear._problem import CanonicalShapes, LinearProblem, RankDeficientError, linear_problem
from mkc_torch.linear._rows import Rows, blocks

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

_ROWS = 2000
"""Least number of rows of a pilot."""

_ROWS_A_COLUMN = 200
"""Least number of rows of a pilot per column: coefficients are then within a twentieth of the noise."""

_LEVERAGE = 0.05
"""Largest leverage of a row: beyond it, fewer than twenty rows share a direction. A pilot must do without such rows."""

_LEAST_SHARE = 1e-6
"""Least share of a direction that the rows without high leverage must hold."""


def drawn_rows(values: CanonicalShapes, count: int, seed: int) -> Int[Tensor, " k"]:
    """About ``count`` of the rows in use, drawn at random, each at most once, in their order."""
    used = _used(values)
    generator = torch.Generator().manual_seed(seed)
    among = None if used is None else used.nonzero().squeeze(-1)
    total = values.Y.shape[-2] if among is None else among.shape[0]
    drawn = torch.randint(total, (count,), generator=generator).unique()
    return drawn if among is None else among[drawn.to(among.device)].cpu()


def rows_at(values: CanonicalShapes, index: Int[Tensor, " k"]) -> CanonicalShapes:
    """The rows at ``index``, where they are and in their type."""
    weight, index = values.sample_weight, index.to(values.Y.device)
    return CanonicalShapes(
        values.X.index_select(-3, index),
        values.Y.index_select(-2, index),
        None if weight is None else weight.index_select(-2, index),
        values.batch,
        values.single_channel,
    )


def rows_of(values: CanonicalShapes) -> Rows:
    """The rows of a single problem."""
    X, Y, weight = values.X, values.Y, values.sample_weight
    weight = None if weight is None else weight.reshape(weight.shape[-2:])
    return Rows(X.reshape(X.shape[-3:]), Y.reshape(Y.shape[-2:]), weight)


def pilot_problem(values: CanonicalShapes, seed: int) -> tuple[LinearProblem, bool] | None:
    """A problem of few rows, and whether all rows had the same chance of being drawn; None where no draw suffices.

    Where uniformly drawn rows leave a direction to a few rows, as for a column that is seldom other than 0, rows are
    added in proportion to their leverage among all rows.
    """
    count = max(_ROWS, _ROWS_A_COLUMN * values.X.shape[-1])
    index = drawn_rows(values, count, seed)
    problem = _problem(values, index)
    if problem is not None:
        return problem, True
    more = _rows_of_leverage(values, count, seed)
    problem = None if more is None else _problem(values, torch.cat([index, more]).unique())
    return None if problem is None else (problem, False)


def _problem(values: CanonicalShapes, index: Int[Tensor, " k"]) -> LinearProblem | None:
    some = rows_at(values, index)
    weight = None if some.sample_weight is None else some.sample_weight.cpu().double()
    try:
        problem = linear_problem(some.X.cpu().double(), some.Y.cpu().double(), weight)
    except (RankDeficientError, ValueError):
        return None
    return problem if _determines_coefficients(problem) else None


def _used(values: CanonicalShapes) -> Bool[Tensor, " N"] | None:
    return None if values.sample_weight is None else (values.sample_weight > 0).any(-1).flatten()


def _determines_coefficients(problem: LinearProblem) -> bool:
    """Whether the rows determine every coefficient without the rows of highest leverage."""
    basis = problem.basis[0]
    if problem.sample_weight is not None:
        basis = basis * (problem.sample_weight[0] > 0).unsqueeze(-1)
    kept = basis.flatten(0, 1)
    kept = kept * (kept.square().sum(-1, keepdim=True) <= _LEVERAGE)
    return bool(torch.linalg.eigvalsh(torch.matmul(kept.mT, kept))[0] > _LEAST_SHARE)


def _rows_of_leverage(values: CanonicalShapes, count: int, seed: int) -> Int[Tensor, " k"] | None:
    """Rows drawn with probability proportional to their leverage; None where columns are linearly dependent."""
    rows = rows_of(values)
    upper: Tensor | None = None
    for block in blocks(rows.X, rows.Y, rows.weight):
        upper = triangle(block, upper)
    assert upper is not None
    inverse, info = torch.linalg.inv_ex(upper)
    if int(info) or not bool(torch.isfinite(inverse).all()):
        return None
    found = []
    for block in blocks(rows.X, rows.Y, rows.weight):
        of_values = torch.matmul(block.rows, inverse).square().sum(-1)
        found.append((of_values if block.weight is None else of_values * (block.weight > 0)).sum(-1))
    cumulated = torch.cat(found).cumsum(0).cpu()
    drawn = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=cumulated.dtype)
    return torch.searchsorted(cumulated, drawn * cumulated[-1]).clamp(max=rows.Y.shape[0] - 1)
