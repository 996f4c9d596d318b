"""Factorisations of small matrices in elementwise operations, compared with LAPACK's."""

import pytest
import torch
from torch import Tensor

from mkc_torch._support.side_by_side import at_once, forced, side_by_side, steps_between_tests
from mkc_torch._support.small_factors import (
    LARGEST,
    definite_inverse,
    null_vector,
    orthonormalising,
    pinv,
    solve,
    solve_gram,
    symmetric_eigen,
    symmetric_pinv,
)
from tests.draws import normal as sample

EPS = torch.finfo(torch.float64).eps
SIZES = [1, 2, 3, 5, 6, 9, 12, LARGEST]


@pytest.fixture(autouse=True)
def _off_the_cpu():
    with forced():
        yield


def eye(n: int) -> Tensor:
    return torch.eye(n, dtype=torch.float64)


@pytest.mark.parametrize("n", SIZES)
def test_the_basis_is_orthonormal_up_to_rounding_times_the_condition_number(n):
    rows = sample(n, 50, 80, n) * torch.logspace(0, -4, n, dtype=torch.float64) @ sample(99, n, n)
    rows = rows / rows.abs().amax(-2, keepdim=True)
    upper, inverse, well = orthonormalising(rows)
    condition = torch.linalg.cond(rows)
    basis = rows @ inverse
    assert bool(well.all())
    off = (basis.mT @ basis - eye(n)).abs().amax((-2, -1))
    assert bool((off <= 20 * n * EPS * condition).all())
    torch.testing.assert_close(upper.mT @ upper, rows.mT @ rows, rtol=0.0, atol=200 * n * EPS)
    assert bool((upper.tril(-1) == 0).all())


def test_dependent_and_nearly_dependent_columns_are_not_well_conditioned():
    rows = sample(0, 4, 30, 3)
    rows[1, :, 2] = rows[1, :, 0] - 2.0 * rows[1, :, 1]
    rows[2, :, 2] = rows[2, :, 0] + 1e-7 * rows[2, :, 2]
    rows[3, :, 1] = 0.0
    assert orthonormalising(rows)[2].tolist() == [True, False, False, False]


def test_float32_rows_are_summed_in_float64():
    rows = sample(0, 1, 200_000, 2).float()
    upper, _, _ = orthonormalising(rows)
    torch.testing.assert_close(upper.mT @ upper, rows.double().mT @ rows.double(), rtol=1e-12, atol=1e-8)


@pytest.mark.parametrize("n", SIZES)
def test_eigenvalues_and_vectors_of_indefinite_matrices_agree_with_lapack(n):
    matrix = sample(n, 40, n, n)
    matrix = matrix + matrix.mT
    values, vectors = symmetric_eigen(matrix)
    size = torch.linalg.matrix_norm(matrix, 2)[:, None, None]
    torch.testing.assert_close(values, torch.linalg.eigvalsh(matrix), rtol=0.0, atol=40 * EPS * float(size.max()))
    torch.testing.assert_close(vectors.mT @ vectors, eye(n).expand(40, n, n), rtol=0.0, atol=100 * EPS)
    assert bool((values.diff(dim=-1) >= 0).all())
    error = (matrix @ vectors - vectors * values.unsqueeze(-2)) / size
    assert float(error.abs().max()) < 100 * EPS


@pytest.mark.parametrize(
    "matrix",
    [torch.zeros(3, 3).double(), eye(4), 1e-200 * eye(2), 1e150 * (1.0 - eye(2))],
    ids=["zero", "identity", "tiny", "opposite eigenvalues"],
)
def test_eigenvalues_of_special_matrices_agree_with_lapack(matrix):
    values, vectors = symmetric_eigen(matrix)
    torch.testing.assert_close(values, torch.linalg.eigvalsh(matrix), rtol=1e-13, atol=0.0)
    torch.testing.assert_close(vectors @ torch.diag(values) @ vectors.mT, matrix, rtol=1e-13, atol=1e-13 * 1e150)


@pytest.mark.parametrize("n", [2, 3, 7])
def test_pseudo_inverses_of_singular_symmetric_matrices_agree_with_lapack(n):
    rows = sample(n, 20, n - 1, n)
    matrix = rows.mT @ rows - 0.5 * rows[:, :1].mT @ rows[:, :1]
    expected = torch.linalg.pinv(matrix, hermitian=True, rtol=1e-12)
    torch.testing.assert_close(
        symmetric_pinv(matrix, 1e-12), expected, rtol=1e-6, atol=1e-7 * float(expected.abs().max())
    )


@pytest.mark.parametrize("shape", [(4, 4), (2, 5), (5, 2)])
def test_pseudo_inverses_of_any_shape_agree_with_lapack(shape):
    matrix = sample(1, 10, *shape)
    torch.testing.assert_close(pinv(matrix), torch.linalg.pinv(matrix), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("inverse", [symmetric_pinv, pinv])
def test_pseudo_inverses_have_derivatives_of_first_and_second_order(inverse):
    matrix = (sample(2, 3, 3) + 5.0 * eye(3)).requires_grad_()

    def of_symmetric(a: Tensor) -> Tensor:
        return inverse(a + a.mT)

    assert torch.autograd.gradcheck(of_symmetric, matrix)
    assert torch.autograd.gradgradcheck(of_symmetric, matrix)


@pytest.mark.parametrize("n", SIZES)
def test_general_systems_are_solved_with_pivots(n):
    matrix, right = sample(n, 30, n, n), sample(3, 30, n, 2)
    matrix[:, 0, 0] = 0.0 if n > 1 else 1.0
    expected = torch.linalg.solve(matrix, right)
    tolerance = 1e2 * EPS * float(torch.linalg.cond(matrix).max())
    torch.testing.assert_close(
        solve(matrix, right), expected, rtol=tolerance, atol=tolerance * float(expected.abs().max())
    )


def test_singular_systems_have_no_finite_solution_and_shared_matrices_are_expanded():
    assert not bool(solve(torch.ones(2, 2).double(), sample(0, 2, 1)).isfinite().all())
    right = sample(0, 5, 3, 1)
    matrix = sample(1, 1, 3, 3)
    torch.testing.assert_close(solve(matrix, right), torch.linalg.solve(matrix, right))


@pytest.mark.parametrize("n", SIZES)
def test_definite_systems_and_inverses_agree_with_lapack(n):
    rows = sample(n, 30, 3 * n, n)
    gram, moment = rows.mT @ rows, sample(2, 30, n)
    torch.testing.assert_close(solve_gram(gram, moment), torch.linalg.solve(gram, moment), rtol=1e-8, atol=1e-10)
    unit = gram.diagonal(dim1=-2, dim2=-1).rsqrt()
    inverse, strict = definite_inverse(unit.unsqueeze(-1) * gram * unit.unsqueeze(-2))
    assert bool(strict.all())
    torch.testing.assert_close(
        unit.unsqueeze(-1) * inverse * unit.unsqueeze(-2), torch.linalg.inv(gram), rtol=1e-7, atol=1e-9
    )


def test_an_indefinite_matrix_has_no_definite_inverse():
    matrix = torch.stack([eye(2), torch.tensor([[1.0, 2.0], [2.0, 1.0]]).double()])
    inverse, strict = definite_inverse(matrix)
    assert strict.tolist() == [True, False]
    torch.testing.assert_close(inverse, eye(2).expand(2, 2, 2))


def test_a_singular_gram_system_has_the_least_squares_fit():
    rows = sample(0, 4, 9, 3)
    rows[..., 2] = rows[..., 0] - rows[..., 1]
    gram, target = rows.mT @ rows, sample(1, 4, 9, 1)
    solution = solve_gram(gram, (rows.mT @ target).squeeze(-1))
    assert bool(solution.isfinite().all())
    fitted = rows @ torch.linalg.pinv(rows) @ target
    torch.testing.assert_close(rows @ solution.unsqueeze(-1), fitted, rtol=1e-9, atol=1e-9)
    assert solve_gram(torch.zeros(3, 3).double(), torch.zeros(3).double()).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("n", [1, 2, 6])
def test_null_vector_is_orthogonal_to_the_columns(n):
    rows = sample(n, 40, n + 1, n)
    normal = null_vector(rows)
    torch.testing.assert_close(torch.linalg.vector_norm(normal, dim=-1), torch.ones(40).double())
    assert float((normal.unsqueeze(-2) @ rows).abs().max()) < 1e-13


def test_the_choice_is_forced_only_within_the_context():
    tensor = torch.zeros(1)
    assert side_by_side(tensor)
    assert steps_between_tests(tensor) > 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mkc_torch._support.side_by_side._forced", False)
        assert not side_by_side(tensor)
        assert steps_between_tests(tensor) == 1
        assert (at_once(tensor, 10, 100), at_once(tensor, 1000, 100)) == (10, 1)
        assert side_by_side(torch.zeros(1, device="meta"))


def test_the_batch_size_follows_the_memory(monkeypatch):
    before = at_once(torch.zeros(1), 10, 100)
    monkeypatch.setattr("mkc_torch._support.side_by_side._MEMORY", 1 << 20)
    assert 1 <= at_once(torch.zeros(1), 10, 100) < before
    assert at_once(torch.zeros(1), 1 << 40, 100) == 1
