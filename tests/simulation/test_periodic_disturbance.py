"""A disturbance of unknown period, hidden at an output without states, at a state's rate and at a measured output."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.effects.periodic import PeriodicRate
from mkc_torch.simulation import Dynamics, Static


class Spring(Static):
    inputs = ("position",)
    outputs = ("force",)
    parameters = {"stiffness": 10.0, "zero": 0.0}
    units = {"force": "N", "position": "m"}

    def output(self, time, u, p):
        return {"force": p.stiffness * u.position + p.zero}


def spring(amplitude, seed=0, N=500):
    r = np.random.default_rng(seed)
    time = 0.05 * np.arange(N)
    position = lfilter([0.1], [1.0, -0.9], r.normal(size=N))
    force = 12.0 * position + 3.0 + r.normal(0.0, 1.0, N) + amplitude * np.sin(2.0 * np.pi * time / 0.731 + 0.4)
    return Recording({"time": time, "position": position, "force": force}, units={"force": "N", "position": "m"})


def value(finding, name):
    return next(parameter for parameter in finding.parameters if parameter.name == name)


def test_a_periodic_disturbance_of_a_static_model_is_named_with_its_period():
    recording = spring(1.0)
    result = diagnose(Spring(), recording)
    [finding] = result.findings
    assert finding.effect == "periodic"
    assert finding.channels == ("force",)
    # no draw of 99 has such a line, and lines are tested at a fifth of the level
    assert finding.p_value == pytest.approx(0.01 / 0.2)
    period, amplitude = value(finding, "period"), value(finding, "amplitude")
    assert abs(period.value - 0.731) < 2.0 * period.standard_error < 0.004
    assert period.unit == "s"
    for found, hidden, error in zip(amplitude.value, (np.sin(0.4), np.cos(0.4)), amplitude.standard_error, strict=True):
        assert abs(found - hidden) < 2.0 * error
    assert "repeats through the whole recording" in finding.explanation
    assert finding.recurrence == "a disturbance keeps its period, and has another phase"
    model = DiagnosedModel.from_json(result.model.to_json(), simulation=Spring())
    corrected = model(recording)["force"]
    left = recording["force"] - corrected
    assert float(left.std()) == pytest.approx(1.0, abs=0.1)


def test_a_static_model_without_a_periodic_disturbance_has_no_such_finding():
    assert not diagnose(Spring(), spring(0.0)).findings


class Cart(Dynamics):
    states = ("position", "speed")
    inputs = ("force",)
    outputs = ("position",)
    parameters = {"mass": 1.0, "damping": 0.3, "spring": 2.0}
    units = {"position": "m", "speed": "m/s", "force": "N"}
    input_hold = "linear"

    def derivative(self, time, x, u, p):
        rate = (u.force - p.damping * x.speed - p.spring * x.position) / p.mass
        return {"position": x.speed, "speed": rate}


def cart(at_rate=0.0, at_output=0.0, seed=0, N=400):
    r = np.random.default_rng(seed)
    time = 0.05 * np.arange(N)
    force = 2.0 * lfilter([0.4], [1.0, -0.9], r.normal(size=N))

    def rates(t, x):
        pump = at_rate * np.sin(2.0 * np.pi * t / 0.97 + 1.0)
        return [x[1], (np.interp(t, time, force) - 0.4 * x[1] - 2.5 * x[0]) / 1.2 + pump]

    x = solve_ivp(rates, (0.0, time[-1]), [0.3, 0.0], t_eval=time, max_step=0.05, rtol=1e-8).y
    position = x[0] + r.normal(0.0, 0.01, N) + at_output * np.sin(2.0 * np.pi * time / 0.97 + 1.0)
    return Recording({"time": time, "force": force, "position": position}, units={"position": "m", "force": "N"})


@pytest.mark.slow
@pytest.mark.parametrize(("place", "size"), [("rate of speed", 1.5), ("position", 0.05)])
def test_a_periodic_disturbance_of_differential_equations_is_named(place, size):
    at_rate = place == "rate of speed"
    recording = cart(at_rate=size) if at_rate else cart(at_output=size)
    result = diagnose(Cart(), recording)
    finding = result.findings[0]
    assert finding.effect in ("periodic_rate", "periodic_output")
    period = value(finding, "period")
    assert abs(period.value - 0.97) < 3.0 * period.standard_error < 0.02
    # one output alone cannot distinguish a line at the rate from a line at the output
    names = {finding.effect, *(rival.effect for rival in finding.alternatives if not rival.separable)}
    assert ("periodic_rate" if at_rate else "periodic_output") in names
    source = result.model.to_python(module="cart")
    assert "torch.cos(" in source
    assert "* (time - 0.0)" in source


def test_code_of_a_periodic_rate_uses_the_time_of_the_derivative():
    time = torch.linspace(2.0, 4.0, 9).double()
    [line] = PeriodicRate().code([1.0, 2.0], {"period": 0.5, "start": 2.0}, {})
    value = eval(line, {"torch": torch, "time": time})
    angle = 4.0 * np.pi * (time - 2.0)
    torch.testing.assert_close(value, angle.cos() + 2.0 * angle.sin())
