"""Chebyshev (minimax) regression: minimise the largest absolute residual by exchanging n + 1 extreme rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.independent_rows import independent_rows, taken
from mkc_torch._support.side_by_side import side_by_side, steps_between_tests
from mkc_torch._support.small_factors import null_vector, solve

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_STALLED = 10
"""Exchanges without growth of the height after which Bland's rule applies."""


@dataclass(frozen=True)
class Minimax:
    """Coefficients, largest absolute residual of the rows in use, and whether it is optimal."""

    beta: Float[Tensor, "P n"]
    height: Float[Tensor, " P"]
    converged: Tensor


def equal_heights(rows: Float[Tensor, "*batch k n"], target: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch n"]:
    """Chebyshev fit of k = n + 1 rows: all residuals have equal size. Not finite where the rows are dependent."""
    n = rows.shape[-1]
    if side_by_side(rows):
        sign = torch.where(null_vector(rows) < 0, -1.0, 1.0).to(rows.dtype).unsqueeze(-1)
        matrix = torch.cat([rows.expand(*target.shape, n), sign.expand(*target.shape, 1)], -1)
        return solve(matrix, target.unsqueeze(-1))[..., :n, 0]
    q, upper = torch.linalg.qr(rows, mode="complete")
    normal = q[..., n]
    height = (normal * target).sum(-1, keepdim=True) / normal.abs().sum(-1, keepdim=True)
    fitted = target - height * torch.where(normal < 0, -1.0, 1.0)
    moment = torch.matmul(q[..., :n].mT, fitted.unsqueeze(-1))
    solution: Tensor = torch.linalg.solve_triangular(upper[..., :n, :], moment, upper=True).squeeze(-1)
    return solution


def minimax(
    rows: Float[Tensor, "#P R n"],
    target: Float[Tensor, "P R"],
    used: Bool[Tensor, "P R"],
    guess: Float[Tensor, "P n"],
    *,
    max_iter: int = 1000,
) -> Minimax:
    """Minimise the largest ``|target - rows beta|`` over the rows in use, of full rank and more than n, in float64.

    The simplex method on the dual. A vertex is n + 1 rows with the signs of their residuals. The row of the largest
    residual enters, and the ratio test chooses the row that leaves. After some exchanges without growth of the height
    the rows are taken in order (Bland's rule), which cannot cycle. The largest residuals of ``guess`` choose the first.

    References:
        Stiefel, "Note on Jordan elimination, linear programming and Tchebycheff approximation", Numerische Mathematik 2
        (1960) 1-17.
    """
    P, R = target.shape
    n = rows.shape[-1]
    rows, target, guess = rows.double(), target.double(), guess.double()
    # residuals of the guess, so that a large offset costs no digits
    centred = target - torch.matmul(rows, guess.unsqueeze(-1)).squeeze(-1)
    everywhere = rows.expand(P, -1, -1)
    basis = _first_rows(everywhere, centred, used)
    eps = torch.finfo(torch.float64).eps
    floor = 64 * eps * (target.abs() * used).amax(-1)
    normal = null_vector(taken(everywhere, basis))
    sign = torch.where(normal < 0, -1.0, 1.0).to(target)
    negative = (normal * centred.gather(1, basis)).sum(-1, keepdim=True) < 0
    sign = torch.where(negative, -sign, sign)

    beta = torch.zeros_like(guess)
    height = target.new_zeros(P)
    best = target.new_full((P,), -1.0)
    stalled = torch.zeros(P, dtype=torch.long, device=target.device)
    moving = torch.ones(P, dtype=torch.bool, device=target.device)
    last = torch.zeros(n + 1, dtype=target.dtype, device=target.device)
    last[-1] = 1.0
    every = steps_between_tests(target)
    for step in range(max_iter + 1):
        if step % every == 0:
            at = moving.nonzero().squeeze(-1)
            if len(at) == 0:
                break
        matrix = torch.cat([everywhere[at.unsqueeze(-1), basis[at]], sign[at].unsqueeze(-1)], -1)
        solution = solve(matrix, centred[at].gather(1, basis[at]).unsqueeze(-1)).squeeze(-1)
        beta[at], height[at] = solution[:, :n], solution[:, n]
        residual = centred[at] - torch.matmul(everywhere[at], beta[at].unsqueeze(-1)).squeeze(-1)
        over = torch.where(used[at], residual.abs(), 0.0) - height[at].unsqueeze(-1)
        beyond = over > torch.maximum(1e-12 * height[at], floor[at]).unsqueeze(-1)
        left = moving[at] & beyond.any(-1)
        moving[at] = left
        if step == max_iter:
            break
        if every == 1:
            at, matrix, residual, over, beyond = at[left], matrix[left], residual[left], over[left], beyond[left]
            left = left[left]
        grown = height[at] > best[at] + floor[at]
        stalled[at] = torch.where(grown, 0, stalled[at] + 1)
        best[at] = torch.maximum(best[at], height[at])
        patient = stalled[at] <= _STALLED
        enter = torch.where(patient, over.argmax(-1), beyond.to(torch.uint8).argmax(-1)).unsqueeze(-1)
        enter_sign = torch.where(residual.gather(1, enter) < 0, -1.0, 1.0).to(target)
        column = torch.cat([everywhere[at, enter.squeeze(-1)], enter_sign], -1)
        both = torch.stack([column, last.expand_as(column)], -1)
        share, dual = solve(matrix.mT, both).unbind(-1)
        falls = share * enter_sign * sign[at]
        ratio = torch.where(falls > 1e-12, (dual * sign[at]).clamp(min=0.0) / falls, torch.inf)
        ties = ratio <= ratio.amin(-1, keepdim=True) * (1 + 1e-12)
        leave = torch.where(ties, basis[at], R).argmin(-1, keepdim=True)
        stays = ~left.unsqueeze(-1)
        basis[at] = torch.where(stays, basis[at], basis[at].scatter(1, leave, enter))
        sign[at] = torch.where(stays, sign[at], sign[at].scatter(1, leave, enter_sign))
    return Minimax(beta + guess, height, ~moving)


def _first_rows(
    rows: Float[Tensor, "P R n"], residual: Float[Tensor, "P R"], used: Bool[Tensor, "P R"]
) -> Int[Tensor, "P n+1"]:
    """n linearly independent rows, preferably with large residuals, and of the others that with the largest."""
    size = residual.abs() + 1e-3 * (residual.abs() * used).amax(-1, keepdim=True)
    size = torch.where(used, size.clamp(min=torch.finfo(size.dtype).tiny ** 0.5), 0.0)
    chosen = independent_rows(rows, size, used, 1e-8)
    rest = size.scatter(1, chosen, -1.0)
    return torch.cat([chosen, rest.argmax(-1, keepdim=True)], -1)
