"""The ports that declarations allow contain those of every recording."""

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.shapes import ports_of
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Dynamics, Magnetometer, Paired, SimulationError, Static
from mkc_torch.simulation.declared_ports import declared_ports
from tests.diagnosis.line import Line
from tests.simulation.tumbling import tumbling

TIME = 0.1 * torch.arange(60, dtype=torch.float64)


class Cart(Dynamics):
    states, inputs, outputs = ("x", "speed"), ("command",), ("x",)
    units = {"x": "m", "speed": "m/s"}
    parameters = {"stiffness": 2.0}

    def derivative(self, time, x, u, p):
        return {"x": x.speed, "speed": u.command - p.stiffness * x.x}


class Room(Dynamics):
    states, inputs = ("warm", "cold"), ("power", "outside")
    units = {"warm": "K", "cold": "K", "outside": "K"}
    parameters = {"loss": 0.1}

    def derivative(self, time, x, u, p):
        return {"warm": u.power - p.loss * (x.warm - u.outside), "cold": -p.loss * (x.cold - u.outside)}


class Joint(Static):
    inputs, outputs, parameters = ("command",), ("angle", "wrist"), {"slope": 1.0}

    def output(self, time, u, p):
        return {"angle": p.slope * u.command, "wrist": u.command}


def waves(*names):
    return Recording({"time": TIME} | {name: torch.sin((1.0 + 0.4 * k) * TIME + k) for k, name in enumerate(names)})


CASES = [
    (Cart(), waves("command", "x")),
    (Room(), waves("warm", "cold", "power", "outside")),
    (Joint(), waves("command", "angle", "wrist")),
    (Paired(waves("a", "b")), Recording({"time": TIME, "a": TIME.cos(), "b": TIME.sin()})),
    (Magnetometer("attitude"), tumbling(300, noise=0.3, attitude=True)),
    (Magnetometer("norm"), tumbling(300, noise=0.3)),
]


@pytest.mark.parametrize(("simulation", "recording"), CASES, ids=lambda value: getattr(value, "name", ""))
def test_declared_ports_contain_those_of_a_recording(simulation, recording):
    declared, prepared = declared_ports(simulation), simulation.prepare(recording).ports
    assert set(prepared) <= set(declared)
    for effect in CATALOGUE:
        assert set(ports_of(effect, prepared)) <= set(ports_of(effect, declared)), effect.id


def test_a_state_may_reverse_where_no_recording_shows_that_it_does_not():
    constant = Recording({"time": TIME, "command": TIME.sin(), "x": 3.0 * TIME + 0.01 * TIME.sin()})
    (friction,) = (effect for effect in CATALOGUE if effect.id == "coulomb_friction")
    assert ports_of(friction, Cart().prepare(constant).ports) == ()
    assert ports_of(friction, declared_ports(Cart())) == ("rate of speed",)


def test_a_simulation_of_another_kind_needs_a_recording():
    with pytest.raises(SimulationError, match="line does not declare where effects can act; give a recording"):
        declared_ports(Line())


def test_the_names_of_a_system_are_checked():
    class Nameless(Dynamics):
        pass

    with pytest.raises(SimulationError, match="Nameless has no `states`"):
        declared_ports(Nameless())
