"""Robust Levenberg-Marquardt and MKC-EM on residuals: comparison with SciPy, closed forms and repeated experiments."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.optimize import minimize as scipy_minimize
from torch import Tensor

from mkc_torch.linear import MKCRegression
from mkc_torch.nonlinear import GaussianPrior, fit, minimise
from tests.draws import normal as sample

T = torch.linspace(0, 4, 120, dtype=torch.float64)
TRUTH = torch.tensor([3.0, 0.7, 0.5], dtype=torch.float64)
START = torch.tensor([1.0, 0.3, 0.0], dtype=torch.float64)


def decay(theta: Tensor) -> Tensor:
    return theta[0] * torch.exp(-theta[1] * T) + theta[2]


def noisy(seed: int, share: float = 0.0, noise: float = 0.05) -> Tensor:
    """The decay with noise and a share of one-sided outliers spread over it."""
    y = decay(TRUTH) + noise * sample(seed, len(T))
    bad = torch.randperm(len(T), generator=torch.Generator().manual_seed(seed))[: int(share * len(T))]
    y[bad] += 3.0 + sample(seed + 1, len(bad)).abs()
    return y


def residual_to(y: Tensor):
    return lambda theta: (decay(theta) - y).unsqueeze(-1)


def for_scipy(residual):
    def function(theta: np.ndarray) -> np.ndarray:
        return residual(torch.from_numpy(np.asarray(theta))).flatten().numpy()

    return function


def linear(seed: int, N: int = 40, p: int = 3) -> tuple[Tensor, Tensor]:
    X = sample(seed, N, p)
    return X, X @ torch.arange(1.0, p + 1).double() + 0.3 * sample(seed + 1, N)


def linear_residual(X: Tensor, y: Tensor):
    return lambda theta: (X @ theta - y).unsqueeze(-1)


# the minimum


@pytest.mark.e2e
def test_least_squares_equals_scipy():
    residual = residual_to(noisy(0))
    found = minimise(residual, START, tol=1e-15)
    expected = least_squares(for_scipy(residual), START.numpy(), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(found.theta.numpy(), expected.x, rtol=1e-7)
    assert float(found.objective) == pytest.approx(expected.cost, rel=1e-12)
    assert bool(found.converged)
    assert bool((found.weights == 1).all())


@pytest.mark.parametrize(("sigma", "d"), [(1.0, 0.2), (3.0, 0.05), (0.7, 0.5)])
def test_the_mkc_loss_equals_scipy_with_a_custom_loss(sigma, d):
    residual = residual_to(noisy(1, 0.2))

    def loss(z: np.ndarray) -> np.ndarray:  # SciPy minimises f_scale² Σ rho(z) / 2 with z = (e / f_scale)²
        h = sigma**2
        w = np.exp(-z / (2 * h))
        return np.stack([2 * h * (1 - w), w, -w / (2 * h)])

    found = minimise(residual, TRUTH, sigma=sigma, d=d, tol=1e-15)
    expected = least_squares(
        for_scipy(residual), TRUTH.numpy(), loss=loss, f_scale=d, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    np.testing.assert_allclose(found.theta.numpy(), expected.x, rtol=1e-5)
    assert float(found.objective) * d**2 == pytest.approx(expected.cost, rel=1e-9)
    z = found.residual / d
    torch.testing.assert_close(found.weights, torch.exp(-z.square() / (2 * sigma**2)))


def test_a_bounded_fit_equals_scipy():
    residual = residual_to(noisy(2))
    lower, upper = torch.tensor([0.0, 0.8, -math.inf]).double(), torch.tensor([2.5, math.inf, math.inf]).double()
    found = minimise(residual, torch.tensor([1.0, 1.0, 0.0]).double(), lower=lower, upper=upper, tol=1e-15)
    expected = least_squares(
        for_scipy(residual), [1.0, 1.0, 0.0], bounds=(lower.numpy(), upper.numpy()), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    np.testing.assert_allclose(found.theta.numpy(), expected.x, rtol=1e-5)
    assert float(found.theta[0]) == 2.5
    free = minimise(residual, START).theta
    assert bool(((free < lower) | (free > upper)).any())


def test_every_trial_lies_within_the_bounds():
    lower, upper = torch.tensor([0.0, 0.1, -0.1]).double(), torch.tensor([2.5, 1.0, 0.4]).double()
    seen = []

    plain = residual_to(noisy(2))

    def residual(theta: Tensor) -> Tensor:
        if not torch._C._functorch.is_functorch_wrapped_tensor(theta):
            seen.append(theta)
        return plain(theta)

    minimise(residual, torch.tensor([50.0, -3.0, 0.0]).double(), lower=lower, upper=upper)
    assert len(seen) > 3
    for theta in seen:
        assert bool(((theta >= lower) & (theta <= upper)).all())


def test_a_start_outside_the_bounds_is_moved_to_the_nearest_point():
    lower, upper = torch.full((3,), 0.1).double(), torch.full((3,), 5.0).double()
    far = torch.tensor([9.0, -1.0, 1.0]).double()
    inside = torch.tensor([5.0, 0.1, 1.0]).double()
    reference = minimise(residual_to(noisy(2)), far, lower=lower, upper=upper)
    other = minimise(residual_to(noisy(2)), inside, lower=lower, upper=upper)
    assert torch.equal(reference.theta, other.theta)


def test_equal_bounds_fix_a_parameter():
    residual, fixed = residual_to(noisy(2)), torch.tensor([math.inf, 0.6, math.inf], dtype=torch.float64)
    found = minimise(residual, START, lower=torch.where(fixed < 1, fixed, -math.inf), upper=fixed)
    assert float(found.theta[1]) == 0.6
    held = fixed[1]
    other = minimise(lambda a: residual(torch.stack([a[0], held, a[1]])), START[[0, 2]])
    torch.testing.assert_close(found.theta[[0, 2]], other.theta, rtol=1e-6, atol=1e-8)


def test_the_objective_never_rises_with_more_steps():
    objective = [
        float(minimise(residual_to(noisy(1, 0.3)), START, sigma=1.0, d=0.2, max_iter=k).objective) for k in range(1, 15)
    ]
    assert all(later <= earlier for earlier, later in itertools.pairwise(objective))
    assert objective[0] > objective[-1]


def test_rosenbrock_is_solved_from_its_usual_start():
    def residual(t: Tensor) -> Tensor:
        return torch.stack([10.0 * (t[1] - t[0] ** 2), 1.0 - t[0]]).unsqueeze(-1)

    found = minimise(residual, torch.tensor([-1.2, 1.0]).double(), max_iter=100)
    torch.testing.assert_close(found.theta, torch.ones(2).double(), rtol=0, atol=1e-8)
    assert bool(found.converged)


def test_missing_convergence_is_reported():
    residual = residual_to(noisy(1, 0.3))
    assert not bool(minimise(residual, START, sigma=1.0, d=0.2, max_iter=2).converged)
    assert not bool(fit(residual, START, max_iter=1).converged)
    # an exponential that diverges to a straight line has no minimum
    line = minimise(lambda t: (t[0] * torch.exp(-t[1] * T) + t[2] - T).unsqueeze(-1), START, max_iter=30)
    assert not bool(line.converged)


# identities


def test_infinite_sigma_equals_weighted_least_squares():
    X, y = linear(0)
    weight = sample(5, 40).abs()
    found = minimise(linear_residual(X, y), torch.zeros(3).double(), d=0.3, weight=weight)
    expected = torch.linalg.solve(X.mT @ (weight[:, None] * X), X.mT @ (weight * y))
    torch.testing.assert_close(found.theta, expected, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(found.curvature, X.mT @ (weight[:, None] * X) / 0.3**2)
    torch.testing.assert_close(found.jacobian, X.unsqueeze(-2))
    torch.testing.assert_close(found.residual.squeeze(-1), X @ expected - y)


def test_channels_are_weighted_by_their_d():
    X, y = linear(0)
    z = y + 2.0 + sample(9, 40)
    d = torch.tensor([0.5, 2.0]).double()
    found = minimise(lambda t: torch.stack([X @ t - y, X @ t - z], -1), torch.zeros(3).double(), d=d)
    expected = torch.linalg.lstsq(X, (y / d[0] ** 2 + z / d[1] ** 2) / d.pow(-2).sum()).solution
    torch.testing.assert_close(found.theta, expected)


def test_a_prior_equals_ridge_regression_and_augmented_rows():
    X, y = linear(1)
    mean, precision = torch.tensor([1.0, -1.0, 0.5]).double(), torch.tensor([3.0, 0.0, 20.0]).double()
    found = minimise(linear_residual(X, y), torch.zeros(3).double(), prior=GaussianPrior(mean, precision))
    P = torch.diag(precision)
    torch.testing.assert_close(found.theta, torch.linalg.solve(X.mT @ X + P, X.mT @ y + P @ mean))
    full = minimise(linear_residual(X, y), torch.zeros(3).double(), prior=GaussianPrior(mean, P))
    torch.testing.assert_close(full.theta, found.theta)
    rows, target = torch.cat([X, P.sqrt()]), torch.cat([y, P.sqrt() @ mean])
    stacked = minimise(linear_residual(rows, target), torch.zeros(3).double())
    torch.testing.assert_close(stacked.theta, found.theta)
    torch.testing.assert_close(stacked.objective, found.objective)
    torch.testing.assert_close(stacked.curvature, found.curvature)


def test_a_prior_determines_parameters_that_the_residuals_do_not():
    prior = GaussianPrior(torch.tensor([1.0, 2.0]).double(), torch.tensor([1.0, 1.0]).double())
    found = minimise(lambda t: (t[:1] - 3.0).unsqueeze(-1), torch.zeros(2).double(), prior=prior)
    torch.testing.assert_close(found.theta, torch.tensor([2.0, 2.0]).double())


def test_weight_zero_equals_removal_of_any_value():
    X, y = linear(2)
    contaminated = torch.cat([y, torch.tensor([math.nan, math.inf, 1e9]).double()])
    wide = torch.cat([X, torch.tensor([[math.nan] * 3, [1.0] * 3, [1.0] * 3]).double()])
    weight = (torch.arange(43) < 40).double()
    found = minimise(linear_residual(wide, contaminated), torch.zeros(3).double(), weight=weight)
    torch.testing.assert_close(found.theta, torch.linalg.lstsq(X, y).solution)
    robust = fit(linear_residual(wide, contaminated), torch.zeros(3).double(), weight=weight)
    alone = fit(linear_residual(X, y), torch.zeros(3).double())
    torch.testing.assert_close(robust.theta, alone.theta, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(robust.covariance, alone.covariance, rtol=1e-4, atol=1e-10)


def test_a_weight_of_two_counts_a_sample_twice():
    y = noisy(3, 0.2)
    weight = torch.ones(len(T)).double()
    weight[:30] = 2.0

    def doubled(theta: Tensor) -> Tensor:
        all_ = residual_to(y)(theta)
        return torch.cat([all_, all_[:30]])

    reference = minimise(residual_to(y), START, sigma=2.0, d=0.3, weight=weight, tol=1e-14)
    other = minimise(doubled, START, sigma=2.0, d=0.3, tol=1e-14)
    torch.testing.assert_close(reference.theta, other.theta, rtol=1e-8, atol=0)
    torch.testing.assert_close(reference.objective, other.objective)


@pytest.mark.parametrize("jacobian", ["reverse", "reverse twice"])
def test_reverse_mode_agrees_with_forward_mode(jacobian):
    residual = residual_to(noisy(0, 0.1)[:20].repeat(6))
    for start in (START, torch.stack([START, 1.1 * START])):
        reference = minimise(residual, start, sigma=2.0, d=0.2)
        other = minimise(residual, start, sigma=2.0, d=0.2, jacobian=jacobian)
        torch.testing.assert_close(reference.theta, other.theta, rtol=1e-9, atol=0)
        torch.testing.assert_close(reference.jacobian, other.jacobian)


class OnceDifferentiable(torch.autograd.Function):
    """The exponential, with a derivative in each mode but no second derivative."""

    @staticmethod
    def forward(x):
        return torch.exp(x)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(output)
        ctx.save_for_forward(output)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        return gradient * ctx.saved_tensors[0]

    @staticmethod
    def jvp(ctx, tangent):
        return tangent * ctx.saved_tensors[0]

    generate_vmap_rule = True


@pytest.mark.parametrize(
    "function",
    [
        lambda theta: torch.where(T > 0, (T * theta[1]).abs().sqrt(), theta[1]) + theta[0] * T + theta[2],
        lambda theta: OnceDifferentiable.apply(-theta[1] * T) * theta[0] + theta[2],
        lambda theta: theta[0] * T + theta[2] + 0.0 * theta[1],
    ],
    ids=["infinite slope left out", "no second derivative", "linear"],
)
def test_forward_mode_differentiates_functions_without_a_second_derivative(function):
    from mkc_torch._support.forward_mode import forward_tangents, twice_reverse_tangents

    found = twice_reverse_tangents(function)(TRUTH)
    assert found.shape == (3, len(T))
    assert bool(found.isfinite().all())
    torch.testing.assert_close(found, forward_tangents(function)(TRUTH))


def test_float32_stays_float32():
    residual = residual_to(noisy(0, 0.2))
    single = fit(lambda t: residual(t.double()).float(), START.float())
    double = fit(residual, START)
    for name in ("theta", "sigma", "d", "covariance", "jacobian", "residual"):
        assert getattr(single, name).dtype == torch.float32
    torch.testing.assert_close(single.theta.double(), double.theta, rtol=5e-3, atol=0)
    assert minimise(lambda t: residual(t.double()).float(), START.float()).theta.dtype == torch.float32


# constraints


def test_an_equality_gives_the_closed_form_of_lagrange():
    X, y = linear(3)
    C, c = torch.tensor([[1.0, 1.0, 1.0], [1.0, -2.0, 0.0]]).double(), torch.tensor([2.0, 0.5]).double()
    found = minimise(linear_residual(X, y), torch.zeros(3).double(), equality=lambda t: C @ t - c)
    kkt = torch.cat([torch.cat([X.mT @ X, C.mT], 1), torch.cat([C, torch.zeros(2, 2).double()], 1)])
    expected = torch.linalg.solve(kkt, torch.cat([X.mT @ y, c]))[:3]
    torch.testing.assert_close(found.theta, expected, rtol=0, atol=1e-7)
    torch.testing.assert_close(C @ found.theta, c, rtol=0, atol=1e-8)
    assert bool(found.converged)
    free = torch.linalg.lstsq(X, y).solution
    assert float((C @ free - c).abs().max()) > 0.5


def test_a_nonlinear_equality_gives_the_solution_of_scipy():
    residual = residual_to(noisy(0))
    found = minimise(residual, START, equality=lambda t: (t[0] * t[1] - 1.5).reshape(1), tol=1e-13)
    expected = scipy_minimize(
        lambda t: 0.5 * (for_scipy(residual)(t) ** 2).sum(),
        TRUTH.numpy(),
        method="SLSQP",
        constraints={"type": "eq", "fun": lambda t: t[0] * t[1] - 1.5},
        options={"ftol": 1e-14},
    )
    assert float(found.theta[0] * found.theta[1]) == pytest.approx(1.5, abs=1e-8)
    np.testing.assert_allclose(found.theta.numpy(), expected.x, rtol=1e-4)


def test_an_inactive_inequality_changes_nothing_and_an_active_inequality_acts_as_an_equality():
    X, y = linear(3)
    free = torch.linalg.lstsq(X, y).solution
    loose = minimise(linear_residual(X, y), torch.zeros(3).double(), inequality=lambda t: t + 10.0)
    torch.testing.assert_close(loose.theta, free)
    assert bool(loose.converged)
    tight = minimise(linear_residual(X, y), torch.zeros(3).double(), inequality=lambda t: 4.0 - t.sum().reshape(1))
    equal = minimise(linear_residual(X, y), torch.zeros(3).double(), equality=lambda t: 4.0 - t.sum().reshape(1))
    torch.testing.assert_close(tight.theta, equal.theta, rtol=0, atol=1e-7)
    assert float(free.sum()) > 4.0
    assert bool(tight.converged)


def test_bounds_and_inequalities_agree():
    residual, upper = residual_to(noisy(2, 0.1)), torch.tensor([2.5, math.inf, math.inf]).double()
    reference = minimise(residual, START, sigma=3.0, d=0.1, upper=upper, tol=1e-14)
    other = minimise(residual, START, sigma=3.0, d=0.1, inequality=lambda t: 2.5 - t[:1], tol=1e-14)
    torch.testing.assert_close(reference.theta, other.theta, rtol=0, atol=1e-6)


def test_active_bounds_and_equalities_have_standard_error_zero():
    residual = residual_to(noisy(4, 0.2))
    upper = torch.tensor([2.8, math.inf, math.inf], dtype=torch.float64)
    bounded = fit(residual, START, upper=upper, bound=10.0)
    assert float(bounded.theta[0]) == 2.8
    assert float(bounded.standard_error()[0]) == 0.0
    assert bool((bounded.standard_error()[1:] > 0).all())
    equal = fit(residual, START, equality=lambda t: t[:1] - 2.8, bound=10.0)
    torch.testing.assert_close(equal.theta, bounded.theta, rtol=0, atol=1e-5)
    torch.testing.assert_close(equal.covariance, bounded.covariance, rtol=1e-2, atol=1e-9)
    assert float(bounded.log_likelihood) < float(fit(residual, START, bound=10.0).log_likelihood)
    fixed = fit(lambda a: residual(torch.cat([bounded.theta[:1], a])), START[1:], bound=10.0)
    torch.testing.assert_close(fixed.standard_error(), bounded.standard_error()[1:], rtol=1e-2, atol=0)


# batches


def batch_data() -> tuple[Tensor, Tensor]:
    return torch.stack([noisy(10 * s, 0.05 * s) for s in range(6)]).reshape(2, 3, -1), START.expand(2, 3, 3)


def decay_residual(theta: Tensor, data: dict[str, Tensor]) -> Tensor:
    return (decay(theta) - data["y"]).unsqueeze(-1)


def test_a_batch_of_minimisations_equals_a_loop():
    y, start = batch_data()
    found = minimise(decay_residual, start, data={"y": y}, sigma=2.0, d=0.1)
    assert found.theta.shape == (2, 3, 3)
    assert found.residual.shape == found.weights.shape == (2, 3, 120, 1)
    assert found.objective.shape == found.converged.shape == (2, 3)
    assert found.jacobian.shape == (2, 3, 120, 1, 3)
    assert found.curvature.shape == (2, 3, 3, 3)
    for i in range(2):
        for j in range(3):
            alone = minimise(residual_to(y[i, j]), START, sigma=2.0, d=0.1)
            torch.testing.assert_close(found.theta[i, j], alone.theta, rtol=1e-6, atol=0)
            torch.testing.assert_close(found.curvature[i, j], alone.curvature, rtol=1e-5, atol=1e-6)


def test_a_batch_of_fits_equals_a_loop():
    y, start = batch_data()
    found = fit(decay_residual, start, data={"y": y})
    assert found.sigma.shape == found.d.shape == found.bound.shape == (2, 3, 1)
    assert found.log_likelihood.shape == found.converged.shape == (2, 3)
    assert found.standard_error().shape == (2, 3, 3)
    assert bool(found.converged.all())
    for i in range(2):
        for j in range(3):
            alone = fit(residual_to(y[i, j]), START, bound=float(found.bound[i, j]))
            torch.testing.assert_close(found.theta[i, j], alone.theta, rtol=1e-3, atol=0)
            torch.testing.assert_close(found.log_likelihood[i, j], alone.log_likelihood, rtol=0, atol=1e-6)
            torch.testing.assert_close(found.standard_error()[i, j], alone.standard_error(), rtol=0.02, atol=0)


def test_a_batch_of_starts_shares_a_residual_without_data():
    starts = START + 0.1 * sample(0, 5, 3)
    found = minimise(residual_to(noisy(0)), starts)
    torch.testing.assert_close(found.theta, found.theta[:1].expand(5, 3), rtol=1e-6, atol=0)


# MKC-EM


def test_a_decay_is_recovered_from_thirty_per_cent_outliers_unlike_by_least_squares():
    for seed in range(5):
        residual = residual_to(noisy(seed, 0.3))
        found = fit(residual, START)
        torch.testing.assert_close(found.theta, TRUTH, rtol=0, atol=0.12)
        assert bool(found.converged)
        wrong = minimise(residual, START).theta
        assert float((wrong - TRUTH).abs().max()) > 0.4
        outlying = noisy(seed, 0.3) - decay(TRUTH) > 2.0
        assert float(found.weights.squeeze(-1)[outlying].max()) < 0.01


def test_distant_starts_reach_the_truth():
    for start in ([10.0, 3.0, -5.0], [0.1, 0.01, 3.0], [-2.0, 0.5, 2.0]):
        found = fit(residual_to(noisy(1, 0.3)), torch.tensor(start).double())
        torch.testing.assert_close(found.theta, TRUTH, rtol=0, atol=0.12)


def test_on_gaussian_data_the_fit_agrees_with_least_squares():
    residual = residual_to(noisy(0))
    found, least = fit(residual, START), minimise(residual, START)
    assert float(found.sigma) > 4
    error = found.standard_error()
    assert bool(((found.theta - least.theta).abs() < 0.1 * error).all())
    assert float(found.d) == pytest.approx(0.05, rel=0.15)


def test_a_linear_residual_equals_the_linear_regression():
    X, y = linear(0, 300)
    y[:60] += 5.0
    # the same domain, since the rough fits that choose it differ
    regression = MKCRegression(bound=6.0).fit(X, y)
    found = fit(linear_residual(X, y), torch.zeros(3).double(), bound=6.0)
    torch.testing.assert_close(found.theta, regression.coef_, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.sigma, regression.sigma_, rtol=1e-3, atol=0)
    torch.testing.assert_close(found.d, regression.d_, rtol=1e-3, atol=0)
    torch.testing.assert_close(found.log_likelihood * 300, regression.log_likelihood_, rtol=1e-8, atol=0)
    torch.testing.assert_close(found.covariance, regression.covariance_, rtol=1e-3, atol=1e-8)
    series = fit(linear_residual(X, y), torch.zeros(3).double(), bound=6.0, covariance="hac", bandwidth=7)
    hac = MKCRegression(bound=6.0, covariance="hac", bandwidth=7).fit(X, y)
    torch.testing.assert_close(series.covariance, hac.covariance_, rtol=1e-3, atol=1e-8)
    assert not torch.allclose(series.covariance, found.covariance, rtol=0.02)


def test_weights_of_samples_enter_the_covariance_as_in_the_linear_regression():
    X, y = linear(0, 300)
    weight = sample(8, 300).abs()
    regression = MKCRegression(bound=6.0).fit(X, y, weight)
    found = fit(linear_residual(X, y), torch.zeros(3).double(), bound=6.0, weight=weight)
    torch.testing.assert_close(found.theta, regression.coef_, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.covariance, regression.covariance_, rtol=1e-3, atol=1e-8)
    plain = fit(linear_residual(X, y), torch.zeros(3).double(), bound=6.0)
    assert not torch.allclose(found.covariance, plain.covariance, rtol=0.02)


def test_no_fit_is_less_likely_than_a_gaussian_at_least_squares():
    for seed in [*range(10), 52]:
        X = sample(seed, 16, 3)
        residual = linear_residual(X, X.sum(-1) + sample(seed + 1000, 16))
        found = fit(residual, torch.zeros(3).double())
        gaussian = fit(residual, torch.zeros(3).double(), sigma=math.inf, bound=float(found.bound))
        assert float(found.log_likelihood) >= float(gaussian.log_likelihood) - 1e-9


def test_d_does_not_collapse_with_few_residuals_per_parameter():
    for seed in range(20):
        X = sample(seed, 20, 9)
        found = fit(linear_residual(X, X.sum(-1) + sample(seed + 1000, 20)), torch.zeros(9).double())
        assert float(found.d) > 0.1


def test_given_sigma_and_d_are_kept():
    residual = residual_to(noisy(0, 0.2))
    found = fit(residual, START, sigma=2.0, d=0.06, bound=20.0)
    assert float(found.sigma) == pytest.approx(2.0)
    assert float(found.d) == pytest.approx(0.06)
    assert float(found.bound) == pytest.approx(20.0)
    direct = minimise(residual, found.theta, sigma=2.0, d=0.06, tol=1e-14)
    torch.testing.assert_close(found.theta, direct.theta, rtol=1e-5, atol=0)


def test_each_channel_learns_its_own_density():
    clean, dirty = noisy(0), noisy(20, 0.3, noise=0.2)
    found = fit(lambda t: torch.stack([decay(t) - clean, decay(t) - dirty], -1), START)
    assert found.sigma.shape == (2,)
    assert float(found.sigma[1]) < 3 < float(found.sigma[0])
    assert float(found.d[0]) == pytest.approx(0.05, rel=0.2)
    assert float(found.d[1]) == pytest.approx(0.2, rel=0.3)


def test_a_prior_and_the_likelihood_are_weighted_by_their_precisions():
    residual = residual_to(noisy(0))
    free = fit(residual, START)
    error = float(free.standard_error()[0])
    firm = GaussianPrior(torch.tensor([2.0, 0.0, 0.0]).double(), torch.tensor([1e8, 0.0, 0.0]).double())
    held = fit(residual, START, prior=firm)
    assert float(held.theta[0]) == pytest.approx(2.0, abs=0.01)
    assert float(held.standard_error()[0]) < 2e-4
    mean = torch.stack([free.theta[0] - 2.0 * error, *torch.zeros(2).double()])
    weak = GaussianPrior(mean, torch.tensor([error**-2, 0.0, 0.0]).double())
    between = fit(residual, START, prior=weak)
    # two measurements of equal precision, two standard errors apart, meet in the middle
    assert float(between.theta[0]) == pytest.approx(float(free.theta[0]) - error, abs=0.2 * error)
    assert float(between.standard_error()[0]) == pytest.approx(error / math.sqrt(2), rel=0.1)


def test_an_exact_fit_has_no_nan():
    found = fit(residual_to(decay(TRUTH)), START)
    torch.testing.assert_close(found.theta, TRUTH, rtol=1e-6, atol=0)
    assert bool(torch.isfinite(found.d).all())
    assert bool(torch.isfinite(found.standard_error()).all())
    there = fit(residual_to(decay(TRUTH)), TRUTH)
    torch.testing.assert_close(there.theta, TRUTH, rtol=1e-6, atol=0)


def test_a_parameter_without_effect_has_an_infinite_error():
    residual = residual_to(noisy(0))
    found = fit(lambda t: residual(t[:3]), torch.cat([START, torch.ones(1).double()]))
    error = found.standard_error()
    assert float(found.theta[3]) == 1.0
    assert bool(torch.isinf(error[3]))
    torch.testing.assert_close(error[:3], fit(residual, START).standard_error(), rtol=0.05, atol=0)


@pytest.mark.e2e
@settings(derandomize=True, deadline=None, max_examples=15)
@given(seed=st.integers(0, 1000), exponent=st.integers(-6, 6), share=st.floats(0.0, 0.3))
def test_the_fit_is_equivariant_to_the_unit_of_the_residual(seed, exponent, share):
    unit, y = 10.0**exponent, noisy(seed, share)
    reference = fit(residual_to(y), START, bound=20.0)
    other = fit(lambda t: unit * residual_to(y)(t), START, bound=20.0 * unit)
    torch.testing.assert_close(reference.theta, other.theta, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(reference.d * unit, other.d, rtol=1e-4, atol=0)
    torch.testing.assert_close(reference.standard_error(), other.standard_error(), rtol=1e-3, atol=0)


@settings(derandomize=True, deadline=None, max_examples=15)
@given(
    seed=st.integers(0, 1000),
    exponents=st.lists(st.integers(-5, 5), min_size=3, max_size=3),
    sigma=st.sampled_from([1.0, 3.0, math.inf]),
)
def test_the_fit_is_equivariant_to_the_units_of_the_parameters(seed, exponents, sigma):
    X, y = linear(seed)
    unit = 10.0 ** torch.tensor(exponents).double()
    reference = minimise(linear_residual(X, y), torch.zeros(3).double(), sigma=sigma, d=0.5, tol=1e-13)
    other = minimise(linear_residual(X * unit, y), torch.zeros(3).double(), sigma=sigma, d=0.5, tol=1e-13)
    torch.testing.assert_close(reference.theta, other.theta * unit, rtol=1e-6, atol=1e-6)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(seed=st.integers(0, 10_000), sigma=st.sampled_from([0.5, 2.0, math.inf]))
def test_a_converged_solution_is_a_stationary_point_no_higher_than_its_start(seed, sigma):
    start = START + 0.2 * sample(seed, 3)
    found = minimise(residual_to(noisy(seed, 0.2)), start, sigma=sigma, d=0.2, max_iter=200, tol=1e-14)
    begin = minimise(residual_to(noisy(seed, 0.2)), start, sigma=sigma, d=0.2, max_iter=1)
    assert float(found.objective) <= float(begin.objective)
    # a draw in a hundred has its minimum at infinity or along a flat valley, and is reported as not converged
    assume(bool(found.converged))
    gradient = torch.einsum("nmp,nm->p", found.jacobian, found.weights * found.residual) / 0.04
    size = found.jacobian.square().sum((0, 1)).sqrt() / 0.2
    assert float((gradient / size).abs().max()) < 1e-4


def test_hac_errors_cover_under_correlated_noise_and_those_for_independent_samples_do_not():
    draws, N = 150, 800
    x = torch.linspace(-2, 2, N).double()
    noise, rho = sample(0, draws, N), 0.6
    for k in range(1, N):
        noise[:, k] = rho * noise[:, k - 1] + math.sqrt(1 - rho**2) * noise[:, k]
    truth = torch.tensor([1.0, 0.8]).double()
    y = truth[0] * torch.exp(truth[1] * x) + 0.3 * noise

    def residual(theta: Tensor, data: Tensor) -> Tensor:
        return (theta[0] * torch.exp(theta[1] * x) - data).unsqueeze(-1)

    start = torch.tensor([0.9, 0.9]).double().expand(draws, 2)
    covered = {}
    for kind in ("hac", "sandwich"):
        found = fit(residual, start, data=y, covariance=kind)
        covered[kind] = ((found.theta - truth).abs() < 1.96 * found.standard_error()).double().mean(0)
    # binomial: three standard deviations of 150 draws are 0.06; HAC is below 0.95 by a few per cent at this N
    assert bool((covered["hac"] > 0.84).all())
    assert bool((covered["hac"] < 0.99).all())
    assert bool((covered["sandwich"] < 0.8).all())


# refusals


def test_without_a_covariance_standard_errors_are_refused():
    found = fit(residual_to(noisy(0)), START, covariance=None)
    assert found.covariance is None
    with pytest.raises(ValueError, match="covariance=None"):
        found.standard_error()


def test_residuals_that_are_not_finite_at_the_start_are_refused_with_their_count():
    y = noisy(0)
    y[3:6] = math.nan
    with pytest.raises(ValueError, match=r"finite at `start`.*got 3 of 120"):
        minimise(residual_to(y), START)


def test_derivatives_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="finite derivatives at `start`"):
        minimise(lambda t: (T + t[0] + t[1].sqrt()).unsqueeze(-1), torch.tensor([1.0, 0.0]).double())


def test_a_step_into_nan_is_shortened():
    found = minimise(lambda t: (torch.log(t) + 3.0).unsqueeze(-1), torch.tensor([5.0]).double())
    torch.testing.assert_close(found.theta, torch.tensor([math.exp(-3.0)]).double())


def test_more_parameters_than_residuals_are_refused():
    with pytest.raises(ValueError, match=r"at least as many residuals as parameters, 3.*got 2"):
        minimise(lambda t: t[:2].unsqueeze(-1), START)
    with pytest.raises(ValueError, match=r"parameters, 3.*got 1"):
        minimise(lambda t: t.unsqueeze(-1), START, weight=torch.tensor([1.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"lower": torch.ones(3), "upper": torch.zeros(3)}, r"`lower` to be at most `upper`.*\[0, 1, 2\]"),
        ({"lower": torch.ones(2)}, "`lower` to be 3 numbers"),
        ({"sigma": 0.0}, "`sigma` to be positive"),
        ({"d": math.inf}, "`d` to be positive and finite"),
        ({"d": torch.ones(2)}, "`d` to be a number"),
        ({"weight": torch.ones(7)}, "`weight` of shape"),
        ({"weight": -torch.ones(120)}, "`weight` to be finite, >= 0"),
        ({"prior": GaussianPrior(torch.zeros(2), torch.ones(2))}, "`prior` with a mean"),
        ({"prior": GaussianPrior(torch.zeros(3), -torch.ones(3))}, "positive semi-definite"),
        ({"equality": lambda t: t[0]}, "`equality` to return"),
        ({"jacobian": "sideways"}, "'forward', 'reverse' or 'reverse twice'"),
        ({"max_iter": 0}, "`max_iter` to be a whole number of at least 1"),
        ({"tol": -1.0}, "`tol` to be >= 0 and finite"),
        ({"data": torch.ones(3, 4)}, None),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    if message is None:
        with pytest.raises(ValueError, match="`data` to begin with the batch dimensions"):
            minimise(lambda t, _: residual_to(noisy(0))(t), START.expand(2, 3), **arguments)
        return
    with pytest.raises(ValueError, match=message):
        minimise(residual_to(noisy(0)), START, **arguments)


@pytest.mark.parametrize("function", [minimise, fit])
def test_bad_starts_and_residuals_are_refused(function):
    with pytest.raises(TypeError, match=r"`start`.*floating-point"):
        function(residual_to(noisy(0)), torch.ones(3, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"`start`.*finite.*got 1"):
        function(residual_to(noisy(0)), torch.tensor([1.0, math.nan, 1.0]).double())
    with pytest.raises(ValueError, match=r"return a tensor \(N, m\).*got shape \(120,\)"):
        function(lambda t: residual_to(noisy(0))(t).squeeze(-1), START)
    with pytest.raises(TypeError, match=r"dtype of `start`, torch.float32.*got torch.float64"):
        function(residual_to(noisy(0)), START.float())


@pytest.mark.parametrize("function", [minimise, fit])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"residual": 3}, "`residual` to be a function of the parameters but got 3"),
        ({"equality": 3}, "`equality` to be a function of the parameters but got 3"),
        ({"equality": lambda _: 3}, r"`equality` to be a function that returns a tensor \(k,\) but got 3"),
        ({"start": START.half()}, r"`start` of dtype float32 or float64 but got torch\.float16; use \.float"),
        ({"residual": lambda _: "text"}, "`residual` to be a function that returns a tensor but got 'text'"),
        ({"start": [1.0, 1.0, 1.0]}, r"`start` .* got list; make a tensor of it, torch\.as_tensor\(start\)"),
        ({"sigma": "a"}, "`sigma` to be a number or a tensor of numbers but got 'a'"),
        ({"weight": "a"}, "`weight` to be a number or a tensor of numbers"),
        ({"lower": "a"}, "`lower` to be a number or a tensor of numbers"),
        ({"prior": 3}, r"`prior` to be a GaussianPrior but got 3; write GaussianPrior\(mean, precision\)"),
        ({"prior": GaussianPrior("a", 3)}, r"`prior\.mean` to be a number or a tensor of numbers but got 'a'"),
        ({"data": "a"}, "`data` to be tensors but got 'a'"),
        ({"tol": "a"}, "`tol` to be a number"),
    ],
)
def test_arguments_of_another_type_are_refused(function, arguments, message):
    given = {"residual": residual_to(noisy(0)), "start": START} | arguments
    with pytest.raises(TypeError, match=message):
        function(given.pop("residual"), given.pop("start"), **given)


def test_sigma_below_its_limit_is_refused_where_the_density_is_normalised():
    minimise(residual_to(noisy(0)), START, sigma=0.04)
    with pytest.raises(ValueError, match=r"`sigma`.*\[0\.05, inf\].*got 0\.04"):
        fit(residual_to(noisy(0)), START, sigma=0.04)


def test_a_narrow_bound_is_refused():
    with pytest.raises(ValueError, match=r"too far from the data.*`bound` of at least two robust scales.*0\.01"):
        fit(residual_to(noisy(0)), START, bound=0.01)
    with pytest.raises(ValueError, match="'sandwich' or 'hac'"):
        fit(residual_to(noisy(0)), START, covariance="classical")
