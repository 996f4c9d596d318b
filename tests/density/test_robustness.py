"""Theorem 3 and its consequences: the bound holds, its minimum agrees with Corollary 2, its limits are right."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from torch import Tensor

from mkc_torch.density.robustness import (
    bandwidth_for_efficiency,
    breakdown_point,
    error_bound,
    error_bound_slope,
    gaussian_breakdown,
    gaussian_efficiency,
    least_bandwidth,
    least_error_bound,
    optimal_bandwidth,
    phi,
)
from mkc_torch.linear import FixedPointLinear, LeastSquares
from mkc_torch.linear._psi import gaussian_efficiency as psi_efficiency

INF = math.inf
sampled = settings(derandomize=True, deadline=None, max_examples=60)
widths = st.floats(math.log(1e-2), math.log(1e2)).map(math.exp)


@st.composite
def counts(draw: st.DrawFn, most: int = 60) -> tuple[int, int]:
    """N and M with N/2 < M < N."""
    N = draw(st.integers(3, most))
    return N, draw(st.integers(N // 2 + 1, N - 1))


def double(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def global_minimiser(x: Tensor, y: Tensor, h: float, reach: float) -> float:
    """argmin of (21) over |θ| <= reach: the best of a grid finer than the kernel, then Brent's method."""

    def kernel_sum(theta: Tensor) -> Tensor:
        return torch.exp(-0.5 * ((y - x * theta.unsqueeze(-1)) / h).square()).sum(-1)

    step = h / float(x.abs().max()) / 20
    grid = torch.arange(-reach, reach + step, step, dtype=torch.float64)
    peak = float(grid[kernel_sum(grid).argmax()])
    found = minimize_scalar(
        lambda t: -float(kernel_sum(double(t))), bounds=(peak - step, peak + step), method="bounded"
    )
    return float(found.x)


@sampled
@given(counts(), widths, widths, widths, st.floats(1.01, 6.0), st.integers(0, 10**6))
def test_no_outliers_move_the_minimiser_beyond_the_bound(sizes, d, epsilon, zeta, above, seed):
    N, M = sizes
    g = torch.Generator().manual_seed(seed)
    sigma = above * float(least_bandwidth(double(epsilon), N, M))
    x = zeta * (1.0 + 0.5 * torch.rand(N, generator=g).double()) * (torch.randint(2, (N,), generator=g) * 2 - 1)
    noise = epsilon * d * (2.0 * torch.rand(N, generator=g).double() - 1.0)
    if seed % 2:  # all inliers have errors of one sign, that of the outliers
        noise = epsilon * d * torch.sign(x)
    xi = float(error_bound(double(sigma), d, epsilon, zeta, N, M))
    # all outliers agree on a coefficient near the bound
    noise[M:] = x[M:] * xi * float(torch.rand((), generator=g)) * (1.2 if seed % 3 else -1.2)
    found = global_minimiser(x, noise, sigma * d, reach=1.5 * xi + 3.0 * epsilon * d / zeta)
    assert abs(found) <= xi * (1 + 1e-9)


@sampled
@given(st.integers(0, 10**6))
def test_the_fixed_point_stays_within_the_bound_under_gross_outliers(seed):
    g = torch.Generator().manual_seed(seed)
    x = 1.0 + torch.rand(50, generator=g).double()
    y = 3.0 * x + 0.5 * (2.0 * torch.rand(50, generator=g).double() - 1.0)
    y[35:] += 1000.0 * torch.randn(15, generator=g).double()
    sigma = float(optimal_bandwidth(1.0, 50, 35))
    fit = FixedPointLinear(sigma=sigma, d=0.5).fit(x.unsqueeze(-1), y)
    assert abs(float(fit.coef_) - 3.0) <= float(error_bound(sigma, 0.5, 1.0, 1.0, 50, 35))


@pytest.mark.parametrize(("sigma", "close"), [(0.7, 0.2), (1.0, 0.4), (5.0, 0.85), (40.0, 0.98)])
def test_outliers_of_large_leverage_nearly_reach_the_bound(sigma, close):
    # all inliers are at ε on the side of the outliers, whose narrow kernels agree on a coefficient
    N, M, epsilon = 100, 80, 1.0
    xi = float(error_bound(double(sigma), 1.0, epsilon, 1.0, N, M))
    place = torch.linspace(epsilon, xi, 2000).double()
    x = torch.cat([torch.ones(M), torch.full((N - M,), 1e6)]).double()
    inliers = torch.full((M,), epsilon).double()

    def kernel_sum(theta: Tensor, place: Tensor) -> Tensor:
        y = torch.cat([inliers.expand(len(place), M), place.unsqueeze(1) * x[M:]], 1)
        return torch.exp(-0.5 * ((y - theta.unsqueeze(1) * x) / sigma).square()).sum(1)

    # there or at the inliers: outliers have no influence elsewhere
    won = kernel_sum(place, place) > kernel_sum(torch.full_like(place, epsilon), place)
    assert close * xi < float(place[won].max()) <= xi


@sampled
@given(counts(10**4), widths, widths, widths, st.floats(1e-3, 0.9))
def test_the_bound_falls_then_rises_about_the_optimal_bandwidth(sizes, d, epsilon, zeta, step):
    least, best = (float(f(double(epsilon), *sizes)) for f in (least_bandwidth, optimal_bandwidth))
    assert least < best < INF
    below = least + (best - least) * (1 - step)
    sigma = double([below, best, best / (1 - step), INF])
    bounds = error_bound(sigma, d, epsilon, zeta, *sizes)
    assert bool((bounds[1] <= bounds * (1 + 1e-12)).all())
    torch.testing.assert_close(bounds[1], least_error_bound(double(d), epsilon, zeta, *sizes), rtol=1e-9, atol=0.0)
    slope = error_bound_slope(sigma, d, epsilon, zeta, *sizes)
    assert float(slope[0]) < 0 < float(slope[2]) < float(slope[3])
    assert abs(float(slope[1])) < 1e-6 * float(slope[3])


def test_the_optimal_bandwidth_equals_a_numerical_search():
    for N, M in ((10, 6), (100, 51), (100, 80), (1000, 999)):

        def bound(log_sigma: float, N: int = N, M: int = M) -> float:
            return float(error_bound(double(math.exp(log_sigma)), 0.5, 2.0, 0.1, N, M))

        low = math.log(float(least_bandwidth(double(2.0), N, M)))
        found = minimize_scalar(bound, bounds=(low + 1e-9, low + 5), method="bounded", options={"xatol": 1e-10})
        best = float(optimal_bandwidth(double(2.0), N, M))
        assert math.exp(found.x) == pytest.approx(best, rel=1e-6)


@sampled
@given(counts(10**6), widths)
def test_the_optimal_bandwidth_satisfies_corollary_2(sizes, epsilon):
    N, M = sizes
    sigma = optimal_bandwidth(double(epsilon), N, M)
    p = torch.exp(-0.5 * (epsilon / sigma).square())
    # close to 50 % outliers p - q loses digits
    assert float(phi(p, double((N - M) / M))) == pytest.approx(1.0, abs=1e-13 * N + 1e-9)
    torch.testing.assert_close(optimal_bandwidth(double(2 * epsilon), N, M), 2 * sigma, rtol=1e-12, atol=0.0)
    assert float(sigma) > epsilon / math.sqrt(2)


@sampled
@given(st.floats(1e-6, 0.999), st.floats(1e-3, 0.998), st.floats(1e-4, 1e-3))
def test_phi_is_decreasing(q, share, step):
    low = q + (1 - q) * share
    assert float(phi(double(low), q)) > float(phi(double(low + (1 - q) * step), q))
    assert float(phi(double(1.0), q)) == 0.0


@sampled
@given(counts(10**4), widths, st.floats(1.001, 50.0))
def test_the_slope_equals_the_derivative(sizes, epsilon, above):
    sigma = (above * least_bandwidth(double(epsilon), *sizes)).requires_grad_()
    bound = error_bound(sigma, 0.5, epsilon, 2.0, *sizes)
    (slope,) = torch.autograd.grad(bound, sigma)
    torch.testing.assert_close(
        slope, error_bound_slope(sigma.detach(), 0.5, epsilon, 2.0, *sizes), rtol=1e-8, atol=1e-8
    )


def test_least_squares_has_no_bound():
    assert float(error_bound(INF, 1.0, 1.0, 1.0, 100, 99)) == INF
    limit = error_bound_slope(double(INF), 0.5, 3.0, 2.0, 100, 80)
    assert float(limit) == pytest.approx(0.25 * math.sqrt(-2 * math.log(0.75)), rel=1e-12)
    far = double([1e4, 1e5])
    bounds = error_bound(far, 0.5, 3.0, 2.0, 100, 80)
    assert float(bounds.diff() / far.diff()) == pytest.approx(float(limit), rel=1e-6)
    y = torch.ones(100).double()
    for outlier in (1e3, 1e9):
        y[0] = outlier
        assert float(LeastSquares().fit(torch.ones(100, 1).double(), y).coef_) > 0.009 * outlier


def test_the_bound_has_its_limits():
    least = least_bandwidth(double(2.0), 100, 70)
    assert error_bound(least * double([0.1, 1 - 1e-12]), 1.0, 2.0, 1.0, 100, 70).tolist() == [INF, INF]
    assert error_bound_slope(least * 0.5, 1.0, 2.0, 1.0, 100, 70).tolist() == -INF
    assert float(error_bound(least * (1 + 1e-6), 1.0, 2.0, 1.0, 100, 70)) < INF
    # no outliers: both θ and θ° are within ε of every sample
    sigma = double([1e-3, 1.0, 1e3, INF])
    assert error_bound(sigma, 0.5, 2.0, 0.1, 100, 100).tolist() == pytest.approx([20.0] * 4, rel=1e-12)
    assert error_bound_slope(sigma, 0.5, 2.0, 0.1, 100, 100).tolist() == [0.0] * 4
    assert float(least_bandwidth(double(2.0), 100, 100)) == 0.0
    # exact inliers: the bound grows in proportion to the bandwidth from 0
    exact = error_bound(double([0.1, 1.0]), 1.0, 0.0, 1.0, 100, 80)
    assert exact.tolist() == pytest.approx([math.sqrt(-2 * math.log(0.75)) * s for s in (0.1, 1.0)])
    assert float(optimal_bandwidth(double(1.0), 10**9, 10**9 - 1)) == pytest.approx(math.sqrt(0.5), rel=1e-6)


@sampled
@given(counts(1000), widths)
def test_float32_agrees_with_float64(sizes, epsilon):
    for function in (least_bandwidth, optimal_bandwidth):
        single = function(torch.tensor(epsilon), *sizes)
        assert single.dtype == torch.float32
        torch.testing.assert_close(single.double(), function(double(epsilon), *sizes), rtol=1e-5, atol=0.0)
    sigma = 2.0 * optimal_bandwidth(double(epsilon), *sizes)
    wide = error_bound(sigma, 1.0, epsilon, 1.0, *sizes)
    torch.testing.assert_close(
        error_bound(sigma.float(), 1.0, epsilon, 1.0, *sizes).double(), wide, rtol=1e-3, atol=0.0
    )


def test_shapes_broadcast():
    sigma, M = double([2.0, 3.0]).unsqueeze(-1), torch.tensor([60, 80, 95])
    together = error_bound(sigma, 0.5, 1.0, double(2.0), 100, M)
    assert together.shape == error_bound_slope(sigma, 0.5, 1.0, 2.0, 100, M).shape == (2, 3)
    for i, j in itertools.product(range(2), range(3)):
        alone = error_bound(sigma[i, 0], 0.5, 1.0, 2.0, 100, int(M[j]))
        torch.testing.assert_close(together[i, j], alone)
    assert optimal_bandwidth(double([1.0, 2.0]).unsqueeze(-1), 100, M).shape == (2, 3)
    assert least_error_bound(double([1.0, 2.0]).unsqueeze(-1), 1.0, 1.0, 100, M).shape == (2, 3)
    assert breakdown_point(torch.zeros(4, 2, 7), double([1.0, 2.0]), 1.0).shape == (4, 2)


@sampled
@given(st.floats(0.3, 20.0))
def test_efficiency_equals_welschs_and_has_an_inverse(h):
    c = h * math.sqrt(2)
    assert float(gaussian_efficiency(double(h))) == pytest.approx(psi_efficiency("welsch", (c,)), rel=1e-9)
    assert float(gaussian_efficiency(double(h), 3.0, 3.0)) == pytest.approx(float(gaussian_efficiency(double(h))))
    assert float(bandwidth_for_efficiency(gaussian_efficiency(double(h)))) == pytest.approx(h, rel=1e-8)


def test_efficiency_equals_a_simulation():
    g = torch.Generator().manual_seed(0)
    X = torch.randn(300, 200, 2, generator=g, dtype=torch.float64)
    y = 0.5 * torch.randn(300, 200, generator=g, dtype=torch.float64)
    squares = [e.fit(X, y).coef_.square().sum() for e in (LeastSquares(), FixedPointLinear(sigma=1.5, d=0.5))]
    expected = float(gaussian_efficiency(1.5))
    assert float(squares[0] / squares[1]) == pytest.approx(expected, abs=0.04)
    assert gaussian_efficiency(double(INF)) == 1.0
    assert bandwidth_for_efficiency(double(1.0)) == INF


@pytest.mark.e2e
@sampled
@given(st.integers(5, 40), st.floats(0.3, 5.0), st.integers(0, 10**6))
def test_breakdown_point_of_a_single_coefficient(N, h, seed):
    g = torch.Generator().manual_seed(seed)
    x, y = 1.0 + torch.rand(N, generator=g).double(), torch.randn(N, generator=g).double()
    at = global_minimiser(x, y, h, reach=10.0)
    share = float(breakdown_point(y - x * at, double(h), 1.0))
    fewest = round(share * N / (1 - share))
    for added, moved in ((fewest - 1, False), (fewest + 1, True)):
        grown_x = torch.cat([x, torch.full((added,), 2.0).double()])
        grown_y = torch.cat([y, torch.full((added,), 1000.0).double()])
        found = global_minimiser(grown_x, grown_y, h, reach=600.0)
        assert (abs(found) > 100.0) == moved


@pytest.mark.filterwarnings("ignore:FixedPointLinear follows the bad leverage points:UserWarning")
def test_breakdown_point_of_a_line_under_leverage():
    g = torch.Generator().manual_seed(1)
    # evenly spaced: at a finite slope two samples close by may both lie on the line through the outliers
    X = torch.stack([torch.ones(40), torch.linspace(-2, 2, 40)], -1).double()
    y = X.sum(-1) + 0.3 * torch.randn(40, generator=g).double()
    fit = FixedPointLinear(sigma=1.0, d=0.5).fit(X, y)
    share = float(breakdown_point(y - X @ fit.coef_, 1.0, 0.5, num_coefficients=2))
    fewest = round(share * 40 / (1 - share))
    assert 0.4 < share < 0.5

    def moved(added: int) -> bool:
        far = torch.tensor([[1.0, 1e3]]).double().expand(added, 2)
        rows, target = torch.cat([X, far]), torch.cat([y, torch.full((added,), -1e6).double()])
        # the better of the minimum near the fit and of those that pass the outliers and one sample
        starts = [
            fit.coef_,
            *(torch.linalg.solve(torch.stack([far[0], X[i]]), double([-1e6, y[i]])) for i in range(0, 40, 8)),
        ]
        ends = [FixedPointLinear(sigma=1.0, d=0.5, start=s).fit(rows, target) for s in starts]
        best = min(ends, key=lambda e: float(e.history_[-1]))
        return float(best.coef_.abs().max()) > 100.0

    assert not moved(fewest - 1)
    assert moved(fewest + 2)


def test_the_breakdown_point_of_many_gaussian_errors_equals_its_limit():
    g = torch.Generator().manual_seed(0)
    e = torch.randn(200_000, generator=g, dtype=torch.float64)
    for h in (0.5, 1.0, 3.0):
        measured = float(breakdown_point(e, double(h / 2), 2.0))
        assert measured == pytest.approx(float(gaussian_breakdown(double(h / 2), 2.0)), abs=2e-3)
    assert gaussian_breakdown(double([INF, 1e9])).tolist() == [0.0, 0.5]
    assert float(breakdown_point(e[:3], INF, 1.0)) == 0.0
    assert float(breakdown_point(double([0.0, 50.0]), 1.0, 1.0, num_coefficients=3)) == 0.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: error_bound(0.0, 1, 1, 1, 10, 8), "`sigma` to be positive but got 0.0"),
        (lambda: error_bound(math.nan, 1, 1, 1, 10, 8), "`sigma` to be positive but got nan"),
        (lambda: error_bound(1.0, INF, 1, 1, 10, 8), "`d` to be positive and finite but got inf"),
        (lambda: error_bound(1.0, 1, -1.0, 1, 10, 8), "`epsilon` to be not negative and finite but got -1.0"),
        (lambda: error_bound(1.0, 1, 1, 0.0, 10, 8), "`zeta` to be positive and finite but got 0.0"),
        (lambda: error_bound_slope(1.0, 1, 1, 1, 10, 5), "`num_inliers` to be more than half .* got 5.0 of 10.0"),
        (lambda: least_bandwidth(1.0, 10, 11), "`num_inliers` to be more than half of the samples and at most all"),
        (lambda: optimal_bandwidth(0.0, 10, 8), "`epsilon` to be positive and finite but got 0.0"),
        (lambda: optimal_bandwidth(1.0, 10, 10), "fewer than all of them but got 10.0 of 10.0; without outliers"),
        (lambda: least_error_bound(1.0, 1.0, -2.0, 10, 8), "`zeta` to be positive and finite but got -2.0"),
        (lambda: phi(0.2, 0.5), r"`p` to be in \(q, 1\] but got"),
        (lambda: phi(0.5, 1.0), r"`q` to be in \[0, 1\) but got 1.0"),
        (lambda: gaussian_efficiency(-1.0), "`sigma` to be positive but got -1.0"),
        (lambda: gaussian_breakdown(1.0, noise=0.0), "`noise` to be positive and finite but got 0.0"),
        (lambda: bandwidth_for_efficiency(1.5), r"`efficiency` to be in \(0, 1\] but got 1.5"),
        (lambda: breakdown_point(double([1.0, math.nan]), 1.0, 1.0), "`error` to be finite but got 1 values"),
        (lambda: breakdown_point(torch.zeros(0), 1.0, 1.0), r"`error` of shape \(\*, N >= 1\) but got \(0,\)"),
        (lambda: breakdown_point(torch.zeros(3), 1.0, 1.0, 0), "`num_coefficients` to be a whole number"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
