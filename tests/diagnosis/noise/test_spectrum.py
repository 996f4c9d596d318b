"""Cosine transforms, noise spectra, and pseudo-residuals."""

import itertools
import math

import numpy as np
import pytest
import scipy.fft
import torch
from scipy import signal, stats

from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.noise.outliers import pseudo_residual
from mkc_torch.diagnosis.noise.spectrum import (
    NoiseSpectrum,
    _levinson,
    autoregressive,
    cosines,
    dct,
    dct_of_courses,
    enters_at_port,
    inverse_dct,
    port_autoregression,
    spectrum_of,
)
from mkc_torch.functional import mkc_energy
from tests.simulation.tumbling import turns

AR2 = torch.tensor([1.2, -0.5], dtype=torch.float64)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def randn(*size, seed=0):
    return torch.randn(*size, generator=generator(seed), dtype=torch.float64)


def whitened(spectrum, values):
    """Return the slowest cosine coefficients in units of the spectrum's root, channels stacked."""
    return spectrum.scaled(dct(values, len(spectrum.root)))


def coloured(phi, N, seed=0):
    """Return a stationary autoregression by SciPy's filter."""
    noise = np.random.default_rng(seed).standard_normal(N + 2000)
    return torch.from_numpy(signal.lfilter([1.0], np.concatenate([[1.0], -np.asarray(phi)]), noise)[2000:].copy())


@pytest.mark.parametrize("N", [1, 2, 3, 8, 9, 360, 4501])
@pytest.mark.parametrize("rest", [(), (3,), (2, 3)])
def test_the_cosine_transform_agrees_with_scipy(N, rest):
    values = randn(N, *rest)
    expected = scipy.fft.dct(values.numpy(), axis=0, norm="ortho")
    np.testing.assert_allclose(dct(values), expected, atol=1e-11)
    np.testing.assert_allclose(inverse_dct(values), scipy.fft.idct(values.numpy(), axis=0, norm="ortho"), atol=1e-11)
    torch.testing.assert_close(inverse_dct(dct(values)), values, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize(("N", "kept", "courses"), [(20, 20, 3), (21, 9, 4), (40, 40, 4), (61, 61, 6)])
def test_the_transform_of_modulated_courses_is_the_transform_of_their_products(N, kept, courses):
    values = randn(N, 2, 3)
    products = values[:, :, None, :] * cosines(courses, N)[:, None, :, None]
    expected = scipy.fft.dct(products.flatten(2).numpy(), axis=0, norm="ortho")[:kept]
    found = dct_of_courses(values, courses, kept)
    torch.testing.assert_close(found, torch.from_numpy(expected), rtol=1e-12, atol=1e-12)


def test_the_cosine_transform_keeps_the_dtype_and_accepts_no_columns():
    assert dct(torch.ones(8)).dtype == torch.float32
    assert dct(torch.zeros(5, 0)).shape == (5, 0)
    np.testing.assert_allclose(dct(randn(64).float()), scipy.fft.dct(randn(64).numpy(), norm="ortho"), atol=1e-5)


def test_the_cosine_transform_of_white_noise_is_white():
    coefficients = dct(randn(500, 400))
    power = coefficients.square().mean(1)
    assert float((power - 1.0).abs().max()) < 5.0 * math.sqrt(2.0 / 400)
    correlation = torch.corrcoef(coefficients[:20]) - torch.eye(20, dtype=torch.float64)
    assert float(correlation.abs().max()) < 0.25


def test_a_random_walk_is_nearly_diagonal_in_cosines():
    """Its coefficients are independent except for its end, with standard deviations proportional to 1/k."""
    walk = randn(300, 20_000, seed=1).cumsum(0)
    coefficients = dct(walk - walk.mean(0))
    spread = coefficients.std(1)
    k = torch.arange(1, 30, dtype=torch.float64)
    torch.testing.assert_close(spread[1:30] / spread[1], 1.0 / k, rtol=0.05, atol=0.0)
    correlation = torch.corrcoef(coefficients[1:15]) - torch.eye(14, dtype=torch.float64)
    assert float(correlation.abs().max()) < 0.05


def test_cosines_are_orthogonal_with_unit_mean_square():
    courses = cosines(40, 300)
    assert courses.shape == (300, 40)
    torch.testing.assert_close(courses.mT @ courses / 300.0, torch.eye(40, dtype=torch.float64))
    torch.testing.assert_close(courses.sum(0), torch.zeros(40, dtype=torch.float64), rtol=0.0, atol=1e-10)
    expected = math.sqrt(300.0) * torch.eye(300, dtype=torch.float64)[:, 1:41]
    torch.testing.assert_close(dct(courses), expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("phi", [[0.9], [-0.6], [1.2, -0.5]])
def test_draws_have_the_autocovariance_of_their_autoregression(phi):
    drawn = autoregressive(torch.tensor(phi, dtype=torch.float64), 400, 1500, generator())
    assert drawn.shape == (400, 1500)
    frequency = np.linspace(0.0, np.pi, 20_001)
    response = signal.freqz([1.0], np.concatenate([[1.0], -np.asarray(phi)]), frequency)[1]
    expected = [np.trapezoid(np.abs(response) ** 2 * np.cos(lag * frequency), frequency) / np.pi for lag in range(8)]
    found = [float((drawn[: 400 - lag] * drawn[lag:]).mean()) for lag in range(8)]
    np.testing.assert_allclose(found, expected, atol=0.03 * expected[0])
    # stationary: the variance is constant in time
    power = drawn.square().mean(1)
    assert float((power / expected[0] - 1.0).abs().max()) < 6.0 * math.sqrt(2.0 / 1500)


def test_draws_are_not_periodic():
    drawn = autoregressive(torch.tensor([0.95], dtype=torch.float64), 200, 4000, generator())
    ends = torch.corrcoef(drawn[[0, -1]])[0, 1]
    assert abs(float(ends)) < 0.06


@pytest.mark.parametrize("phi", [[], [0.8], [0.97], [1.2, -0.5]])
def test_the_spectrum_whitens_an_autoregression(phi):
    noise = torch.stack([coloured(phi, 4000, seed) for seed in (1, 2)], -1)
    noise_spectrum = spectrum_of(dct(noise).square())
    white = whitened(noise_spectrum, noise).unflatten(0, (4000, 2))
    assert float(white.square().mean()) == pytest.approx(1.0, abs=0.03)
    # the periodogram is flat in eight bands
    edges = [0, 40, 100, 250, 500, 1000, 2000, 3000, 4000]
    for low, high in itertools.pairwise(edges):
        level = white[low:high].square().mean()
        assert float(level) == pytest.approx(1.0, abs=4.0 * math.sqrt(1.0 / (high - low)) + 0.05)
    series = inverse_dct(white)
    lags = torch.stack([(series[lag:] * series[: 4000 - lag]).mean() for lag in range(1, 6)])
    assert float(lags.abs().max()) < 0.06


def test_the_spectrum_has_order_and_coefficients_of_the_autoregression():
    found = spectrum_of(dct(coloured(AR2.numpy(), 6000).unsqueeze(-1)).square())
    assert found.order == 2
    torch.testing.assert_close(found.coefficients[0], AR2, rtol=0.0, atol=0.05)
    assert spectrum_of(dct(randn(6000, 2)).square()).order == 0


def test_each_channel_has_its_own_spectrum():
    noise = torch.stack([coloured([0.9], 4000), 5.0 * randn(4000, seed=3)], -1)
    noise_spectrum = spectrum_of(dct(noise).square())
    assert [len(phi) for phi in noise_spectrum.coefficients] == [1, 0]
    white = whitened(noise_spectrum, noise).unflatten(0, (4000, 2))
    torch.testing.assert_close(white.square().mean(0), torch.ones(2, dtype=torch.float64), rtol=0.0, atol=0.05)


@pytest.fixture(scope="module")
def whitened_walks():
    """Mean power of whitened white noise plus a random walk, which an autoregression of order 12 cannot describe."""
    power = torch.zeros(4000, dtype=torch.float64)
    for seed in range(40):
        noise = randn(4000, 1, seed=100 + seed) + 0.01 * randn(4000, 1, seed=200 + seed).cumsum(0)
        noise = noise - noise.mean()
        power += whitened(spectrum_of(dct(noise).square()), noise).square() / 40
    assert float(dct(noise)[1:4].square().mean()) > 10.0
    return power


@pytest.mark.parametrize(("low", "high", "most"), [(1, 4, 3.5), (4, 10, 1.5), (10, 30, 1.2), (30, 4000, 1.05)])
def test_the_spectrum_includes_slow_noise(whitened_walks, low, high, most):
    assert 0.75 < float(whitened_walks[low:high].mean()) < most


def test_the_spectrum_includes_the_slowest_noise(whitened_walks):
    assert float(whitened_walks[1:4].mean()) < 1.75


def test_a_zero_channel_has_order_zero():
    noise_spectrum = spectrum_of(torch.zeros(500, 1, dtype=torch.float64))
    assert noise_spectrum.order == 0


def test_whitening_keeps_the_slowest_coefficients_and_stacks_channels():
    values = randn(50, 2, 3)
    root = torch.arange(1.0, 21.0, dtype=torch.float64).reshape(10, 2)
    white = whitened(NoiseSpectrum((AR2, AR2[:0]), root), values)
    torch.testing.assert_close(white, (dct(values)[:10] / root.unsqueeze(-1)).reshape(20, 3))
    assert NoiseSpectrum((AR2, AR2[:0]), root).order == 2


def turning(rate, N=12_000):
    """Return the residual of three slow axes along a turning direction, and the direction."""
    angle = rate * torch.arange(N, dtype=torch.float64)
    direction = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1).unsqueeze(1)
    noise = torch.stack([coloured([0.9], N, seed) for seed in range(3)], -1)
    return torch.einsum("nmc,nc->nm", direction, noise), direction


def test_the_autoregression_of_a_turning_port_is_recovered():
    residual, direction = turning(0.1)
    assert spectrum_of(dct(residual).square()).order > 1
    assert port_autoregression(residual, direction).tolist() == [pytest.approx(0.9, abs=0.02)]
    assert len(port_autoregression(randn(2000, 1), direction[:2000])) == 0


@pytest.mark.parametrize(
    ("covariance", "kept"),
    [
        ([1.0, 1.02, 1.01, 1.0, 0.95], [0.999]),
        ([1.0, 0.8, 0.1, 0.2, 0.95], [0.8]),
        ([1.0, 0.8, 0.1, 0.2, -0.95], [0.8]),
        ([1.0, 1.002, 1.002, 1.003, 1.008, 1.007, 1.002, 1.006, 1.0035, 1.0036, 1.0036, 1.0036, 1.006], [0.999]),
    ],
)
def test_invalid_autocovariances_are_used_up_to_the_last_valid_lag(covariance, kept):
    """Nearly constant noise at a turning port has such autocovariances once the rotation is divided out."""
    found = _levinson(torch.tensor(covariance).double().unsqueeze(-1), 1000)[:, 0]
    assert found.tolist() == pytest.approx([*kept, *[0.0] * (len(covariance) - 1 - len(kept))])
    assert bool(autoregressive(found, 500, 3, generator()).isfinite().all())


def test_the_autoregression_of_a_fast_turning_port_is_stationary():
    phi = port_autoregression(*turning(0.4))
    poles = np.abs(np.roots([1.0, *(-phi).tolist()]))
    assert poles.size == 0 or poles.max() < 1.0


def test_the_pseudo_residual_of_least_squares_is_the_residual():
    error = randn(100, 2)
    values, counts = pseudo_residual(
        error, torch.tensor([math.inf, math.inf]).double(), torch.tensor([1.0, 0.3]).double(), 0.1
    )
    assert torch.equal(values, error)
    assert torch.equal(counts, torch.ones_like(error))


def test_the_pseudo_residual_is_the_score_over_its_mean_slope():
    error, sigma, d = 1.5 * randn(400, 1), torch.tensor([1.8]).double(), torch.tensor([0.7]).double()

    def energy(e):
        return mkc_energy(e, sigma, d).sum()

    values, counts = pseudo_residual(error, sigma, d, 0.1)
    score = torch.func.grad(energy)(error)
    slope = torch.func.vmap(torch.func.grad(lambda e: torch.func.grad(energy)(e).sum()))(error)
    used = counts > 0
    assert 0.5 < float(counts.mean()) < 1.0
    torch.testing.assert_close(values[used], (score / slope[used].mean())[used])
    assert torch.equal(values[~used], torch.zeros_like(values[~used]))
    weight = torch.exp(-0.5 * (error / (d * sigma)).square())
    assert torch.equal(used, weight >= 0.1)


def test_least_squares_on_pseudo_residuals_is_the_robust_estimate_to_first_order():
    """A step from the truth is nearly the maximum-likelihood location, and far more precise than the mean."""
    draws = []
    for seed in range(40):
        error = randn(400, 1, seed=seed)
        error[::5] += 30.0
        found = fit_density(error, bound=60.0)
        values, counts = pseudo_residual(error, found.sigma, found.d, 0.1)
        draws.append(float(values.sum() / counts.sum()))
    assert np.std(draws) < 1.4 * math.sqrt(1.0 / 320)
    assert abs(np.mean(draws)) < 4.0 * np.std(draws) / math.sqrt(40)


def test_the_spread_of_pseudo_residuals_equals_the_spread_of_the_estimate():
    error = torch.from_numpy(stats.t(4).rvs(4000, random_state=0)).unsqueeze(-1)
    found = fit_density(error)
    values, counts = pseudo_residual(error, found.sigma, found.d, 0.1)
    # the mean of values has the sandwich variance of the location, which for this t is near its bound of 7/5
    predicted = float(values.square().mean() / counts.mean().square())
    assert predicted == pytest.approx(1.4, abs=0.15)


def test_the_entry_of_noise_at_a_port_is_detected():
    axes = torch.from_numpy(turns(np.arange(3000) / 50.0).as_matrix().copy())
    right = 0
    for seed in range(10):
        noise = torch.stack([coloured([0.98], 3000, 10 * seed + k) for k in range(3)], -1)
        white = 0.5 * randn(3000, 3, seed=seed)
        right += enters_at_port(white + torch.einsum("nmc,nc->nm", axes, noise), axes)
        right += not enters_at_port(white + noise, axes)
    assert right >= 18


def test_an_offset_does_not_change_the_spectrum():
    power = torch.randn(400, 2, generator=torch.Generator().manual_seed(12), dtype=torch.float64).square()
    shifted = power.clone()
    shifted[0] = 1e5
    torch.testing.assert_close(spectrum_of(shifted).root, spectrum_of(power).root)
