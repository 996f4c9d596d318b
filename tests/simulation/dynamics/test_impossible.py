"""Fitted values that cannot be, on systems whose equations and recordings are in the test."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.impossible import impossible_checks, impossible_values

TIME = np.arange(300) * 2.0


class Heater(Dynamics):
    states, inputs, outputs = ("temp",), ("power",), ("temp",)
    parameters = {"ambient": 22.0, "tau": 60.0, "gain": Parameter(2.0, lower=0.1)}
    units = {"temp": "degC"}

    def derivative(self, time, x, u, p):
        return {"temp": p.gain * u.power - (x.temp - p.ambient) / p.tau}


class Coupled(Dynamics):
    """Two temperatures with an exchange between them, in air."""

    states, inputs, outputs = ("near", "far"), ("air",), ("near", "far")
    parameters = {"offset": 0.0, "near_rate": 0.01, "shared": 30.0}
    units = {"near": "degC", "far": "degC", "air": "degC"}

    def derivative(self, time, x, u, p):
        near = -p.near_rate * (x.near - x.far) - 0.002 * (x.near - u.air)
        return {"near": near, "far": p.near_rate * (x.near - x.far) - 0.01 * (x.far - p.shared)}


def heater(seed=0, **changed):
    random = np.random.default_rng(seed)
    power = (np.sin(TIME / 40.0 + random.uniform(0.0, 6.0)) > 0).astype(float)
    temp = np.full(300, 25.0)
    for k in range(299):
        temp[k + 1] = temp[k] + 2.0 * (1.5 * power[k] - (temp[k] - 22.0) / 60.0)
    columns = {"time": TIME, "power": power, "temp": temp + random.normal(0.0, 0.1, 300)}
    system = type("Other", (Heater,), {"parameters": {**Heater.parameters, **changed}})
    return system().prepare(Recording({name: torch.tensor(values) for name, values in columns.items()}))


def found(prepared, **values):
    theta = prepared.given.clone()
    for name, value in values.items():
        theta[list(prepared.known).index(name)] = value
    return impossible_values(prepared, theta)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_possible_values_pass(seed):
    assert found(heater(seed), ambient=18.0, tau=900.0, gain=0.2) == ()


@pytest.mark.parametrize(("ambient", "acts", "word"), [(-42.0, -1, "a loss"), (400.0, 1, "a source")])
def test_a_level_far_outside_the_recording_acts_like_a_loss_or_a_source(ambient, acts, word):
    prepared = heater()
    (value,) = found(prepared, ambient=ambient)
    assert (value.parameter, value.kind, value.state, value.acts) == ("ambient", "level", "temp", acts)
    assert value.limits == pytest.approx((float(prepared.measured.min()), float(prepared.measured.max())))
    (check,) = impossible_checks(prepared, [value])
    assert check.kind == "impossible value"
    assert check.start == 22.0
    assert f"`ambient` ends at {ambient:.4g} degC" in check.sentence
    assert f"lacks something that acts like {word} of `temp`" in check.sentence


def simulate(seed, loss):
    """A heater by Euler's method, with a constant loss that the simulation does not have."""
    random = np.random.default_rng(seed)
    power = np.repeat(random.choice([0.3, 0.6, 1.0, 1.5], 15), 20)
    temp = np.full(300, 90.0)
    for k in range(299):
        temp[k + 1] = temp[k] + 2.0 * (2.0 * power[k] - (temp[k] - 22.0) / 60.0 - loss)
    columns = {"time": TIME, "power": power, "temp": temp + random.normal(0.0, 0.1, 300)}
    return Recording({name: torch.tensor(values) for name, values in columns.items()})


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("loss", [0.0, 1.2])
def test_a_fit_that_lacks_a_loss_ends_at_an_impossible_ambient(seed, loss):
    system = type("HeldHeater", (Heater,), {"input_hold": "held"})()
    checks = diagnose(system, simulate(seed, loss), effects=(), surrogates=19).checks
    kinds = [(check.kind, check.parameters) for check in checks]
    assert kinds == ([("impossible value", ("ambient",))] if loss else [])
    if loss:
        value = float(checks[0].sentence.split("ends at ")[1].split(" degC")[0])
        assert value == pytest.approx(22.0 - 1.2 * 60.0, abs=1.0)
        assert "acts like a loss of `temp`" in checks[0].sentence


def test_a_nominal_value_outside_the_recording_is_the_users_choice():
    assert found(heater(ambient=-60.0), ambient=-70.0) == ()


@pytest.mark.parametrize(("tau", "kind"), [(1.2e6, "slow"), (0.1, "fast")])
def test_a_time_constant_that_the_recording_cannot_show(tau, kind):
    (value,) = found(heater(), tau=tau)
    assert (value.parameter, value.kind, value.state) == ("tau", kind, "temp")
    assert value.limits == pytest.approx((0.2, 598.0e3))


@pytest.mark.parametrize("tau", [5.0e5, 0.3])
def test_a_time_constant_within_the_limits_passes(tau):
    assert found(heater(), tau=tau) == ()


def test_a_value_at_a_bound_that_it_was_moved_to():
    (value,) = found(heater(), gain=0.1)
    assert (value.parameter, value.kind) == ("gain", "bound")


def test_a_start_at_a_bound_is_no_fitted_value():
    assert found(heater(gain=Parameter(0.1, lower=0.1))) == ()


def coupled():
    near, far, air = np.full(300, 40.0), np.full(300, 35.0), 20.0 + 3.0 * np.sin(TIME / 100.0)
    for k in range(299):
        flow = 0.01 * (near[k] - far[k])
        near[k + 1] = near[k] - 2.0 * (flow + 0.002 * (near[k] - air[k]))
        far[k + 1] = far[k] + 2.0 * (flow - 0.01 * (far[k] - 30.0))
    columns = {"time": TIME, "air": air, "near": near, "far": far}
    return Coupled().prepare(Recording({name: torch.tensor(values) for name, values in columns.items()}))


def test_a_level_of_one_of_several_temperatures():
    (value,) = found(coupled(), shared=-10.0)
    assert (value.parameter, value.kind) == ("shared", "level")
    assert found(coupled(), shared=25.0) == found(coupled(), offset=-500.0) == ()
