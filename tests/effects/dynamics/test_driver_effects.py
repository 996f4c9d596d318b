"""Effects of recorded columns on rates and inputs: values computed by hand, and where each is tried."""

from dataclasses import replace

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import DYNAMICS, PAIRED
from mkc_torch.effects.context import Context
from mkc_torch.effects.dynamics.rate import SURROUNDINGS
from mkc_torch.simulation import Dynamics, Static

OF_COLUMNS = ("driver_force", "driver_exchange", "driver_rate_constant", "driver_input_gain")
SIZE = torch.tensor([0.5], dtype=torch.float64)


def effects(effect_id):
    return [effect for effect in DYNAMICS if effect.id == effect_id]


def context(unit="", own_unit="°C"):
    """A state of 3 and 5, surroundings of 1 and 2, and a column of 7 and 11 with mean 9."""
    signal = torch.tensor([[3.0, 1.0], [5.0, 2.0]], dtype=torch.float64)
    column = torch.tensor([[-2.0], [2.0]], dtype=torch.float64)
    parts = {"own": "temp", "temperature": "temp", SURROUNDINGS: "outside"}
    units = dict.fromkeys(parts, own_unit)
    time = torch.arange(2, dtype=torch.float64)
    names = ("temp", "outside")
    return Context(time, column, (unit,), signal, "°C/s", ("temp",), names, parts, units, None, (9.0,))


def change(effect, at, shape=None):
    return effect.change(SIZE, shape or {}, at)[:, 0].tolist()


def test_a_force_is_in_proportion_to_the_column_with_its_mean():
    (effect,) = effects("driver_force")
    assert change(effect, context()) == [3.5, 5.5]
    assert effect.unit(context("A")) == "°C/s/A"


@pytest.mark.parametrize(("unit", "own_unit", "zeros"), [("", "°C", 0.0), ("°C", "°C", 0.0), ("K", "°C", -273.15)])
def test_an_exchange_is_in_proportion_to_the_difference_of_temperatures_in_one_unit(unit, own_unit, zeros):
    (effect,) = effects("driver_exchange")
    assert change(effect, context(unit, own_unit)) == pytest.approx([0.5 * (4.0 + zeros), 0.5 * (6.0 + zeros)])


def test_a_rate_constant_changes_with_the_column_less_its_mean():
    to_surroundings, alone = effects("driver_rate_constant")
    assert change(alone, context()) == [3.0, -5.0]
    assert change(to_surroundings, context(), {SURROUNDINGS: 1.0}) == [2.0, -3.0]
    assert alone.unit(context("m/s")) == "1/s/(m/s)"


def test_a_gain_changes_with_the_column_less_its_mean():
    (effect,) = effects("driver_input_gain")
    (own,) = effect.quantities({}, context("V"))
    assert own.unit == "1/V"
    assert change(effect, context("V")) == [-3.0, 5.0]


def test_a_context_without_means_has_drivers_as_recorded():
    assert replace(context(), driver_means=()).recorded.tolist() == [-2.0, 2.0]


class Room(Dynamics):
    states, inputs = ("temp",), ("power", "outside")
    parameters = {"loss": 0.1}
    units = {"temp": "°C", "outside": "°C"}
    step = 0.1

    def derivative(self, time, x, u, p):
        return {"temp": u.power - p.loss * (x.temp - u.outside)}


class Line(Static):
    inputs, outputs = ("power",), ("temp",)
    parameters = {"slope": 1.0}

    def output(self, time, u, p):
        return {"temp": p.slope * u.power}


def recording():
    time = torch.arange(60, dtype=torch.float64) * 0.1
    columns = {"time": time, "power": 3.0 + time.sin(), "outside": 5.0 + time.cos(), "temp": 20.0 + time}
    return Recording({**columns, "sun": (2.0 * time).cos(), "temperature_cellar": 9.0 + (0.7 * time).sin()})


def tried(simulation, known=None):
    """Return effect, column and port of each candidate that a column drives at a rate or an input."""
    known = recording() if known is None else known
    prepared = simulation.prepare(known)
    drivers = find_drivers(known, frozenset(simulation.columns), DriverSettings()).drivers
    terms = candidate_terms(prepared, drivers, (*DYNAMICS, *PAIRED))
    return {(term.effect.id, term.columns[0], term.port) for term in terms if term.effect.id in OF_COLUMNS}


def test_columns_act_on_rates_and_actuators_but_not_on_the_surroundings():
    rate = "rate of temp"
    assert tried(Room()) == {
        ("driver_force", "sun", rate),
        ("driver_exchange", "temperature_cellar", rate),
        ("driver_rate_constant", "sun", rate),
        ("driver_rate_constant", "temperature_cellar", rate),
        ("driver_input_gain", "sun", "input power"),
        ("driver_input_gain", "temperature_cellar", "input power"),
    }


def test_a_static_simulation_has_the_gain_of_its_output_instead():
    assert tried(Line()) == set()


@pytest.mark.parametrize(("noise", "acts"), [(0.1, False), (3.0, True)])
def test_a_column_that_nearly_repeats_an_input_acts_on_no_rate(noise, acts):
    known = recording()
    g = torch.Generator().manual_seed(1)
    copied = known["power"] + noise * torch.randn(60, generator=g, dtype=torch.float64)
    columns = {name: known[name] for name in ("time", "power", "outside", "temp")}
    assert bool(tried(Room(), Recording({**columns, "measured": copied}))) is acts
