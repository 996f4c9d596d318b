"""The density fit: derivatives equal to automatic ones, the optimum equal to BFGS, and the remarks of the paper."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import norm
from torch import Tensor

from mkc_torch import fit_density
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density import likelihood
from mkc_torch.density.domain import domain_rule
from mkc_torch.density.likelihood import (
    DensityState,
    energy_derivatives,
    initial_state,
    negative_log_likelihood,
    newton_step,
    normaliser_derivatives,
)
from mkc_torch.linear import LeastSquares, MKCRegression
from tests.draws import normal, uniform

KAPPAS = [0.0, 1e-9, 1e-3, 0.019, 0.021, 0.049, 0.051, 1.0, 50.0, 400.0]


def contaminated(seed: int, count: int, share: float = 0.2, low: float = -20.0, high: float = 20.0) -> Tensor:
    """Standard normal errors with a share of uniform errors, (count,)."""
    e = normal(seed, count)
    bad = round(share * count)
    e[:bad] = low + (high - low) * uniform(seed + 1, bad)
    return e


def graded_rule(panels: int = 40, order: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes on [0, 1] in panels halved towards 0."""
    x, w = np.polynomial.legendre.leggauss(order)
    edges = np.concatenate([[0.0], 0.5 ** np.arange(panels, -1, -1.0)])
    width = np.diff(edges)[:, None]
    return (edges[:-1, None] + width * 0.5 * (x + 1.0)).ravel(), (0.5 * width * w).ravel()


NODES, WEIGHTS = graded_rule()


def plain_energy(q: Tensor, kappa: Tensor) -> Tensor:
    """(1 - exp(-κ q)) / κ from its power series where κ q is small."""
    x = kappa * q
    small = x < 0.5
    inner = torch.where(small, x, 0.0)
    series = sum((-inner) ** j / math.factorial(j + 1) for j in range(18))
    outer = torch.where(small, 1.0, x)
    return q * torch.where(small, series, (1.0 - torch.exp(-outer)) / outer)


def plain_nll(parameters: Tensor, error: Tensor, bound: float, weight: Tensor | None = None) -> Tensor:
    """Mean negative log-likelihood in (κ, log d), written from (17) of the paper."""
    kappa, d = parameters[0], torch.exp(parameters[1])
    energy = plain_energy(0.5 * (error / d) ** 2, kappa)
    u = bound / d * torch.from_numpy(NODES)
    z = 2.0 * bound / d * (torch.from_numpy(WEIGHTS) * torch.exp(-plain_energy(0.5 * u**2, kappa))).sum()
    mean = energy.mean() if weight is None else (weight * energy).sum() / weight.sum()
    return mean + parameters[1] + torch.log(z)


def numpy_nll(log_sigma: float, log_d: float, error: np.ndarray, bound: float) -> float:
    sigma2, d = math.exp(min(2.0 * log_sigma, 60.0)), math.exp(log_d)
    energy = -sigma2 * np.expm1(-0.5 * (error / d) ** 2 / sigma2)
    u = bound / d * NODES
    z = 2.0 * bound / d * (WEIGHTS * np.exp(sigma2 * np.expm1(-0.5 * u**2 / sigma2))).sum()
    return float(energy.mean() + log_d + math.log(z))


def bfgs(error: np.ndarray, bound: float) -> tuple[float, float, float]:
    """Algorithm 2 of the paper from several starts: σ, d and the mean log-likelihood."""
    best = None
    rms = math.sqrt((error**2).mean())
    middle = 1.4826 * np.median(np.abs(error))
    for sigma, d in ((20.0, rms), (3.0, middle), (1.5, middle), (0.8, middle), (0.4, 0.5 * middle)):
        found = minimize(
            lambda p: numpy_nll(p[0], p[1], error, bound), [math.log(sigma), math.log(d)], options={"gtol": 1e-8}
        )
        if best is None or found.fun < best.fun:
            best = found
    return math.exp(best.x[0]), math.exp(best.x[1]), -best.fun


def state_at(kappa: float, log_d: float, bound: float) -> DensityState:
    unit = torch.ones(1, dtype=torch.float64)
    return DensityState(kappa * unit, log_d * unit, math.log(bound) * unit, -20.0 * unit, 1e-3 * unit, 0.0 * unit)


# derivatives


@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("d", [0.3, 2.0])
@pytest.mark.parametrize("weighted", [False, True])
def test_derivatives_equal_autograd_on_the_plain_likelihood(kappa, d, weighted):
    error, bound = contaminated(0, 60), 25.0
    weight = uniform(7, 60) if weighted else None
    at = torch.tensor([kappa, math.log(d)], dtype=torch.float64)
    value = plain_nll(at, error, bound, weight)
    gradient = torch.func.grad(plain_nll)(at, error, bound, weight)
    hessian = torch.func.jacrev(torch.func.grad(plain_nll))(at, error, bound, weight)

    share = None if weight is None else (weight / weight.sum()).unsqueeze(-1)
    k, log_d = at[:1], at[1:]
    fit = energy_derivatives(error.unsqueeze(-1), share, k, log_d)
    norm = normaliser_derivatives(k, log_d, torch.full_like(k, math.log(bound)))
    total = [float(a + b) for a, b in zip(fit, norm, strict=True)]
    expected = [value, gradient[0], gradient[1], hessian[0, 0], hessian[0, 1], hessian[1, 1]]
    for name, got, want in zip(fit._fields, total, expected, strict=True):
        size = max(1.0, abs(float(want)), float(abs(getattr(fit, name))))
        assert abs(got - float(want)) <= 1e-9 * size, (name, got, float(want))


@pytest.mark.parametrize("kappa", KAPPAS)
def test_the_negative_log_likelihood_equals_the_papers(kappa):
    error, bound = contaminated(0, 60), 25.0
    got = negative_log_likelihood(error.unsqueeze(-1), None, state_at(kappa, math.log(0.7), bound))
    expected = plain_nll(torch.tensor([kappa, math.log(0.7)], dtype=torch.float64), error, bound)
    torch.testing.assert_close(got, expected.unsqueeze(0), rtol=1e-11, atol=1e-11)


def test_a_newton_step_never_increases_the_value():
    error = torch.stack([contaminated(s, 80, share) for s, share in ((0, 0.0), (2, 0.3), (4, 0.45))], -1)
    scale = robust_scale(error)
    state = initial_state(error, None, scale, domain_rule(error, scale), 1e-3 * scale)
    for _ in range(20):
        after = newton_step(error, None, state)
        assert bool((after.value <= state.value + 1e-14).all())
        torch.testing.assert_close(after.value, negative_log_likelihood(error, None, after), rtol=0, atol=1e-12)
        state = after


@pytest.mark.parametrize("free", [(True, True), (False, True), (True, False)])
@pytest.mark.parametrize("weighted", [True, False])
def test_a_newton_step_of_a_problem_equals_that_in_a_batch(free, weighted, monkeypatch):
    error = torch.stack([contaminated(s, 80, share) for s, share in ((0, 0.0), (2, 0.3), (4, 0.45))], -1).unsqueeze(0)
    weight = uniform(5, *error.shape) if weighted else None
    weight = None if weight is None else weight / weight.sum(-2, keepdim=True)
    scale = robust_scale(error[0]).unsqueeze(0)
    state = initial_state(error, weight, 3.0 * scale, domain_rule(error, scale), 1e-3 * scale)
    state = replace(state, free_kappa=free[0], free_d=free[1])
    moved = False
    for _ in range(6):
        with monkeypatch.context() as patch:
            patch.setattr(likelihood, "is_short", lambda _: False)
            expected = newton_step(error, weight, state)
        found = newton_step(error, weight, state)
        for field in ("kappa", "log_d", "value"):
            torch.testing.assert_close(getattr(found, field), getattr(expected, field), rtol=1e-9, atol=1e-7)
        moved = moved or bool((found.value < state.value).any())
        state = expected
    assert moved


# the optimum

SAMPLES = {
    "heavy_tailed": (contaminated(0, 200, 0.1), None),
    "very_heavy_tailed": (contaminated(2, 150, 0.4), None),
    "student": (normal(5, 200) / (normal(6, 200, 3).square().mean(-1)).sqrt(), None),
    "cauchy": (normal(8, 100) / normal(9, 100), None),
    "gaussian": (normal(10, 200), None),
    "gaussian_tight_domain": (normal(11, 100), 2.9),
    "one_sided": (contaminated(12, 200, 0.3, 0.0, 20.0), None),
    "one_sided_wide_domain": (contaminated(14, 200, 0.3, 5.0, 20.0), 60.0),
    "tiny_sample": (contaminated(16, 8, 0.25), None),
}


@pytest.mark.parametrize("name", SAMPLES)
def test_the_optimum_equals_bfgs(name):
    error, bound = SAMPLES[name]
    fit = fit_density(error.unsqueeze(-1), bound=bound, d_min=1e-4)
    assert bool(fit.converged.all())
    sigma, d, value = bfgs(error.numpy(), float(fit.bound))
    assert float(fit.log_likelihood) >= value - 1e-9
    if sigma < 20.0:
        assert float(fit.log_likelihood) == pytest.approx(value, abs=1e-8)
        assert float(fit.sigma) == pytest.approx(sigma, rel=1e-3)
    assert float(fit.d) == pytest.approx(d, rel=1e-3)


def test_steps_from_every_corner_of_the_parameters_converge_to_the_optimum():
    edges = torch.tensor(list(itertools.product([0.0, 400.0], [0.1, 1.0, 40.0])), dtype=torch.float64)
    kappa, d = edges.unbind(-1)
    for name in ("heavy_tailed", "very_heavy_tailed"):
        error = SAMPLES[name][0].unsqueeze(-1)
        fit = fit_density(error, bound=40.0, d_min=0.1)
        log_bound, log_d_min = torch.full_like(d, math.log(40.0)), torch.full_like(d, math.log(0.1))
        state = DensityState(kappa, torch.log(d), log_bound, log_d_min, torch.full_like(d, 1e-3), d)
        for _ in range(80):
            state = newton_step(error.expand(-1, 6), None, state)
        torch.testing.assert_close(torch.exp(state.log_d), fit.d.expand(6), rtol=1e-6, atol=0)
        torch.testing.assert_close(state.kappa, fit.sigma.pow(-2).expand(6), rtol=1e-6, atol=0)


def test_steps_are_counted_and_a_truncated_fit_is_not_converged():
    error = SAMPLES["one_sided_wide_domain"][0].unsqueeze(-1)
    cut = fit_density(error, max_iter=3)
    assert cut.n_iter == 3
    assert not bool(cut.converged.any())
    whole = fit_density(error)
    assert bool(whole.converged.all())
    assert 3 < whole.n_iter < 50
    assert float(whole.log_likelihood) > float(cut.log_likelihood)


@pytest.mark.parametrize("name", SAMPLES)
def test_the_log_likelihood_is_the_mean_log_density(name):
    error, bound = SAMPLES[name]
    fit = fit_density(error.unsqueeze(-1), bound=bound)
    log_sigma = min(math.log(float(fit.sigma)), 15.0)
    expected = -numpy_nll(log_sigma, math.log(float(fit.d)), error.numpy(), float(fit.bound))
    assert float(fit.log_likelihood) == pytest.approx(expected, abs=1e-9)


def test_channels_and_batches_are_fitted_independently():
    error = torch.stack([contaminated(s, 120, 0.05 * s) for s in range(6)]).reshape(2, 3, 120).mT
    error = error * torch.tensor([1e-3, 1.0, 1e4], dtype=torch.float64)
    fit = fit_density(error)
    assert (
        fit.sigma.shape == fit.d.shape == fit.bound.shape == fit.log_likelihood.shape == fit.converged.shape == (2, 3)
    )
    for i in range(2):
        for k in range(3):
            alone = fit_density(error[i, :, k : k + 1])
            torch.testing.assert_close(fit.d[i, k], alone.d[0], rtol=1e-6, atol=0)
            torch.testing.assert_close(fit.sigma[i, k], alone.sigma[0], rtol=1e-6, atol=0)
            torch.testing.assert_close(fit.log_likelihood[i, k], alone.log_likelihood[0], rtol=0, atol=1e-10)


def test_gaussian_residuals_get_an_infinite_sigma_and_their_rms():
    # normal quantiles have lighter tails than the Gaussian density, so that no finite σ is more likely
    error = torch.from_numpy(norm.ppf((np.arange(400) + 0.5) / 400)).unsqueeze(-1)
    fit = fit_density(error)
    assert math.isinf(float(fit.sigma))
    assert float(fit.d) == pytest.approx(float(error.square().mean().sqrt()), rel=1e-9)


def test_half_of_gaussian_samples_get_an_infinite_sigma_and_the_others_gain_little():
    # κ = 0 is on the boundary of the parameters: its score has either sign with probability 1/2, and twice the gain in
    # likelihood is half a χ² variable of one degree of freedom, so that the mean gain is 1/4
    error = normal(0, 400, 100, 1)
    fit = fit_density(error, bound=12.0)
    gaussian = fit_density(error, bound=12.0, sigma=math.inf)
    gain = 100 * (fit.log_likelihood - gaussian.log_likelihood)
    assert float(torch.isinf(fit.sigma).double().mean()) > 0.45
    assert bool((gain >= -1e-9).all())
    assert float(gain.mean()) < 0.35


def test_every_fit_at_its_optimum_is_converged():
    fit = fit_density(normal(0, 400, 100, 1))
    assert bool(fit.converged.all()), f"{int((~fit.converged).sum())} of 400 not"


def test_a_mixture_with_a_flat_tail_is_recovered():
    sigma, d, a = 2.0, 0.5, 20.0
    u = np.linspace(-a / d, a / d, 400_001)
    density = np.exp(-(sigma**2) * -np.expm1(-(u**2) / (2 * sigma**2)))
    cumulated = np.cumsum(density) / density.sum()
    error = torch.from_numpy(np.interp((np.arange(20_000) + 0.5) / 20_000, cumulated, u * d)).unsqueeze(-1)
    fit = fit_density(error, bound=a)
    assert float(fit.sigma) == pytest.approx(sigma, rel=2e-3)
    assert float(fit.d) == pytest.approx(d, rel=2e-3)


# Remarks 6 and 7


def test_with_a_given_d_sigma_is_optimal():
    error, d = contaminated(0, 150), 0.9
    fit = fit_density(error.unsqueeze(-1), d=d, bound=30.0)
    assert float(fit.d) == pytest.approx(d, rel=1e-14)
    found = minimize_scalar(
        lambda s: numpy_nll(s, math.log(d), error.numpy(), 30.0),
        bounds=(-3.0, 3.0),
        method="bounded",
        options={"xatol": 1e-9},
    )
    assert float(fit.sigma) == pytest.approx(math.exp(found.x), rel=1e-5)
    assert float(fit.log_likelihood) == pytest.approx(-found.fun, abs=1e-10)


@pytest.mark.parametrize("sigma", [0.7, 2.0, 10.0])
def test_with_a_given_sigma_d_is_optimal(sigma):
    error = contaminated(0, 150)
    fit = fit_density(error.unsqueeze(-1), sigma=sigma, bound=30.0)
    assert float(fit.sigma) == pytest.approx(sigma, rel=1e-14)
    values = [numpy_nll(math.log(sigma), s, error.numpy(), 30.0) for s in np.linspace(-2.0, 3.0, 400)]
    start = np.linspace(-2.0, 3.0, 400)[int(np.argmin(values))]
    found = minimize_scalar(
        lambda s: numpy_nll(math.log(sigma), s, error.numpy(), 30.0),
        bounds=(start - 0.1, start + 0.1),
        method="bounded",
        options={"xatol": 1e-9},
    )
    assert float(fit.d) == pytest.approx(math.exp(found.x), rel=1e-5)


def test_an_infinite_sigma_gives_the_rms_on_a_wide_domain():
    error = torch.stack([contaminated(0, 100, 0.1), normal(3, 100)], -1)
    fit = fit_density(error, sigma=math.inf, bound=1e4)
    torch.testing.assert_close(fit.d, error.square().mean(-2).sqrt(), rtol=1e-9, atol=0)
    assert bool(torch.isinf(fit.sigma).all())


def test_given_parameters_may_differ_by_channel():
    error = torch.stack([contaminated(0, 100, 0.1), contaminated(3, 100, 0.1)], -1)
    fit = fit_density(error, d=torch.tensor([0.5, 1.5], dtype=torch.float64))
    torch.testing.assert_close(fit.d, torch.tensor([0.5, 1.5], dtype=torch.float64))
    fit = fit_density(error, bound=torch.tensor([30.0, 70.0], dtype=torch.float64))
    torch.testing.assert_close(fit.bound, torch.tensor([30.0, 70.0], dtype=torch.float64))


# weights, floor, domain


def test_integer_weights_equal_repetition():
    error = contaminated(0, 60).unsqueeze(-1)
    count = 1 + (torch.arange(60) % 3)
    weighted = fit_density(error, weight=count.double().unsqueeze(-1), bound=25.0, d_min=1e-3)
    repeated = fit_density(error.repeat_interleave(count, 0), bound=25.0, d_min=1e-3)
    torch.testing.assert_close(weighted.d, repeated.d, rtol=1e-6, atol=0)
    torch.testing.assert_close(weighted.sigma, repeated.sigma, rtol=1e-6, atol=0)
    torch.testing.assert_close(weighted.log_likelihood, repeated.log_likelihood, rtol=0, atol=1e-10)


@pytest.mark.parametrize("share", [0.2, 0.6])
def test_weight_zero_equals_removal(share):
    error = contaminated(0, 100)
    junk = torch.full((round(share / (1 - share) * 100),), 1e5, dtype=torch.float64)
    weight = torch.cat([torch.ones(100), torch.zeros(junk.shape[0])]).double().unsqueeze(-1)
    fit = fit_density(torch.cat([error, junk]).unsqueeze(-1), weight=weight)
    alone = fit_density(error.unsqueeze(-1))
    torch.testing.assert_close(fit.bound, alone.bound)
    torch.testing.assert_close(fit.d, alone.d, rtol=1e-6, atol=0)
    torch.testing.assert_close(fit.sigma, alone.sigma, rtol=1e-6, atol=0)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_the_fit_does_not_depend_on_the_scale_of_the_weights(factor):
    error, weight = contaminated(0, 60).unsqueeze(-1), uniform(7, 60).unsqueeze(-1)
    first, other = fit_density(error, weight=weight), fit_density(error, weight=factor * weight)
    torch.testing.assert_close((first.sigma, first.d), (other.sigma, other.d), rtol=1e-6, atol=0)


def test_d_stays_above_its_floor_if_the_likelihood_is_unbounded():
    error = torch.cat([1e-9 * normal(1, 40), normal(0, 20)]).unsqueeze(-1)
    fit = fit_density(error, d_min=0.01, bound=10.0)
    assert float(fit.d) == pytest.approx(0.01, rel=1e-12)
    assert math.isfinite(float(fit.log_likelihood))


def test_the_default_floor_is_a_tenth_of_the_robust_scale():
    error = torch.cat([1e-9 * normal(1, 24), normal(0, 26)]).unsqueeze(-1)
    fit = fit_density(error)
    assert float(fit.d) >= 0.1 * 1.4826 * float(error.abs().median()) * (1 - 1e-12)


def test_the_domain_is_half_the_range_and_at_least_ten_scales():
    error = torch.tensor([[-1.0, -3.0], [0.0, 0.0], [5.0, 41.0]], dtype=torch.float64)
    scale = torch.tensor([1.0, 2.0], dtype=torch.float64)
    assert domain_rule(error, scale).tolist() == [10.0, 22.0]
    assert domain_rule(error, scale, scales=2.0).tolist() == [3.0, 22.0]
    used = torch.tensor([[True, True], [True, True], [False, False]])
    assert domain_rule(error, scale, used).tolist() == [10.0, 20.0]
    assert domain_rule(error, scale, used, scales=0.25).tolist() == [0.5, 1.5]


def test_the_default_domain_follows_its_rule():
    error = torch.stack([contaminated(0, 100), normal(3, 100)], -1)
    expected = torch.maximum(0.5 * (error.amax(0) - error.amin(0)), 10 * 1.4826 * error.abs().sort(0).values[49])
    torch.testing.assert_close(fit_density(error).bound, expected)


def test_likelihoods_depend_on_the_domain():
    error = contaminated(0, 100).unsqueeze(-1)
    values = [float(fit_density(error, bound=a).log_likelihood) for a in (20.0, 200.0, 2000.0)]
    assert values[0] > values[1] > values[2]


def test_residuals_that_are_all_zero_give_finite_numbers():
    error = torch.stack([torch.zeros(20).double(), normal(0, 20)], -1)
    fit = fit_density(error)
    assert bool(torch.isfinite(fit.d).all())
    assert bool(torch.isfinite(fit.log_likelihood).all())
    torch.testing.assert_close(fit.d[1], fit_density(error[:, 1:]).d[0], rtol=1e-9, atol=0)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 1000),
    share=st.sampled_from([0.0, 0.1, 0.4]),
    exponent=st.integers(-12, 12),
    sign=st.sampled_from([-1.0, 1.0]),
)
def test_scaling_the_residuals_scales_d_and_not_sigma(seed, share, exponent, sign):
    error = contaminated(seed, 50, share).unsqueeze(-1)
    factor = 10.0**exponent
    first, other = fit_density(error), fit_density(sign * factor * error)
    torch.testing.assert_close(other.d, factor * first.d, rtol=1e-5, atol=0)
    torch.testing.assert_close(other.bound, factor * first.bound, rtol=1e-12, atol=0)
    torch.testing.assert_close(other.sigma.pow(-2), first.sigma.pow(-2), rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(other.log_likelihood, first.log_likelihood - math.log(factor), rtol=0, atol=1e-9)


def test_float32_stays_float32_and_is_close():
    error = torch.stack([contaminated(0, 200), normal(3, 200)], -1)
    fit, exact = fit_density(error.float()), fit_density(error)
    assert fit.d.dtype == fit.sigma.dtype == fit.log_likelihood.dtype == torch.float32
    torch.testing.assert_close(fit.log_likelihood.double(), exact.log_likelihood, rtol=0, atol=1e-4)
    torch.testing.assert_close(fit.d.double(), exact.d, rtol=2e-2, atol=0)


def test_every_fit_in_float32_is_converged():
    fit = fit_density(torch.stack([contaminated(s, 200, 0.05 * (s % 5)) for s in range(20)], -1).float())
    assert bool(fit.converged.all()), f"{int((~fit.converged).sum())} of 20 not"


# errors


@pytest.mark.parametrize("shape", [(5,), (1, 2), (0, 1)])
def test_fewer_than_two_residuals_are_refused(shape):
    with pytest.raises(ValueError, match=r"shape \(\*, N >= 2, m\)"):
        fit_density(torch.ones(shape))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_residuals_that_are_not_finite_are_refused(bad):
    error = normal(0, 10, 1)
    error[3] = bad
    with pytest.raises(ValueError, match="finite"):
        fit_density(error)


@pytest.mark.parametrize("name", ["sigma", "d", "bound", "d_min"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_parameters_that_are_not_positive_are_refused(name, value):
    with pytest.raises(ValueError, match=f"`{name}`"):
        fit_density(normal(0, 10, 1), **{name: value})


@pytest.mark.parametrize("name", ["d", "bound", "d_min"])
def test_infinite_parameters_other_than_sigma_are_refused(name):
    with pytest.raises(ValueError, match=f"`{name}`"):
        fit_density(normal(0, 10, 1), **{name: math.inf})


@pytest.mark.parametrize("weight", [torch.zeros(10, 1), -torch.ones(10, 1), torch.full((10, 1), math.nan)])
def test_weights_that_are_negative_or_all_zero_are_refused(weight):
    with pytest.raises(ValueError, match="weight"):
        fit_density(normal(0, 10, 1), weight=weight.double())


def test_weights_of_another_shape_are_refused_with_a_remedy():
    error = normal(0, 10, 10)
    with pytest.raises(ValueError, match=r"`weight` of shape \(10, 10\) or \(10, 1\).*got \(10,\);.*weight\[:, None\]"):
        fit_density(error, weight=torch.ones(10))
    with pytest.raises(ValueError, match=r"`weight` of shape \(10, 10\) or \(10, 1\).*got \(3, 10\)\."):
        fit_density(error, weight=torch.ones(3, 10))
    with pytest.raises(ValueError, match=r"`weight` .* channels of the sums \[0\.0\]"):
        fit_density(error[:, :1], weight=torch.zeros(10, 1))
    once = fit_density(error, weight=torch.ones(10, 1))
    torch.testing.assert_close(once.d, fit_density(error).d)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        ([[0.0]] * 10, r"`error` .* got list; make a tensor of it, torch\.as_tensor\(error\)"),
        (torch.zeros(10, 1, dtype=torch.int64), r"`error` .* got torch\.int64; convert it, .*error\.double\(\)"),
        (torch.zeros(10, 1).half(), r"`error` of dtype float32 or float64 but got torch\.float16; use \.float"),
        (torch.zeros(10, 1) + 0j, r"`error` .* got torch\.complex64"),
    ],
)
def test_residuals_of_another_type_are_refused_with_a_remedy(error, message):
    with pytest.raises(TypeError, match=message):
        fit_density(error)


def test_a_missing_channel_dimension_is_refused_with_a_remedy():
    with pytest.raises(ValueError, match=r"but got \(1000,\);.*error\[:, None\]"):
        fit_density(torch.zeros(1000))
    with pytest.raises(ValueError, match=r"at least one channel.*got \(10, 0\)"):
        fit_density(torch.zeros(10, 0))


@pytest.mark.parametrize("name", ["sigma", "d", "bound", "d_min"])
def test_parameters_that_are_not_numbers_or_of_another_shape_are_refused(name):
    with pytest.raises(TypeError, match=rf"`{name}`.*number.*got 'a'"):
        fit_density(normal(0, 10, 2), **{name: "a"})
    with pytest.raises(ValueError, match=rf"`{name}`.*number or of shape \(m,\) or \(2,\).*got \(3,\)"):
        fit_density(normal(0, 10, 2), **{name: torch.full((3,), 9.0)})


def test_arguments_out_of_range_are_refused():
    for options, message in (
        ({"sigma": 0.01}, r"`sigma` to be in \[0\.05, inf\] but got 0\.01"),
        ({"d": 30.0, "bound": 20.0}, "`d` below `bound` but got 30.0 and 20.0"),
        ({"d_min": 1e9}, r"`d_min` below the half-width of the domain, \[.*\], but got 1000000000"),
        ({"max_iter": 0}, "`max_iter` to be a whole number of at least 1 but got 0"),
        ({"tol": -1.0}, "`tol` to be >= 0 and finite but got -1"),
        ({"tol": math.nan}, "`tol` to be >= 0 and finite but got nan"),
    ):
        with pytest.raises(ValueError, match=message):
            fit_density(normal(0, 10, 1), **options)


# Barron's line


def barron_line() -> tuple[Tensor, Tensor]:
    """The toy regression of Barron, "A General and Adaptive Robust Loss Function" (2019): X (slope, intercept), y."""
    random = np.random.RandomState(1)
    x = random.uniform(size=50)
    y = 0.7 * x + 0.15 + random.normal(scale=0.025, size=50)
    flipped = random.uniform(size=50) > 0.9
    y = np.where(flipped, 0.05 + 0.4 * (1.0 - np.sign(y - 0.5)), y)
    return torch.from_numpy(np.stack([x, np.ones(50)], -1)), torch.from_numpy(y)


def test_barrons_line_has_the_published_likelihood():
    X, y = barron_line()
    expected = torch.tensor([0.51121488, 0.24678294], dtype=torch.float64)
    torch.testing.assert_close(LeastSquares().fit(X, y).coef_, expected, rtol=1e-7, atol=0)
    fit = MKCRegression(bound=1.0).fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.tensor([0.709619, 0.149875], dtype=torch.float64), rtol=1e-5, atol=0)
    assert float(fit.d_) == pytest.approx(0.020170, rel=1e-4)
    assert float(fit.sigma_) == pytest.approx(2.39579, rel=1e-4)
    assert -float(fit.log_likelihood_) / 50 == pytest.approx(-1.702394, abs=1e-6)
    wide = MKCRegression(bound=10.0).fit(X, y)
    assert -float(wide.log_likelihood_) / 50 == pytest.approx(-1.469973, abs=1e-6)


@pytest.mark.parametrize(("dtype", "size"), [(torch.float64, 1e300), (torch.float32, 1e20)])
def test_residuals_whose_squares_overflow_are_refused(dtype, size):
    error = torch.linspace(-1.0, 1.0, 50, dtype=dtype).unsqueeze(-1)
    error[3] = size
    with pytest.raises(ValueError, match=r"`error` within.*, beyond which squares overflow.*got 1e\+"):
        fit_density(error)


def test_arrays_and_frames_are_fitted_like_tensors():
    error = torch.randn(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weight = torch.ones(200, 1)
    weight[:50] = 0.0
    want = fit_density(error, weight=weight)
    frame = pytest.importorskip("pandas").DataFrame(error.numpy(), columns=["a", "b"])
    for values in (error.numpy(), frame):
        got = fit_density(values, weight=weight.numpy())
        assert torch.equal(got.sigma, want.sigma)
        assert torch.equal(got.d, want.d)
    with pytest.raises(TypeError, match=r"column `b` of argument `error` .* text"):
        fit_density(frame.assign(b="x"))
