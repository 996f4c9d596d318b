"""Effects at the entry of an input that moves several rates, as a force goes through a mass matrix."""

import importlib.util
import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.effects.dynamics.constant_force import ConstantForce
from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.entries import entries, typical_gains
from mkc_torch.simulation.dynamics.user_functions import kinematic
from mkc_torch.simulation.parameter import known_parameters


def found_entries(system: Dynamics) -> dict[str, str]:
    known = known_parameters(system.name, system.parameters)
    return entries(system, known, kinematic(system, known))


class Arm(Dynamics):
    """Two links in a plane: positions before speeds, torques in the order of the joints."""

    states = ("q1", "q2", "w1", "w2")
    inputs = ("tau1", "tau2")
    parameters = {"heavy": 0.3, "light": 0.04, "between": 0.1}

    def derivative(self, time, x, u, p):
        own = p.heavy + 2.0 * p.between * torch.cos(x.q2)
        cross = p.light + p.between * torch.cos(x.q2)
        det = own * p.light - cross**2
        rates = {"q1": x.w1, "q2": x.w2, "w1": (p.light * u.tau1 - cross * u.tau2) / det}
        return {**rates, "w2": (own * u.tau2 - cross * u.tau1) / det}


@pytest.mark.parametrize("states", list(itertools.permutations(("q1", "q2", "w1", "w2"))))
@pytest.mark.parametrize("inputs", [("tau1", "tau2"), ("tau2", "tau1")])
def test_each_torque_of_an_arm_acts_along_its_own_joint(states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    arm = Arm()
    arm.states, arm.inputs = states, inputs
    assert found_entries(arm) == {"tau1": "w1", "tau2": "w2"}


class Cart(Dynamics):
    """A cart with a hanging pendulum, and a force on the cart."""

    states = ("position", "angle", "speed", "rotation")
    inputs = ("force",)
    outputs = ("position", "angle")
    parameters = {"mass": Parameter(1.0, lower=0.0)}
    units = {"position": "m", "angle": "rad", "speed": "m/s", "rotation": "rad/s", "force": "N"}
    initial = {"speed": 0.0, "rotation": 0.0}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        s, c = torch.sin(x.angle), torch.cos(x.angle)
        along = u.force + 0.2 * s * (0.5 * x.rotation**2 + 9.81 * c)
        speed = along / (p.mass + 0.2 * s**2)
        return {
            "position": x.speed,
            "angle": x.rotation,
            "speed": speed,
            "rotation": -(9.81 * s + speed * c) / 0.5 - 0.1 * x.rotation,
        }


@pytest.mark.parametrize("order", [("speed", "rotation"), ("rotation", "speed")])
def test_the_unit_of_a_force_chooses_its_speed(order: tuple[str, str]) -> None:
    cart = Cart()
    cart.states = ("position", "angle", *order)
    assert found_entries(cart) == {"force": "speed"}
    cart.units = {**Cart.units, "force": "N m"}
    assert found_entries(cart) == {"force": "rotation"}
    cart.units = {}
    assert found_entries(cart) == {"force": order[0]}


class Pendulum(Dynamics):
    """A torque that moves a single rate, and a wind by its square and of changing direction."""

    states = ("angle", "rotation", "other", "drift")
    inputs = ("torque", "wind", "turned")

    def derivative(self, time, x, u, p):
        blown = u.wind**2
        turned = torch.sin(3.0 * x.angle) * u.turned
        own = {"angle": x.rotation, "rotation": u.torque - x.angle + blown + turned}
        return {**own, "other": blown - x.other, "drift": torch.cos(4.0 * x.angle) * u.turned}


def test_inputs_of_one_rate_by_a_square_or_of_either_sign_have_no_entry() -> None:
    assert found_entries(Pendulum()) == {}


def rolled(seed: int, friction: float, tilt: float = 0.0, noise: float = 0.002) -> Recording:
    """A cart by SciPy, its force held for half a second at a time; dry friction and a constant force on the cart."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 8.0, 0.04)
    force = np.repeat(rng.choice([-2.0, -1.0, 0.0, 1.0, 2.0], 40), 10)[: len(time)]

    def rate(_: float, x: np.ndarray, u: float) -> list[float]:
        s, c = math.sin(x[1]), math.cos(x[1])
        acting = u + tilt - friction * math.tanh(x[2] / 0.005)
        speed = (acting + 0.2 * s * (0.5 * x[3] ** 2 + 9.81 * c)) / (1.0 + 0.2 * s**2)
        return [x[2], x[3], speed, -(9.81 * s + speed * c) / 0.5 - 0.1 * x[3]]

    x, states = np.array([0.0, 0.3, 0.0, 0.0]), []
    for k, now in enumerate(time):
        states.append(x)
        x = solve_ivp(rate, (now, now + 0.04), x, args=(force[k],), method="LSODA", rtol=1e-8, atol=1e-10).y[:, -1]
    seen = np.array(states)[:, :2] + noise * rng.normal(size=(len(time), 2))
    return Recording({"time": time, "force": force, "position": seen[:, 0], "angle": seen[:, 1]})


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_friction_of_a_cart_is_found_at_the_force_and_exported(seed: int, tmp_path) -> None:
    recording = rolled(seed, friction=0.3)
    found = diagnose(Cart(), recording, effects=(CoulombFriction(),), surrogates=39, max_findings=1)
    assert [(f.effect, f.channels) for f in found.findings] == [("coulomb_friction", ("input force",))]
    friction = found.findings[0].parameters[0]
    assert friction.unit == "N"
    assert found.environment.input_hold == {"force": "held"}
    assert friction.value == pytest.approx(0.3, abs=4.0 * friction.standard_error + 0.003)
    assert ("coulomb_friction@force",) in {model.terms for model in found.decisions.models}
    assert all(len(set(model.terms)) == len(model.terms) for model in found.decisions.models)
    file = tmp_path / "corrected.py"
    file.write_text(found.model.to_python(__name__))
    spec = importlib.util.spec_from_file_location("corrected", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    prepared = module.CorrectedCart().prepare(recording)
    fit = fitted(JointModel(prepared), prepared.start())
    assert float(fit.residual.square().mean().sqrt()) < 0.003


@pytest.mark.e2e
def test_nothing_is_found_at_the_force_of_a_cart_without_friction() -> None:
    effects = (CoulombFriction(), ConstantForce())
    assert diagnose(Cart(), rolled(3, friction=0.0), effects=effects, surrogates=19, max_findings=1).findings == ()


def test_the_gains_of_a_force_are_those_of_the_equations() -> None:
    prepared = Cart().prepare(rolled(4, friction=0.0))
    gains = typical_gains(prepared, "force")
    assert gains["position"] == gains["angle"] == 0.0
    assert gains["speed"] == pytest.approx(1.0, abs=0.05)
    assert gains["rotation"] == pytest.approx(2.0, abs=0.2)


def test_a_change_at_the_entry_is_a_change_of_the_force() -> None:
    """A spring from the force to the wall, added at the entry, against the same spring in the equations."""

    class Sprung(Cart):
        def derivative(self, time, x, u, p):
            u.force = u.force - 0.5 * x.position
            return super().derivative(time, x, u, p)

    recording = rolled(5, friction=0.0)
    prepared, sprung = Cart().prepare(recording), Sprung().prepare(recording)
    theta = sprung.given
    port = prepared.ports["entry of force"]
    place = port.carries.index("position")
    changes = {"entry of force": lambda signal: -0.5 * signal[:, [place]]}
    assert torch.allclose(prepared.residual(theta, changes), sprung.residual(theta, {}), atol=1e-9)
    assert prepared.signals(theta, changes)["entry of force"].shape == (len(port.clock.time), len(port.carries))
