"""Minimum-entropy regression: the objective, its derivatives and minimum, location, equivariance, refusals."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from mkc_torch.linear import LeastSquares, MinimumEntropy, RankDeficientError
from mkc_torch.linear import minimum_entropy as module
from mkc_torch.linear._problem import linear_problem
from tests.draws import normal as sample

KINDS = [(e, s) for e in ("shannon", "renyi") for s in ("median", "symmetric")]


def line(seed: int, N: int = 80, share: float = 0.25) -> tuple[Tensor, Tensor]:
    X = torch.cat([torch.ones(N, 1).double(), sample(seed, N, 2)], 1)
    y = X @ torch.tensor([1.0, 2.0, -1.0]).double() + 0.1 * sample(seed + 1, N)
    bad = int(share * N)
    y[:bad] += 6.0 + sample(seed + 2, bad)
    return X, y


def entropy(r: Tensor, h: Tensor, kind: str, location: str, w: Tensor | None = None) -> Tensor:
    """Entropy of one channel's residuals, all pairs at once; Rényi's as the integral of the squared density."""
    w = torch.ones_like(r) if w is None else w
    w = w / w.sum()
    if location == "symmetric":
        points, mass = torch.cat([r, -r]), torch.cat([w, w]) / 2
    else:
        points, mass = r, w
    width = h if kind == "shannon" else h * math.sqrt(2.0)
    kernel = torch.distributions.Normal(0.0, 1.0)
    density = (mass * torch.exp(kernel.log_prob((r[:, None] - points) / width)) / width).sum(-1)
    return -(w * density.log()).sum() if kind == "shannon" else -(w * density).sum().log()


@pytest.mark.parametrize("pairs", [1 << 18, 60])
@pytest.mark.parametrize(("kind", "location"), KINDS)
def test_derivatives_equal_automatic_differentiation(kind, location, pairs, monkeypatch):
    monkeypatch.setattr(module, "_PAIRS", pairs)
    X, Y, w = sample(0, 3, 20, 2, 3), sample(1, 3, 20, 2), sample(2, 3, 20, 2).abs() + 0.1
    p, h, beta = linear_problem(X, Y, w), sample(3, 3, 2).abs() + 0.3, sample(4, 3, 3)
    kernel = module._Kernel(p, h, torch.eye(3).double().unsqueeze(0), kind, location == "symmetric")
    found = kernel.quadratic(beta, torch.arange(3))
    value, density = kernel.at(beta)
    torch.testing.assert_close(value, found.value, rtol=1e-12, atol=0)
    assert density.shape == (3, 20, 2)
    for i in range(3):

        def total(b: Tensor, i: int = i) -> Tensor:
            r = Y[i] - p.basis[i] @ b
            parts = [entropy(r[:, c], h[i, c], kind, location, w[i, :, c]) for c in range(2)]
            return parts[0] + parts[1]

        torch.testing.assert_close(found.value[i], total(beta[i]), rtol=1e-12, atol=0)
        torch.testing.assert_close(found.gradient[i], torch.func.grad(total)(beta[i]), rtol=1e-9, atol=1e-11)
        hessian = torch.func.jacrev(torch.func.grad(total))(beta[i])
        torch.testing.assert_close(found.hessian[i], hessian, rtol=1e-8, atol=1e-10)


def test_renyi_entropy_is_the_integral_of_the_squared_density():
    X, y = line(5)
    fit = MinimumEntropy("renyi").fit(X, y)
    r, h = y - X @ fit.coef_, float(fit.bandwidth_)
    grid = torch.linspace(float(r.min()) - 8 * h, float(r.max()) + 8 * h, 200_001, dtype=torch.float64)
    density = sum(torch.exp(-0.5 * ((grid - v) / h) ** 2) for v in r.tolist()) / (80 * h * math.sqrt(2 * math.pi))
    assert float(fit.entropy_) == pytest.approx(-math.log(float(torch.trapezoid(density**2, grid))), rel=1e-9)


@pytest.mark.parametrize(("kind", "location"), KINDS)
def test_scipy_finds_the_same_minimum(kind, location):
    X, y = line(6)
    fit = MinimumEntropy(kind, location=location).fit(X, y)
    assert bool(fit.converged_)

    def h(theta: np.ndarray) -> float:
        return float(entropy(y - X @ torch.from_numpy(theta), fit.bandwidth_[0], kind, location))

    found = minimize(
        h, fit.coef_.numpy(), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-14, "maxiter": 3000}
    )
    assert float(fit.entropy_) == pytest.approx(h(fit.coef_.numpy()), abs=1e-10)
    assert found.fun >= float(fit.entropy_) - 1e-10
    first = 0 if location == "symmetric" else 1  # the entropy does not depend on the intercept
    np.testing.assert_allclose(found.x[first:], fit.coef_.numpy()[first:], rtol=0, atol=1e-5)


def test_the_scale_of_weights_is_irrelevant_and_weight_zero_equals_removal():
    X, Y = sample(1, 40, 2, 3), sample(2, 40, 2)
    X[..., 0] = 1.0
    kept = MinimumEntropy(bandwidth=0.5).fit(X[:30], Y[:30])
    weight = torch.cat([torch.full((30, 2), 0.01), torch.zeros(10, 2)]).double()
    fit = MinimumEntropy(bandwidth=0.5).fit(X, Y, weight)
    torch.testing.assert_close(fit.coef_, kept.coef_, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(fit.entropy_, kept.entropy_)


@pytest.mark.parametrize(("kind", "location"), KINDS)
def test_outliers_have_small_weights_and_influence(kind, location):
    X, y = line(7)
    truth = torch.tensor([1.0, 2.0, -1.0]).double()
    fit = MinimumEntropy(kind, location=location).fit(X, y)
    assert float((fit.coef_ - truth)[1:].abs().max()) < 0.1
    assert float((fit.coef_ - truth)[0].abs()) < (
        0.1 if location == "symmetric" else 0.4
    )  # a median is shifted by a quarter
    assert float((LeastSquares().fit(X, y).coef_ - truth).norm()) > 1.0
    assert float(fit.weights_[:20].max()) < 0.2
    assert float(fit.weights_.max()) == 1.0


def test_residuals_have_median_zero_for_any_columns_that_span_the_constant():
    X, y = line(8)
    fit = MinimumEntropy().fit(X, y)
    assert float((y - X @ fit.coef_).quantile(0.5).abs()) < 1e-12
    turned = X @ torch.tensor([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.3, 2.0]]).double()
    again = MinimumEntropy().fit(turned, y)
    assert float((y - turned @ again.coef_).quantile(0.5).abs()) < 1e-12
    torch.testing.assert_close(turned @ again.coef_, X @ fit.coef_, rtol=1e-5, atol=1e-6)
    w = sample(9, 80).abs()
    weighted = MinimumEntropy().fit(X, y, w)
    r = y - X @ weighted.coef_
    assert float((w * torch.sign(r)).sum().abs()) <= float(w.max())


def test_without_a_constant_column_the_location_is_free_and_symmetry_fixes_it():
    x = sample(10, 200)
    y = 2 * x + 5 + 0.1 * sample(11, 200)
    free = MinimumEntropy().fit(x.unsqueeze(1), y)
    assert float(free.coef_) == pytest.approx(2.0, abs=0.05)
    X, y = sample(12, 200, 1), sample(13, 200)
    fit = MinimumEntropy(location="symmetric").fit(X, 3 * X[:, 0] + 0.1 * y)
    assert float(fit.coef_) == pytest.approx(3.0, abs=0.05)


def test_efficiency_on_gaussian_data_is_at_least_one_half():
    X = torch.cat([torch.ones(100, 1).double(), sample(14, 100, 1)], 1)
    Y = sample(15, 30, 100)
    fit, ls = MinimumEntropy(location="symmetric").fit(X, Y), LeastSquares().fit(X, Y)
    assert float(fit.coef_.square().mean()) < 2.0 * float(ls.coef_.square().mean())
    assert bool(fit.converged_.all())


@pytest.mark.parametrize(("kind", "location"), KINDS)
def test_regression_scale_and_affine_equivariance(kind, location):
    X, y = line(16)
    fit = MinimumEntropy(kind, location=location).fit(X, y)
    shift = torch.tensor([100.0, -30.0, 5.0]).double()
    moved = MinimumEntropy(kind, location=location).fit(X, y + X @ shift)
    torch.testing.assert_close(moved.coef_ - shift, fit.coef_, rtol=1e-6, atol=1e-6)
    scaled = MinimumEntropy(kind, location=location).fit(X, 1e4 * y)
    torch.testing.assert_close(scaled.coef_ / 1e4, fit.coef_, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(scaled.entropy_ - math.log(1e4), fit.entropy_, rtol=1e-8, atol=1e-8)
    A = torch.tensor([[1.0, 2.0, 0.0], [0.0, 1e3, 1.0], [0.0, 0.0, 1e-3]]).double()
    turned = MinimumEntropy(kind, location=location).fit(X @ A, y)
    torch.testing.assert_close(A @ turned.coef_, fit.coef_, rtol=1e-5, atol=1e-5)


def test_integer_weights_equal_repetition():
    X, y = line(17)
    counts = torch.randint(0, 4, (80,), generator=torch.Generator().manual_seed(0))
    start, h = torch.tensor([1.0, 2.0, -1.0]).double(), 0.1
    again = MinimumEntropy(start=start, bandwidth=h).fit(X.repeat_interleave(counts, 0), y.repeat_interleave(counts))
    fit = MinimumEntropy(start=start, bandwidth=h).fit(X, y, counts)
    torch.testing.assert_close(fit.coef_[1:], again.coef_[1:], rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(fit.entropy_, again.entropy_, rtol=1e-9, atol=1e-9)


def test_batch_equals_loop_and_the_order_of_samples_is_irrelevant():
    pairs = [line(s) for s in range(3)]
    X, Y = torch.stack([p[0] for p in pairs]).unsqueeze(-2), torch.stack([p[1] for p in pairs]).unsqueeze(-1)
    start = torch.tensor([1.0, 2.0, -1.0]).double()
    fit = MinimumEntropy(start=start).fit(X, Y)
    assert fit.weights_.shape == (3, 80, 1)
    assert fit.bandwidth_.shape == (3, 1)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    for i, (x, y) in enumerate(pairs):
        reference = MinimumEntropy(start=start).fit(x[order], y[order])
        torch.testing.assert_close(fit.coef_[i], reference.coef_, rtol=1e-6, atol=1e-7)


def test_channels_share_their_coefficients():
    X = sample(18, 60, 2, 2)
    Y = X @ torch.tensor([1.0, -2.0]).double() + torch.tensor([0.1, 10.0]).double() * sample(19, 60, 2)
    Y[:10, 0] += 40.0
    fit = MinimumEntropy(location="symmetric").fit(X, Y)
    torch.testing.assert_close(fit.coef_, torch.tensor([1.0, -2.0]).double(), rtol=0, atol=0.1)
    assert fit.bandwidth_.shape == (2,)


def test_float32_agrees_with_float64():
    X, y = line(20)
    single = MinimumEntropy().fit(X.float(), y.float())
    assert single.coef_.dtype == single.entropy_.dtype == torch.float32
    torch.testing.assert_close(single.coef_.double(), MinimumEntropy().fit(X, y).coef_, rtol=1e-3, atol=1e-3)


def test_an_exact_fit_keeps_the_robust_start():
    X, _ = line(21)
    y = X @ torch.tensor([1.0, 2.0, 3.0]).double()
    y[:20] += 7.0
    fit = MinimumEntropy().fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.tensor([1.0, 2.0, 3.0]).double(), rtol=1e-9, atol=1e-9)
    assert float(fit.entropy_) == -math.inf
    assert bool(fit.converged_)
    assert bool(torch.isfinite(fit.weights_).all())


def test_dependent_columns_few_samples_and_bad_options_are_refused():
    X, y = line(22)
    with pytest.raises(RankDeficientError):
        MinimumEntropy().fit(torch.cat([X, X[:, :1]], 1), y)
    with pytest.raises(ValueError, match="finite"):
        MinimumEntropy().fit(X, torch.where(torch.arange(80) == 3, math.nan, y))
    with pytest.raises(ValueError, match="at least 3 values"):
        MinimumEntropy().fit(X[:2], y[:2])
    for arguments in ({"entropy": "gibbs"}, {"location": "mean"}, {"bandwidth": 0.0}, {"max_iter": 0}):
        with pytest.raises(ValueError, match=next(iter(arguments))):
            MinimumEntropy(**arguments)
    with pytest.raises(ValueError, match="bandwidth"):
        MinimumEntropy(bandwidth=torch.ones(3)).fit(X, y)
