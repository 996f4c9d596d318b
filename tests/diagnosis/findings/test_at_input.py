"""The size of an effect on a rate in the unit of the input that moves the rate."""

import math

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.result import Finding
from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from mkc_torch.report.diagnosis.numbers import at_input
from mkc_torch.simulation import Dynamics, Parameter
from tests.diagnosis.cart import FRICTION, cart_recording

MASS = 2.0


class Cart(Dynamics):
    """A cart whose mass is fitted, driven by a force, without friction."""

    states = ("speed",)
    inputs = ("force",)
    parameters = {"mass": Parameter(1.5, lower=0.0)}
    units = {"speed": "m/s", "force": "N"}
    input_hold = "linear"

    def derivative(self, time, x, u, p):
        return {"speed": u.force / p.mass}


class Rubbed(Cart):
    """The same cart with its friction in its equations, at the force."""

    parameters = {**Cart.parameters, "friction": Parameter(0.1, unit="N")}

    def derivative(self, time, x, u, p):
        # the smooth sign of the effect in the catalogue is narrow compared with the speeds of this recording
        return {"speed": (u.force - p.friction * torch.tanh(x.speed / 0.005)) / p.mass}


class Slowed(Rubbed):
    """The same cart with its friction at the rate."""

    parameters = {**Cart.parameters, "friction": Parameter(0.1, unit="m/s²")}

    def derivative(self, time, x, u, p):
        return {"speed": u.force / p.mass - p.friction * torch.tanh(x.speed / 0.005)}


def least_squares(system: Dynamics) -> tuple[float, float]:
    """Return the friction of a system with its standard error."""
    prepared = system.prepare(moved(friction=FRICTION))
    fit = fitted(JointModel(prepared), prepared.start())
    slope = torch.func.jacfwd(lambda values: prepared.residual(values, {}))(fit.parameters).flatten(0, 1)
    variance = fit.residual.square().mean() * torch.linalg.inv(slope.mT @ slope)[1, 1]
    return float(fit.parameters[1]), math.sqrt(float(variance))


def moved(**options: float) -> Recording:
    """Return a cart of 2 kg with friction: the force is that of a cart of 1 kg, doubled."""
    recording = cart_recording(mean=0.0, **options)
    columns = {name: recording[name] for name in recording.names}
    return Recording({**columns, "force": MASS * columns["force"]})


def found(system: Dynamics, **options: float) -> Finding:
    effects = (CoulombFriction(), QuadraticDrag())
    return diagnose(system, moved(**options), effects=effects, surrogates=19, max_findings=1).findings[0]


@pytest.mark.e2e
def test_friction_of_a_rate_is_a_friction_of_the_force_with_the_error_of_a_fit_at_the_force():
    finding = found(Cart(), friction=FRICTION)
    assert (finding.effect, finding.channels) == ("coulomb_friction", ("rate of speed",))
    assert finding.at_input is not None
    assert finding.at_input.input == "force"
    assert (finding.region.state, finding.region.unit) in {("force", "N"), ("speed", "m/s")}
    (size,) = finding.at_input.parameters
    assert (size.name, size.unit) == ("friction", "N")
    # independent: the friction as a parameter of the equations, at the rate and at the force, by least squares
    (at_rate, rate_error), (at_force, force_error) = (least_squares(system) for system in (Slowed(), Rubbed()))
    assert size.value == pytest.approx(at_force, rel=0.01)
    assert size.value / finding.parameters[0].value == pytest.approx(at_force / at_rate, rel=1e-3)
    # correlated with the mass: the error is not that of the rate times the mass
    ratio = size.standard_error / finding.parameters[0].standard_error
    assert ratio == pytest.approx(force_error / rate_error, rel=0.02)
    assert ratio < 0.99 * MASS
    assert at_input(finding.at_input).startswith("the same as friction 0.3989 ± 0.0016 N at the input force")


@pytest.mark.e2e
def test_there_is_no_size_at_an_input_without_a_unit_and_none_where_two_inputs_move_the_rate():
    class Unnamed(Cart):
        units = {"speed": "m/s"}
        inputs = ("throttle",)

        def derivative(self, time, x, u, p):
            return {"speed": u.throttle / p.mass}

    class Braked(Cart):
        inputs = ("force", "brake")
        units = {**Cart.units, "brake": "N"}

        def derivative(self, time, x, u, p):
            return {"speed": (u.force - u.brake) / p.mass}

    recording = moved(friction=FRICTION)
    columns = {name: recording[name] for name in recording.names}
    effects = (CoulombFriction(),)
    for system in (Unnamed(), Braked()):
        table = Recording({**columns, "throttle": columns["force"], "brake": torch.zeros_like(columns["force"])})
        result = diagnose(system, table, effects=effects, surrogates=19, max_findings=1)
        assert result.findings[0].effect == "coulomb_friction"
        assert result.findings[0].at_input is None


@pytest.mark.e2e
def test_a_drag_in_proportion_to_the_square_has_the_unit_of_the_force_by_that_of_the_square():
    recording = cart_recording(drag=0.3)
    table = {name: recording[name] for name in recording.names}
    table["force"] = MASS * table["force"]
    finding = diagnose(Cart(), Recording(table), effects=(QuadraticDrag(),), surrogates=19, max_findings=1).findings[0]
    (size,) = finding.at_input.parameters
    assert size.unit == "N·s²/m²"
    assert size.value == pytest.approx(0.6, abs=4.0 * size.standard_error)
