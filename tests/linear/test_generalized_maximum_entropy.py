"""Generalised maximum entropy: comparison with SciPy, singular X, supports, refusals."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from mkc_torch.linear import GeneralizedMaximumEntropy, LeastSquares, Ridge
from tests.draws import normal as sample

POINTS = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0], dtype=torch.float64)


def primal(X: np.ndarray, y: np.ndarray, z: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, float]:
    """(35)-(38) by sequential quadratic programming over the probabilities."""
    N, n, l, k = *X.shape, z.shape[-1], v.shape[-1]  # noqa: E741 - the paper's name

    def split(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return u[: n * l].reshape(n, l), u[n * l :].reshape(N, k)

    def constraints(u: np.ndarray) -> np.ndarray:
        p, w = split(u)
        return np.concatenate([y - X @ (p * z).sum(1) - (w * v).sum(1), p.sum(1) - 1, w.sum(1) - 1])

    u = np.concatenate([np.full(n * l, 1 / l), np.full(N * k, 1 / k)])
    found = minimize(
        lambda u: float((u * np.log(u)).sum()),
        u,
        jac=lambda u: np.log(u) + 1,
        constraints={"type": "eq", "fun": constraints},
        bounds=[(1e-12, 1.0)] * u.size,
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert found.success, found.message
    return (split(found.x)[0] * z).sum(1), -found.fun


@pytest.mark.parametrize("rank_deficient", [False, True])
def test_the_fit_equals_constrained_optimisation_by_scipy(rank_deficient):
    X = sample(0, 6, 3)
    if rank_deficient:
        X[:, 2] = X[:, 0] - X[:, 1]
    y = X @ torch.tensor([1.0, -2.0, 0.5]).double() + 0.3 * sample(1, 6)
    z, v = 5 * POINTS, 3 * POINTS[::2]
    fit = GeneralizedMaximumEntropy(z, v).fit(X, y)
    coef, entropy = primal(X.numpy(), y.numpy(), z.expand(3, 5).numpy(), v.expand(6, 3).numpy())
    np.testing.assert_allclose(fit.coef_.numpy(), coef, rtol=0, atol=1e-5)
    assert float(fit.entropy_) == pytest.approx(entropy, abs=1e-8)


def test_the_solution_satisfies_the_constraints_and_is_stationary():
    X, y = sample(2, 40, 4), sample(3, 40)
    fit = GeneralizedMaximumEntropy(10.0, 8.0).fit(X, y)
    p, w = fit.probabilities_, fit.error_probabilities_[:, 0]
    torch.testing.assert_close(X @ fit.coef_ + fit.error_[:, 0], y, rtol=0, atol=1e-8)
    torch.testing.assert_close(p.sum(-1), torch.ones(4).double(), rtol=1e-12, atol=0)
    torch.testing.assert_close(w.sum(-1), torch.ones(40).double(), rtol=1e-12, atol=0)
    torch.testing.assert_close((p * 10 * POINTS).sum(-1), fit.coef_, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close((w * 8 * POINTS).sum(-1), fit.error_[:, 0], rtol=1e-12, atol=1e-12)
    # log w = -λ v + const and log p = -z Xᵀλ + const
    multiplier = -(torch.log(w[:, -1]) - torch.log(w[:, 0])) / 16
    tilt = -(torch.log(p[:, -1]) - torch.log(p[:, 0])) / 20
    torch.testing.assert_close(X.T @ multiplier, tilt, rtol=1e-7, atol=1e-9)
    total = -(p * p.log()).sum() - (w * w.log()).sum()
    assert float(fit.entropy_) == pytest.approx(float(total), rel=1e-12)


def test_wide_supports_equal_ridge_regression():
    # the entropy is quadratic near uniform distributions: variances c² / 2 and d² / 2 of the five points
    X, y = sample(4, 30, 3), sample(5, 30)
    c, d = 2e3, 1e4
    fit = GeneralizedMaximumEntropy(c, d).fit(X, y)
    torch.testing.assert_close(fit.coef_, Ridge(alpha=(d / c) ** 2).fit(X, y).coef_, rtol=1e-5, atol=1e-7)
    loose = GeneralizedMaximumEntropy(1e6, 30.0).fit(X, y)
    torch.testing.assert_close(loose.coef_, LeastSquares().fit(X, y).coef_, rtol=0, atol=0.01)


def test_columns_of_zeros_give_the_middle_of_the_supports():
    y = sample(6, 20)
    fit = GeneralizedMaximumEntropy(7.0).fit(torch.zeros(20, 3).double(), y - y.mean())
    assert float(fit.coef_.abs().max()) < 1e-12
    torch.testing.assert_close(fit.probabilities_, torch.full((3, 5), 0.2, dtype=torch.float64), rtol=1e-10, atol=0)
    shifted = GeneralizedMaximumEntropy(torch.tensor([0.0, 1.0, 5.0]).double()).fit(torch.zeros(20, 3).double(), y)
    torch.testing.assert_close(shifted.coef_, torch.full((3,), 2.0, dtype=torch.float64), rtol=1e-10, atol=0)


def test_equal_columns_share_a_coefficient_and_fewer_samples_than_coefficients_are_fitted():
    x = sample(7, 30, 1)
    fit = GeneralizedMaximumEntropy(10.0, 5.0).fit(torch.cat([x, x], 1), 3 * x[:, 0] + 0.1 * sample(8, 30))
    assert float(fit.coef_[0] - fit.coef_[1]) == pytest.approx(0.0, abs=1e-9)
    assert float(fit.coef_.sum()) == pytest.approx(3.0, abs=0.2)
    wide = GeneralizedMaximumEntropy(10.0, 1.0).fit(sample(9, 3, 8), sample(10, 3))
    assert wide.coef_.shape == (8,)
    assert bool(torch.isfinite(wide.coef_).all())


def test_supports_bound_the_coefficients():
    x = torch.linspace(1, 2, 25, dtype=torch.float64)
    fit = GeneralizedMaximumEntropy(torch.tensor([[0.0, 0.5, 1.0]]).double(), 50.0).fit(x.unsqueeze(1), 9 * x)
    assert 0.5 < float(fit.coef_) < 1.0


def test_scaling_the_target_and_the_supports_scales_the_fit():
    X, y = sample(11, 25, 3), sample(12, 25)
    z, v = torch.stack([1.0 * POINTS, 3.0 * POINTS, 10.0 * POINTS]), 4 * POINTS
    fit = GeneralizedMaximumEntropy(z, v).fit(X, y)
    scaled = GeneralizedMaximumEntropy(1e5 * z, 1e5 * v).fit(X, 1e5 * y)
    torch.testing.assert_close(scaled.coef_, 1e5 * fit.coef_, rtol=1e-8, atol=1e-6)
    size = torch.tensor([1e-4, 1.0, 1e4]).double()
    columns = GeneralizedMaximumEntropy(z / size.unsqueeze(1), v).fit(X * size, y)
    torch.testing.assert_close(columns.coef_ * size, fit.coef_, rtol=1e-8, atol=1e-10)
    default = GeneralizedMaximumEntropy(z).fit(X, y)
    again = GeneralizedMaximumEntropy(1e5 * z).fit(X, 1e5 * y)
    torch.testing.assert_close(again.coef_, 1e5 * default.coef_, rtol=1e-8, atol=1e-6)


def test_integer_weights_equal_repetition_and_the_order_of_samples_is_irrelevant():
    X, y = sample(13, 20, 2), sample(14, 20)
    counts = torch.randint(0, 4, (20,), generator=torch.Generator().manual_seed(0))
    fit = GeneralizedMaximumEntropy(5.0, 6.0).fit(X, y, counts)
    again = GeneralizedMaximumEntropy(5.0, 6.0).fit(X.repeat_interleave(counts, 0), y.repeat_interleave(counts))
    torch.testing.assert_close(fit.coef_, again.coef_, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(fit.entropy_, again.entropy_, rtol=1e-10, atol=0)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(1))
    turned = GeneralizedMaximumEntropy(5.0, 6.0).fit(X[order], y[order], counts[order])
    torch.testing.assert_close(turned.coef_, fit.coef_, rtol=1e-8, atol=1e-10)


def test_batch_equals_loop():
    X, Y = sample(15, 4, 25, 2, 3), sample(16, 4, 25, 2)
    d = torch.tensor([4.0, 8.0]).double().unsqueeze(1) * POINTS
    fit = GeneralizedMaximumEntropy(5.0, d).fit(X, Y)
    assert fit.error_.shape == fit.weights_.shape == (4, 25, 2)
    assert fit.probabilities_.shape == (4, 3, 5)
    assert fit.n_iter_.shape == fit.entropy_.shape == (4,)
    for i in range(4):
        reference = GeneralizedMaximumEntropy(5.0, d).fit(X[i], Y[i])
        torch.testing.assert_close(fit.coef_[i], reference.coef_, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(fit.predict(X)[2], X[2] @ fit.coef_[2], rtol=1e-12, atol=1e-12)


def test_float32_agrees_with_float64():
    X, y = sample(17, 30, 3), sample(18, 30)
    single = GeneralizedMaximumEntropy(5.0).fit(X.float(), y.float())
    assert single.coef_.dtype == torch.float32
    torch.testing.assert_close(
        single.coef_.double(), GeneralizedMaximumEntropy(5.0).fit(X, y).coef_, rtol=1e-5, atol=1e-6
    )


def test_infeasible_supports_are_refused_naming_the_sample():
    X, y = torch.ones(10, 1).double(), torch.ones(10).double()
    y[6] = 100.0
    with pytest.raises(ValueError, match=r"sample 6 .* widen"):
        GeneralizedMaximumEntropy(2.0, 5.0).fit(X, y)


@pytest.mark.parametrize("seed", [1, 3, 7, 8, 9, 12])
def test_errors_at_the_end_of_their_support_are_refused(seed):
    X = sample(seed, 10, 3)
    supports = torch.linspace(-10, 10, 5).double(), torch.linspace(-3, 3, 5).double()
    y = torch.full((10,), 3.0).double()
    with pytest.raises(ValueError, match=r"sample \d+ .*; widen `coef_support` or `error_support`"):
        GeneralizedMaximumEntropy(*supports).fit(X, y)
    wider = GeneralizedMaximumEntropy(supports[0], 2.0 * supports[1]).fit(X, y)
    torch.testing.assert_close(X @ wider.coef_ + wider.error_.squeeze(-1), y, rtol=0, atol=1e-8)


def test_bad_supports_data_and_options_are_refused():
    X, y = sample(19, 10, 2), sample(20, 10)
    for support in (0.0, math.inf, torch.ones(1), torch.ones(5), torch.tensor([0.0, math.nan])):
        with pytest.raises(ValueError, match="`coef_support`"):
            GeneralizedMaximumEntropy(support)
    with pytest.raises(ValueError, match="`coef_support` to broadcast"):
        GeneralizedMaximumEntropy(POINTS.expand(3, 5)).fit(X, y)
    with pytest.raises(ValueError, match="`error_support` to broadcast"):
        GeneralizedMaximumEntropy(1.0, POINTS.expand(3, 1, 5)).fit(X, y)
    with pytest.raises(ValueError, match="finite"):
        GeneralizedMaximumEntropy(1.0).fit(X, torch.full((10,), math.nan).double())
    for arguments in ({"tol": 0.0}, {"max_iter": 0}):
        with pytest.raises(ValueError, match=next(iter(arguments))):
            GeneralizedMaximumEntropy(1.0, **arguments)
