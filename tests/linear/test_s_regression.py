"""S-regression: the published scales, the equation of the M-scale, the optimum, breakdown, equivariance."""

import itertools

import numpy as np
import pytest
import torch
from scipy.optimize import brentq, minimize
from torch import Tensor

from mkc_torch.linear import LeastSquares, SRegression
from mkc_torch.linear._problem import linear_problem
from mkc_torch.linear._psi import BISQUARE_50, bisquare_for_breakdown, bisquare_rho, tukey_weight
from mkc_torch.linear.s_regression import MScale, starts_worth_drawing
from tests.draws import normal as sample
from tests.literature import DATA_SETS, REFERENCE

WITH_SCALE = [n for n in REFERENCE if REFERENCE[n].mm is not None]


def contaminated_line(seed: int, N: int = 40, n: int = 3, share: float = 0.3) -> tuple[Tensor, Tensor]:
    X = torch.cat([torch.ones(N, 1).double(), sample(seed, N, n - 1)], 1)
    y = X.sum(-1) + 0.1 * sample(seed + 1, N)
    y[: int(share * N)] += 10.0 + sample(seed + 2, int(share * N))
    return X, y


def m_scale(residual: np.ndarray, p: int, weight: np.ndarray | None = None) -> float:
    """The root of sum ρ(r / (c s)) = (N - p) / 2, by bisection."""
    w = np.ones_like(residual) if weight is None else weight

    def excess(log_s: float) -> float:
        u = np.minimum(np.abs(residual) / (1.547644980928226 * np.exp(log_s)), 1.0)
        return float((w * (3 * u**2 - 3 * u**4 + u**6)).sum() - 0.5 * (w.sum() - p))

    top = np.log(np.abs(residual).max())
    return float(np.exp(brentq(excess, top - 40, top + 5, xtol=1e-14)))


# published and computed optima


@pytest.mark.parametrize("name", WITH_SCALE)
def test_the_published_scale_is_found(name):
    X, y = DATA_SETS[name]()
    fit = SRegression().fit(X, y)
    assert float(fit.scale_) == pytest.approx(REFERENCE[name].mm.scale, rel=1e-5)
    assert bool(fit.converged_)


@pytest.mark.parametrize("name", DATA_SETS)
def test_the_scale_solves_its_equation_and_no_simplex_search_lowers_it(name):
    X, y = DATA_SETS[name]()
    fit = SRegression().fit(X, y)
    n = X.shape[1]
    assert float(fit.scale_) == pytest.approx(m_scale((y - X @ fit.coef_).numpy(), n), rel=1e-9)
    Q, R = np.linalg.qr(X.numpy())
    found = minimize(
        lambda b: m_scale(y.numpy() - Q @ b, n),
        R @ fit.coef_.numpy(),
        method="Nelder-Mead",
        options={"maxiter": 300, "xatol": 1e-9, "fatol": 1e-12},
    )
    assert found.fun >= float(fit.scale_) * (1 - 1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_the_optimum_equals_that_of_descents_from_all_elemental_sets(seed):
    X, y = sample(seed, 12, 2), sample(seed + 100, 12) * torch.exp(sample(seed + 200, 12))
    best = np.inf
    starts = []
    for pair in itertools.combinations(range(12), 2):
        coef = torch.linalg.solve(X[list(pair)], y[list(pair)]).numpy()
        starts.append((m_scale((y.numpy() - X.numpy() @ coef), 2), coef))
    starts.sort(key=lambda s: s[0])
    for _, coef in starts[:12]:
        found = minimize(
            lambda b: m_scale(y.numpy() - X.numpy() @ b, 2),
            coef,
            method="Nelder-Mead",
            options={"xatol": 1e-8, "fatol": 1e-11},
        )
        best = min(best, found.fun)
    fit = SRegression().fit(X, y)
    assert float(fit.scale_) <= best * (1 + 1e-7)
    assert float(fit.scale_) == pytest.approx(m_scale((y - X @ fit.coef_).numpy(), 2), rel=1e-9)


def test_the_solution_is_a_fixed_point_of_its_own_weights():
    X, y = contaminated_line(0)
    fit = SRegression().fit(X, y)
    u = ((y - X @ fit.coef_) / (1.547644980928226 * fit.scale_)).clamp(-1, 1)
    weight = (1 - u**2) ** 2
    torch.testing.assert_close(fit.weights_[:, 0], weight, rtol=0, atol=1e-10)
    torch.testing.assert_close(
        LeastSquares().fit(X, y, weight.clamp(min=1e-300)).coef_, fit.coef_, rtol=1e-5, atol=1e-6
    )


def test_scale_of_gaussian_residuals_is_their_standard_deviation():
    fit = SRegression(starts=20).fit(torch.ones(20_000, 1).double(), 3.0 * sample(0, 20_000))
    assert float(fit.scale_) == pytest.approx(3.0, rel=0.02)


def test_rho_and_weight_of_the_bisquare():
    u = torch.linspace(-1.5, 1.5, 31, dtype=torch.float64)
    inside = u.abs() <= 1
    expected = torch.where(inside, 3 * u**2 - 3 * u**4 + u**6, 1.0)
    torch.testing.assert_close(bisquare_rho(u), expected)
    leaf = u.clone().requires_grad_()
    (slope,) = torch.autograd.grad(bisquare_rho(leaf).sum(), leaf)
    torch.testing.assert_close(6.0 * u * tukey_weight(u, 1.0) * inside, slope)
    assert abs(BISQUARE_50 - 1.547645) < 1e-7


@pytest.mark.parametrize("share", [0.0, 0.4, 0.49])
def test_the_m_scale_of_any_residuals_solves_its_equation(share):
    residual = sample(0, 50)
    residual[: int(share * 50)] *= 1e6
    residual[25:30] = 0.0
    problem = linear_problem(torch.ones(50, 1).double(), residual)
    got = MScale(60).scale(problem, residual.reshape(1, 1, 50, 1))
    assert float(got) == pytest.approx(m_scale(residual.numpy(), 1), rel=1e-10)


# weights


def test_integer_weights_equal_repetition_up_to_the_degrees_of_freedom():
    X, y = contaminated_line(0)
    count = 1 + (torch.arange(40) % 2)
    fit = SRegression().fit(X, y, count.double())
    repeated = SRegression().fit(X.repeat_interleave(count, 0), y.repeat_interleave(count))
    torch.testing.assert_close(fit.coef_, repeated.coef_, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(fit.scale_, repeated.scale_, rtol=1e-8, atol=0)


def test_weight_zero_equals_removal():
    X, y = contaminated_line(0, 30)
    junk_X, junk_y = 5.0 + sample(9, 20, 3), torch.full((20,), 1e3, dtype=torch.float64)
    weight = torch.cat([torch.ones(30), torch.zeros(20)]).double()
    fit = SRegression().fit(torch.cat([X, junk_X]), torch.cat([y, junk_y]), weight)
    alone = SRegression().fit(X, y)
    torch.testing.assert_close(fit.coef_, alone.coef_, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(fit.scale_, alone.scale_, rtol=1e-8, atol=0)


# equivariance


def test_the_fit_is_equivariant_to_column_scales():
    X, y = contaminated_line(0)
    factor = torch.tensor([1e-8, 1.0, 1e8], dtype=torch.float64)
    coef = SRegression().fit(X, y).coef_
    torch.testing.assert_close(SRegression().fit(X * factor, y).coef_ * factor, coef, rtol=1e-6, atol=1e-7)


# breakdown and exact fits


def test_an_exact_fit_is_found_with_forty_per_cent_outliers():
    X = torch.cat([torch.ones(50, 1).double(), sample(0, 50, 2)], 1)
    y = X @ torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    y[:20] = 50.0 + sample(1, 20)
    fit = SRegression().fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64), rtol=1e-12, atol=1e-12)
    assert float(fit.scale_) < 1e-12
    assert bool(torch.isfinite(fit.weights_).all())


# channels


def two_channels(seed: int, factor: float) -> tuple[Tensor, Tensor]:
    X = torch.stack([torch.cat([torch.ones(60, 1).double(), sample(seed + k, 60, 1)], 1) for k in range(2)], -2)
    Y = X.sum(-1) + 0.1 * sample(seed + 2, 60, 2)
    Y[:20, 0] += 9.0
    Y[30:55, 1] -= 7.0
    unit = torch.tensor([1.0, factor], dtype=torch.float64)
    return X * unit.unsqueeze(-1), Y * unit


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_the_fit_is_equivariant_to_the_unit_of_a_channel(factor):
    reference, other = SRegression().fit(*two_channels(0, 1.0)), SRegression().fit(*two_channels(0, factor))
    torch.testing.assert_close(other.coef_, reference.coef_, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(other.scale_, reference.scale_ * torch.tensor([1.0, factor]).double(), rtol=1e-6, atol=0)
    torch.testing.assert_close(reference.coef_, torch.ones(2).double(), rtol=0, atol=0.1)


def test_the_product_of_the_channels_scales_is_minimal():
    X, Y = two_channels(0, 1.0)
    fit = SRegression().fit(X, Y)

    def product(coef: np.ndarray) -> float:
        residual = (Y - X @ torch.from_numpy(coef)).numpy()
        return m_scale(residual[:, 0], 1) * m_scale(residual[:, 1], 1)

    at = fit.coef_.numpy()
    assert float(fit.scale_.prod()) == pytest.approx(product(at), rel=1e-9)
    found = minimize(product, at, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-13})
    assert found.fun >= product(at) * (1 - 1e-7)


def test_a_channel_fitted_exactly_does_not_hide_the_others():
    X, Y = two_channels(0, 1.0)
    Y[:, 0] = X[:, 0].sum(-1)
    fit = SRegression().fit(X, Y)
    torch.testing.assert_close(fit.coef_, torch.ones(2).double(), rtol=0, atol=1e-9)
    assert bool(torch.isfinite(fit.scale_).all())
    assert bool(torch.isfinite(fit.weights_).all())


# parameters


@pytest.mark.parametrize("breakdown", [0.2, 0.35])
def test_a_lower_breakdown_point_solves_its_equation_at_gaussian_scale(breakdown):
    residual = sample(0, 20_000)
    fit = SRegression(breakdown=breakdown, starts=20).fit(torch.ones(20_000, 1).double(), 3.0 * residual)
    assert float(fit.scale_) == pytest.approx(3.0, rel=0.02)
    X, y = contaminated_line(0, share=0.15)
    fit = SRegression(breakdown=breakdown).fit(X, y)
    c = bisquare_for_breakdown(breakdown)
    rho = bisquare_rho((y - X @ fit.coef_) / (c * fit.scale_))
    assert float(rho.sum()) == pytest.approx(breakdown * 37, rel=1e-9)


def test_the_scale_is_zero_only_if_enough_samples_are_fitted_exactly():
    X = sample(0, 40, 2)
    y = X.sum(-1)
    y[:12] += 5.0
    # 12 of 40 differ: more than 0.25 (40 - 2), fewer than 0.4 (40 - 2)
    assert float(SRegression(breakdown=0.4).fit(X, y).scale_) < 1e-12
    assert float(SRegression(breakdown=0.25).fit(X, y).scale_) > 0.1


@pytest.mark.parametrize("breakdown", [0.0, 0.51])
def test_a_breakdown_point_out_of_range_is_refused(breakdown):
    with pytest.raises(ValueError, match=rf"`breakdown` .*\[0\.01, 0\.5\].* got {breakdown}"):
        SRegression(breakdown=breakdown)


def test_zero_starts_are_refused():
    with pytest.raises(ValueError, match="`starts`"):
        SRegression(starts=0)


def test_equal_seeds_give_equal_results():
    X, y = sample(0, 30, 4), sample(1, 30)
    reference, other = SRegression(starts=3, seed=5).fit(X, y), SRegression(starts=3, seed=5).fit(X, y)
    assert torch.equal(reference.coef_, other.coef_)


@pytest.mark.parametrize(("n", "drawn"), [(1, 30), (2, 73), (3, 156), (4, 322), (5, 500), (6, 500), (12, 500)])
def test_no_more_starts_are_drawn_than_the_breakdown_point_requires(n, drawn):
    """Where fewer starts than requested are drawn, all miss with probability at most 1e-9 at 50 % outliers."""
    assert starts_worth_drawing(500, n) == drawn
    assert drawn == 500 or (1 - 0.5**n) ** drawn <= 1e-9 < (1 - 0.5**n) ** (drawn - 1)
    assert starts_worth_drawing(7, n) == 7


@pytest.mark.parametrize("off", [1e-9, 0.3, 1.0, 1.1, 1e9])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_scale_does_not_depend_on_its_start(off, dtype):
    X, y = sample(50, 40, 2).to(dtype), sample(51, 3, 40).to(dtype)
    problem = linear_problem(X, y)
    residual = problem.Y.unsqueeze(1)
    rule = MScale(30)
    scale = rule.scale(problem, residual)
    again, weight = rule.weighted(problem, residual, off * scale)
    tolerance = 8 * torch.finfo(dtype).eps
    torch.testing.assert_close(again, scale, rtol=tolerance, atol=0.0)
    expected = tukey_weight(residual, BISQUARE_50 * scale.unsqueeze(-2))
    torch.testing.assert_close(weight, expected, rtol=0.0, atol=100 * tolerance)


def test_many_problems_in_one_call_equal_separate_fits():
    """More problems than are processed at once; some converge long before others."""
    X, y = sample(52, 150, 40, 2), sample(53, 150, 40)
    y[::3, :15] = 50.0 + X[::3, :15, 0]
    together = SRegression().fit(X, y)
    assert bool(together.converged_.all())
    for i in range(0, 150, 13):
        alone = SRegression().fit(X[i], y[i])
        torch.testing.assert_close(together.coef_[i], alone.coef_, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(together.scale_[i], alone.scale_, rtol=1e-12, atol=0.0)


def test_derivatives_of_several_channels_equal_differences_of_refits():
    """Channels whose derivatives cancel in the sum: each of them enters the derivative of the fit."""
    X, Y = sample(3, 12, 2, 2), sample(4, 12, 2)
    Y[:, 0] += 2.0 * X[:, 0, 0]

    def fitted(Y: Tensor) -> Tensor:
        return SRegression(starts=50).fit(X, Y).coef_

    slopes = torch.autograd.functional.jacobian(fitted, Y)
    for k in (0, 5):
        for channel in range(2):
            change = torch.zeros_like(Y)
            change[k, channel] = 1e-5
            refitted = (fitted(Y + change) - fitted(Y - change)) / 2e-5
            torch.testing.assert_close(slopes[:, k, channel], refitted, rtol=0, atol=1e-7)
