"""Least absolute deviations: the optimum of the linear program for all kinds of data."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.optimize import linprog
from torch import Tensor

from mkc_torch.linear import RankDeficientError
from mkc_torch.linear.least_absolute_deviations import LeastAbsoluteDeviations
from tests.draws import normal as sample
from tests.literature import DATA_SETS, REFERENCE

properties = settings(derandomize=True, deadline=None, max_examples=25)
seeds = st.integers(0, 2**31 - 1)


def linear_program(X: Tensor, y: Tensor, weight: Tensor | None = None) -> tuple[Tensor, float]:
    """Coefficients and optimum of one problem X (R, n), y (R,), by HiGHS."""
    R, n = X.shape
    w = torch.ones_like(y) if weight is None else weight
    equal = sparse.hstack([sparse.csr_matrix(X.numpy()), sparse.eye(R), -sparse.eye(R)])
    bounds = [(None, None)] * n + [(0, None)] * (2 * R)
    cost = np.concatenate([np.zeros(n), w, w])
    coef = torch.from_numpy(linprog(cost, A_eq=equal, b_eq=y.numpy(), bounds=bounds, method="highs").x[:n])
    return coef, float((w * (y - X @ coef).abs()).sum())


def heavy_tailed(seed: int, *shape: int) -> Tensor:
    """Noise like Student's t with two degrees of freedom: heavy tails, but a finite mean."""
    return sample(seed, *shape) / (sample(seed + 1, *shape).square() + sample(seed + 2, *shape).square()).sqrt()


def assert_is_optimum(fit: LeastAbsoluteDeviations, index: tuple[int, ...], X: Tensor, y: Tensor, w: Tensor | None):
    coef, optimum = linear_program(X, y, w)
    assert float(fit.objective_[index]) == pytest.approx(optimum, rel=1e-10)
    torch.testing.assert_close(fit.coef_[index], coef, rtol=1e-7, atol=1e-7)
    assert bool(fit.converged_[index])


@pytest.mark.parametrize("name", REFERENCE)
def test_published_data_sets_give_the_published_fit(name):
    X, y = DATA_SETS[name]()
    fit = LeastAbsoluteDeviations().fit(X, y)
    published = torch.tensor(REFERENCE[name].lad, dtype=X.dtype)
    if name != "telef":  # its optimum is not unique
        torch.testing.assert_close(fit.coef_, published, rtol=1e-6, atol=1e-8)
    assert float(fit.objective_) == pytest.approx(REFERENCE[name].lad_objective, rel=1e-10)
    assert float((y - X @ published).abs().sum()) == pytest.approx(float(fit.objective_), rel=1e-7)
    assert bool(fit.converged_)


@pytest.mark.parametrize("name", ["salinity", "coleman"])
def test_further_data_sets_give_the_optimum_of_the_linear_program(name):
    X, y = DATA_SETS[name]()
    assert_is_optimum(LeastAbsoluteDeviations().fit(X, y), (), X, y, None)


@pytest.mark.parametrize(("N", "n"), [(7, 6), (40, 3), (51, 1), (80, 20), (400, 2)])
def test_a_single_problem_reaches_the_optimum_of_the_linear_program(N, n):
    X, y = sample(N, N, n), heavy_tailed(n, N)
    fit = LeastAbsoluteDeviations().fit(X, y)
    assert fit.coef_.shape == (n,)
    assert fit.objective_.shape == fit.converged_.shape == fit.n_iter_.shape == ()
    assert_is_optimum(fit, (), X, y, None)


@pytest.mark.parametrize("weighted", [False, True])
def test_every_problem_of_a_batch_reaches_the_optimum_of_its_linear_program(weighted):
    X, y = sample(0, 2, 5, 30, 3).unsqueeze(-2), heavy_tailed(1, 2, 5, 30).unsqueeze(-1)
    weight = sample(4, 2, 5, 30).exp() if weighted else None
    fit = LeastAbsoluteDeviations().fit(X, y, weight)
    assert fit.coef_.shape == (2, 5, 3)
    assert fit.objective_.shape == fit.converged_.shape == fit.n_iter_.shape == (2, 5)
    for i in np.ndindex(2, 5):
        assert_is_optimum(fit, i, X[i].squeeze(-2), y[i].squeeze(-1), None if weight is None else weight[i])


@pytest.mark.parametrize("weighted", [False, True])
def test_channels_share_the_coefficients(weighted):
    X, Y = sample(0, 4, 20, 3, 5), heavy_tailed(1, 4, 20, 3)
    weight = sample(4, 4, 20, 3).exp() if weighted else None
    fit = LeastAbsoluteDeviations().fit(X, Y, weight)
    assert fit.weights_.shape == Y.shape
    for i in range(4):
        w = None if weight is None else weight[i].flatten()
        assert_is_optimum(fit, (i,), X[i].reshape(60, 5), Y[i].flatten(), w)


def test_a_shared_design_equals_a_loop_over_targets():
    X, Y = sample(0, 40, 2), heavy_tailed(1, 3, 40)
    fit = LeastAbsoluteDeviations().fit(X, Y)
    assert fit.coef_.shape == (3, 2)
    for i in range(3):
        assert_is_optimum(fit, (i,), X, Y[i], None)


def test_weights_of_very_different_size_reach_the_optimum():
    X, y, w = sample(0, 50, 4), heavy_tailed(1, 50), 10.0 ** (4 * sample(2, 50).clamp(-2, 2))
    fit = LeastAbsoluteDeviations().fit(X, y, w)
    coef, optimum = linear_program(X, y, w / w.max())
    assert float(fit.objective_ / w.max()) == pytest.approx(optimum, rel=1e-9)
    torch.testing.assert_close(fit.coef_, coef, rtol=1e-7, atol=1e-7)


def test_batch_equals_loop():
    X, y = sample(0, 6, 25, 3).unsqueeze(-2), heavy_tailed(1, 6, 25).unsqueeze(-1)
    y[2] = torch.matmul(X[2], torch.ones(3, dtype=X.dtype))  # a problem that needs no iteration
    together = LeastAbsoluteDeviations().fit(X, y)
    for i in range(6):
        alone = LeastAbsoluteDeviations().fit(X[i], y[i])
        torch.testing.assert_close(together.coef_[i], alone.coef_, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(together.objective_[i], alone.objective_, rtol=1e-12, atol=1e-12)
        assert together.n_iter_[i] == alone.n_iter_
    assert together.n_iter_[2] == 0


@properties
@given(seed=seeds, factor=st.floats(-1e3, 1e3).filter(lambda c: abs(c) > 1e-3))
def test_regression_and_scale_equivariance(seed, factor):
    X, y, shift = sample(seed, 21, 3), heavy_tailed(seed + 10, 21), 10 * sample(seed + 20, 3)
    plain = LeastAbsoluteDeviations().fit(X, y)
    moved = LeastAbsoluteDeviations().fit(X, factor * y + X @ shift)
    expected = factor * plain.coef_ + shift
    torch.testing.assert_close(moved.coef_, expected, rtol=1e-7, atol=1e-7 * float(expected.abs().max()))
    torch.testing.assert_close(moved.objective_, abs(factor) * plain.objective_, rtol=1e-9, atol=1e-9)


@properties
@given(seed=seeds, exponents=st.lists(st.integers(-8, 8), min_size=3, max_size=3))
def test_affine_equivariance(seed, exponents):
    X, y, mix = sample(seed, 21, 3), heavy_tailed(seed + 10, 21), torch.eye(3).double() + 0.2 * sample(seed + 20, 3, 3)
    scale = torch.tensor([10.0**e for e in exponents], dtype=X.dtype)
    plain = LeastAbsoluteDeviations().fit(X, y)
    mixed = LeastAbsoluteDeviations().fit(X @ mix * scale, y)
    torch.testing.assert_close(mix @ (scale * mixed.coef_), plain.coef_, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(mixed.objective_, plain.objective_, rtol=1e-9, atol=0.0)


@properties
@given(seed=seeds, N=st.integers(4, 30), levels=st.integers(1, 3))
def test_degenerate_ties_reach_the_optimum(seed, N, levels):
    generator = torch.Generator().manual_seed(seed)
    X = torch.randint(-levels, levels + 1, (N, 2), generator=generator).double()
    X = torch.cat([X, torch.eye(2, dtype=X.dtype)])
    y = torch.randint(-levels, levels + 1, (N + 2,), generator=generator).double()
    fit = LeastAbsoluteDeviations().fit(X, y)
    assert float(fit.objective_) == pytest.approx(linear_program(X, y)[1], rel=1e-10, abs=1e-12)
    assert float((y - X @ fit.coef_).abs().sum()) == pytest.approx(float(fit.objective_), rel=1e-10, abs=1e-12)
    assert bool(fit.converged_)


def test_where_the_optimum_is_not_unique_some_optimum_is_returned():
    y = torch.tensor([0.0, 1.0, 3.0, 10.0], dtype=torch.float64)
    fit = LeastAbsoluteDeviations().fit(torch.ones(4, 1, dtype=y.dtype), y)
    assert 1.0 <= float(fit.coef_) <= 3.0
    assert float(fit.objective_) == pytest.approx(12.0, rel=1e-12)


def test_exact_fit_has_objective_zero():
    X, coef = sample(0, 5, 30, 3).unsqueeze(-2), sample(1, 3)
    y = torch.matmul(X, coef)
    fit = LeastAbsoluteDeviations().fit(X, y)
    torch.testing.assert_close(fit.coef_, coef.expand(5, 3), rtol=1e-12, atol=1e-12)
    assert float(fit.objective_.max()) < 1e-12
    assert bool(fit.converged_.all())


def test_targets_of_zero_give_coefficients_of_zero():
    fit = LeastAbsoluteDeviations().fit(sample(0, 10, 2), torch.zeros(10, dtype=torch.float64))
    assert fit.coef_.tolist() == [0.0, 0.0]
    assert float(fit.objective_) == 0.0
    assert bool(fit.converged_)


def test_majority_on_a_line_is_fitted_exactly():
    X, coef = sample(0, 40, 3), sample(1, 3)
    y = X @ coef
    y[:8] += 1e6 * sample(2, 8)
    fit = LeastAbsoluteDeviations().fit(X, y)
    torch.testing.assert_close(fit.coef_, coef, rtol=1e-9, atol=1e-9)


def test_vast_outliers_leave_the_coefficients_exact():
    X, y = sample(0, 10, 60, 4), heavy_tailed(1, 10, 60)
    near, far = y.clone(), y.clone()
    outlier = 3.0 * sample(2, 10, 6).sign()
    near[:, :6] += 1e3 * outlier
    far[:, :6] += 1e9 * outlier
    # the fit depends on the side of an outlier, not on its distance
    fits = [LeastAbsoluteDeviations().fit(X, v) for v in (near, far)]
    torch.testing.assert_close(fits[1].coef_, fits[0].coef_, rtol=1e-6, atol=1e-6)
    assert bool(fits[1].converged_.all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_as_many_values_as_coefficients_are_interpolated(dtype):
    X, y = sample(0, 2, 3, 6).to(dtype), sample(1, 2, 3).to(dtype)
    fit = LeastAbsoluteDeviations().fit(X, y)
    tolerance = 1e-4 if dtype == torch.float32 else 1e-11
    torch.testing.assert_close(fit.predict(X), y, rtol=tolerance, atol=tolerance)
    assert float(fit.objective_) < tolerance
    assert bool(fit.converged_)


def test_float32_is_exact_to_its_precision():
    X, y = sample(0, 100, 3), heavy_tailed(1, 100)
    fit = LeastAbsoluteDeviations().fit(X.float(), y.float())
    coef, optimum = linear_program(X.float().double(), y.float().double())
    assert fit.coef_.dtype == fit.objective_.dtype == fit.weights_.dtype == torch.float32
    torch.testing.assert_close(fit.coef_, coef.float(), rtol=1e-5, atol=1e-5)
    assert float(fit.objective_) == pytest.approx(optimum, rel=1e-6)
    assert bool(fit.converged_)


def test_weight_zero_equals_removal():
    X, y = sample(0, 30, 3), heavy_tailed(1, 30)
    weight = (torch.arange(30) % 3 > 0).double()
    y[::3] = 1e9
    X[::3] = 1e3
    fit = LeastAbsoluteDeviations().fit(X, y, weight)
    removed = LeastAbsoluteDeviations().fit(X[weight > 0], y[weight > 0])
    torch.testing.assert_close(fit.coef_, removed.coef_, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(fit.objective_, removed.objective_, rtol=1e-12, atol=0.0)


def test_the_solution_does_not_interpolate_values_of_weight_zero():
    X, y = sample(0, 30, 3), heavy_tailed(1, 30)
    weight = (torch.arange(30) > 4).double()
    removed = LeastAbsoluteDeviations().fit(X[5:], y[5:])
    y[:5] = removed.predict(X[:5]) + 1e-6
    fit = LeastAbsoluteDeviations(tol=1e-3).fit(X, y, weight)
    torch.testing.assert_close(fit.coef_, removed.coef_, rtol=1e-12, atol=1e-12)


def test_weight_two_equals_repetition():
    X, y = sample(0, 31, 3), heavy_tailed(1, 31)
    weight = 1.0 + (torch.arange(31) % 2).double()
    fit = LeastAbsoluteDeviations().fit(X, y, weight)
    repeated = LeastAbsoluteDeviations().fit(*(v.repeat_interleave(weight.long(), 0) for v in (X, y)))
    torch.testing.assert_close(fit.coef_, repeated.coef_, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(fit.objective_, repeated.objective_, rtol=1e-12, atol=0.0)
    assert not torch.allclose(fit.coef_, LeastAbsoluteDeviations().fit(X, y).coef_)


def test_result_goes_exactly_through_n_values():
    X, y = sample(0, 100, 4), heavy_tailed(1, 100)
    residual = (y - LeastAbsoluteDeviations(tol=1e-6).fit(X, y).predict(X)).abs().sort().values
    assert float(residual[3]) < 1e-13
    assert float(residual[4]) > 1e-6


def test_weights_are_ones_of_the_shape_of_the_targets():
    fit = LeastAbsoluteDeviations().fit(sample(0, 10, 2), heavy_tailed(1, 10), torch.arange(10.0).double())
    torch.testing.assert_close(fit.weights_, torch.ones(10, 1, dtype=torch.float64))


def test_the_gradient_by_the_targets_passes_gradcheck():
    X, y = sample(0, 12, 2), heavy_tailed(1, 12).requires_grad_()
    assert torch.autograd.gradcheck(lambda y: LeastAbsoluteDeviations().fit(X, y).coef_, (y,), eps=1e-7, atol=1e-5)


def test_stopping_early_is_reported():
    X, y = sample(0, 100, 4), heavy_tailed(1, 100)
    early = LeastAbsoluteDeviations(max_iter=1).fit(X, y)
    assert not bool(early.converged_)
    assert int(early.n_iter_) == 1
    assert bool(torch.isfinite(early.coef_).all())
    assert float(early.objective_) > float(LeastAbsoluteDeviations().fit(X, y).objective_)


def test_dependent_columns_raise():
    X = sample(0, 10, 2)
    with pytest.raises(RankDeficientError, match=r"columns \[0, 1, 2\]"):
        LeastAbsoluteDeviations().fit(torch.cat([X, X.sum(1, keepdim=True)], dim=1), heavy_tailed(1, 10))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tol": 0.0}, r"`tol` to be in \(0, 1\) but got 0.0"),
        ({"tol": 1.0}, r"`tol` to be in \(0, 1\) but got 1.0"),
        ({"tol": float("nan")}, "`tol` .* but got nan"),
        ({"max_iter": 0}, "`max_iter` to be a whole number of at least 1 but got 0"),
    ],
)
def test_parameters_out_of_range_raise(arguments, message):
    with pytest.raises(ValueError, match=message):
        LeastAbsoluteDeviations(**arguments)


def test_repr_shows_the_parameters():
    assert repr(LeastAbsoluteDeviations(max_iter=7)) == "LeastAbsoluteDeviations(tol=1e-09, max_iter=7)"


def test_the_error_for_an_unknown_result_lists_the_results_of_the_fit():
    X, Y = torch.randn(20, 2, generator=torch.Generator().manual_seed(0)), torch.arange(20.0)
    fitted = LeastAbsoluteDeviations().fit(X, Y)
    with pytest.raises(AttributeError, match=r"its results are .*coef_") as error:
        fitted.standard_error_
    assert "first" not in str(error.value)
    with pytest.raises(AttributeError, match="call fit"):
        LeastAbsoluteDeviations().coef_
