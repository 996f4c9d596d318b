"""Lags of sensors and actuators are distinguished, and come in the order in which the signal passes them."""

import numpy as np
import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.model.joint import in_order_of_the_chain
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects.dynamics.dead_zone import DeadZone
from mkc_torch.effects.dynamics.input_lag import InputLag
from mkc_torch.effects.dynamics.input_square import InputSquare
from mkc_torch.effects.dynamics.sensor_lag import SensorLag
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.flow import flow_of

QUICK = {"surrogates": 19, "max_findings": 2}


class Block(Dynamics):
    """A metal block is heated; the thermometer is taken to be quick."""

    states = ("temp",)
    inputs = ("power",)
    units = {"temp": "°C", "power": "W"}
    parameters = {
        "capacity": Parameter(150.0, lower=1.0, unit="J/K"),
        "loss": Parameter(1.0, lower=0.0, unit="W/K"),
        "room": Parameter(22.0, lower=15.0, upper=30.0, unit="°C"),
    }

    def derivative(self, time, x, u, p):
        return {"temp": (u.power - p.loss * (x.temp - p.room)) / p.capacity}


class Motor(Dynamics):
    states = ("speed",)
    inputs = ("voltage",)
    units = {"speed": "rad/s", "voltage": "V"}
    parameters = {"gain": Parameter(50.0, lower=0.0), "damping": Parameter(5.0, lower=0.0, unit="1/s")}

    def derivative(self, time, x, u, p):
        return {"speed": p.gain * u.voltage - p.damping * x.speed}


def integrated_output(rate, start, inputs, step):
    """Return the second state of a system of two, (N,), with its input held over each step, by Heun's method."""
    state, seen, short = np.array(start, float), [], step / 50
    for value in inputs:
        seen.append(state[1])
        for _ in range(50):
            ahead = state + short * rate(state, value)
            state = state + 0.5 * short * (rate(state, value) + rate(ahead, value))
    return np.array(seen)


def thermometer():
    """Return a recording of a heated block, sampled every 5 s by a thermometer with a lag of 25 s."""
    random = np.random.default_rng(3)
    power = np.repeat(random.choice([0.0, 30.0, 60.0, 100.0], 5), 48)
    temp = integrated_output(
        lambda x, u: np.array([(u - 0.9 * (x[0] - 22.0)) / 180.0, (x[0] - x[1]) / 25.0]), [22, 22], power, 5.0
    )
    temp = temp + random.normal(0.0, 0.1, len(temp))
    return Recording({"time": np.arange(len(temp)) * 5.0, "power": power, "temp": temp})


def motor():
    """Return a recording of a motor behind a driver with a dead zone of 0.8 V and a lag of 40 ms."""
    random = np.random.default_rng(4)
    time = np.arange(300) * 0.02
    voltage = np.round(3.0 * np.sin(2.2 * time) + 1.5 * np.sin(5.7 * time + 1.0), 3)
    voltage[150:200] = 2.0 * np.sign(np.sin(12.6 * time[150:200]))

    def rate(x, u):
        passed = np.sign(u) * max(abs(u) - 0.8, 0.0)
        return np.array([(passed - x[0]) / 0.04, 60.0 * x[0] - 5.0 * x[1]])

    speed = integrated_output(rate, [0.0, 0.0], voltage, 0.02) + random.normal(0.0, 0.3, len(time))
    return Recording({"time": time, "voltage": voltage, "speed": speed})


def numbers(finding):
    return {p.name: (p.value, p.standard_error) for p in finding.parameters}


@pytest.mark.e2e
def test_a_slow_thermometer_is_a_sensor_lag():
    diagnosis = diagnose(Block(), thermometer(), **QUICK)
    assert diagnosis.verdict == "explained"
    (finding,) = diagnosis.findings
    assert finding.effect == "sensor_lag"
    lag, error = numbers(finding)["lag"]
    assert abs(lag - 25.0) < 2.0 * error
    assert finding.held_out.rmse_after == pytest.approx(0.1, rel=0.2)


@pytest.mark.slow
@pytest.mark.e2e
def test_a_drivers_dead_zone_acts_before_the_motors_lag():
    diagnosis = diagnose(Motor(), motor(), **QUICK)
    assert diagnosis.verdict == "explained"
    zone, lag = diagnosis.findings
    # the motor is linear behind its driver, so a lag before it and a lag of its sensor give the same speed
    [other] = {"input_lag", "sensor_lag"} - {lag.effect}
    rivals = {rival.effect: rival for rival in lag.alternatives if not rival.separable}
    assert zone.effect == "dead_zone"
    width, error = numbers(zone)["width"]
    assert abs(width - 0.8) < 2.0 * error
    assert numbers(lag)["lag"][0] == pytest.approx(0.04, rel=0.15)
    [again] = [p for p in rivals[other].parameters if p.name == "lag"]
    assert abs(again.value - 0.04) < 2.0 * again.standard_error


@pytest.mark.e2e
@pytest.mark.slow
def test_the_code_of_a_drivers_dead_zone_acts_before_that_of_the_motors_lag():
    diagnosis = diagnose(Motor(), motor(), effects=(DeadZone(), InputLag()), **QUICK)
    assert {finding.effect for finding in diagnosis.findings} == {"dead_zone", "input_lag"}
    model = DiagnosedModel.from_json(diagnosis.model.to_json(), simulation=Motor())
    assert [term.effect.id for term in model.terms if term.first] == ["dead_zone"]
    source = diagnosis.model.to_python()
    assert source.index("# dead_zone:") < source.index("# input_lag:")


def test_the_noise_is_estimated_from_the_residual_behind_a_lagging_sensor():
    system = Block().prepare(thermometer()).dynamics
    theta = torch.tensor([180.0, 0.9, 22.0, 22.0], dtype=torch.float64)
    lag = Term(SensorLag(), None, {"lag": 25.0}, "output")

    def change(outputs):
        return lag.effect.change(torch.ones(1, dtype=outputs.dtype), lag.shape, lag.context(system, outputs))

    changes = {"output": change}
    residual = system.residual(theta, changes).numpy()
    assert flow_of(system, theta, changes, None).new == pytest.approx(residual, abs=1e-9)


def test_effects_with_memory_act_before_others_except_those_marked_first():
    lag, square = Term(InputLag(), None, {"lag": 1.0}), Term(InputSquare(), None, {})
    before = Term(DeadZone(), None, {}, first=True)
    assert in_order_of_the_chain((square, lag, before), range(3)) == [2, 1, 0]
