"""The surroundings of a state: the input relative to which it acts, by the form of the equations."""

import pytest

from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.surroundings import surroundings


class Sled(Dynamics):
    states, inputs = ("speed",), ("force",)

    def derivative(self, _time, x, u, p):
        return {"speed": (u.force - p.friction * x.speed) / p.mass}


class Heater(Dynamics):
    states, inputs = ("temp",), ("power", "outside")

    def derivative(self, _time, x, u, p):
        return {"temp": u.power - p.loss * (x.temp - u.outside)}


@pytest.mark.parametrize("friction", [1.0, 0.7, Parameter(1.0, lower=0.0)])
def test_a_force_is_not_the_surroundings_at_any_friction(friction):
    system = type("Sled", (Sled,), {"parameters": {"mass": 4.0, "friction": friction}})()
    assert surroundings(system) == {}


@pytest.mark.parametrize("loss", [1.0, 0.1, 0.0])
def test_an_ambient_temperature_is_the_surroundings_at_any_loss(loss):
    assert surroundings(type("Heater", (Heater,), {"parameters": {"loss": loss}})()) == {"temp": "outside"}
