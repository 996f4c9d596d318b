"""Least median of squares: published and exhaustive optima, minimax by a linear program, breakdown."""

import itertools

import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from torch import Tensor

from mkc_torch._support.side_by_side import forced
from mkc_torch.linear import LeastMedianOfSquares
from mkc_torch.linear._chebyshev import equal_heights, minimax
from tests.draws import normal as sample
from tests.literature import DATA_SETS, REFERENCE


def linear_program(X: np.ndarray, y: np.ndarray) -> float:
    """Minimum over the coefficients of the largest absolute residual."""
    N, n = X.shape
    column = np.ones((N, 1))
    found = linprog(
        [0.0] * n + [1.0],
        np.block([[X, -column], [-X, -column]]),
        np.concatenate([y, -y]),
        bounds=[(None, None)] * n + [(0, None)],
        method="highs",
    )
    return float(found.fun)


# minimax


@pytest.mark.parametrize("name", DATA_SETS)
def test_the_largest_residual_equals_that_of_a_linear_program(name):
    X, y = DATA_SETS[name]()
    fit = LeastMedianOfSquares(len(y)).fit(X, y)
    best = linear_program(np.linalg.qr(X.numpy())[0], y.numpy())
    assert float(fit.objective_) == pytest.approx(best, rel=1e-6)
    assert float((y - X @ fit.coef_).abs().max()) == pytest.approx(float(fit.objective_), rel=1e-10)
    assert fit.exact_
    assert bool(fit.converged_)
    assert float(fit.weights_.min()) == 1.0


@pytest.mark.parametrize(("N", "n"), [(8, 2), (30, 5), (300, 6)])
@pytest.mark.parametrize("whole", [False, True])
def test_minimax_of_a_batch_equals_a_linear_program_with_and_without_ties(N, n, whole):
    X, y = 1.5 * sample(N, 8, N, n), 1.5 * sample(N + 1, 8, N)
    if whole:  # many rows and targets are equal, and most vertices degenerate
        X, y = X.round().clamp(-1, 1), y.round()
    fit = minimax(X, y, torch.ones_like(y, dtype=torch.bool), torch.zeros(8, n).double())
    assert bool(fit.converged.all())
    for i in range(8):
        assert float(fit.height[i]) == pytest.approx(linear_program(X[i].numpy(), y[i].numpy()), abs=1e-6)


def test_minimax_ignores_rows_that_are_not_in_use():
    X, y = sample(0, 1, 30, 3), sample(1, 1, 30)
    used = torch.arange(30).unsqueeze(0) % 3 > 0
    fit = minimax(X, torch.where(used, y, 1e6), used, torch.zeros(1, 3).double())
    assert float(fit.height) == pytest.approx(linear_program(X[used].numpy(), y[used].numpy()), rel=1e-6)


def test_a_minimax_fit_of_one_more_row_than_coefficients_has_equal_absolute_residuals():
    X, y = sample(0, 50, 4, 3), sample(1, 50, 4)
    residual = y - (X @ equal_heights(X, y).unsqueeze(-1)).squeeze(-1)
    size = residual.abs()
    torch.testing.assert_close(size, size[:, :1].expand_as(size), rtol=1e-8, atol=1e-10)


# quantiles


@pytest.mark.parametrize("name", [n for n in REFERENCE if REFERENCE[n].lms is not None])
def test_the_published_optimum_is_found(name):
    X, y = DATA_SETS[name]()
    reference = REFERENCE[name].lms
    fit = LeastMedianOfSquares().fit(X, y)
    assert int((fit.weights_ > 0).sum()) >= reference.h
    assert float(fit.objective_) == pytest.approx(reference.objective, rel=1e-6)
    assert fit.exact_
    if reference.coef is not None:
        torch.testing.assert_close(fit.coef_, torch.tensor(reference.coef, dtype=torch.float64), rtol=1e-5, atol=0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("N", "n", "h"), [(9, 2, 5), (10, 3, 7), (8, 1, 6)])
def test_the_optimum_equals_the_search_over_all_subsets(seed, N, n, h):
    X, y = sample(seed, N, n), sample(seed + 100, N) * torch.exp(sample(seed + 200, N))
    subsets = map(list, itertools.combinations(range(N), h))
    best = min(linear_program(X[s].numpy(), y[s].numpy()) for s in subsets)
    fit = LeastMedianOfSquares(h).fit(X, y)
    assert float(fit.objective_) == pytest.approx(best, rel=1e-6)
    assert float((y - X @ fit.coef_).abs().sort().values[h - 1]) == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize("name", ["salinity", "coleman"])
def test_the_objective_varies_little_between_seeds(name):
    X, y = DATA_SETS[name]()
    fits = [LeastMedianOfSquares(seed=s).fit(X, y) for s in range(4)]
    assert not fits[0].exact_
    found = [float(f.objective_) for f in fits]
    assert max(found) < 1.15 * min(found)


@pytest.mark.parametrize("seed", range(2))
def test_forty_five_per_cent_clustered_outliers_do_not_move_the_fit(seed):
    X, truth = sample(seed, 3, 300, 6), sample(seed + 1, 3, 6)
    y = (X @ truth.unsqueeze(-1)).squeeze(-1) + 0.1 * sample(seed + 2, 3, 300)
    X[:, :135] = 8.0 + 0.3 * sample(seed + 3, 3, 135, 6)
    y[:, :135] = 40.0 + 0.3 * sample(seed + 4, 3, 135)
    fit = LeastMedianOfSquares().fit(X, y)
    assert float((fit.coef_ - truth).abs().max()) < 0.15
    assert float(fit.weights_[:, :135].sum()) == 0.0


def test_the_scale_of_gaussian_residuals_is_their_standard_deviation():
    y = 3.0 * sample(0, 40, 100)
    for h in (51, 100):
        fit = LeastMedianOfSquares(h, starts=50).fit(torch.ones(100, 1).double(), y)
        # the minimised quantile of the residuals is smaller than that of the errors
        assert 0.8 * 3.0 < float(fit.scale_.mean()) < 1.1 * 3.0


def test_weight_zero_equals_removal():
    X, y = sample(0, 20, 2), sample(1, 20)
    weight = torch.cat([torch.ones(20), torch.zeros(10)]).double()
    both = torch.cat([X, 5.0 + sample(2, 10, 2)]), torch.cat([y, torch.full((10,), 1e3).double()])
    fit = LeastMedianOfSquares(18).fit(*both, weight)  # 18 / 30 = 12 / 20
    torch.testing.assert_close(fit.objective_, LeastMedianOfSquares(12).fit(X, y).objective_, rtol=1e-9, atol=0)
    largest = LeastMedianOfSquares(30).fit(*both, weight)
    torch.testing.assert_close(largest.objective_, LeastMedianOfSquares(20).fit(X, y).objective_, rtol=1e-9, atol=0)


def test_no_nearby_coefficients_improve_every_channel():
    X = torch.stack([torch.cat([torch.ones(60, 1).double(), sample(k, 60, 1)], 1) for k in range(2)], -2)
    Y = X.sum(-1) + 0.1 * sample(2, 60, 2) * torch.tensor([1.0, 50.0])
    Y[:20, 0] += 9.0
    fit = LeastMedianOfSquares(starts=300, seed=1).fit(X, Y)

    def quantiles(coef: Tensor) -> Tensor:
        return (Y - X @ coef).abs().sort(0).values[30]

    torch.testing.assert_close(quantiles(fit.coef_), fit.objective_)
    for step in 0.02 * sample(3, 300, 2):
        assert not bool((quantiles(fit.coef_ + step) < fit.objective_ * (1 - 1e-9)).all())


def test_rows_in_a_hyperplane_give_finite_coefficients():
    X = torch.cat([torch.ones(20, 1), (torch.arange(20) < 6).unsqueeze(-1)], 1).double()
    y = sample(0, 20)
    fit = LeastMedianOfSquares().fit(X, y)
    assert bool(torch.isfinite(fit.coef_).all())


@pytest.mark.parametrize("h", [1, 3, 41])
def test_a_quantile_out_of_range_is_refused(h):
    with pytest.raises(ValueError, match=r"`h` .*4 .*40 samples.* got"):
        LeastMedianOfSquares(h).fit(sample(0, 40, 3), sample(1, 40))


@pytest.mark.parametrize("h", [2.5, True])
def test_a_non_integer_quantile_is_refused(h):
    with pytest.raises(TypeError, match="`h` to be a whole number"):
        LeastMedianOfSquares(h)


def test_as_many_samples_as_coefficients_are_fitted_exactly():
    X, y = sample(0, 3, 3), sample(1, 3)
    fit = LeastMedianOfSquares().fit(X, y)
    torch.testing.assert_close(X @ fit.coef_, y)
    assert bool(torch.isfinite(fit.scale_).all())


def test_equal_residuals_are_counted_in_order_on_every_device():
    """A Chebyshev fit has n + 1 residuals of one size, and rounding differs between devices."""
    generator = torch.Generator().manual_seed(1)
    X = torch.randn(12, 60, 2, generator=generator, dtype=torch.float64)
    y = X.sum(-1) + torch.randn(12, 60, generator=generator, dtype=torch.float64)
    y[:, :10] += 20.0
    plain = LeastMedianOfSquares(starts=200).fit(X, y)
    with forced():
        other = LeastMedianOfSquares(starts=200).fit(X, y)
    torch.testing.assert_close(other.coef_, plain.coef_)
    torch.testing.assert_close(other.objective_, plain.objective_)
