"""An orthonormal basis of the columns of X, and the test of their rank."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.side_by_side import side_by_side
from mkc_torch._support.small_factors import LARGEST, orthonormalising

if TYPE_CHECKING:
    from jaxtyping import Float


class RankDeficientError(ValueError):
    """The columns of X are linearly dependent, so that the coefficients are not determined."""


def orthonormalise(X: Tensor, weight: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return an orthonormal basis of the columns of X, and the matrix from its coefficients to those of X.

    Args:
        X: (*, N, m, n).
        weight: weights (*, N, m); the basis is orthonormal over the samples whose weight is positive.

    Raises:
        RankDeficientError: columns are linearly dependent on these samples.
    """
    rows = X.flatten(-3, -2)
    used = rows
    if weight is not None and rows.shape[0] == weight.shape[:-2].numel():
        used = rows * (weight > 0).reshape(rows.shape[0], -1, 1)
    scale = used.abs().amax(-2)
    scaled = used / torch.where(scale > 0, scale, 1.0).unsqueeze(-2)
    if not side_by_side(X) or X.shape[-1] > LARGEST:
        inverse = _inverse_triangle(scaled, scale)
    else:
        upper, inverse, well = orthonormalising(scaled)
        if not bool(well.all()):
            weak = (~well).nonzero().squeeze(-1)
            own = _inverse_triangle(scaled[weak].cpu(), scale[weak].cpu())
            inverse = inverse.index_copy(0, weak, own.to(inverse))
        # sums in float64 lose no rank with the number of rows
        _refuse_small_ratio(upper[well], inverse[well], min(rows.shape[-2], _MOST_ROWS) * torch.finfo(X.dtype).eps)
    to_coef = inverse / scale.unsqueeze(-1)
    basis = torch.matmul(rows.to(to_coef.dtype), to_coef).unflatten(-2, X.shape[-3:-1])
    return basis.to(X.dtype), to_coef.to(X.dtype)


_MOST_ROWS = 1000
"""Rows beyond which the tolerance of the rank does not grow, where sums are in float64."""

_MOST_ROWS_OF_QR = 8192
"""Rows beyond which the tolerance no longer grows in a QR: LAPACK adds up blocks of rows, whose errors nearly cancel.

At 1e7 rows of float32 the tolerance would exceed 1, and every matrix would count as dependent."""


def rank_tolerance(num_rows: int, columns: int, dtype: torch.dtype) -> float:
    """Ratio of singular values up to which columns count as dependent."""
    return max(min(num_rows, _MOST_ROWS_OF_QR), columns) * torch.finfo(dtype).eps


def _inverse_triangle(rows: Float[Tensor, "B K n"], scale: Float[Tensor, "B n"]) -> Float[Tensor, "B n n"]:
    """Inverse of the R of rows divided by ``scale``; refuses dependent columns."""
    upper = torch.linalg.qr(rows).R
    return refuse_dependent(upper, scale, rows.shape[-2])


def refuse_dependent(
    upper: Float[Tensor, "*batch k n"], scale: Float[Tensor, "*batch n"], num_rows: int
) -> Float[Tensor, "*batch n n"]:
    """Return the inverse of the R of the columns divided by ``scale``, which is 0 for a column of zeros.

    Raises:
        RankDeficientError: columns are dependent, or a column is 0.
    """
    if (scale == 0).any():
        column = int((scale == 0).nonzero()[0, -1])
        raise RankDeficientError(f"Column {column} of `X` is zero on every sample in use; remove it.")
    k, n = upper.shape[-2:]
    tolerance = rank_tolerance(num_rows, n, upper.dtype)
    # with fewer rows than columns there is no inverse
    inverse = torch.linalg.inv_ex(upper).inverse if k == n else upper.new_full((*upper.shape[:-2], n, n), torch.inf)
    _refuse_small_ratio(upper, inverse, tolerance)
    return inverse


_CONDITION = 1e3
"""Largest ratio of singular values of the scaled columns at which sums of their products keep ten digits.

Sums of products of the columns lose digits by its square, six of sixteen here."""


def nearly_dependent(upper: Float[Tensor, "k n"]) -> bool:
    """Whether products of the columns of this R would lose the digits that distinguish them.

    Columns such as a time in seconds and an intercept need a change of basis before sums are formed.
    """
    singular = torch.linalg.svdvals(upper / torch.linalg.vector_norm(upper, dim=0))
    return not bool(singular[0] <= _CONDITION * singular[upper.shape[-1] - 1])


def _refuse_small_ratio(upper: Tensor, inverse: Tensor, tolerance: float) -> None:
    """Refuse an R whose smallest singular value is at most ``tolerance`` times its largest."""
    # the product of the Frobenius norms is an upper bound of the condition number, and cheap
    bound = torch.linalg.vector_norm(upper.detach(), dim=(-2, -1)) * torch.linalg.vector_norm(
        inverse.detach(), dim=(-2, -1)
    )
    unclear = ~(bound * tolerance < 1.0)
    if not bool(unclear.any()):
        return
    n = upper.shape[-1]
    _, singular, right = torch.linalg.svd(upper.detach()[unclear].cpu())
    # with fewer rows than columns there are fewer singular values than columns
    ratio = singular[..., -1] / singular[..., 0] if singular.shape[-1] == n else singular.new_zeros(singular.shape[:-1])
    if (ratio <= tolerance).any():
        worst = right[..., -1, :].reshape(-1, n)[int(ratio.reshape(-1).argmin())]
        involved = [i for i in range(n) if float(worst[i].abs()) > 0.1 * float(worst.abs().max())]
        raise RankDeficientError(
            f"Expected `X` of full column rank but columns {involved} are linearly dependent "
            f"(singular value ratio {float(ratio.min()):.1e}); remove a column of these."
        )
