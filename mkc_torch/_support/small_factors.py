"""Factorisations of many small matrices: by LAPACK on a CPU, elsewhere in elementwise operations on all matrices.

Batched QR, SVD and eigenvalues of cuSOLVER fail for 100,000 matrices or take them one after the other. The functions
here take the same number of operations for any number of matrices and read no value, except where that is stated. They
are meant for up to :data:`LARGEST` columns; larger matrices go to torch.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.side_by_side import side_by_side
from mkc_torch._support.torch_internals import forward_mode_is_active, is_wrapped

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

LARGEST = 32
"""Most columns of a matrix that is factorised in elementwise operations."""

_SAFE_PIVOT = 1e-10
"""Least pivot of a Gram matrix of unit diagonal that counts as well conditioned.

The columns then have a condition number of at most about 1e5 √n. The basis after the first factor is orthonormal to
n · eps / 1e-10 = 2e-6 n, and after the second to rounding.
"""


def _small(matrix: Tensor) -> bool:
    return side_by_side(matrix) and matrix.shape[-1] <= LARGEST


def _double(matrix: Tensor) -> Tensor:
    """In float64, where the device has it."""
    return matrix if matrix.device.type == "mps" else matrix.double()


def _columns(stack: Float[Tensor, "*batch k n"], least: float) -> list[Float[Tensor, "*batch rest"]]:
    """Columns of ``[L; E L⁻ᵀ]``, from the diagonal down, for a stack ``[L Lᵀ; E]`` of k >= n rows.

    A column whose pivot is at most ``least`` times its diagonal element depends on those before it: it becomes 0.
    """
    n = stack.shape[-1]
    limit = least * stack.detach().diagonal(dim1=-2, dim2=-1)
    found = []
    for j in range(n):
        pivot = stack[..., 0, 0]
        kept = pivot > limit[..., j].clamp(min=0.0)
        inverse_root = torch.where(kept, torch.where(kept, pivot, 1.0).rsqrt(), 0.0)
        column = stack[..., :, 0] * inverse_root.unsqueeze(-1)
        found.append(column)
        stack = stack[..., 1:, 1:] - column[..., 1:, None] * column[..., None, 1 : n - j]
    return found


def _with_identity(gram: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch 2n n"]:
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    return torch.cat([gram, eye.expand_as(gram)], -2)


def inverse_factor(gram: Float[Tensor, "*batch n n"]) -> tuple[Float[Tensor, "*batch n n"], Float[Tensor, "*batch n"]]:
    """Upper triangular T with ``T Tᵀ = gram⁻¹``, and the pivots; columns of pivots that are not positive are 0."""
    n = gram.shape[-1]
    columns = _columns(_with_identity(gram), 0.0)
    factor = torch.stack([column[..., n - j :] for j, column in enumerate(columns)], -1)
    return factor, torch.stack([column[..., 0] for column in columns], -1).square()


def definite_inverse(matrix: Float[Tensor, "*batch n n"]) -> tuple[Float[Tensor, "*batch n n"], Bool[Tensor, "*batch"]]:
    """Inverse of symmetric matrices of about unit diagonal, and whether they are safely positive definite.

    Others get the identity.
    """
    least = 1e2 * matrix.shape[-1] * torch.finfo(matrix.dtype).eps
    if _small(matrix):
        factor, pivots = inverse_factor(matrix)
        strict = pivots.amin(-1) > least
        inverse = torch.matmul(factor, factor.mT)
    else:
        factor, info = torch.linalg.cholesky_ex(matrix)
        strict = (info == 0) & (factor.diagonal(dim1=-2, dim2=-1).square().amin(-1) > least)
        eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        inverse = torch.cholesky_inverse(torch.where(strict[..., None, None], factor, eye))
    eye = torch.eye(inverse.shape[-1], dtype=inverse.dtype, device=inverse.device)
    return torch.where(strict[..., None, None], inverse, eye), strict


def orthonormalising(
    rows: Float[Tensor, "B K n"],
) -> tuple[Float[Tensor, "B n n"], Float[Tensor, "B n n"], Bool[Tensor, " B"]]:
    """R and its inverse, with ``rows R⁻¹`` orthonormal, and whether the columns are well conditioned.

    The columns should be of about unit size. R is the product of the Cholesky factors of the Gram matrices of the rows
    and of the first result, in float64 whatever the dtype of the rows. Where the third result is true, R has a relative
    error of a few n · eps of float64.
    """
    rows = _double(rows)
    n = rows.shape[-1]
    gram = torch.matmul(rows.mT, rows)
    size = gram.diagonal(dim1=-2, dim2=-1)
    unit = torch.where(size > 0, size, 1.0).rsqrt()
    first = _columns(_with_identity(unit.unsqueeze(-1) * gram * unit.unsqueeze(-2)), n * torch.finfo(rows.dtype).eps)
    well = torch.stack([column.detach()[..., 0] for column in first], -1).square().amin(-1) > _SAFE_PIVOT
    inverse = unit.unsqueeze(-1) * torch.stack([column[..., n - j :] for j, column in enumerate(first)], -1)
    basis = torch.matmul(rows, inverse)
    second = _columns(_with_identity(torch.matmul(basis.mT, basis)), 0.0)
    correction = torch.stack([column[..., n - j :] for j, column in enumerate(second)], -1)
    upper = torch.matmul(_lower(second, n).mT, _lower(first, n).mT / unit.unsqueeze(-2))
    return upper, torch.matmul(inverse, correction), well


def _lower(columns: list[Tensor], n: int) -> Float[Tensor, "*batch n n"]:
    return torch.stack([torch.nn.functional.pad(c[..., : n - j], (j, 0)) for j, c in enumerate(columns)], -1)


def solve_gram(gram: Float[Tensor, "*batch n n"], moment: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """Solve positive semi-definite systems by Cholesky, also where weights removed a direction.

    On a CPU such a system is then solved by the pseudo-inverse. Elsewhere the coefficients of dependent columns are 0.
    """
    n, eps = gram.shape[-1], torch.finfo(gram.dtype).eps
    if _small(gram):
        columns = _columns(torch.cat([gram, moment.unsqueeze(-2)], -2), n * eps)
        # L Lᵀ x = moment: the last entries of the columns are L⁻¹ moment
        found: list[Tensor] = []
        for j in reversed(range(n)):
            column = columns[j]
            left = column[..., -1]
            for k, value in enumerate(reversed(found), 1):
                left = left - column[..., k] * value
            pivot = column[..., 0]
            found.append(torch.where(pivot > 0, left / torch.where(pivot > 0, pivot, 1.0), 0.0))
        return torch.stack(found[::-1], -1)
    if n == 2 and not (gram.requires_grad or moment.requires_grad):
        solution, least, most = _solve_two(gram, moment)
    else:
        factor, info = torch.linalg.cholesky_ex(gram)
        solution = torch.cholesky_solve(moment.unsqueeze(-1), factor).squeeze(-1)
        pivots = factor.diagonal(dim1=-2, dim2=-1)
        least, most = torch.where(info > 0, 0.0, pivots.amin(-1)), pivots.amax(-1)
    # a matrix without a factor has a pivot of 0 or NaN here
    weak = ~(least > (n * eps) ** 0.5 * most)
    if weak.any():
        inverse = torch.linalg.pinv(gram[weak], hermitian=True, rtol=n * eps)
        repaired = torch.matmul(inverse, moment[weak].unsqueeze(-1)).squeeze(-1)
        solution = solution.masked_scatter(weak.unsqueeze(-1), repaired)
    return solution


def _solve_two(gram: Float[Tensor, "*batch 2 2"], moment: Float[Tensor, "*batch 2"]) -> tuple[Tensor, Tensor, Tensor]:
    """Cholesky solution of many 2 × 2 systems at once, with the smaller and the larger pivot."""
    first = gram[..., 0, 0].sqrt()
    below = gram[..., 0, 1] / first
    second = (gram[..., 1, 1] - below * below).sqrt()
    x, y = moment.unbind(-1)
    x = x / first
    y = (y - below * x) / (second * second)
    x = (x - below * y) / first
    return torch.stack([x, y], -1), torch.minimum(first, second), torch.maximum(first, second)


def solve(matrix: Float[Tensor, "*#batch n n"], right: Float[Tensor, "*#batch n k"]) -> Float[Tensor, "*batch n k"]:
    """Solve general systems by elimination with row pivots; not finite where a matrix is singular."""
    if not _small(matrix):
        solution: Tensor = torch.linalg.solve_ex(matrix, right)[0]
        return solution
    n = matrix.shape[-1]
    lead = matrix.shape[:-2] if matrix.shape[:-2].numel() > right.shape[:-2].numel() else right.shape[:-2]
    rows = torch.cat([matrix.expand(*lead, n, n), right.expand(*lead, *right.shape[-2:])], -1)
    numbers = torch.arange(n, device=rows.device)
    open_rows = torch.ones(rows.shape[:-1], dtype=torch.bool, device=rows.device)
    order = []
    for _ in range(n):
        column, rows = rows[..., 0], rows[..., 1:]
        pivot = torch.where(open_rows, column.detach().abs(), -1.0).argmax(-1, keepdim=True)
        order.append(pivot)
        here = numbers == pivot
        open_rows = open_rows & ~here
        value = column.gather(-1, pivot)
        row = rows.gather(-2, pivot.unsqueeze(-1).expand(*lead, 1, rows.shape[-1]))
        # the pivot's row is divided by the pivot, and eliminates the column from all other rows
        rows = rows - ((column - here.to(column.dtype)) / value).unsqueeze(-1) * row
    index = torch.cat(order, -1).unsqueeze(-1)
    return rows.gather(-2, index.expand(*lead, n, rows.shape[-1]))


def null_vector(rows: Float[Tensor, "*batch k n"]) -> Float[Tensor, "*batch k"]:
    """The unit vector orthogonal to the columns of k = n + 1 rows of rank n."""
    if not _small(rows):
        q = torch.linalg.qr(rows, mode="complete").Q
        return q[..., -1]
    basis = orthonormal_columns(rows)
    # the coordinate axis that is least in the span of the columns
    axis = basis.square().sum(-1).nan_to_num(0.0).argmin(-1, keepdim=True)
    unit = torch.zeros_like(rows[..., 0]).scatter(-1, axis, 1.0)
    return _orthogonal_to(basis, unit.unsqueeze(-1)).squeeze(-1)


def orthonormal_columns(columns: Float[Tensor, "*batch k n"]) -> Float[Tensor, "*batch k n"]:
    """The result of the Gram-Schmidt process on independent columns."""
    if not _small(columns):
        basis, upper = torch.linalg.qr(columns)
        sign = torch.where(upper.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0).to(columns.dtype)
        return basis * sign.unsqueeze(-2)
    basis = columns[..., :0]
    for j in range(columns.shape[-1]):
        basis = torch.cat([basis, _orthogonal_to(basis, columns[..., j : j + 1])], -1)
    return basis


def _orthogonal_to(basis: Float[Tensor, "*batch k j"], vector: Float[Tensor, "*batch k 1"]) -> Tensor:
    """The unit vector in the direction of ``vector`` without its part in the span of an orthonormal basis."""
    for _ in range(2):  # twice is enough
        vector = vector - torch.matmul(basis, torch.matmul(basis.mT, vector))
        vector = vector / torch.linalg.vector_norm(vector, dim=-2, keepdim=True)
    return vector


def symmetric_eigen(
    matrix: Float[Tensor, "*batch n n"],
) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n n"]]:
    """Eigenvalues in ascending order and eigenvectors as columns.

    Off the CPU by Jacobi's rotations; eigenvalues have an absolute error of a few eps times the largest, as LAPACK's.
    Derivatives of first and second order are right where eigenvalues differ.
    """
    if not _small(matrix):
        values, vectors = torch.linalg.eigh(matrix)
        return values, vectors
    a = _double(matrix.detach())
    size = a.abs().amax((-2, -1), keepdim=True)
    a = a / torch.where(size > 0, size, 1.0)
    # with this shift no eigenvalue is negative, and the lengths of the columns A V are in the order of eigenvalues
    shift = a.abs().sum(-1).amax(-1)[..., None, None]
    eye = torch.eye(a.shape[-1], dtype=a.dtype, device=a.device)
    vectors = _rotated(a + shift * eye)
    values = (vectors * torch.matmul(a, vectors)).sum(-2)
    values, order = values.sort(-1)
    vectors = vectors.gather(-1, order.unsqueeze(-2).expand_as(vectors))
    values, vectors = (values * size.squeeze(-1)).to(matrix.dtype), vectors.to(matrix.dtype)
    return _refined(matrix, vectors) if _derived(matrix) else (values, vectors)


def symmetric_eigenvalues(matrix: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n"]:
    """Eigenvalues in ascending order, as of :func:`symmetric_eigen`."""
    return symmetric_eigen(matrix)[0] if _small(matrix) else torch.linalg.eigvalsh(matrix)


def _refined(matrix: Float[Tensor, "*batch n n"], vectors: Float[Tensor, "*batch n n"]) -> tuple[Tensor, Tensor]:
    """The same eigenvalues and eigenvectors as functions of the matrix, by two steps of quadratic convergence.

    Ogita & Aishima, "Iterative refinement for symmetric eigenvalue decomposition", Japan Journal of Industrial and
    Applied Mathematics 35 (2018) 1007-1035, algorithm 1.
    """
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    for _ in range(2):
        missing = eye - torch.matmul(vectors.mT, vectors)
        turned = torch.matmul(vectors.mT, torch.matmul(matrix, vectors))
        values = turned.diagonal(dim1=-2, dim2=-1) / (1.0 - missing.diagonal(dim1=-2, dim2=-1))
        gap = values.unsqueeze(-2) - values.unsqueeze(-1) + eye
        step = torch.where(eye > 0, 0.5 * missing, (turned + missing * values.unsqueeze(-2)) / gap)
        vectors = vectors + torch.matmul(vectors, step)
    return values, vectors


def _derived(matrix: Tensor) -> bool:
    return matrix.requires_grad or is_wrapped(matrix) or forward_mode_is_active()


def _rotated(matrix: Float[Tensor, "*batch k n"]) -> Float[Tensor, "*batch n n"]:
    """V orthogonal such that the columns of ``matrix V`` are orthogonal: one-sided Jacobi, all pairs in parallel.

    Hestenes, "Inversion of matrices by biorthogonalization and related results", J. SIAM 6 (1958) 51-90; the pairs are
    those of a round-robin tournament.
    """
    k, n = matrix.shape[-2:]
    half = (n + 1) // 2
    eye = torch.eye(n, dtype=matrix.dtype, device=matrix.device).expand(*matrix.shape[:-2], n, n)
    both = torch.nn.functional.pad(torch.cat([matrix, eye], -2), (0, 2 * half - n))
    if n == 1:
        return eye.clone()
    place = _round_robin(half, matrix.device)
    for _ in range((2 * half - 1) * (3 + math.ceil(math.log2(2 * half)) + (half > 1))):
        left, right = both[..., :half], both[..., half:]
        a, b = (part[..., :k, :].square().sum(-2, keepdim=True) for part in (left, right))
        g = (left[..., :k, :] * right[..., :k, :]).sum(-2, keepdim=True)
        ratio = (b - a) / torch.where(g == 0, 1.0, 2.0 * g)
        tangent = torch.where(ratio < 0, -1.0, 1.0) / (ratio.abs() + (1.0 + ratio.square()).sqrt())
        tangent = torch.where(g == 0, 0.0, tangent)
        cosine = (1.0 + tangent.square()).rsqrt()
        sine = cosine * tangent
        both = torch.cat([cosine * left - sine * right, sine * left + cosine * right], -1).index_select(-1, place)
    return both[..., k:, :n]


def _round_robin(half: int, device: torch.device) -> Tensor:
    """Places after a round of a tournament whose pairs are (i, half + i); the first stays, the others move on."""
    place = torch.arange(2 * half, device=device)
    if half == 1:
        return place
    return torch.cat(
        [place[:1], place[half : half + 1], place[1 : half - 1], place[half + 1 :], place[half - 1 : half]]
    )


def symmetric_pinv(matrix: Float[Tensor, "*batch n n"], rtol: float | None = None) -> Float[Tensor, "*batch n n"]:
    """Pseudo-inverse of symmetric matrices; eigenvalues of size up to ``rtol`` times the largest count as 0.

    Off the CPU with first and second derivatives, as of an inverse, and by Cholesky's factor where all matrices are
    safely positive definite, for which one value is read.
    """
    eps = torch.finfo(matrix.dtype).eps
    if not _small(matrix):
        return torch.linalg.pinv(matrix, hermitian=True, rtol=rtol)
    if (rtol or 0.0) <= 1e2 * matrix.shape[-1] * eps:
        size = matrix.detach().diagonal(dim1=-2, dim2=-1)
        unit = torch.where(size > 0, size, 1.0).rsqrt()
        outer = unit.unsqueeze(-1) * unit.unsqueeze(-2)
        inverse, strict = definite_inverse(matrix.detach() * outer)
        if bool(strict.all()):
            return _with_derivatives(inverse * outer, matrix)
    values, vectors = symmetric_eigen(matrix)
    size = values.abs()
    limit = max(rtol or 0.0, 4 * matrix.shape[-1] * eps) * size.amax(-1, keepdim=True)
    inverse = torch.where(size > limit, 1.0 / torch.where(size > limit, values, 1.0), 0.0)
    return _with_derivatives(torch.matmul(vectors * inverse.unsqueeze(-2), vectors.mT), matrix)


def pinv(matrix: Float[Tensor, "*batch k n"], rtol: float | None = None) -> Float[Tensor, "*batch n k"]:
    """Pseudo-inverse of any matrices. Off the CPU by the normal equations, refined: for condition numbers to 1e7."""
    if not _small(matrix) or 0 in matrix.shape:
        return torch.linalg.pinv(matrix, rtol=rtol)
    wide = _double(matrix.detach())
    root = rtol or max(matrix.shape[-2:]) * torch.finfo(wide.dtype).eps
    if wide.shape[-2] < wide.shape[-1]:
        found = torch.matmul(wide.mT, symmetric_pinv(torch.matmul(wide, wide.mT), root**2))
    else:
        found = torch.matmul(symmetric_pinv(torch.matmul(wide.mT, wide), root**2), wide.mT)
    found = 2.0 * found - torch.matmul(torch.matmul(found, wide), found)
    return _with_derivatives(found.to(matrix.dtype), matrix)


def _with_derivatives(inverse: Tensor, matrix: Tensor) -> Tensor:
    """The same inverse as a function of the matrix: each of two Newton steps adds an order of derivatives."""
    if _derived(matrix):
        for _ in range(2):
            inverse = 2.0 * inverse - torch.matmul(torch.matmul(inverse, matrix), inverse)
    return inverse
