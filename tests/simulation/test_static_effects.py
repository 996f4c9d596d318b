"""Physics hidden at the output of static simulations, and recordings without any."""

from itertools import combinations

import numpy as np
import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.shapes import candidates_of
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Static

TIME = 0.02 * np.arange(600)


class Damper(Static):
    inputs = ("speed", "position")
    outputs = ("force",)
    parameters = {"damping": 10.0, "zero": 0.0}
    units = {"force": "N", "speed": "m/s", "position": "m"}

    def output(self, time, u, p):
        return {"force": p.damping * u.speed + p.zero}


class Core(Static):
    inputs = ("field",)
    outputs = ("loss",)
    parameters = {"level": 1.0, "slope": 2.0}

    def output(self, time, u, p):
        return {"loss": p.level + p.slope * u.field}


def motion():
    phase = 2.0 * np.cumsum(0.3 + 0.9 * np.abs(np.sin(0.001 * np.arange(600) * 50))) * 0.02
    position = 1.5 * np.sin(phase) + 0.4 * np.sin(0.7 * TIME)
    return position, np.gradient(position, TIME)


def path(position, *, elastic, yields=0.3):
    """Return the state of Bouc and Wen's model, ``elastic`` in unloading, or of Dahl's, by small explicit steps."""
    z, states = 0.0, [0.0]
    for travel in np.diff(position) / 40:
        for _ in range(40):
            z += (
                travel - (abs(travel) * z + travel * abs(z)) / (2.0 * yields)
                if elastic
                else (travel - abs(travel) * z / yields)
            )
        states.append(z)
    return np.array(states)


def damper(hidden, seed):
    position, speed = motion()
    noise = np.random.default_rng(seed).normal(0.0, 2.0, len(TIME))
    force = 12.0 * speed + 3.0 + noise + hidden(position, speed)
    columns = {"time": TIME, "speed": speed, "position": position, "force": force}
    return Recording({name: torch.tensor(values) for name, values in columns.items()})


HIDDEN = {
    "driver_friction": (lambda x, v: 10.0 * np.tanh(v / 0.5), ("speed",), "level", 10.0, 1.0),
    "driver_linear": (lambda x, v: 3.0 * x, ("position",), "per_unit", 3.0, 0.4),
    "driver_dahl": (lambda x, v: 25.0 * path(x, elastic=False), ("position",), "stiffness", 25.0, 5.0),
    "driver_bouc_wen": (lambda x, v: 25.0 * path(x, elastic=True), ("position",), "stiffness", 25.0, 5.0),
}


@pytest.mark.e2e
@pytest.mark.parametrize("effect", HIDDEN)
def test_what_a_damper_lacks_is_named_with_its_size(effect):
    hidden, drivers, name, value, within = HIDDEN[effect]
    for seed in (11, 12):
        found = diagnose(Damper(), damper(hidden, seed), surrogates=19, max_findings=1).findings[0]
        assert (found.effect, found.drivers) == (effect, drivers)
        assert {p.name: p.value for p in found.parameters}[name] == pytest.approx(value, abs=within)


def core(seed, *, hidden):
    r = np.random.default_rng(seed)
    temperature = r.choice([25.0, 50.0, 70.0, 90.0], 600)
    bias = 60.0 + 30.0 * (0.7 * (temperature - 58.0) / 24.0 + 0.7 * r.normal(size=600))
    field = r.uniform(0.0, 2.0, 600)
    loss = 1.0 + 2.0 * field + r.normal(0.0, 0.2, 600) + hidden(temperature - 58.0, bias - 60.0)
    columns = {"field": field, "temperature": temperature, "bias": bias, "loss": loss}
    return Recording({name: torch.tensor(values) for name, values in columns.items()})


@pytest.mark.e2e
def test_two_columns_that_hide_each_other_are_named_together():
    recording = core(3, hidden=lambda temperature, bias: 0.014 * bias - 0.0104 * temperature)
    found = diagnose(Core(), recording, surrogates=19, max_findings=1).findings[0]
    assert (found.effect, found.drivers) == ("driver_pair", ("temperature", "bias"))
    values = {p.name: p.value for p in found.parameters}
    assert values["per_unit_1"] == pytest.approx(-0.0104, abs=0.002)
    assert values["per_unit_2"] == pytest.approx(0.014, abs=0.002)


@pytest.mark.e2e
def test_a_column_that_acts_alone_is_named_alone():
    recording = core(4, hidden=lambda temperature, bias: 0.01 * bias)
    found = diagnose(Core(), recording, surrogates=19, max_findings=1).findings[0]
    assert (found.effect, found.drivers) == ("driver_linear", ("bias",))


@pytest.mark.e2e
def test_nothing_is_named_where_nothing_is_hidden():
    for seed in (21, 22):
        found = diagnose(Damper(), damper(lambda x, v: 0.0, seed), max_findings=1)
        assert found.verdict == "adequate"


def test_inputs_and_pairs_drive_effects_that_state_it():
    recording = damper(lambda x, v: 0.0, 0)
    more = {name: torch.tensor(np.random.default_rng(k).normal(size=600)) for k, name in enumerate("abc")}
    simulation = Damper()
    prepared = simulation.prepare(Recording({**recording.columns, **more}))
    drivers, terms = candidates_of(simulation, prepared, CATALOGUE, DriverSettings())
    assert {driver.columns for driver in drivers.drivers} == {("a",), ("b",), ("c",)}
    tried = {(term.effect.id, term.columns) for term in terms}
    assert {("driver_linear", ("speed",)), ("driver_friction", ("position",))} <= tried
    assert ("driver_gain", ("speed",)) not in tried
    assert {columns for effect, columns in tried if effect == "driver_pair"} == set(combinations("abc", 2))
    friction = next(term for term in terms if term.effect.id == "driver_friction" and term.columns == ("speed",))
    assert friction.driver.units == ("m/s",)


def test_many_columns_are_not_paired():
    recording = damper(lambda x, v: 0.0, 0)
    more = {name: torch.tensor(np.random.default_rng(k).normal(size=600)) for k, name in enumerate("abcdefg")}
    simulation = Damper()
    prepared = simulation.prepare(Recording({**recording.columns, **more}))
    _, terms = candidates_of(simulation, prepared, CATALOGUE, DriverSettings())
    assert not any(term.effect.id == "driver_pair" for term in terms)
