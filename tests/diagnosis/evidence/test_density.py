"""Checks of the residual density by the probability-integral transform, and against a Student-t."""

import numpy as np
import pytest
import torch
from scipy import stats

from mkc_torch import MKCDistribution, diagnose
from mkc_torch._support.effective_size import effective_size
from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.evidence.residual_noise import (
    density_checks,
    kolmogorov,
    student_cdf,
    student_fit,
)
from mkc_torch.diagnosis.findings.warnings import density_warnings
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import tumbling

N = 4500


def checks_of(*channels):
    """Return the density checks of residuals, each channel with its fitted density."""
    residual = torch.stack([torch.as_tensor(channel) for channel in channels], -1)
    fit = fit_density(residual)
    return density_checks(
        residual, fit.sigma, fit.d, fit.bound, [f"channel_{k}" for k in range(len(channels))], EvidenceSettings()
    )


def warnings_of(*channels):
    return density_warnings(checks_of(*channels))


def mkc(seed):
    torch.manual_seed(seed)
    parameters = (torch.tensor(v, dtype=torch.float64) for v in (2.0, 0.5, 15.0))
    return MKCDistribution(*parameters).sample((N,))


def gaussian(seed):
    return 0.5 * np.random.default_rng(seed).standard_normal(N)


def student(seed, freedom=2.0):
    return 0.5 * np.random.default_rng(seed).standard_t(freedom, N)


def autoregressive(draws, phi):
    out = np.empty_like(draws)
    out[0] = draws[0] / np.sqrt(1.0 - phi**2)
    for k in range(1, len(draws)):
        out[k] = phi * out[k - 1] + draws[k]
    return out


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("draw", [mkc, gaussian])
def test_residuals_drawn_from_the_density_have_no_warning(draw, seed):
    assert warnings_of(draw(seed)) == ()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("freedom", [1.0, 1.5, 2.0])
def test_student_t_residuals_have_a_warning_with_the_degrees_of_freedom(freedom, seed):
    (sentence,) = warnings_of(student(seed, freedom))
    assert "does not describe the residuals of channel_0" in sentence
    assert f"a Student-t with {freedom:g} degrees of freedom" in sentence
    assert sentence.endswith("A misfit of the tail is not evidence of physics.")


def test_distances_are_reported_with_and_without_a_warning():
    right, wrong = checks_of(gaussian(0), student(1))
    assert right.distance < right.allowed
    assert right.student_distance < right.allowed
    assert not right.closer
    assert wrong.distance > wrong.allowed > wrong.student_distance
    assert wrong.closer


def test_zero_residuals_have_distances():
    one = torch.ones(1, dtype=torch.float64)
    (check,) = density_checks(
        torch.zeros(50, 1, dtype=torch.float64), one, one, 10.0 * one, ["norm"], EvidenceSettings()
    )
    assert check.distance == pytest.approx(1.0)
    assert check.student_distance == pytest.approx(1.0)


def test_the_warning_names_the_misfit_channels_only():
    (sentence,) = warnings_of(gaussian(0), student(1), mkc(2), student(3, 1.5))
    assert "of channel_1, channel_3: its" in sentence


@pytest.mark.parametrize("seed", range(3))
def test_one_sided_outliers_have_no_warning(seed):
    random = np.random.default_rng(seed)
    corrupted = random.random(N) < 0.2
    assert warnings_of(gaussian(seed) + corrupted * (4.0 + 8.0 * random.random(N))) == ()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("phi", [0.9, 0.99])
def test_correlated_samples_of_the_density_have_no_warning(phi, seed):
    assert warnings_of(autoregressive(gaussian(seed), phi)) == ()


def test_the_allowed_distance_grows_as_the_effective_sample_size_falls():
    """The same misfit in a series in which each sample is repeated ten times."""
    misfit = student(0, 1.5)
    assert warnings_of(misfit) != ()
    assert warnings_of(np.repeat(misfit[:450], 10)) == ()


@pytest.mark.parametrize("freedom", [1.0, 1.5, 2.0, 4.0, 10.0, 30.0])
def test_the_student_t_distribution_function_agrees_with_scipy(freedom):
    size = np.concatenate([np.linspace(0.0, 8.0, 60), [30.0, 1e4]])
    expected = 2.0 * stats.t(freedom).cdf(size) - 1.0
    np.testing.assert_allclose(student_cdf(torch.as_tensor(size), freedom), expected, atol=2e-4)


@pytest.mark.parametrize("freedom", [1.0, 2.0, 4.0])
def test_the_student_t_fit_maximises_the_likelihood(freedom):
    error = student(7, freedom)
    found, scale, likelihood = student_fit(torch.as_tensor(error))
    assert found == freedom
    assert scale == pytest.approx(0.5, rel=0.06)
    best = stats.t.fit(error, floc=0.0)
    assert likelihood == pytest.approx(stats.t(*best).logpdf(error).mean(), abs=2e-3)


def test_the_kolmogorov_distance_agrees_with_scipy():
    values = np.random.default_rng(0).random(300) ** 1.3
    assert kolmogorov(torch.as_tensor(values)) == pytest.approx(stats.kstest(values, "uniform").statistic)


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_the_effective_size_of_an_autoregression_agrees_with_theory(phi):
    sizes = [effective_size(torch.as_tensor(autoregressive(gaussian(seed), phi))) for seed in range(20)]
    assert np.mean(sizes) == pytest.approx(N * (1.0 - phi) / (1.0 + phi), rel=0.2)


def test_the_effective_size_of_a_constant_is_its_number_of_samples():
    assert effective_size(torch.ones(50, dtype=torch.float64)) == 50.0


def test_a_diagnosis_has_the_distances_of_each_channel():
    result = diagnose(Magnetometer("norm"), tumbling(1000, noise=0.3), effects=(), max_findings=0, surrogates=19)
    (check,) = result.density_checks
    assert check.channel == "norm"
    assert 0.0 < check.distance < check.allowed
    assert 0.0 < check.student_distance < 0.1
    assert not check.closer
