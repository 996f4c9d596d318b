"""Names and texts of effects suit the kind of quantity."""

from dataclasses import replace

import pytest
import torch

from mkc_torch._support.unit_text import duration
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.parts import Alternative, Finding
from mkc_torch.effects import DYNAMICS, kind_of, words_of
from mkc_torch.effects.dynamics.constant_force import ConstantForce
from mkc_torch.effects.dynamics.hidden_lag import HiddenLag
from mkc_torch.effects.dynamics.hidden_mode import HiddenMode
from mkc_torch.effects.dynamics.position_periodic_force import PositionPeriodicForce
from mkc_torch.effects.dynamics.power_law import PowerLaw
from mkc_torch.effects.kinds import MOTION, kind_at, zero_of
from mkc_torch.recording import Recording
from mkc_torch.report.diagnosis import findings as report
from mkc_torch.simulation import Dynamics
from tests.effects.contexts import dynamic_context

MECHANICAL = ("speed", "load", "spring", "mass", "drag", "friction", "force", "motion")
STORE = {"time_constant": 7560.0}


def at_state(effect, unit, name="x"):
    """Return the context of an effect at the rate of a state in this unit."""
    context = dynamic_context(effect)
    carries = tuple(name if carried == "speed" else carried for carried in context.carries)
    parts = {part: name if of == "speed" else of for part, of in context.parts.items() if part != "level"}
    units = {**context.part_units, "own": unit}
    return replace(context, carries=carries, channels=(name,), parts=parts, part_units=units)


@pytest.mark.parametrize(
    ("unit", "name", "kind"),
    [
        ("degC", "x", "temperature"), ("K", "x", "temperature"), ("", "temp", "temperature"),
        ("rad/s", "x", "rotation"),
        ("cm", "level_2", "level"), ("V", "level1", "level"), ("V", "u", "voltage"),
        ("m/s", "temp", "speed"), ("", "x", ""),
    ],
)  # fmt: skip
def test_kind_is_from_the_unit_or_else_the_name(unit, name, kind):
    assert kind_of(unit, name) == kind
    assert kind_at(at_state(ConstantForce(), unit, name)) == kind


def test_a_length_without_a_speed_is_a_level():
    context = at_state(ConstantForce(), "m")
    assert kind_at(context) == "position"
    assert kind_at(replace(context, parts={**context.parts, "level": "x"})) == "level"


@pytest.mark.parametrize("kind", ["°C", "V", "A", "bar"])
def test_texts_of_other_kinds_have_no_mechanical_words(kind):
    at_all = [
        e for e in DYNAMICS if e.port in ("rate", "lagged rate") and {*e.needs} <= {"own", "temperature", "flowing"}
    ]
    assert len(at_all) > 5
    for effect in at_all:
        if "flowing" in effect.needs and kind == "°C":
            continue  # it has no meaning for a temperature
        context = at_state(effect, kind)
        shape = {**effect.shapes(context.time)[0], **dict.fromkeys(effect.relative, 1.0)}
        for text in (effect.explained([0.4], shape, context), effect.advised([0.4], shape, context)):
            assert not any(word in text.lower() for word in MECHANICAL), (effect.id, text)
            assert text.endswith(".")


@pytest.mark.parametrize(
    ("unit", "gamma", "text"),
    [
        ("°C", 0.382, "There is a second store of heat, 38 % of the first, exchanging in 2.1 h, that is"),
        (
            "m/s",
            3.14,
            "There is a mass dragged along by a damper, 3.1 times the size of the first, catching up in",
        ),
        ("V", 0.05, "There is a second capacitor behind a resistor, 5 % of the first, exchanging in 2.1 h"),
    ],
)
def test_hidden_lag_states_size_and_time_constant(unit, gamma, text):
    effect = HiddenLag()
    assert effect.explained([gamma], STORE, at_state(effect, unit)).startswith(text)


def test_hidden_lag_states_that_its_size_holds_for_a_start_in_balance():
    effect = HiddenLag()
    context = at_state(effect, "°C")
    assert "in balance with the state at the start of each run" in effect.explained([0.4], STORE, context)
    assert effect.advised([0.4], STORE, context).endswith("refit its start and its size.")


def test_a_periodic_force_states_its_periods():
    effect = PositionPeriodicForce()
    context = at_state(effect, "rad/s")
    assert effect.components("amplitude", {"order": 1.0}, context) == ("sin(x)", "cos(x)")
    assert effect.components("amplitude", {"order": 4.0}, context) == ("sin(4 x)", "cos(4 x)")
    assert "an unbalanced load" in effect.advised([1.0, 0.0], {"order": 1.0}, context)


MODE = {"period": 0.1408, "damping": 0.0224}


@pytest.mark.parametrize(
    ("unit", "gamma", "shape", "text"),
    [
        ("m/s", 0.213, MODE, "a second mass, 21 % of the moving one, on a spring: 7.1 Hz, damping ratio 0.02"),
        (
            "rad/s",
            0.213,
            MODE,
            "a second inertia, 21 % of the turning one, on a flexible shaft: 7.1 Hz, damping ratio 0.02",
        ),
        ("V", 3.14, MODE, "a second capacitor, 3.1 times the size of the first, behind a coil: 7.1 Hz, damping"),
        ("bar", 0.5, MODE | {"period": 420.0}, "a second volume, 50 % of the first, behind a column with inertia: "),
    ],
)  # fmt: skip
def test_hidden_mode_states_size_frequency_and_damping(unit, gamma, shape, text):
    effect = HiddenMode()
    context = at_state(effect, unit)
    assert effect.explained([gamma], shape, context).startswith(f"Not in the equations is {text}")
    assert effect.advised([gamma], shape, context).startswith(f"Add {text}")


def test_hidden_lag_of_a_level_is_a_side_tank():
    context = at_state(HiddenLag(), "cm", "level")
    assert "a side tank, 38 % of the first" in HiddenLag().advised([0.38], STORE, context)


def test_an_excess_states_its_reference():
    effect = PowerLaw("excess")
    context = at_state(effect, "degC")
    shape = {"lowest_of_own": 25.84, "highest_of_own": 98.2, "exponent": 3.0}
    assert "x₀ = 25.84 degC, the lowest of the recording" in effect.equation_of(shape, context)
    assert "counted from 25.84 degC" in effect.advised([1.0], shape, context)
    assert "natural convection" in effect.advised([1.0], shape, context)
    largest = context.part("own").new_full((len(context.time),), 98.2)
    signal = context.signal.clone()
    signal[:, context.carries.index("x")] = largest
    torch.testing.assert_close(
        effect.waveform(shape, replace(context, signal=signal)), -torch.ones_like(largest), rtol=1e-5, atol=0
    )


class Cup(Dynamics):
    states = ("temp",)
    parameters = {"loss": 0.1}
    units = {"temp": "degC"}

    def derivative(self, time, x, u, p):
        return {"temp": -p.loss * (x.temp - 20.0)}


@pytest.mark.parametrize("unit", ["degC", "°C", ""])
def test_a_temperature_has_no_overflow_or_resonance_in_any_notation(unit):
    time = torch.linspace(0.0, 30.0, 100, dtype=torch.float64)

    class Written(Cup):
        units = {"temp": unit} if unit else {}

    prepared = Written().prepare(Recording({"time": time, "temp": 20.0 + 60.0 * torch.exp(-0.1 * time)}))
    tried = {t.effect.id for t in candidate_terms(prepared, (), DYNAMICS)}
    assert not tried & {"overflow", "hidden_mode", "quadratic_drag", "coulomb_friction"}
    # without a unit absolute zero is not known
    assert ("thermal_loss" in tried) == ("power_law" in tried) == bool(unit)


def test_durations_have_a_suitable_unit():
    assert [duration(time) for time in (0.5, 119.0, 121.0, 7300.0, 4e5)] == ["0.5 s", "120 s", "2 min", "2 h", "4.6 d"]
    assert (zero_of("degC"), zero_of("K")) == (273.15, 0.0)
    assert "speed" in MOTION


@pytest.mark.parametrize("unit", ["°C", "V", "A", "bar"])
def test_names_of_other_kinds_have_no_mechanical_words(unit):
    kind = kind_of(unit)
    for effect in DYNAMICS:
        if effect.port in ("rate", "lagged rate") and {*effect.needs} <= {"own", "temperature"}:
            text = words_of(effect.id, kind)
            assert not any(word in text.lower() for word in (*MECHANICAL, "overflow")), text
    assert words_of("linear_drag") == "linear drag"


def test_a_finding_at_a_temperature_and_its_rivals_have_thermal_names():
    rivals = (
        Alternative("constant_force", (), 0.1, False, "rate of room"),
        Alternative("linear_drag", (), 0.2, False, "rate of speed"),
    )
    found = Finding(
        "linear_drag", (), ("rate of room",), (), None, "", "", (), 0.01, rivals, True, "", kind="temperature"
    )
    assert report.finding_name(found) == "loss of heat"
    assert report.rivals(found) == "constant heat flow, linear drag on the rate of speed"
    text = report.with_names("Do not correct for linear_drag yet.", {"linear_drag"}, {"linear_drag": "temperature"})
    assert text == "Do not correct for loss of heat yet."


@pytest.mark.parametrize("name", ["constant_force", "linear_drag"])
def test_a_state_of_unknown_kind_gets_no_mechanical_advice(name):
    """A concentration has no weight, and no viscosity."""
    effect = next(effect for effect in DYNAMICS if effect.id == name)
    context = at_state(effect, "mol/L")
    for text in (effect.explained([0.4], {}, context), effect.advised([0.4], {}, context)):
        assert not any(word in text.lower() for word in MECHANICAL), text
