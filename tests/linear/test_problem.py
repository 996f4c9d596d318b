"""The checked linear problem: shapes, the orthonormal basis, and errors with remedies."""

import pytest
import torch
from torch import Tensor

from mkc_torch.linear import RankDeficientError
from mkc_torch.linear._problem import LinearProblem, canonical_shapes, linear_problem, solve_gram
from tests.draws import normal as sample


def gram_of_basis(problem: LinearProblem) -> Tensor:
    rows = problem.basis.flatten(-3, -2)
    return rows.mT @ rows


@pytest.mark.parametrize(
    ("x_shape", "y_shape", "single", "canonical"),
    [
        ((30, 2), (30,), True, (30, 1)),
        ((5, 30, 2), (5, 30), True, (5, 30, 1)),
        ((30, 3, 4), (30, 3), False, (30, 3)),
        ((5, 30, 3, 4), (5, 30, 3), False, (5, 30, 3)),
        ((30, 2), (5, 30), True, (5, 30, 1)),
        ((30, 3, 4), (5, 30, 3), False, (5, 30, 3)),
        ((5, 30, 2), (30,), True, (5, 30, 1)),
        ((1, 30, 2), (5, 30), True, (5, 30, 1)),
    ],
)
def test_data_with_and_without_a_channel_dimension_are_accepted(x_shape, y_shape, single, canonical):
    values = canonical_shapes(sample(0, *x_shape), sample(1, *y_shape))
    assert values.single_channel is single
    assert values.Y.shape == canonical
    assert values.X.shape[-3:] == (*canonical[-2:], x_shape[-1])
    assert values.batch == canonical[:-2]


@pytest.mark.parametrize(
    ("A", "B", "n", "single"),
    [
        (100, 3, 2, False),  # samples of three channels
        (4, 50, 3, True),  # more channels than samples are read as samples
        (100, 50, 3, True),  # as are more than 16
        (100, 16, 3, False),
        (100, 17, 3, True),
        (100, 17, 17, False),  # as many channels as coefficients
    ],
)
def test_ambiguous_shapes_are_read_by_the_documented_rule(A, B, n, single):
    assert canonical_shapes(sample(0, A, B, n), sample(1, A, B)).single_channel is single


def test_a_channel_dimension_resolves_an_ambiguous_shape():
    values = canonical_shapes(sample(0, 100, 3, 2).unsqueeze(-2), sample(1, 100, 3).unsqueeze(-1))
    assert values.batch == (100,)
    assert values.Y.shape == (100, 3, 1)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_basis_is_orthonormal_and_spans_the_columns(batch):
    X, Y = sample(0, *batch, 20, 3, 5), sample(1, *batch, 20, 3)
    problem = linear_problem(X, Y)
    eye = torch.eye(5, dtype=X.dtype).expand_as(gram_of_basis(problem))
    torch.testing.assert_close(gram_of_basis(problem), eye, rtol=0.0, atol=1e-13)
    coef = sample(2, *batch, 5)
    fitted = problem.Y - problem.residual(problem.in_basis(coef))
    expected = torch.matmul(X, coef.reshape(*batch, 1, 5, 1)).squeeze(-1)
    torch.testing.assert_close(problem.restore(fitted), expected, rtol=1e-11, atol=1e-11)


def test_basis_is_orthonormal_for_columns_of_very_different_size():
    X = sample(0, 40, 4) * torch.tensor([1e-8, 1e8, 1.0, 1e4]).double()
    problem = linear_problem(X, sample(1, 40))
    torch.testing.assert_close(gram_of_basis(problem)[0], torch.eye(4).double(), rtol=0.0, atol=1e-13)


def test_basis_is_orthonormal_on_the_samples_in_use():
    weight = (torch.arange(40) % 4 > 0).double()
    problem = linear_problem(sample(0, 40, 3), sample(1, 40), weight)
    rows = problem.basis[0, weight > 0].squeeze(-2)
    torch.testing.assert_close(rows.mT @ rows, torch.eye(3).double(), rtol=0.0, atol=1e-13)


def test_coefficients_and_in_basis_are_inverse():
    problem = linear_problem(sample(0, 2, 3, 20, 1, 4), sample(1, 2, 3, 20, 1))
    coef = sample(2, 2, 3, 4)
    torch.testing.assert_close(problem.coefficients(problem.in_basis(coef)), coef)


def test_a_shared_design_is_stored_once():
    problem = linear_problem(sample(0, 40, 2), sample(1, 5, 40))
    assert problem.basis.shape == (1, 40, 1, 2)
    assert problem.Y.shape == (5, 40, 1)
    assert problem.residual(sample(2, 5, 2)).shape == (5, 40, 1)


def test_a_stack_of_candidates_equals_a_loop():
    problem = linear_problem(sample(0, 3, 20, 2, 4), sample(1, 3, 20, 2), sample(2, 3, 20).exp())
    weights, betas = sample(3, 3, 6, 20, 2).exp(), sample(4, 3, 6, 4)
    fits, residuals = problem.weighted_fit(weights), problem.residual(betas)
    assert fits.shape == (3, 6, 4)
    assert residuals.shape == (3, 6, 20, 2)
    for s in range(6):
        torch.testing.assert_close(fits[:, s], problem.weighted_fit(weights[:, s]))
        torch.testing.assert_close(residuals[:, s], problem.residual(betas[:, s]))


@pytest.mark.parametrize("few", [0, 10])
@pytest.mark.parametrize("x_batch", [(), (3,)])
@pytest.mark.parametrize("stack", [(), (4,)])
def test_normal_equations_in_chunks_equal_those_at_once(few, x_batch, stack, monkeypatch):
    problem = linear_problem(sample(0, *x_batch, 20, 2, 4), sample(1, 3, 20, 2), sample(3, 3, 20).exp())
    weight = sample(2, 3, *stack, 20, 2).exp()
    whole = problem.normal_equations(weight)
    monkeypatch.setattr("mkc_torch.linear._problem._CHUNK", 300)
    monkeypatch.setattr("mkc_torch.linear._problem._BLOCK", 6)
    monkeypatch.setattr("mkc_torch.linear._problem._MAX_SETS_IN_BLOCKS", few)
    for part, at_once in zip(problem.normal_equations(weight), whole, strict=True):
        torch.testing.assert_close(part, at_once)


@pytest.mark.parametrize("x_batch", [(), (4,)])
def test_select_keeps_the_problems_at_the_index(x_batch):
    X, Y, weight = sample(0, *x_batch, 20, 3), sample(1, 4, 20), sample(2, 4, 20).exp()
    problem = linear_problem(X, Y, weight)
    index = torch.tensor([2, 0])
    unit_weight = torch.ones_like(problem.Y)
    part = problem.select(index)
    assert part.batch == (2,)
    torch.testing.assert_close(
        part.coefficients(part.weighted_fit(unit_weight[index])),
        problem.coefficients(problem.weighted_fit(unit_weight))[index],
    )


def test_select_samples_keeps_the_samples_at_the_index():
    X, Y, weight = sample(0, 20, 3), sample(1, 20), sample(2, 20).exp()
    index = torch.arange(0, 20, 2)
    part = linear_problem(X, Y, weight).select_samples(index)
    expected = linear_problem(X[index], Y[index], weight[index])
    fits = [p.coefficients(p.weighted_fit(torch.ones_like(p.Y))) for p in (part, expected)]
    torch.testing.assert_close(fits[0], fits[1])


@pytest.mark.parametrize("weighted", [False, True])
def test_total_weight_sums_the_samples_of_each_channel(weighted):
    weight = sample(2, 4, 20, 2).exp()
    problem = linear_problem(sample(0, 4, 20, 2, 3), sample(1, 4, 20, 2), weight if weighted else None)
    expected = weight.sum(-2) if weighted else torch.full((4, 2), 20.0).double()
    torch.testing.assert_close(problem.total_weight(), expected)


@pytest.mark.parametrize(("n", "m", "share"), [(4, 1, 4), (4, 2, 2), (5, 2, 3), (1, 3, 1)])
def test_coefficients_are_shared_among_channels_rounding_up(n, m, share):
    assert linear_problem(sample(0, 20, m, n), sample(1, 20, m)).coefficients_per_channel == share


def test_solve_gram_equals_solve_and_falls_back_to_the_least_norm():
    factor = sample(0, 3, 6, 4)
    gram, moment = factor.mT @ factor, sample(1, 3, 4)
    gram[1, :, 3] = gram[1, 3, :] = moment[1, 3] = 0.0
    solution = solve_gram(gram, moment)
    torch.testing.assert_close(solution[0], torch.linalg.solve(gram[0], moment[0]))
    torch.testing.assert_close(solution[1, :3], torch.linalg.solve(gram[1, :3, :3], moment[1, :3]))
    assert abs(float(solution[1, 3])) < 1e-12


def test_dependent_columns_raise_naming_them():
    X = sample(0, 20, 4)
    X[:, 3] = 2 * X[:, 1]
    with pytest.raises(RankDeficientError, match=r"columns \[1, 3\] are linearly dependent .* remove a column"):
        linear_problem(X, sample(1, 20))


def test_dependent_columns_of_any_size_raise_naming_them():
    X = sample(0, 20, 4)
    X[:, 3] = 1e10 * X[:, 1]
    with pytest.raises(RankDeficientError, match=r"columns \[1, 3\]"):
        linear_problem(X, sample(1, 20))


def test_dependent_columns_of_a_problem_in_a_batch_raise_naming_it():
    X = sample(0, 3, 20, 1, 3)
    X[1, ..., 2] = X[1, ..., 0] + X[1, ..., 1]
    with pytest.raises(RankDeficientError, match=r"columns \[0, 1, 2\]"):
        linear_problem(X, sample(1, 3, 20, 1))


def test_columns_dependent_on_the_samples_in_use_raise_naming_them():
    X, weight = torch.ones(20, 2).double(), torch.ones(20).double()
    X[:5, 1] = 3.0
    linear_problem(X, sample(1, 20), weight)
    weight[:5] = 0.0
    with pytest.raises(RankDeficientError, match=r"columns \[0, 1\]"):
        linear_problem(X, sample(1, 20), weight)


def test_a_zero_column_raises_naming_it():
    X = sample(0, 20, 3)
    X[:, 1] = 0.0
    with pytest.raises(RankDeficientError, match=r"Column 1 of `X` .*zero.*; remove"):
        linear_problem(X, sample(1, 20))


def test_a_column_that_is_zero_on_the_samples_in_use_raises_naming_it():
    X = sample(0, 20, 3)
    X[5:, 2] = 0.0
    weight = (torch.arange(20) >= 5).double()
    with pytest.raises(RankDeficientError, match=r"Column 2 of `X` .*zero"):
        linear_problem(X, sample(1, 20), weight)


def test_fewer_weighted_samples_than_coefficients_raise():
    weight = (torch.arange(20) < 2).double()
    with pytest.raises(RankDeficientError, match="linearly dependent"):
        linear_problem(sample(0, 20, 3), sample(1, 20), weight)


def test_fewer_values_than_coefficients_raise():
    with pytest.raises(ValueError, match=r"at least 4 .*4 coefficients.* got 3 samples x 1; add samples"):
        linear_problem(sample(0, 3, 4), sample(1, 3))


def test_values_of_all_channels_determine_the_coefficients():
    assert linear_problem(sample(0, 2, 2, 4), sample(1, 2, 2)).num_coefficients == 4


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_values_that_are_not_finite_raise_naming_their_index(value):
    X, Y, weight = sample(0, 20, 3), sample(1, 20), torch.ones(20).double()
    bad_X, bad_Y, bad_weight = X.clone(), Y.clone(), weight.clone()
    bad_X[4, 0, ...] = bad_Y[7] = bad_weight[9] = value
    with pytest.raises(ValueError, match=rf"`X` .*finite.* got {value} at index \(4, 0, 0\)"):
        linear_problem(bad_X.unsqueeze(-2), Y.unsqueeze(-1))
    with pytest.raises(ValueError, match=rf"`Y` .*finite.* got {value} at index \(7, 0\)"):
        linear_problem(X.unsqueeze(-2), bad_Y.unsqueeze(-1))
    with pytest.raises(ValueError, match=rf"`sample_weight` .*finite.* got {value} at index \(9, 0\)"):
        linear_problem(X, Y, bad_weight)


@pytest.mark.parametrize("name", ["X", "Y"])
def test_integer_dtype_raises(name):
    values = {"X": sample(0, 20, 3), "Y": sample(1, 20)}
    values[name] = values[name].long()
    message = rf"`{name}` .*real.* got torch\.int64"
    with pytest.raises(TypeError, match=message):
        linear_problem(**values)


def test_data_of_another_type_raise():
    with pytest.raises(TypeError, match=r"`Y` .*tensor.* got list"):
        linear_problem(sample(0, 2, 1), [1.0, 2.0])


def test_different_dtypes_raise():
    with pytest.raises(TypeError, match=r"dtype and device .*torch\.float64 on cpu and torch\.float32"):
        linear_problem(sample(0, 20, 3), sample(1, 20).float())


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_raises(dtype):
    with pytest.raises(TypeError, match=rf"dtype float32 or float64 but got {dtype}; use .float\(\)"):
        linear_problem(sample(0, 20, 3).to(dtype), sample(1, 20).to(dtype))


@pytest.mark.parametrize(
    ("x_shape", "y_shape", "shown"),
    [
        ((20, 3), (19,), r"\(20, 3\) and \(19,\)"),
        ((20,), (20,), r"\(20,\) and \(20,\)"),
        ((20, 3), (20, 3), r"\(20, 3\) and \(20, 3\)"),
        ((20, 2, 3), (20, 4), r"\(20, 2, 3\) and \(20, 4\)"),
    ],
)
def test_mismatched_shapes_raise_naming_both_shapes(x_shape, y_shape, shown):
    with pytest.raises(ValueError, match=rf"`X` of shape \(\*, N, m, n\) .* but got {shown}"):
        linear_problem(sample(0, *x_shape), sample(1, *y_shape))


def test_empty_input_raises():
    with pytest.raises(ValueError, match=r"one sample and one column"):
        linear_problem(sample(0, 0, 3), sample(1, 0))
    with pytest.raises(ValueError, match=r"one sample and one column"):
        linear_problem(sample(0, 20, 0), sample(1, 20))


@pytest.mark.parametrize("shape", [(), (19,), (20, 2), (3, 19)])
def test_weight_of_a_bad_shape_raises(shape):
    with pytest.raises(ValueError, match=r"`sample_weight` of shape \(\*, 20\) or \(\*, 20, 1\)"):
        linear_problem(sample(0, 20, 3), sample(1, 20), torch.ones(shape).double())


def test_negative_weight_raises():
    weight = torch.ones(20).double()
    weight[3] = -0.5
    with pytest.raises(ValueError, match=r"`sample_weight` .*>= 0.* got -0\.5"):
        linear_problem(sample(0, 20, 3), sample(1, 20), weight)


def test_weights_all_zero_in_a_channel_raise():
    weight = torch.ones(20, 2).double()
    weight[:, 1] = 0.0
    with pytest.raises(ValueError, match=r"`sample_weight` .*positive.*every channel"):
        linear_problem(sample(0, 20, 2, 3), sample(1, 20, 2), weight)
