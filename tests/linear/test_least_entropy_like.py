"""Least entropy-like regression: published minima, local minima of H, equivariance, input without a solution."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from torch import Tensor

from mkc_torch.linear import LeastEntropyLike, LeastSquares, RankDeficientError
from mkc_torch.linear._problem import linear_problem
from mkc_torch.linear.least_entropy_like import _Directions
from mkc_torch.losses.entropy_like import entropy_like
from tests.draws import normal as sample
from tests.literature import hbk

properties = settings(derandomize=True, deadline=None, max_examples=20)
seeds = st.integers(0, 2**31 - 1)


def problem(seed: int, N: int = 60, n: int = 3, outliers: float = 0.15) -> tuple[Tensor, Tensor]:
    """A fit with gross outliers in Y, with a minimum of H near the truth (1, ..., n)."""
    X = sample(seed, N, n)
    y = X @ torch.arange(1.0, n + 1).double() + 0.1 * sample(seed + 1, N)
    bad = int(outliers * N)
    y[:bad] += 10.0 + 3.0 * sample(seed + 2, bad)
    return X, y


def entropy_function(X: np.ndarray, y: np.ndarray):
    def h(theta: np.ndarray) -> float:
        r = y - X @ theta
        q = r**2 / (r**2).sum()
        return float(-(q * np.log(np.maximum(q, 1e-300))).sum() / math.log(len(y)))

    return h


# published


def test_hawkins_bradu_kass_has_the_published_minima():
    X, y = hbk()
    X = X[:, 1:]
    fit = LeastEntropyLike().fit(X, y)

    def median(theta: Tensor) -> float:
        return round(float((y - X @ theta).square().median()), 2)

    first = fit.starts_[0]
    assert [round(v, 2) for v in first.tolist()] == [0.08, -0.36, 0.44]
    assert round(float(entropy_like(y - X @ first)), 4) == 0.6532
    assert median(first) == 0.68
    assert [round(v, 2) for v in fit.coef_.tolist()] == [-0.33, 0.33, 0.23]
    assert round(float(fit.entropy_), 4) == 0.4290
    assert median(fit.coef_) == 0.53
    other = fit.minima_[fit.minima_entropy_.argmax()]
    assert round(float(other[0]), 4) == -0.0043
    assert [round(v, 2) for v in other[1:].tolist()] == [0.05, -0.05]
    assert round(float(fit.minima_entropy_.max()), 4) == 0.5600
    assert median(other) == 0.31
    assert sorted(round(v, 4) for v in fit.minima_entropy_.tolist()) == [0.4290, 0.4290, 0.5600]
    assert bool(fit.minima_converged_.all())


def test_many_starts_on_hawkins_bradu_kass_find_no_other_minimum():
    X, y = hbk()
    starts = sample(0, 200, 3) * torch.tensor([0.1, 1.0, 10.0, 1e4]).double().repeat_interleave(50).unsqueeze(1)
    fit = LeastEntropyLike(starts=starts).fit(X[:, 1:], y)
    assert bool(fit.minima_converged_.all())
    assert sorted({round(v, 6) for v in fit.minima_entropy_.tolist()}) == [0.429046, 0.560008]
    assert int(fit.n_iter_) <= 20


# derivatives and minima


@pytest.mark.parametrize(("shared", "weighted", "m"), [(False, True, 2), (True, False, 1), (False, False, 3)])
def test_gradient_and_hessian_equal_automatic_differentiation(shared, weighted, m):
    X, Y = sample(1, 1 if shared else 4, 15, m, 3), sample(2, 4, 15, m)
    weight = sample(3, 4, 15, m).abs() + 0.2 if weighted else None
    p = linear_problem(X, Y, weight)
    remainder = p.residual(p.weighted_fit(torch.ones_like(p.Y)))
    c = torch.nn.functional.normalize(sample(4, 4, 4), dim=-1)

    def h(c: Tensor, i: int) -> Tensor:
        rows = p.basis[0 if shared else i]
        return entropy_like(rows @ c[:3] + c[3] * remainder[i], 0, None if weight is None else weight[i]).mean()

    found = _Directions(p, remainder, 1).quadratic(c, torch.arange(4))
    for i in range(4):
        across = torch.eye(4, dtype=c.dtype) - torch.outer(c[i], c[i])
        torch.testing.assert_close(found.value[i], h(c[i], i), rtol=1e-12, atol=0)
        torch.testing.assert_close(found.gradient[i], torch.func.grad(h)(c[i], i), rtol=1e-9, atol=1e-12)
        hessian = torch.func.jacrev(torch.func.grad(h))(c[i], i)
        torch.testing.assert_close(across @ found.hessian[i] @ across, across @ hessian @ across, rtol=1e-8, atol=1e-10)
    gradient = found.gradient[0]
    step = 1e-6 * sample(5, 4)
    difference = h(c[0] + step, 0) - h(c[0] - step, 0)
    torch.testing.assert_close(2 * (gradient * step).sum(), difference, rtol=1e-5, atol=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_scipy_confirms_every_minimum(seed):
    X, y = problem(seed)
    fit = LeastEntropyLike().fit(X, y)
    h = entropy_function(X.numpy(), y.numpy())
    assert bool(fit.minima_converged_.all())
    for theta, value in zip(fit.minima_.numpy(), fit.minima_entropy_.tolist(), strict=True):
        assert value == pytest.approx(h(theta), abs=1e-12)
        best = minimize(h, theta, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-15, "maxiter": 2000})
        assert best.fun >= value - 1e-12
        np.testing.assert_allclose(best.x, theta, rtol=1e-5, atol=1e-6)
    assert float(fit.entropy_) == float(fit.minima_entropy_.min())


@pytest.mark.parametrize("seed", range(4))
def test_outliers_in_y_have_weight_zero(seed):
    X, y = problem(seed, N=200)
    fit = LeastEntropyLike().fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.tensor([1.0, 2.0, 3.0]).double(), rtol=0, atol=0.2)
    assert float((fit.coef_ - torch.arange(1.0, 4.0)).norm()) < float(
        (LeastSquares().fit(X, y).coef_ - torch.arange(1.0, 4.0)).norm()
    )
    r = y - X @ fit.coef_
    q = r**2 / (r**2).sum()
    assert torch.equal(fit.weights_[:, 0] == 1, torch.log(q) <= (q * torch.log(q)).sum())
    assert float(fit.weights_[30:].mean()) == 1.0


def test_descents_from_very_far_starts_converge():
    X, y = hbk()
    fit = LeastEntropyLike(starts=torch.tensor([[1e9, 2e9, -1e9], [-1e9, -2e9, 1e9]]).double()).fit(X[:, 1:], y)
    assert bool(fit.minima_converged_.all())
    assert float(fit.minima_.abs().max()) < 1.0


# starts


def test_given_starts_are_used():
    X, y = problem(7)
    guess = torch.tensor([3.0, 0.0, 0.0]).double()
    fit = LeastEntropyLike(guess).fit(X, y)
    torch.testing.assert_close(fit.starts_[0], guess, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(fit.starts_ @ fit.starts_.T, 9 * torch.eye(3).double(), rtol=1e-9, atol=1e-9)
    starts = sample(8, 5, 3)
    fit = LeastEntropyLike(starts=starts).fit(X, y)
    torch.testing.assert_close(fit.starts_, starts, rtol=1e-10, atol=1e-10)
    assert fit.minima_.shape == (5, 3)
    for bad in (torch.ones(2, 4).double(), torch.full((1, 3), math.nan).double()):
        with pytest.raises(ValueError, match="`starts`"):
            LeastEntropyLike(starts=bad).fit(X, y)
    with pytest.raises(ValueError, match="`start`"):
        LeastEntropyLike(torch.ones(2).double()).fit(X, y)
    with pytest.raises(ValueError, match="`start` or `starts` but got both"):
        LeastEntropyLike(guess, starts=starts)


# equivariance: of the minima, from equivariant starts


@properties
@given(seeds)
def test_regression_scale_and_affine_equivariance(seed):
    X, y = problem(seed % 1000)
    starts = sample(seed, 4, 3) + torch.arange(1.0, 4.0)
    fit = LeastEntropyLike(starts=starts).fit(X, y)
    shift = 100 * sample(seed + 1, 3)
    moved = LeastEntropyLike(starts=starts + shift).fit(X, y + X @ shift)
    torch.testing.assert_close(moved.minima_ - shift, fit.minima_, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(moved.minima_entropy_, fit.minima_entropy_, rtol=1e-8, atol=1e-10)
    for c in (-3e6, 1e-7):
        scaled = LeastEntropyLike(starts=c * starts).fit(X, c * y)
        torch.testing.assert_close(scaled.minima_ / c, fit.minima_, rtol=1e-6, atol=1e-6)
    A = sample(seed + 2, 3, 3) + 3 * torch.eye(3)
    turned = LeastEntropyLike(starts=torch.linalg.solve(A, starts.T).T).fit(X @ A, y)
    torch.testing.assert_close(turned.minima_ @ A.T, fit.minima_, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_the_default_starts_are_equivariant_to_target_scale_and_sample_order(seed):
    X, y = problem(seed)
    fit = LeastEntropyLike().fit(X, y)
    torch.testing.assert_close(LeastEntropyLike().fit(X, -7 * y).coef_, -7 * fit.coef_, rtol=1e-8, atol=1e-8)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(seed))
    again = LeastEntropyLike().fit(X[order], y[order])
    torch.testing.assert_close(again.minima_, fit.minima_, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(again.weights_, fit.weights_[order], rtol=0, atol=0)


@pytest.mark.parametrize("seed", range(3))
def test_integer_weights_equal_repetition(seed):
    X, y = problem(seed)
    counts = torch.randint(0, 4, (60,), generator=torch.Generator().manual_seed(seed))
    again, weighted = (
        LeastEntropyLike().fit(X.repeat_interleave(counts, 0), y.repeat_interleave(counts)),
        LeastEntropyLike().fit(X, y, counts),
    )
    torch.testing.assert_close(weighted.minima_, again.minima_, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(weighted.minima_entropy_, again.minima_entropy_, rtol=1e-10, atol=0)


@pytest.mark.parametrize("weighted", [False, True])
def test_batch_equals_loop(weighted, monkeypatch):
    pairs = [problem(seed) for seed in range(5)]
    X, Y = torch.stack([p[0] for p in pairs]), torch.stack([p[1] for p in pairs])
    w = sample(9, 5, 60).abs() if weighted else None
    fit = LeastEntropyLike().fit(X.unsqueeze(-2), Y.unsqueeze(-1), w)
    assert fit.minima_.shape == (5, 3, 3)
    assert fit.weights_.shape == (5, 60, 1)
    assert fit.n_iter_.shape == fit.converged_.shape == fit.entropy_.shape == (5,)
    for i in range(5):
        reference = LeastEntropyLike().fit(X[i], Y[i], None if w is None else w[i])
        torch.testing.assert_close(fit.minima_[i], reference.minima_, rtol=1e-8, atol=1e-9)
        torch.testing.assert_close(fit.coef_[i], reference.coef_, rtol=1e-8, atol=1e-9)
    monkeypatch.setattr("mkc_torch.linear.least_entropy_like._CHUNK", 2000)
    parts = LeastEntropyLike().fit(X.unsqueeze(-2), Y.unsqueeze(-1), w)
    torch.testing.assert_close(parts.minima_, fit.minima_, rtol=1e-8, atol=1e-9)


def test_a_shared_design_equals_a_loop_over_targets():
    X, _ = problem(0)
    Y = torch.stack([X @ sample(i, 3) + sample(i + 9, 60) for i in range(4)])
    fit = LeastEntropyLike().fit(X, Y)
    for i in range(4):
        torch.testing.assert_close(fit.minima_[i], LeastEntropyLike().fit(X, Y[i]).minima_, rtol=1e-7, atol=1e-8)


def test_the_fit_is_equivariant_to_the_unit_of_each_channel():
    X = sample(10, 80, 2, 3)
    Y = X @ torch.arange(1.0, 4.0).double() + 0.1 * sample(11, 80, 2)
    Y[:8, 0] += 30.0
    Y[50:60, 1] -= 20.0
    fit = LeastEntropyLike().fit(X, Y)
    torch.testing.assert_close(fit.coef_, torch.arange(1.0, 4.0).double(), rtol=0, atol=0.1)
    assert float(fit.entropy_) == pytest.approx(float(entropy_like(Y - X @ fit.coef_, 0).mean()), rel=1e-10)
    units = torch.tensor([1.0, 1e5]).double()
    again = LeastEntropyLike(starts=fit.starts_).fit(X * units[:, None], Y * units)
    torch.testing.assert_close(again.coef_, fit.coef_, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(fit.predict(X), X @ fit.coef_, rtol=1e-12, atol=1e-12)


def test_the_fit_is_equivariant_to_column_scales():
    X, y = problem(12)
    size = torch.tensor([1e-8, 1.0, 1e8]).double()
    fit = LeastEntropyLike(starts=torch.ones(1, 3).double()).fit(X, y)
    again = LeastEntropyLike(starts=1 / size.unsqueeze(0)).fit(X * size, y)
    torch.testing.assert_close(again.coef_ * size, fit.coef_, rtol=1e-6, atol=1e-8)


def test_float32_agrees_with_float64():
    X, y = problem(13)
    single = LeastEntropyLike().fit(X.float(), y.float())
    assert single.coef_.dtype == single.minima_.dtype == single.entropy_.dtype == torch.float32
    torch.testing.assert_close(single.coef_.double(), LeastEntropyLike().fit(X, y).coef_, rtol=1e-4, atol=1e-4)


# no solution, or an exact solution


def test_an_exact_fit_equals_least_squares_with_entropy_zero():
    X = sample(14, 20, 3)
    beta = sample(15, 3)
    Y = torch.stack([X @ beta, X @ beta + sample(16, 20), torch.zeros(20).double()])
    fit = LeastEntropyLike().fit(X, Y)
    torch.testing.assert_close(fit.coef_[0], beta, rtol=1e-10, atol=1e-12)
    assert fit.entropy_[0] == 0 == fit.entropy_[2] != fit.entropy_[1]
    assert float(fit.coef_[2].abs().max()) == 0.0
    assert bool(fit.converged_.all())
    assert bool(torch.isfinite(fit.minima_).all())
    assert float(fit.weights_[0].min()) == 1.0


def test_outliers_of_weight_zero_leave_an_exact_fit():
    X = sample(14, 20, 3)
    beta, counts = sample(15, 3), torch.ones(20)
    y = X @ beta
    y[:6], counts[:6] = 1e3, 0.0
    fit = LeastEntropyLike().fit(X, y, counts)
    torch.testing.assert_close(fit.coef_, beta, rtol=1e-9, atol=1e-9)
    assert float(fit.entropy_) == 0.0


def test_a_channel_without_residuals_does_not_affect_the_others():
    X = torch.zeros(30, 2, 3).double()
    X[:, 0, :2], X[:, 1, 2] = sample(16, 30, 2), 1.0
    y = X[:, 0] @ torch.tensor([1.0, 2.0, 0.0]).double() + sample(17, 30)
    fit = LeastEntropyLike().fit(X, torch.stack([y, torch.full_like(y, 5.0)], 1))
    assert bool(torch.isfinite(fit.minima_).all())
    assert 0.0 <= float(fit.entropy_) <= 1.0


def test_a_single_outlier_leaves_an_exact_line():
    x = torch.arange(12.0, dtype=torch.float64)
    y = 3 - 2 * x
    y[4] = 1e3
    fit = LeastEntropyLike().fit(torch.stack([torch.ones_like(x), x], -1), y)
    torch.testing.assert_close(fit.coef_, torch.tensor([3.0, -2.0]).double(), rtol=0, atol=1e-6)
    assert float(fit.entropy_) < 1e-12
    assert fit.weights_[:, 0].tolist() == [1.0] * 4 + [0.0] + [1.0] * 7


def test_dependent_columns_few_samples_and_bad_options_are_refused():
    X, y = problem(17)
    with pytest.raises(RankDeficientError):
        LeastEntropyLike().fit(torch.cat([X, X[:, :1]], 1), y)
    with pytest.raises(ValueError, match=r"at least 5 .*3 coefficients.* got 4"):
        LeastEntropyLike().fit(X[:4], y[:4])
    with pytest.raises(ValueError, match=r"at least 5 .*3 coefficients.* got 4"):
        LeastEntropyLike().fit(X, y, (torch.arange(60) < 4).double())
    with pytest.raises(ValueError, match="count repetitions"):
        LeastEntropyLike().fit(X, y, torch.full((60,), 1 / 60).double())
    with pytest.raises(ValueError, match="finite"):
        LeastEntropyLike().fit(X, torch.where(torch.arange(60) == 3, math.nan, y))
    with pytest.raises(ValueError, match="`tol`"):
        LeastEntropyLike(tol=0.0)
    with pytest.raises(ValueError, match="`max_iter`"):
        LeastEntropyLike(max_iter=0)
    assert repr(LeastEntropyLike()) == "LeastEntropyLike(start=None, starts=None, tol=1e-12, max_iter=200)"
