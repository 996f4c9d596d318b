"""First fits that diverge: other starts are tried, and a failure is explained in words."""

from dataclasses import replace

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.model import process_noise
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import fit_alone
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation import Dynamics

N = 300


class Motor(Dynamics):
    """A first-order motor; its state is measured in another unit, and the given friction has the wrong sign."""

    states, inputs, outputs = ("speed",), ("voltage",), ("rpm",)
    parameters = {"friction": 30.0, "gain": 1.0}

    def derivative(self, time, x, u, p):
        return {"speed": p.friction * x.speed + p.gain * u.voltage}

    def output(self, time, x, u, p):
        return {"rpm": 9.55 * x.speed}


class Room(Dynamics):
    """A heated room; its thermometer has another unit, and the given loss has the wrong sign."""

    states, inputs, outputs = ("air",), ("heat", "ambient"), ("indoor",)
    parameters = {"loss": -3.0, "gain": 1.0}

    def derivative(self, time, x, u, p):
        return {"air": p.loss * (u.ambient - x.air) + p.gain * u.heat}

    def output(self, time, x, u, p):
        return {"indoor": 32.0 + 1.8 * x.air}


class Decay(Dynamics):
    states, parameters = ("level",), {"rate": 1.0}

    def derivative(self, time, x, u, p):
        return {"level": -p.rate * x.level}


def motor():
    g = torch.Generator().manual_seed(0)
    time = torch.arange(N, dtype=torch.float64) / 10.0
    voltage = (5.0 * torch.randn(N // 15, generator=g, dtype=torch.float64)).repeat_interleave(15)
    speed = torch.zeros(N, dtype=torch.float64)
    share = torch.exp(torch.tensor(-0.25, dtype=torch.float64))
    for i in range(1, N):
        speed[i] = share * speed[i - 1] + (1.0 - share) * 20.0 * voltage[i - 1]
    rpm = 9.55 * speed + 2.0 * torch.randn(N, generator=g, dtype=torch.float64)
    return Recording({"time": time, "voltage": voltage, "rpm": rpm}, name="motor")


def room():
    g = torch.Generator().manual_seed(1)
    time = torch.arange(N, dtype=torch.float64)
    heat = (torch.rand(N // 15, generator=g, dtype=torch.float64) > 0.5).double().repeat_interleave(15)
    ambient = 5.0 + 3.0 * torch.sin(time / 20.0)
    air = torch.full((N,), 10.0, dtype=torch.float64)
    for i in range(1, N):
        rate = 0.1 * (ambient[i - 1] - air[i - 1]) + 2.0 * heat[i - 1]
        air[i] = air[i - 1] + rate
    indoor = 32.0 + 1.8 * air + 0.05 * torch.randn(N, generator=g, dtype=torch.float64)
    return Recording({"time": time, "heat": heat, "ambient": ambient, "indoor": indoor}, name="room")


@pytest.mark.parametrize(
    ("simulation", "recording", "expected"), [(Motor(), motor(), [-2.5, 50.0]), (Room(), room(), [0.1, 2.0])]
)
def test_a_first_fit_that_diverges_restarts_from_other_parameters(simulation, recording, expected):
    prepared = simulation.prepare(recording)
    found = fit_alone(prepared, {}, Settings().noise)
    assert found.fit.parameters[:2].tolist() == pytest.approx(expected, rel=0.2)


def test_a_domain_smaller_than_the_residual_is_widened():
    time = torch.arange(60, dtype=torch.float64) / 10.0
    noise = 0.1 * torch.randn(60, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    prepared = Decay().prepare(Recording({"time": time, "level": torch.exp(-time) + noise}))
    free = fitted(JointModel(prepared), prepared.start())
    narrow = replace(free, bound=1e-3 * free.bound)
    with pytest.raises(NoFitError):
        fitted(free.model, free.parameters, narrow.bound, graduate=False)
    wider = process_noise._wider(narrow, Settings().noise)
    assert float(wider.bound) >= 2.9 * float(robust_scale(free.residual))


def test_the_first_start_of_the_motor_has_no_fit():
    prepared = Motor().prepare(motor())
    with pytest.raises(NoFitError):
        fitted(JointModel(prepared), prepared.start())


def test_the_error_after_all_starts_fail_states_the_reason(monkeypatch):
    def lost(*_, **__):
        raise NoFitError("Expected `residual` to be finite at `start` but got 5782 of 8150 values that are not.")

    monkeypatch.setattr(process_noise, "fitted", lost)
    monkeypatch.setattr(process_noise, "multiple_shooting_start", lambda *_, **__: None)
    with pytest.raises(NoFitError, match="motor: no fit of Motor to `rpm` was found") as error:
        diagnose(Motor(), motor(), effects=())
    message = str(error.value)
    for words in (
        "the equations have no finite solution: `rpm` diverges",
        "With `friction` = ",
        "Tried:",
        "Check the sign",
    ):
        assert words in message
    for word in ("`start`", "`residual`", "`bound`", "argument", "nan"):
        assert word not in message
