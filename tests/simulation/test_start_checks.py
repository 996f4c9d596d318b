"""Checks of a simulation's parameters before the search; the truth of each is in the equations of the test."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter, Static

TIME = np.arange(400) / 20.0


class Disc(Dynamics):
    states, inputs, outputs = ("angle", "speed"), ("torque",), ("angle",)
    parameters = {"inertia": 0.1, "damping": 0.02}
    units = {"angle": "rad", "speed": "rad/s", "torque": "N m"}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": (self.drive(x, u, p) - p.damping * x.speed) / p.inertia}

    def drive(self, x, u, p):
        return u.torque


def recording(seed: int) -> Recording:
    """An angle that a damped disc of inertia 0.11 kg m² takes under three sines, by Euler's method in small steps."""
    random = np.random.default_rng(seed)
    frequency, phase = random.uniform(0.1, 1.0, 3), random.uniform(0.0, 6.28, 3)
    fine = np.arange(8000) / 400.0
    torque = 0.1 * np.sin(2.0 * np.pi * frequency * fine[:, None] + phase).sum(1)
    angle, speed = np.zeros(8000), np.zeros(8000)
    for k in range(7999):
        angle[k + 1] = angle[k] + speed[k] / 400.0
        speed[k + 1] = speed[k] + (torque[k] - 0.02 * speed[k]) / 0.11 / 400.0
    columns = {"time": TIME, "torque": torque[::20], "angle": angle[::20] + random.normal(0.0, 0.003, 400)}
    return Recording({name: torch.tensor(values) for name, values in columns.items()})


def checks(seed=1, drive=None, **parameters):
    def derived(self, x, u, p):
        return u.torque if drive is None else drive(x, u, p)

    system = type("Other", (Disc,), {"parameters": {**Disc.parameters, **parameters}, "drive": derived})
    return system().prepare(recording(seed)).checks


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_well_excited_system_passes(seed):
    assert checks(seed) == ()


def test_a_parameter_that_no_function_reads_is_in_no_equation():
    (check,) = checks(unused=2.0)
    assert (check.kind, check.parameters) == ("no equation", ("unused",))


def test_a_parameter_of_a_branch_that_is_never_reached_changes_no_output():
    (check,) = checks(drive=lambda x, u, p: u.torque - p.stop * torch.relu(x.angle.abs() - 1e3), stop=5.0)
    assert (check.kind, check.parameters) == ("no output", ("stop",))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_parameters_with_a_common_factor_are_determined_up_to_it(seed):
    (check,) = checks(seed, drive=lambda x, u, p: p.gain * u.torque, gain=1.0)
    assert check.kind == "only together"
    assert set(check.parameters) == {"gain", "inertia", "damping"}
    quotients = {frozenset(part.split(" / ")) for part in check.combination.split(", ")}
    assert len(quotients) == 2
    assert set().union(*quotients) == {"gain", "inertia", "damping"}
    assert abs(check.correlation) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("drive", "combination"),
    [
        (lambda x, u, p: p.first * p.second * u.torque, "first * second"),
        (lambda x, u, p: p.first / p.second * u.torque, "first / second"),
        (lambda x, u, p: u.torque * p.first * p.second**2, "second * sqrt(first)"),
        (lambda x, u, p: u.torque - (p.first + p.second), "first + 1 second"),
    ],
    ids=["product", "quotient", "power", "sum"],
)
def test_the_determined_combination_of_two_parameters_is_named(drive, combination):
    check = checks(drive=drive, first=0.5, second=0.7)[0]
    assert (check.kind, check.parameters, check.combination) == ("only together", ("first", "second"), combination)


@pytest.mark.parametrize(
    ("given", "start"),
    [
        (Parameter(0.0, lower=0.0, upper=1.0), pytest.approx(0.02)),
        (Parameter(1.0, lower=0.0, upper=1.0), pytest.approx(0.98)),
        (Parameter(0.5, lower=0.5), pytest.approx(0.55)),
    ],
)
def test_a_start_at_a_bound_is_moved_inside(given, start):
    check = checks(drive=lambda x, u, p: u.torque + p.bias * torch.cos(3.0 * x.angle), bias=given)[-1]
    assert (check.kind, check.start) == ("at a bound", start)


def test_a_start_at_a_single_bound_of_0_is_moved_visibly():
    """The angle changes by a tenth of its variation, by a central difference of the simulation."""
    system = type("Biased", (Disc,), {"parameters": {**Disc.parameters, "bias": Parameter(0.0, lower=0.0)}})
    system.drive = lambda self, x, u, p: u.torque + p.bias
    prepared = system().prepare(recording(1))
    (check,) = [check for check in prepared.checks if check.kind == "at a bound"]
    theta = torch.cat([torch.tensor([0.1, 0.02, 0.0]).double(), prepared.given[3:]])
    moved = theta.clone()
    moved[2] = check.start
    change = (prepared.simulated(moved, {}) - prepared.simulated(theta, {})).square().mean().sqrt()
    assert float(change) == pytest.approx(0.1 * float(prepared.measured.std()), rel=0.05)
    assert float(prepared.given[2]) == check.start


def test_a_fixed_parameter_is_not_moved():
    assert checks(drive=lambda x, u, p: u.torque + p.bias, bias=Parameter(0.0, lower=0.0, upper=0.0)) == ()


def test_a_static_simulation_has_the_same_checks():
    class Divider(Static):
        inputs, outputs = ("supply",), ("voltage",)
        parameters = {"upper": 2.0, "lower": 1.0, "unused": 1.0, "bias": Parameter(0.0, lower=0.0, upper=1.0)}

        def output(self, time, u, p):
            return {"voltage": u.supply * p.lower / p.upper + p.bias}

    supply = torch.linspace(1.0, 3.0, 60, dtype=torch.float64)
    known = Recording({"time": torch.arange(60.0), "supply": supply, "voltage": 0.4 * supply})
    prepared = Divider().prepare(known)
    assert [(check.kind, check.parameters) for check in prepared.checks] == [
        ("no equation", ("unused",)), ("only together", ("upper", "lower")), ("at a bound", ("bias",)),
    ]  # fmt: skip
    assert prepared.checks[1].combination in {"lower / upper", "upper / lower"}
    assert float(prepared.start()[3]) == pytest.approx(0.02)
