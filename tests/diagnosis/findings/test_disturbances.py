"""Unrecorded disturbances: process noise, the estimated time series with its band, and its correlates."""

import functools
import math

import pytest
import torch

from mkc_torch.diagnosis.findings.noise import forcing_of, process_noise_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.simulation.dynamics.first_fit import strong_observer
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise
from mkc_torch.simulation.dynamics.noise_selection import SelectedNoise
from mkc_torch.simulation.dynamics.observer import Disturbance
from tests.diagnosis.swing import NOISE, Pendulum, fitted_pendulum, pendulum_recording

TRUTH = {"white": Disturbance("rate", True, 0.0, 0.4), "slow": Disturbance("rate", True, 1.0, 0.3)}
TRUTH["torque"] = Disturbance("rate", True, 0.6, 0.6)  # of the torque's duration, delayed
DRIFT = Disturbance("angle", False, 2.0, 0.01)


def noise_of(*disturbances, errors=None, gains=None):
    sensor = torch.tensor([NOISE], dtype=torch.float64)
    many = len(disturbances)
    known = SelectedNoise(disturbances, errors or (0.1,) * many, gains or (50.0,) * many, sensor, 0.0, (False,))
    return StateSpaceNoise(known, None)


@functools.cache
def at_the_truth(disturbance, seed):
    """Return a pendulum at its true parameters, observed along the recording."""
    prepared = Pendulum().prepare(pendulum_recording(disturbance, seed)[0])
    theta = torch.tensor([9.0, 0.15, 0.3, 0.0], dtype=torch.float64)
    model = JointModel(prepared.observed(strong_observer(prepared, theta, 10.0)))
    unit_scale, residual = theta.new_ones(1), model.residual(theta).detach()
    return FittedModel(model, theta, unit_scale, unit_scale, unit_scale, residual, torch.ones_like(residual), 0.0, True)


@functools.cache
def forcing(disturbance, seed):
    (found,) = forcing_of(at_the_truth(disturbance, seed), noise_of(TRUTH[disturbance]))
    return found, pendulum_recording(disturbance, seed)[1]


def correlation(first, second):
    return float(torch.corrcoef(torch.stack([first, second]))[0, 1])


def test_process_noise_has_the_unit_of_its_rate_or_output():
    prepared = Pendulum().prepare(pendulum_recording("white", 1)[0])
    noise = noise_of(TRUTH["slow"], DRIFT, errors=(0.2, 0.05), gains=(311.0, 12.0))
    rate, angle = process_noise_of(prepared, noise)
    assert (rate.place, rate.at_rate, rate.correlation_time, rate.size, rate.log_likelihood_gain) == (
        "rate",
        True,
        1.0,
        0.3,
        311.0,
    )
    assert rate.unit == prepared.ports["rate of rate"].unit == "rad/s/s"
    assert (angle.place, angle.at_rate, angle.unit, angle.log_likelihood_gain) == ("angle", False, "rad", 12.0)
    # errors are of the logarithm
    assert (rate.standard_error, angle.standard_error) == (pytest.approx(0.06), pytest.approx(0.0005))


def test_the_standard_error_is_the_size_if_the_likelihood_has_no_curvature():
    prepared = Pendulum().prepare(pendulum_recording("white", 1)[0])
    (process_noise,) = process_noise_of(prepared, noise_of(TRUTH["slow"], errors=(math.inf,)))
    assert process_noise.standard_error == process_noise.size


def test_without_process_noise_nothing_is_reported():
    fit = at_the_truth("white", 1)
    assert process_noise_of(fit.model.prepared, noise_of()) == ()
    assert forcing_of(fit, noise_of()) == ()


@pytest.mark.parametrize("disturbance", ["white", "slow", "torque"])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_band_covers_the_true_disturbance(disturbance, seed):
    found, true = forcing(disturbance, seed)
    assert found.time.shape == found.value.shape == found.band.shape == true.shape
    covered = float(((found.value - true).abs() <= found.band).double().mean())
    assert 0.9 <= covered <= 0.99


@pytest.mark.parametrize(("disturbance", "least", "share"), [("slow", 0.9, 0.4), ("white", 0.35, 1.0)])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_estimate_follows_a_slow_disturbance_better_than_a_white_one(disturbance, least, share, seed):
    """The band is relative to the disturbance: at 1.96 times its size, nothing is known."""
    found, true = forcing(disturbance, seed)
    assert correlation(found.value, true) > least
    assert float(found.band.median()) / (1.96 * TRUTH[disturbance].size) < share


@pytest.mark.parametrize("disturbance", ["white", "slow", "torque"])
def test_the_first_sentence_states_whether_a_disturbance_is_white(disturbance):
    first = forcing(disturbance, 1)[0].sentences[0]
    if disturbance == "white":
        assert "rate of rate is white" in first
    else:
        lasting = f"{TRUTH[disturbance].lasting:.2g} s"
        assert "rate of rate is not white" in first
        assert f"correlation time is about {lasting}" in first


@pytest.mark.parametrize("disturbance", ["white", "slow"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_independent_disturbance_is_reported_as_uncorrelated_with_the_input(disturbance, seed):
    (text,) = forcing(disturbance, seed)[0].sentences[1:]
    assert "uncorrelated with torque" in text


@pytest.mark.parametrize("seed", [1, 2])
def test_a_disturbance_correlated_with_an_input_is_reported_with_its_lag(seed):
    (text,) = forcing("torque", seed)[0].sentences[1:]
    assert text.startswith("It is correlated with torque with a delay of 0.3 s (correlation 0.9")


def test_curves_along_each_state_and_input_have_units():
    found, _ = forcing("torque", 1)
    assert [(curve.driver, curve.unit, curve.value_unit) for curve in found.curves] == [
        ("angle", "rad", "rad/s/s"),
        ("rate", "rad/s", "rad/s/s"),
        ("torque", "", "rad/s/s"),
    ]
    for curve in found.curves:
        assert curve.channels == ("rate of rate",)
        assert bool((curve.x.diff() >= 0).all())
        assert curve.value.shape == curve.band.shape == (len(curve.x), 1)
        assert bool((curve.band > 0).all())


@pytest.mark.parametrize("disturbance", ["white", "slow"])
def test_curves_of_an_independent_disturbance_are_zero_within_the_band(disturbance):
    """240 means with a band of 95 %; a slow disturbance is smooth, so neighbouring means are correlated."""
    known = [curve for seed in (1, 2, 3, 4) for curve in forcing(disturbance, seed)[0].curves]
    inside = torch.cat([item.value.abs() <= item.band for item in known]).double().mean()
    assert 0.9 <= float(inside) <= 0.99


@pytest.mark.e2e
@pytest.mark.parametrize("disturbance", ["white", "slow"])
def test_the_process_noise_of_a_fit_is_that_of_the_true_disturbance(disturbance):
    environment = fitted_pendulum(disturbance)
    first = process_noise_of(environment.fit.model.prepared, environment.noise)[0]
    true = TRUTH[disturbance]
    assert (first.place, first.at_rate, first.unit) == ("rate", True, "rad/s/s")
    assert (first.correlation_time > 0.0) == (true.lasting > 0.0)
    assert true.size / 2.0 < first.size < 2.0 * true.size
    assert first.log_likelihood_gain > 100.0
    found = forcing_of(environment.fit, environment.noise)[0]
    assert correlation(found.value, pendulum_recording(disturbance)[1]) > (0.9 if disturbance == "slow" else 0.35)


def test_an_undisturbed_pendulum_has_no_process_noise():
    environment = fitted_pendulum()
    assert not environment.has_disturbances
    assert process_noise_of(environment.fit.model.prepared, environment.noise) == ()
