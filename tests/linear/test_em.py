"""MKC-EM: recovery, efficiency, its likelihood, the remarks of the paper, no collapse, equivariance."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import minimize
from torch import Tensor

from mkc_torch import fit_density
from mkc_torch.functional import mkc_nll
from mkc_torch.linear import FixedPointLinear, LeastAbsoluteDeviations, LeastSquares, MKCRegression, RankDeficientError
from mkc_torch.linear._problem import linear_problem
from mkc_torch.linear._robust_start import robust_start
from tests.draws import normal as sample
from tests.draws import uniform


def line(seed: int, N: int = 100, n: int = 3, share: float = 0.2) -> tuple[Tensor, Tensor]:
    """y = X 1 + 0.5 noise with a share of uniform errors on both sides."""
    X = torch.cat([torch.ones(N, 1).double(), sample(seed, N, n - 1)], 1)
    y = X.sum(-1) + 0.5 * sample(seed + 1, N)
    bad = int(share * N)
    y[:bad] = X[:bad].sum(-1) + 20.0 * (uniform(seed + 2, bad) - 0.5)
    return X, y


def channels(seed: int, N: int = 80) -> tuple[Tensor, Tensor]:
    """Two channels of 3 coefficients, the first with 20 % outliers."""
    X = sample(seed, N, 2, 3)
    Y = X.sum(-1) + torch.tensor([0.5, 2.0]).double() * sample(seed + 1, N, 2)
    bad = N // 5
    Y[:bad, 0] += 20.0 * (uniform(seed + 2, bad) - 0.5)
    return X, Y


def energy(e: np.ndarray, sigma: float, d: float) -> np.ndarray:
    z = e / d
    return 0.5 * z**2 if math.isinf(sigma) else -(sigma**2) * np.expm1(-(z**2) / (2 * sigma**2))


def log_density_sum(residual: np.ndarray, sigma: float, d: float, bound: float) -> float:
    """Sum of log p(e) of (17), the normaliser by adaptive quadrature."""
    width = d * np.array([0.5, 1, 2, 3, 4, 6, 8, 10])
    points = [p for p in width if p < bound]
    z = 0.0
    for low, high in zip([0.0, *points], [*points, bound], strict=True):
        z += 2.0 * quad(lambda e: float(np.exp(-energy(np.asarray(e), sigma, d))), low, high, epsabs=0, epsrel=1e-11)[0]
    return float(-energy(residual, sigma, d).sum() - len(residual) * math.log(z))


# Example 2 of the paper

CASES = [(1.0, 1.0), (0.8, 1.0), (1.0, 0.8), (0.8, 0.8), (0.8, 0.6), (0.6, 0.8)]


def example_2(case: int, draws: int) -> tuple[Tensor, Tensor, Tensor]:
    """X (100, 2, 2), Y (draws, 100, 2) and the mask of the values of the head."""
    p = torch.tensor(CASES[case - 1], dtype=torch.float64)
    x = 8.0 * torch.sin(0.04 * math.pi * torch.arange(1, 101, dtype=torch.float64))
    X = torch.stack([torch.ones(100).double(), x], -1).unsqueeze(-2).expand(100, 2, 2)
    head = torch.tensor([0.5, 1.0], dtype=torch.float64) * sample(case, draws, 100, 2)
    reach = torch.tensor([10.0, 20.0], dtype=torch.float64)
    share = uniform(case + 20, draws, 100, 2)
    if case == 5:
        tail = torch.tensor([100.0, 200.0]).double().sqrt() * sample(case + 10, draws, 100, 2)
    elif case == 6:
        tail = reach * share
    else:
        tail = reach * (2.0 * share - 1.0)
    good = uniform(case + 30, draws, 100, 2) < p
    return X, X.sum(-1) + torch.where(good, head, tail), good


def rms_error(coef: Tensor) -> float:
    return float((coef - 1.0).square().sum(-1).mean().sqrt())


def oracle(X: Tensor, Y: Tensor, good: Tensor) -> Tensor:
    """Weighted least squares on the values of the head with their true variances."""
    precision = torch.tensor([4.0, 1.0], dtype=torch.float64) * good
    gram = torch.einsum("bki,kin,kil->bnl", precision, X, X)
    return torch.linalg.solve(gram, torch.einsum("bki,kin,bki->bn", precision, X, Y))


@pytest.mark.parametrize("case", [1, 2, 3, 4, 5, 6])
def test_errors_in_example_2_of_the_paper_are_near_those_of_the_oracle(case):
    X, Y, good = example_2(case, 60)
    error = rms_error(MKCRegression().fit(X, Y).coef_)
    best = rms_error(oracle(X, Y, good))
    if case == 1:
        assert error < 1.03 * best
    else:
        wls = FixedPointLinear(sigma=math.inf, d=torch.tensor([1.0, 2.0]).double()).fit(X, Y).coef_
        # one-sided outliers overlap the head in case 6, and bias every symmetric density
        assert error < (1.6 if case == 6 else 1.35) * best
        assert error < (0.6 if case == 3 else 0.4) * rms_error(wls)
        assert error < rms_error(LeastAbsoluteDeviations().fit(X, Y).coef_)


@pytest.mark.parametrize("case", [1, 2])
def test_example_2_is_at_the_maximum_of_the_likelihood(case):
    X, Y, _ = example_2(case, 3)
    fit = MKCRegression().fit(X, Y)
    for i in range(3):
        assert likelihood_by_bfgs(X, Y[i], fit, i) <= float(fit.log_likelihood_[i]) + 1e-5


def likelihood_by_bfgs(X: Tensor, Y: Tensor, fit: MKCRegression, i: int | None = None) -> float:
    """Likelihood that BFGS reaches from the solution, jointly in θ and every channel's log σ and log d."""
    coef, sigma, d, bound = (
        getattr(fit, f)[i].numpy() if i is not None else getattr(fit, f).numpy()
        for f in ("coef_", "sigma_", "d_", "bound_")
    )
    m, n = Y.shape[-1], X.shape[-1]
    nodes, weights = np.polynomial.legendre.leggauss(60)
    edges = np.concatenate([[0.0], 0.5 ** np.arange(14, -1, -1.0)])
    u = (edges[:-1, None] + np.diff(edges)[:, None] * 0.5 * (nodes + 1)).ravel()
    w = (np.diff(edges)[:, None] * 0.5 * weights).ravel()
    x, y = X.numpy(), Y.numpy()
    spread = d.max() / np.abs(x).max((0, 1))

    def objective(p: np.ndarray) -> float:
        residual = y - x @ (coef + spread * p[:n])
        total = 0.0
        for k in range(m):
            s, e_d = math.exp(min(p[n + k], 15.0)), math.exp(p[n + m + k])
            z = 2 * bound[k] * (w * np.exp(-energy(bound[k] * u, s, e_d))).sum()
            total += energy(residual[:, k], s, e_d).sum() + len(y) * math.log(z)
        return total

    begin = np.concatenate([np.zeros(n), np.minimum(np.log(sigma), 8.0), np.log(d)])
    return -minimize(objective, begin, method="BFGS", options={"gtol": 1e-6, "maxiter": 60}).fun


# efficiency


@pytest.mark.e2e
def test_efficiency_on_gaussian_data_is_at_least_99_per_cent():
    X, noise = sample(0, 200, 4), sample(1, 1500, 200)
    fit = MKCRegression().fit(X, noise)
    ls = LeastSquares().fit(X, noise)
    assert float(ls.coef_.square().mean() / fit.coef_.square().mean()) >= 0.99


# the likelihood and its maximum


@pytest.mark.parametrize("seed", range(4))
def test_log_likelihood_is_the_sum_of_log_densities(seed):
    X, Y = channels(10 * seed)
    fit = MKCRegression().fit(X, Y)
    residual = (Y - X @ fit.coef_).numpy()
    expected = sum(
        log_density_sum(residual[:, k], float(fit.sigma_[k]), float(fit.d_[k]), float(fit.bound_[k])) for k in range(2)
    )
    assert float(fit.log_likelihood_) == pytest.approx(expected, rel=1e-10, abs=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_a_search_over_all_parameters_does_not_improve_the_likelihood(seed):
    X, Y = channels(10 * seed)
    fit = MKCRegression().fit(X, Y)
    assert bool(fit.converged_)
    assert likelihood_by_bfgs(X, Y, fit) <= float(fit.log_likelihood_) + 1e-5


def test_the_coefficients_satisfy_equation_15_at_the_learned_parameters():
    X, Y = channels(0)
    fit = MKCRegression().fit(X, Y)
    e = Y - X @ fit.coef_
    w = torch.exp(-(e**2) / (2 * fit.d_**2 * fit.sigma_**2))
    torch.testing.assert_close(fit.weights_, w, rtol=0, atol=1e-12)
    torch.testing.assert_close(LeastSquares().fit(X, Y, w / fit.d_**2).coef_, fit.coef_, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("start", ["lts", "s", "least_squares"])
def test_history_never_increases_and_ends_at_the_likelihood(start):
    X, Y = channels(0)
    fit = MKCRegression(start=start).fit(X, Y)
    assert bool((fit.history_.diff() <= 1e-12).all())
    assert len(fit.history_) == fit.n_iter_ + 1
    assert -80 * float(fit.history_[-1]) == pytest.approx(float(fit.log_likelihood_), abs=1e-6)


def test_convergence_is_reported():
    X, Y = channels(0)
    assert bool(MKCRegression().fit(X, Y).converged_)
    short = MKCRegression(max_iter=1, bound=40.0, start="least_squares").fit(X, Y)
    assert not bool(short.converged_)
    assert short.n_iter_ == 1


@pytest.mark.parametrize("start", ["lts", "least_squares"])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.45])
def test_a_converged_fit_is_optimal_in_sigma_and_d(start, share):
    X, e = sample(0, 300, 60, 1, 3), sample(1, 300, 60, 1)
    bad = int(share * 60)
    e[:, :bad] = 40.0 * (uniform(2, 300, bad, 1) - 0.5)
    Y = X.sum(-1) + e
    fit = MKCRegression(bound=40.0, start=start).fit(X, Y)
    assert float(fit.converged_.double().mean()) > 0.98
    residual = Y - torch.einsum("bkin,bn->bki", X, fit.coef_)
    above_floor = (fit.d_ > 0.3 * robust_start(linear_problem(X, Y), start).scale * (1 + 1e-9)).squeeze(-1)
    # steps of 1 % in either parameter, by the density written out
    here = mean_log_density(residual, fit.sigma_, fit.d_, 40.0)
    for by_sigma, by_d in ((1.01, 1.0), (0.99, 1.0), (1.0, 1.01), (1.0, 0.99)):
        there = mean_log_density(residual, by_sigma * fit.sigma_, by_d * fit.d_, 40.0)
        gain = 60 * (there - here)[fit.converged_ & (above_floor | (by_d >= 1.0))]
        assert float(gain.max()) < 1e-3, f"{int((gain > 1e-3).sum())} of {len(gain)} fits not at their optimum"


def mean_log_density(residual: Tensor, sigma: Tensor, d: Tensor, bound: float) -> Tensor:
    """Mean log-density of each of many one-channel fits, (B,), the normaliser by a dense rule."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    edges = np.concatenate([[0.0], 0.5 ** np.arange(14, -1, -1.0)])
    u = bound * torch.from_numpy((edges[:-1, None] + np.diff(edges)[:, None] * 0.5 * (nodes + 1)).ravel())
    w = bound * torch.from_numpy((np.diff(edges)[:, None] * weights).ravel())
    s = sigma.clamp(max=1e4)

    def values(e: Tensor) -> Tensor:
        return -(s**2) * torch.expm1(-((e / d) ** 2) / (2 * s**2))

    return -values(residual.squeeze(-1)).mean(-1) - torch.log((w * torch.exp(-values(u))).sum(-1))


def test_covariance_equals_that_of_the_fixed_point_at_the_learned_parameters():
    X, Y = channels(0)
    fit = MKCRegression().fit(X, Y)
    fixed = FixedPointLinear(sigma=fit.sigma_, d=fit.d_, start=fit.coef_).fit(X, Y)
    torch.testing.assert_close(fit.covariance_, fixed.covariance_, rtol=1e-4, atol=1e-9)


def test_standard_errors_equal_the_spread_of_repeated_experiments():
    X = torch.cat([torch.ones(150, 1).double(), sample(0, 150, 2)], 1)
    noise = torch.where(uniform(1, 300, 150) < 0.8, sample(2, 300, 150), 40.0 * (uniform(3, 300, 150) - 0.5))
    fit = MKCRegression().fit(X, X.sum(-1) + noise)
    spread = fit.coef_.T.cov().diagonal().sqrt()
    torch.testing.assert_close(fit.covariance_.median(0).values.diagonal().sqrt(), spread, rtol=0.15, atol=0)


# Remarks 6 and 7


def test_a_given_d_is_kept_and_sigma_is_learned():
    X, Y = channels(0)
    d = torch.tensor([0.5, 2.0], dtype=torch.float64)
    fit = MKCRegression(d=d).fit(X, Y)
    torch.testing.assert_close(fit.d_, d, rtol=1e-12, atol=0)
    residual = (Y - X @ fit.coef_).numpy()
    for k in range(2):
        s, b = float(fit.sigma_[k]), float(fit.bound_[k])
        here = log_density_sum(residual[:, k], s, float(d[k]), b)
        for other in (0.9 * s, 1.1 * s) if math.isfinite(s) else (5.0, 20.0):
            assert log_density_sum(residual[:, k], other, float(d[k]), b) <= here + 1e-8


def test_an_infinite_sigma_is_least_squares_with_learned_channel_weights():
    X, Y = channels(0)
    fit = MKCRegression(sigma=math.inf, bound=1e4).fit(X, Y)
    assert bool(torch.isinf(fit.sigma_).all())
    coef, d = LeastSquares().fit(X, Y).coef_, None
    for _ in range(500):  # the alternation of Remark 7, written out
        d = (Y - X @ coef).square().mean(0).sqrt()
        coef = LeastSquares().fit(X / d.unsqueeze(-1), Y / d).coef_
    torch.testing.assert_close(fit.coef_, coef, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(fit.d_, d, rtol=1e-4, atol=0)
    assert torch.equal(fit.weights_, torch.ones(80, 2).double())


def test_an_infinite_sigma_of_one_channel_is_least_squares_exactly():
    X, y = line(0)
    fit = MKCRegression(sigma=math.inf, bound=1e4).fit(X, y)
    torch.testing.assert_close(fit.coef_, LeastSquares().fit(X, y).coef_, rtol=1e-10, atol=1e-11)
    torch.testing.assert_close(fit.d_[0], (y - X @ fit.coef_).square().mean().sqrt(), rtol=1e-6, atol=0)


def test_given_sigma_and_d_give_the_coefficients_of_the_fixed_point():
    X, Y = channels(0)
    sigma, d = torch.tensor([1.5, 4.0]).double(), torch.tensor([0.5, 2.0]).double()
    fit = MKCRegression(sigma=sigma, d=d).fit(X, Y)
    torch.testing.assert_close(fit.sigma_, sigma, rtol=1e-12, atol=0)
    fixed = FixedPointLinear(sigma=sigma, d=d).fit(X, Y)
    torch.testing.assert_close(fit.coef_, fixed.coef_, rtol=1e-4, atol=1e-5)


def test_a_given_bound_is_kept_and_reported():
    X, Y = channels(0)
    bound = torch.tensor([50.0, 70.0], dtype=torch.float64)
    torch.testing.assert_close(MKCRegression(bound=bound).fit(X, Y).bound_, bound, rtol=1e-12, atol=0)
    assert float(MKCRegression(bound=33.0).fit(*line(0)).bound_) == pytest.approx(33.0, rel=1e-12)


def test_the_default_bound_covers_the_residuals():
    X, Y = channels(0)
    fit = MKCRegression().fit(X, Y)
    e = Y - X @ fit.coef_
    assert bool((fit.bound_ >= 0.49 * (e.amax(0) - e.amin(0))).all())
    assert bool((fit.bound_ >= 5.0 * fit.d_).all())


# where it could go wrong


@pytest.mark.e2e
def test_d_does_not_collapse_where_a_fit_interpolates():
    X, y = sample(0, 200, 20, 9), sample(1, 200, 20)
    X, y = X.unsqueeze(-2), y.unsqueeze(-1)
    fit = MKCRegression().fit(X, y)
    scale = robust_start(linear_problem(X, y)).scale
    assert bool((fit.d_ >= 0.3 * scale * (1 - 1e-9)).all())
    assert float(fit.coef_.abs().max()) < 20.0
    ls = LeastSquares().fit(X, y).coef_
    assert rms(fit.coef_) < 2.0 * rms(ls)


def rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


@pytest.mark.parametrize("seed", range(6))
def test_forty_per_cent_one_sided_outliers_do_not_trap_the_fit(seed):
    X = torch.cat([torch.ones(100, 1).double(), sample(10 * seed, 100, 1)], 1)
    y = X.sum(-1) + 0.5 * sample(10 * seed + 1, 100)
    y[:40] = X[:40].sum(-1) + 10.0 * uniform(10 * seed + 2, 40)
    fit = MKCRegression().fit(X, y)
    good = LeastSquares().fit(X[40:], y[40:]).coef_
    torch.testing.assert_close(fit.coef_, good, rtol=0, atol=0.3)
    assert float(fit.weights_[:40].mean()) < 0.25


def test_sigma_is_large_in_a_clean_and_small_in_a_contaminated_channel():
    X, Y, _ = example_2(2, 60)
    fit = MKCRegression().fit(X, Y)
    assert bool((fit.sigma_[:, 0] < 3.5).all())
    assert bool((fit.sigma_[:, 1] > fit.sigma_[:, 0]).all())
    assert float(torch.isinf(fit.sigma_[:, 1]).double().mean()) > 0.3
    # (σ, d) of the best density of 0.8 N(0, 0.25) + 0.2 U(-10, 10) are (2.07, 0.432)
    q = torch.special.ndtri((torch.arange(8000, dtype=torch.float64) + 0.5) / 8000)
    population = torch.cat([0.5 * q, torch.linspace(-10, 10, 2000, dtype=torch.float64)]).numpy()

    def expected(p: np.ndarray) -> float:
        return -log_density_sum(population, math.exp(p[0]), math.exp(p[1]), 10.0) / 10_000

    best = np.exp(minimize(expected, [0.7, -0.8], method="Nelder-Mead", options={"xatol": 1e-3}).x)
    assert float(fit.sigma_[:, 0].median()) == pytest.approx(best[0], rel=0.1)
    assert float(fit.d_[:, 0].median()) == pytest.approx(best[1], rel=0.1)
    assert float(fit.d_[:, 1].median()) == pytest.approx(1.0, rel=0.1)


def test_an_exact_fit_is_flagged_and_finite():
    X, _ = line(0)
    truth = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    y = X @ truth
    y[:30] += 10.0 + sample(5, 30)
    fit = MKCRegression().fit(X, y)
    assert bool(fit.exact_fit_)
    torch.testing.assert_close(fit.coef_, truth, rtol=1e-10, atol=1e-10)
    assert float(fit.weights_[:30].max()) < 1e-6
    assert float(fit.weights_[30:].min()) > 0.9
    for name in ("d_", "bound_", "log_likelihood_", "covariance_", "weights_"):
        assert bool(torch.isfinite(getattr(fit, name)).all()), name


def test_targets_that_are_all_fitted_exactly_give_finite_results():
    X, _ = line(0)
    for y in (X.sum(-1), torch.zeros(100).double()):
        fit = MKCRegression().fit(X, y)
        assert bool(fit.exact_fit_)
        torch.testing.assert_close(X @ fit.coef_, y, rtol=1e-9, atol=1e-9)
        assert bool(torch.isfinite(fit.log_likelihood_))
        assert bool(torch.isfinite(fit.covariance_).all())


def test_an_ordinary_fit_is_not_flagged_as_exact():
    assert not bool(MKCRegression().fit(*line(0)).exact_fit_)


def test_an_exactly_fitted_channel_determines_the_coefficients_of_a_noisy_channel():
    X, Y = channels(0)
    Y[:, 1] = X[:, 1].sum(-1)
    fit = MKCRegression().fit(X, Y)
    torch.testing.assert_close(fit.coef_, torch.ones(3).double(), rtol=0, atol=1e-8)
    for name in ("d_", "bound_", "log_likelihood_", "covariance_", "weights_"):
        assert bool(torch.isfinite(getattr(fit, name)).all()), name
    # the coefficients are known exactly, so the other channel is only a fit of its density
    residual = (Y - X @ fit.coef_)[:, :1]
    alone = fit_density(residual, bound=float(fit.bound_[0]))
    assert float(fit.d_[0]) == pytest.approx(float(alone.d), rel=1e-3)
    assert float(fit.sigma_[0]) == pytest.approx(float(alone.sigma), rel=1e-3)


def test_as_many_values_as_coefficients_give_finite_results():
    X, y = sample(0, 5, 5), sample(1, 5)
    fit = MKCRegression().fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.linalg.solve(X, y), rtol=1e-8, atol=1e-9)
    assert bool(torch.isfinite(fit.log_likelihood_))


# weights and forms of input


def test_integer_weights_equal_repetition():
    X, y = line(0, N=60)
    count = 1 + (torch.arange(60) % 2)
    fit = MKCRegression(bound=15.0).fit(X, y, count.double())
    repeated = MKCRegression(bound=15.0).fit(X.repeat_interleave(count, 0), y.repeat_interleave(count))
    torch.testing.assert_close(fit.coef_, repeated.coef_, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(fit.d_, repeated.d_, rtol=1e-4, atol=0)
    torch.testing.assert_close(fit.log_likelihood_, repeated.log_likelihood_, rtol=1e-7, atol=1e-6)


def test_weight_zero_equals_removal():
    X, y = line(0, N=60)
    junk_X, junk_y = 5.0 + sample(9, 40, 3), torch.full((40,), 1e4, dtype=torch.float64)
    weight = torch.cat([torch.ones(60), torch.zeros(40)]).double()
    fit = MKCRegression().fit(torch.cat([X, junk_X]), torch.cat([y, junk_y]), weight)
    alone = MKCRegression().fit(X, y)
    torch.testing.assert_close(fit.bound_, alone.bound_, rtol=1e-3, atol=0)
    torch.testing.assert_close(fit.coef_, alone.coef_, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(fit.d_, alone.d_, rtol=1e-2, atol=0)
    fixed = MKCRegression(bound=15.0).fit(torch.cat([X, junk_X]), torch.cat([y, junk_y]), weight)
    torch.testing.assert_close(fixed.log_likelihood_, MKCRegression(bound=15.0).fit(X, y).log_likelihood_)


def test_batch_equals_loop():
    problems = [channels(10 * s) for s in range(4)]
    X, Y = torch.stack([p[0] for p in problems]), torch.stack([p[1] for p in problems])
    fit = MKCRegression().fit(X.reshape(2, 2, 80, 2, 3), Y.reshape(2, 2, 80, 2))
    assert fit.coef_.shape == (2, 2, 3)
    assert fit.sigma_.shape == fit.d_.shape == fit.bound_.shape == (2, 2, 2)
    assert fit.log_likelihood_.shape == fit.converged_.shape == fit.exact_fit_.shape == (2, 2)
    assert fit.covariance_.shape == (2, 2, 3, 3)
    for i in range(4):
        alone = MKCRegression().fit(X[i], Y[i])
        a, b = divmod(i, 2)
        torch.testing.assert_close(fit.coef_[a, b], alone.coef_, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(fit.d_[a, b], alone.d_, rtol=1e-5, atol=0)
        torch.testing.assert_close(fit.log_likelihood_[a, b], alone.log_likelihood_, rtol=1e-9, atol=1e-7)


def test_a_shared_design_equals_a_loop_over_targets():
    X, y = line(0)
    Y = torch.stack([y, y.flip(0), 10.0 * y])
    fit = MKCRegression().fit(X, Y)
    assert fit.d_.shape == (3, 1)
    for i in range(3):
        torch.testing.assert_close(fit.coef_[i], MKCRegression().fit(X, Y[i]).coef_, rtol=1e-4, atol=1e-5)


@settings(derandomize=True, deadline=None, max_examples=8)
@given(exponent=st.integers(-9, 9), sign=st.sampled_from([-1.0, 1.0]))
def test_the_fit_is_equivariant_to_the_unit_of_the_targets(exponent, sign):
    X, Y = channels(0)
    factor = 10.0**exponent
    reference, other = MKCRegression().fit(X, Y), MKCRegression().fit(X, sign * factor * Y)
    torch.testing.assert_close(other.coef_, sign * factor * reference.coef_, rtol=1e-5, atol=0)
    torch.testing.assert_close(other.d_, factor * reference.d_, rtol=1e-5, atol=0)
    torch.testing.assert_close(other.bound_, factor * reference.bound_, rtol=1e-5, atol=0)
    torch.testing.assert_close(other.sigma_.pow(-2), reference.sigma_.pow(-2), rtol=1e-4, atol=1e-6)
    shifted = reference.log_likelihood_ - 160 * math.log(factor)
    torch.testing.assert_close(other.log_likelihood_, shifted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_the_fit_is_equivariant_to_the_unit_of_a_channel(factor):
    X, Y = channels(0)
    unit, bound = torch.tensor([1.0, factor]).double(), torch.tensor([10.0, 20.0]).double()
    reference = MKCRegression(bound=bound).fit(X, Y)
    other = MKCRegression(bound=bound * unit).fit(X * unit.unsqueeze(-1), Y * unit)
    torch.testing.assert_close(other.coef_, reference.coef_, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(other.d_, reference.d_ * unit, rtol=1e-5, atol=0)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_the_default_domain_is_nearly_equivariant_to_the_unit_of_a_channel(factor):
    X, Y = channels(0)
    unit = torch.tensor([1.0, factor]).double()
    reference, other = MKCRegression().fit(X, Y), MKCRegression().fit(X * unit.unsqueeze(-1), Y * unit)
    torch.testing.assert_close(other.bound_, reference.bound_ * unit, rtol=1e-2, atol=0)
    torch.testing.assert_close(other.coef_, reference.coef_, rtol=0, atol=1e-3)
    torch.testing.assert_close(other.d_, reference.d_ * unit, rtol=1e-3, atol=0)


def test_the_fit_is_equivariant_to_column_scales_and_regression_shifts():
    X, y = line(0, n=4)
    factor, shift = torch.tensor([1e-8, 1.0, 1e3, 1e8], dtype=torch.float64), sample(7, 4)
    reference = MKCRegression().fit(X, y)
    other = MKCRegression().fit(X * factor, y)
    torch.testing.assert_close(other.coef_ * factor, reference.coef_, rtol=1e-5, atol=1e-6)
    moved = MKCRegression().fit(X, y + X @ shift)
    torch.testing.assert_close(moved.coef_, reference.coef_ + shift, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(moved.d_, reference.d_, rtol=1e-5, atol=0)


def test_float32_stays_float32():
    X, Y = channels(0)
    fit, exact = MKCRegression().fit(X.float(), Y.float()), MKCRegression().fit(X, Y)
    for name in ("coef_", "sigma_", "d_", "bound_", "log_likelihood_", "weights_", "covariance_", "history_"):
        assert getattr(fit, name).dtype == torch.float32
    assert bool(fit.converged_)
    torch.testing.assert_close(fit.coef_.double(), exact.coef_, rtol=0, atol=5e-3)
    torch.testing.assert_close(fit.d_.double(), exact.d_, rtol=2e-2, atol=0)


def test_results_of_one_channel_have_a_channel_dimension_of_size_one():
    fit = MKCRegression().fit(*line(0))
    assert fit.sigma_.shape == fit.d_.shape == fit.bound_.shape == (1,)
    assert fit.weights_.shape == (100, 1)
    assert fit.coef_.shape == fit.covariance_.shape[:1]
    assert fit.log_likelihood_.shape == ()


# errors


@pytest.mark.parametrize("name", ["sigma", "d", "bound"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_parameters_that_are_not_positive_are_refused(name, value):
    with pytest.raises(ValueError, match=f"`{name}`"):
        MKCRegression(**{name: value}).fit(*channels(0))


@pytest.mark.parametrize("name", ["d", "bound"])
def test_infinite_parameters_other_than_sigma_are_refused(name):
    with pytest.raises(ValueError, match=f"`{name}`"):
        MKCRegression(**{name: math.inf}).fit(*channels(0))


@pytest.mark.parametrize(("argument", "value"), [("start", "ols"), ("covariance", "iid"), ("max_iter", 0)])
def test_unknown_options_are_refused(argument, value):
    with pytest.raises(ValueError, match=f"`{argument}`"):
        MKCRegression(**{argument: value}).fit(*channels(0))


def test_dependent_columns_are_refused():
    X, y = line(0)
    with pytest.raises(RankDeficientError, match="linearly dependent"):
        MKCRegression().fit(torch.cat([X, X[:, :1]], 1), y)


def test_fewer_values_than_coefficients_are_refused():
    with pytest.raises(ValueError, match="at least 4 values"):
        MKCRegression().fit(sample(0, 3, 4), sample(1, 3))


def test_results_of_a_batched_fit_are_valid_parameters():
    generator = torch.Generator().manual_seed(0)
    X = torch.randn(50, 2, generator=generator, dtype=torch.float64)
    Y = X.sum(-1) + 0.1 * torch.randn(3, 50, generator=generator, dtype=torch.float64)
    first = MKCRegression().fit(X, Y)
    second = MKCRegression(bound=first.bound_, start=first.coef_).fit(X, Y)
    torch.testing.assert_close(second.bound_, first.bound_)
    torch.testing.assert_close(second.log_likelihood_, first.log_likelihood_, rtol=0, atol=1e-6)


@pytest.mark.parametrize("start", [torch.full((2,), math.nan), torch.zeros(3), torch.tensor(1.0)])
def test_a_start_of_invalid_coefficients_is_refused(start):
    X, y = torch.randn(20, 2).double(), torch.randn(20).double()
    with pytest.raises(ValueError, match=r"`start` to be (2 )?finite coefficients"):
        MKCRegression(start=start).fit(X, y)


def test_a_domain_too_narrow_for_the_residuals_is_refused():
    X, y = torch.ones(50, 1).double(), torch.linspace(-1, 1, 50).double()
    with pytest.raises(ValueError, match=r"`bound` .*two robust scales.* 1\.\d+, .*got 0\.1"):
        MKCRegression(bound=0.1).fit(X, y)


@pytest.mark.parametrize(("dtype", "unit"), [(torch.float64, 1e200), (torch.float64, 1e-200), (torch.float32, 1e19)])
def test_a_unit_that_overflows_is_refused(dtype, unit):
    X, y = torch.ones(50, 1, dtype=dtype), unit * torch.linspace(-1, 1, 50, dtype=dtype)
    with pytest.raises(ValueError, match=r"`Y` of a magnitude between .* choose another unit"):
        MKCRegression().fit(X, y)


def test_the_likelihood_is_never_below_that_of_a_gaussian_at_least_squares():
    generator = torch.Generator().manual_seed(0)
    X = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    Y = torch.randn(300, 20, generator=generator, dtype=torch.float64)
    fit = MKCRegression().fit(X, Y)
    residual = Y - LeastSquares().fit(X, Y).predict(X)
    d = residual.square().mean(-1, keepdim=True).sqrt()
    gaussian = -mkc_nll(residual, math.inf, d, fit.bound_).sum(-1)
    assert float((fit.log_likelihood_ - gaussian).min()) > -1e-9


def test_a_weight_of_two_equals_two_samples_at_the_lower_limit_of_d():
    """The lower limit of d is a share of a robust scale, whose small-sample factor depends on the number of samples."""
    apart = []
    for seed in (0, 6, 8, 13, 20, 32):
        X = torch.cat([torch.ones(20, 1).double(), sample(seed, 20, 2)], 1)
        y = X.sum(-1) + 0.1 * sample(seed + 1, 20)
        y[::5] += 5.0 + sample(seed + 2, 4)
        count = 1 + torch.arange(20) % 2
        weighted = MKCRegression(bound=8.0).fit(X, y, count.double())
        repeated = MKCRegression(bound=8.0).fit(X.repeat_interleave(count, 0), y.repeat_interleave(count))
        apart.append(float((weighted.d_ / repeated.d_ - 1.0).abs()))
    # the start's coverage, a share of the samples, still differs a little
    assert sorted(apart)[3] < 1e-6
    assert max(apart) < 0.06
