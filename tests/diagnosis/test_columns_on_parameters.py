"""Diagnoses of equations in which a column acts on a parameter, on an output, or on a delay; truth by SciPy."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording, diagnose
from mkc_torch.simulation import Dynamics, Parameter

N = 300


class Cart(Dynamics):
    states, inputs = ("speed",), ("force",)
    units = {"speed": "m/s", "force": "N"}
    parameters = {"mass": Parameter(2.0, lower=0.1, unit="kg"), "drag": Parameter(0.1, lower=0.0, unit="kg/m")}

    def derivative(self, time, x, u, p):
        return {"speed": (u.force - p.drag * x.speed * x.speed.abs()) / p.mass}


class Vessel(Dynamics):
    states, inputs = ("conc",), ("dose",)
    parameters = {"rate": Parameter(0.3, lower=0.01, unit="1/s"), "gain": Parameter(1.0, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"conc": p.rate * (p.gain * u.dose - x.conc)}


def smooth(rng, correlation):
    """Return a stationary random course with standard deviation 1."""
    keep = np.exp(-1.0 / correlation)
    course = rng.normal(size=N)
    for k in range(1, N):
        course[k] = keep * course[k - 1] + np.sqrt(1.0 - keep * keep) * course[k]
    return course


def levels(rng, count, low, high):
    return np.repeat(rng.uniform(low, high, N // count + 1), count)[:N]


def integrated(rate, first, time):
    step = time[1] - time[0]
    return solve_ivp(rate, (time[0], time[-1]), [first], t_eval=time, rtol=1e-7, atol=1e-9, max_step=step).y[0]


def cart(seed, law=None, more=None):
    """Return a cart's recording: its drag depends on the temperature by a law; ``more`` acts on the measured speed."""
    rng = np.random.default_rng(seed)
    time, force = 0.5 * np.arange(N), levels(rng, 20, 1.0, 12.0)
    columns = {"air_temperature": 15.0 + 6.0 * smooth(rng, 40.0), "humidity": 50.0 + 10.0 * smooth(rng, 60.0)}
    away = columns["air_temperature"] - columns["air_temperature"].mean()
    drag = 0.1 * (np.ones(N) if law is None else law(away))

    def rate(t, x):
        return (np.interp(t, time, force) - np.interp(t, time, drag) * x * np.abs(x)) / 2.0

    speed = integrated(rate, 3.0, time) + (0.0 if more is None else more(away, time))
    return table(rng, {"time": time, "force": force, **columns}, "speed", speed, 0.05)


def table(rng, columns, output, values, noise):
    error = noise * rng.normal(size=N)
    error[rng.random(N) < 0.02] += 8.0 * noise
    known = {**columns, output: values + error}
    return Recording(
        {k: torch.as_tensor(v) for k, v in known.items()},
        units={"air_temperature": "°C"} if "air_temperature" in known else {},
    )


def lagged(away, time, lag):
    return integrated(lambda t, x: (np.interp(t, time, away) - x) / lag, away[0], time)


def parabola(away):
    return 1.0 + 0.02 * away + 0.004 * away**2


HIDDEN = {
    "driver_parameter": (cart, {"law": lambda away: 1.0 + 0.03 * away}, "parameter drag", (0.03,)),
    "driver_parameter_quadratic": (cart, {"law": parabola}, "parameter drag", (0.02, 0.004)),
    "driver_parameter_arrhenius": (
        cart,
        {"law": lambda away: np.exp(0.08 * 288.0 * away / (288.0 + away))},
        "parameter drag",
        (0.08,),
    ),
    "driver_output": (cart, {"more": lambda away, time: 0.2 * away}, "speed", (0.2,)),
    "driver_output_quadratic": (
        cart,
        {"more": lambda away, time: 0.1 * away + 0.02 * away**2},
        "speed",
        (0.1, 0.02),
    ),
    "driver_output_lagged": (cart, {"more": lambda away, time: 0.2 * lagged(away, time, 8.0)}, "speed", (0.2, 8.0)),
}
USUAL = ("driver_parameter", "driver_output")
"""Effects of which every run of the tests diagnoses a recording."""


@pytest.mark.e2e
@pytest.mark.parametrize(
    "effect", [name if name in USUAL else pytest.param(name, marks=pytest.mark.slow) for name in HIDDEN]
)
def test_a_column_that_acts_is_named_with_its_place_and_size(effect):
    make, how, place, sizes = HIDDEN[effect]
    result = diagnose(Cart(), make(7, **how), max_findings=2, surrogates=39)
    first = result.findings[0]
    assert (first.effect, first.drivers, first.channels) == (effect, ("air_temperature",), (place,))
    assert first.grade == "left_out"
    for found, size in zip(first.parameters, sizes, strict=True):
        assert abs(found.value - size) < 4.0 * found.standard_error + 0.02 * abs(size)
    assert first.held_out.outputs["speed"].after < 0.5 * first.held_out.outputs["speed"].before


@pytest.mark.e2e
def test_columns_that_do_nothing_act_on_no_parameter_and_no_output():
    result = diagnose(Cart(), cart(8), max_findings=2, surrogates=39)
    assert (result.findings, result.verdict) == ((), "adequate")


@pytest.mark.e2e
def test_a_delay_by_a_volume_over_a_flow_is_named_with_the_flow():
    rng = np.random.default_rng(5)
    time, dose = 0.5 * np.arange(N), levels(rng, 16, 0.0, 2.0)
    flow = np.clip(np.exp(0.5 * smooth(rng, 40.0)), 0.35, 3.0)
    filled = np.concatenate([[0.0], np.cumsum(0.5 * (flow[1:] + flow[:-1]) * np.diff(time))])

    def entered(t):
        return np.interp(np.interp(t, time, filled) - 3.0, filled, time)

    conc = integrated(lambda t, x: 0.3 * (np.interp(entered(t), time, dose) - x), 0.5, time)
    recording = table(
        rng, {"time": time, "dose": dose, "flow": flow, "wind": 3.0 + smooth(rng, 25.0)}, "conc", conc, 0.02
    )
    first = diagnose(Vessel(), recording, max_findings=2, surrogates=39).findings[0]
    assert (first.effect, first.drivers, first.channels) == ("input_transport_delay", ("flow",), ("input dose",))
    delay = next(found for found in first.parameters if found.name == "delay")
    assert abs(delay.value - 3.0 / flow.mean()) < 4.0 * delay.standard_error + 0.02
