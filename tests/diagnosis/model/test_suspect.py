"""Suspected effects are parsed from text, and every candidate has a text that selects it."""

from functools import cache

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.shapes import candidate_terms, candidates_of
from mkc_torch.diagnosis.model.suspect import suspect_id, suspected_terms
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Dynamics, Magnetometer, Paired, Static
from tests.simulation.tumbling import tumbling

N = 80
TIME = 0.1 * torch.arange(N, dtype=torch.float64)


class Cart(Dynamics):
    """A cart on a spring, with a motor."""

    states, inputs, outputs = ("x", "speed"), ("command",), ("x",)
    units = {"x": "m", "speed": "m/s"}
    parameters = {"stiffness": 2.0}

    def derivative(self, time, x, u, p):
        return {"x": x.speed, "speed": u.command - p.stiffness * x.x}


class Rooms(Dynamics):
    """Three rooms; the first is heated."""

    states, inputs = ("warm", "mild", "cold"), ("power",)
    units = dict.fromkeys(states, "K")
    parameters = {"loss": 0.1}

    def derivative(self, time, x, u, p):
        return {"warm": u.power - p.loss * x.warm, "mild": -p.loss * x.mild, "cold": -p.loss * x.cold}


class Ball(Dynamics):
    """A thrown ball."""

    states = outputs = ("vx", "vy")
    units = dict.fromkeys(states, "m/s")
    parameters = {"g": 9.8}

    def derivative(self, time, x, u, p):
        return {"vx": 0.0 * x.vx, "vy": -p.g + 0.0 * x.vy}


class Echo(Static):
    """The input and the output have the same name."""

    inputs, outputs, parameters = ("level",), ("level",), {"slope": 1.1}

    def output(self, time, u, p):
        return {"level": p.slope * u.level}


def waves(*names):
    return {name: torch.sin((1.0 + 0.37 * k) * TIME + 0.5 * k) for k, name in enumerate(names)}


def prepared_and_terms(simulation, recording):
    prepared = simulation.prepare(recording)
    return prepared, candidates_of(simulation, prepared, CATALOGUE, DriverSettings())[1]


@cache
def cart():
    columns = waves(
        "command", "x", "cell_temperature", "cell_copy", "a+b", "a  b", "load", "power (W)", "it's", "open("
    )
    columns["cell_copy"] = 2.0 * columns["cell_temperature"] + 1.0
    return prepared_and_terms(Cart(), Recording({"time": TIME, **columns}))


@cache
def rooms():
    return prepared_and_terms(Rooms(), Recording({"time": TIME, **waves("warm", "mild", "cold", "power")}))


@cache
def ball():
    return prepared_and_terms(Ball(), Recording({"time": TIME, **waves("vx", "vy", "spin_rate")}))


@cache
def echo():
    recording = Recording({"time": TIME, "level": TIME.cos(), "current": TIME.sin()})
    return prepared_and_terms(Echo(), recording)


@cache
def simulator():
    simulated = waves("shoulder", "elbow")
    measured = {name: 1.1 * values + 0.01 * TIME.cos() for name, values in simulated.items()}
    units = dict.fromkeys(simulated, "rad")
    recording = Recording({"time": TIME, **measured, "load": (3.0 * TIME).cos()}, units=units)
    return prepared_and_terms(Paired(Recording({"time": TIME, **simulated}, units=units)), recording)


@cache
def magnetometer():
    time = np.arange(300) / 50.0
    place = {f"position_{axis}": np.sin((1.0 + k) * time) for k, axis in enumerate("xyz")}
    columns = {"temperature": 20.0 + time, "current_1": np.sin(3.0 * time), "rpm": np.cos(2.0 * time), **place}
    return prepared_and_terms(Magnetometer("attitude"), tumbling(300, noise=0.3, attitude=True, **columns))


def keys(text, known):
    prepared, terms = known
    return [list(dict.fromkeys(term.key for term in found)) for found in suspected_terms(text, terms, prepared)]


@pytest.mark.parametrize("known", [cart, rooms, ball, echo, simulator, magnetometer])
def test_the_text_of_a_candidate_selects_all_candidates_with_its_key(known):
    prepared, terms = known()
    assert len(terms) > 10
    texts = {term.key: suspect_id(term, terms) for term in terms}
    assert len(set(texts.values())) == len(texts)
    for key, text in texts.items():
        (found,) = suspected_terms(text, terms, prepared)
        assert found == tuple(term for term in terms if term.key == key), text


@pytest.mark.parametrize("known", [cart, rooms, ball, simulator, magnetometer])
def test_the_text_needs_no_other_candidates_where_inputs_and_outputs_have_different_names(known):
    _, terms = known()
    assert all(suspect_id(term) == suspect_id(term, terms) for term in terms)


def test_suspected_effects_keep_their_order_and_have_all_shapes_of_the_grid():
    prepared, terms = cart()
    text = " driver_input_gain @ command ( cell_temperature )+coulomb_friction@speed + input_lag"
    gain, friction, lag = suspected_terms(text, terms, prepared)
    assert {term.key for term in gain} == {("driver_input_gain", ("cell_temperature",), "input command")}
    assert {term.key for term in friction} == {("coulomb_friction", (), "rate of speed")}
    assert len({term.shape["width"] for term in friction}) == len(friction) > 1
    assert {term.key for term in lag} == {("input_lag", (), "input command")}


@pytest.mark.parametrize("port", ["speed", "rate of speed", "rate  of speed", '"rate of speed"', "'speed'"])
def test_a_port_has_a_full_and_a_short_name(port):
    assert keys(f"linear_drag@{port}", cart()) == [[("linear_drag", (), "rate of speed")]]


def test_a_port_is_named_by_a_quantity_that_it_changes():
    assert keys("sensor_lag@x", cart()) == [[("sensor_lag", (), "output")]]
    assert keys("hard_iron_step@y", magnetometer()) == [[("hard_iron_step", (), "sensor")]]


def test_a_quantity_of_several_exchanges_means_all_of_them():
    pairs = ["exchange of warm and mild", "exchange of warm and cold"]
    assert keys("coupling@warm", rooms()) == [[("coupling", (), pair) for pair in pairs]]
    assert keys("coupling@warm and cold", rooms()) == [[("coupling", (), pairs[1])]]


def test_the_port_of_a_single_output_precedes_that_of_all_outputs():
    assert keys("offset@elbow + offset@all outputs", simulator()) == [
        [("offset", (), "output elbow")],
        [("offset", (), "all outputs")],
    ]


def test_an_input_and_an_output_of_one_name_are_distinguished_by_their_full_names():
    assert keys("backlash@input level + backlash@output level", echo()) == [
        [("backlash", (), "input level")],
        [("backlash", (), "output level")],
    ]


def test_without_a_driver_the_form_without_a_driver_is_meant():
    port = "exchange of vx and vy"
    assert keys("magnus_lift", ball()) == [[("magnus_lift", (), port)]]
    assert keys("magnus_lift(spin_rate)", ball()) == [[("magnus_lift", ("spin_rate",), port)]]


def test_columns_that_act_together_are_named_by_their_role_or_by_commas():
    place = ("position_x", "position_y", "position_z")
    for driver in ("position", "position_x,position_y , position_z"):
        assert keys(f"field_gradient({driver})", magnetometer()) == [[("field_gradient", place, "field")]]
    assert keys("field_gradient", magnetometer()) == [[("field_gradient", place, "field")]]


def test_a_copy_of_a_column_names_the_driver():
    expected = [[("driver_input_gain", ("cell_temperature",), "input command")]]
    assert keys("driver_input_gain(cell_copy)", cart()) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("EFFECT@PORT(DRIVER)", "got ''")),
        ("linear_drag +", ("got 'linear_drag +'",)),
        ("linear_drag@", ("got 'linear_drag@'",)),
        ("linear_drag(x", ("got 'linear_drag(x'",)),
        ("+ linear_drag", ("write, for example",)),
        ("colomb_friction", ("`colomb_friction`, which is unknown", "did you mean `coulomb_friction`", "`input_lag`")),
        ("nonsense", ("`nonsense`, which is unknown; in Cart, effects that can act there are `constant_force`",)),
        ("overflow", ("act in Cart but got `overflow`, which has no port there", "`linear_drag`")),
        ("driver_exchange", ("`driver_exchange`, which has no port there",)),
        ("linear_drag@sped", ("a port of `linear_drag` but got `sped`", "did you mean `speed`?", "are `speed`.")),
        ("linear_drag@command", ("where it cannot act; its ports in Cart are `speed`",)),
        (
            "driver_force@speed",
            ("the driver of `driver_force`", "for example, `driver_force@speed(cell_temperature)`;"),
        ),
        (
            "driver_force(lod)",
            ("a driver of `driver_force` but got `lod`", "did you mean `load`?", '`a+b`, `"a  b"`, `load`'),
        ),
        ("linear_drag(load)", ("depends on no column", "got `load`; write `linear_drag@speed`.")),
        ("linear_drag + linear_drag@speed", ("name each effect once but got `linear_drag@speed` twice",)),
    ],
)
def test_an_error_names_the_mistake_and_what_there_is(text, words):
    prepared, terms = cart()
    with pytest.raises(ValueError, match="Expected argument `suspect` to ") as raised:
        suspected_terms(text, terms, prepared)
    for word in words:
        assert word in str(raised.value)


def test_a_port_of_several_must_be_named():
    prepared, terms = rooms()
    with pytest.raises(ValueError, match="`linear_drag@warm`; its ports in Rooms are `warm`, `mild`, `cold`"):
        suspected_terms("linear_drag", terms, prepared)


def test_an_effect_without_a_column_to_drive_it_is_refused():
    prepared, terms = rooms()
    with pytest.raises(ValueError, match="`driver_force`, which has no column there that can drive it"):
        suspected_terms("driver_force@warm", terms, prepared)


def test_an_effect_that_only_acts_between_samples_is_refused():
    prepared = Cart().prepare(Recording({"time": TIME[:16], **{k: v[:16] for k, v in waves("command", "x").items()}}))
    terms = tuple(term for term in candidate_terms(prepared, (), CATALOGUE) if term.effect.id != "input_lag")
    with pytest.raises(ValueError, match="`input_lag`, which has no shape longer than a sample there"):
        suspected_terms("input_lag", terms, prepared)


def test_other_than_text_is_refused():
    prepared, terms = cart()
    with pytest.raises(TypeError, match="Expected argument `suspect` to be text but got None"):
        suspected_terms(None, terms, prepared)
