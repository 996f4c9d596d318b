"""The disturbance of a simulation that nobody recorded: its size, its course with a band, and what it goes along
with.
"""

import functools
import math

import pytest
import torch

from mkc_torch.diagnosis.findings.disturbances import forcing_of, process_noise_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.simulation.dynamics.first_fit import strong_observer
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise
from mkc_torch.simulation.dynamics.noise_selection import SelectedNoise
from mkc_torch.simulation.dynamics.observer import Disturbance
from tests.diagnosis.swing import NOISE, Pendulum, fitted_swing, swung

TRUTH = {"white": Disturbance("rate", True, 0.0, 0.4), "slow": Disturbance("rate", True, 1.0, 0.3)}
TRUTH["torque"] = Disturbance("rate", True, 0.6, 0.6)  # of the torque's duration, delayed
WANDER = Disturbance("angle", False, 2.0, 0.01)


def noise_of(*pushes, errors=None, gains=None):
    sensor = torch.tensor([NOISE], dtype=torch.float64)
    many = len(pushes)
    known = SelectedNoise(pushes, errors or (0.1,) * many, gains or (50.0,) * many, sensor, 0.0, (False,))
    return StateSpaceNoise(known, None)


@functools.cache
def at_the_truth(push, seed):
    """A pendulum with its true parameters, along the recording."""
    prepared = Pendulum().prepare(swung(push, seed)[0])
    theta = torch.tensor([9.0, 0.15, 0.3, 0.0], dtype=torch.float64)
    model = JointModel(prepared.observed(strong_observer(prepared, theta, 10.0)))
    one, residual = theta.new_ones(1), model.residual(theta).detach()
    return FittedModel(model, theta, one, one, one, residual, torch.ones_like(residual), 0.0, True)


@functools.cache
def forcing(push, seed):
    (found,) = forcing_of(at_the_truth(push, seed), noise_of(TRUTH[push]))
    return found, swung(push, seed)[1]


def correlation(one, other):
    return float(torch.corrcoef(torch.stack([one, other]))[0, 1])


def test_a_push_of_a_rate_has_its_unit_and_one_of_an_output_that_of_the_output():
    prepared = Pendulum().prepare(swung("white", 1)[0])
    noise = noise_of(TRUTH["slow"], WANDER, errors=(0.2, 0.05), gains=(311.0, 12.0))
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


def test_a_size_that_the_likelihood_does_not_bend_about_is_as_uncertain_as_it_is_large():
    prepared = Pendulum().prepare(swung("white", 1)[0])
    (push,) = process_noise_of(prepared, noise_of(TRUTH["slow"], errors=(math.inf,)))
    assert push.standard_error == push.size


def test_without_pushes_nothing_is_told():
    fit = at_the_truth("white", 1)
    assert process_noise_of(fit.model.prepared, noise_of()) == ()
    assert forcing_of(fit, noise_of()) == ()


@pytest.mark.parametrize("push", ["white", "slow", "torque"])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_band_covers_the_course_that_was_drawn(push, seed):
    found, true = forcing(push, seed)
    assert found.time.shape == found.value.shape == found.band.shape == true.shape
    covered = float(((found.value - true).abs() <= found.band).double().mean())
    assert 0.9 <= covered <= 0.99


@pytest.mark.parametrize(("push", "least", "share"), [("slow", 0.9, 0.4), ("white", 0.35, 1.0)])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_course_follows_what_lasts_and_little_of_what_does_not(push, least, share, seed):
    """The band is told in the size of what it is of: nothing is known where it is 1.96 of it."""
    found, true = forcing(push, seed)
    assert correlation(found.value, true) > least
    assert float(found.band.median()) / (1.96 * TRUTH[push].size) < share


@pytest.mark.parametrize("push", ["white", "slow", "torque"])
def test_whether_it_is_white_is_said(push):
    first = forcing(push, 1)[0].sentences[0]
    if push == "white":
        assert first == "The disturbance of rate of rate is white."
    else:
        lasting = f"{TRUTH[push].lasting:.2g} s"
        assert first == f"The disturbance of rate of rate is not white: its correlation time is about {lasting}."


@pytest.mark.parametrize("push", ["white", "slow"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_push_by_itself_is_said_to_be_independent_of_the_input(push, seed):
    assert forcing(push, seed)[0].sentences[1:] == ("It is uncorrelated with torque at all lags.",)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_push_that_goes_along_with_an_input_is_said_to_with_its_lag(seed):
    (text,) = forcing("torque", seed)[0].sentences[1:]
    assert text.startswith("It is correlated with torque with a delay of 0.3 s (correlation 0.9")


def test_it_is_told_along_each_state_and_input_with_units():
    found, _ = forcing("torque", 1)
    assert [(one.driver, one.unit, one.value_unit) for one in found.curves] == [
        ("angle", "rad", "rad/s/s"),
        ("rate", "rad/s", "rad/s/s"),
        ("torque", "", "rad/s/s"),
    ]
    for curve in found.curves:
        assert curve.channels == ("rate of rate",)
        assert bool((curve.x.diff() >= 0).all())
        assert curve.value.shape == curve.band.shape == (len(curve.x), 1)
        assert bool((curve.band > 0).all())


@pytest.mark.parametrize("push", ["white", "slow"])
def test_a_push_by_itself_is_nought_along_what_it_does_not_depend_on_within_the_band(push):
    """Of 240 means with a band of 95 %; a course is smooth, so samples beside each other say little anew."""
    known = [curve for seed in (1, 2, 3, 4) for curve in forcing(push, seed)[0].curves]
    inside = torch.cat([item.value.abs() <= item.band for item in known]).double().mean()
    assert 0.9 <= float(inside) <= 0.99


@pytest.mark.e2e
@pytest.mark.parametrize("push", ["white", "slow"])
def test_the_noise_of_a_fit_is_the_push_that_was_drawn(push):
    world = fitted_swing(push)
    first = process_noise_of(world.fit.model.prepared, world.noise)[0]
    true = TRUTH[push]
    assert (first.place, first.at_rate, first.unit) == ("rate", True, "rad/s/s")
    assert (first.correlation_time > 0.0) == (true.lasting > 0.0)
    assert true.size / 2.0 < first.size < 2.0 * true.size
    assert first.log_likelihood_gain > 100.0
    found = forcing_of(world.fit, world.noise)[0]
    assert correlation(found.value, swung(push)[1]) > (0.9 if push == "slow" else 0.35)


def test_nothing_pushes_where_nothing_does():
    world = fitted_swing()
    assert not world.has_disturbances
    assert process_noise_of(world.fit.model.prepared, world.noise) == ()
