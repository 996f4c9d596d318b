"""All effects of the catalogue, their simpler forms, and users' effects pass the common test case."""

import pytest
import torch

from mkc_torch import effects
from mkc_torch.effects import (
    ATTITUDE,
    CATALOGUE,
    DYNAMICS,
    PAIRED,
    SENSOR,
    Effect,
    GainEffect,
    Quantity,
    is_curve,
    words_of,
)
from mkc_torch.effects.dynamics.driver_output_quadratic import DriverOutputQuadratic
from mkc_torch.effects.dynamics.driver_parameter_quadratic import DriverParameterQuadratic
from mkc_torch.effects.sensor.field_gradient import FieldGradient
from mkc_torch.effects.sensor.magnetic_pole import MagneticPole
from mkc_torch.effects.sensor.unrecorded import COURSE, Unrecorded
from tests.effects.contexts import make_context
from tests.effects.effect_case import OfEveryEffect, OfEveryShape, cases, over_all_cases

SIMPLER = tuple(effect.simpler for effect in CATALOGUE if effect.simpler is not None)


class SupplyOffset(GainEffect):
    """The example of the README."""

    id = "supply_offset"
    roles = ("voltage",)
    equation = "δB = k (V − V̄)"
    explanation = "The offset follows the supply voltage."
    advice = "Give the sensor a regulator of its own."
    plausible = 1.0
    source = "our bench"

    def waveform(self, shape, context):
        return context.drivers[:, 0]


class EffectWithRequiredMethods(Effect):
    """An effect with the two required methods only."""

    id = "squared_response"
    follows_signal = True
    equation = "δB = γ B²"
    explanation = "The response is quadratic."
    advice = "Look for a magnet near the element."
    source = "our bench"

    def quantities(self, shape, context):
        return (Quantity("coefficient", len(context.channels), f"1/{context.signal_unit}"),)

    def change(self, gamma, shape, context):
        return gamma * context.signal.square()


ALL = (*CATALOGUE, SupplyOffset(), EffectWithRequiredMethods())


@over_all_cases(lambda: [pytest.param(effect, id=f"{type(effect).__name__}-{effect.plot_axis}") for effect in ALL])
class TestEveryEffect(OfEveryEffect):
    pass


@over_all_cases(lambda: cases((*ALL, *SIMPLER)))
class TestEveryShape(OfEveryShape):
    pass


COEFFICIENTS = {f"{COURSE}{k}": 0.5 / k for k in (1, 3)}


@pytest.mark.parametrize(("effect", "shape", "context"), [(Unrecorded(), COEFFICIENTS, make_context(Unrecorded()))])
class TestUnrecorded(OfEveryShape):
    """An effect without a grid of shapes passes the tests of a shape."""

    def test_equation_has_the_form_of_the_shape(self, effect, shape, context):
        equation = effect.equation_of(shape, context)
        assert equation.startswith(effect.equation)
        assert equation.endswith("2 numbers c_k in model.json")
        assert not any(effect.reports(name) for name in shape)
        assert effect.shapes(context.time) == ()


def test_docstrings_have_all_headings():
    for effect in CATALOGUE:
        for heading in ("Simulation:", "Drivers:", "Units:", "Plausible:", "Source:"):
            assert heading in type(effect).__doc__, effect.id


def test_ids_are_unchanged():
    assert tuple(effect.id for effect in SENSOR) == (
        "hard_iron_step", "offset_drift", "temperature_offset", "current_field", "field_gradient", "field_gradient",
        "cubic_nonlinearity", "driver_offset", "unknown",
    )  # fmt: skip
    assert tuple(effect.id for effect in ATTITUDE) == ("heading_reset",)
    assert tuple(effect.id for effect in PAIRED) == (
        "gain", "offset", "delay", "clock_drift", "backlash", "output_saturation", "gravity_sag", "offset", "delay",
        "backlash", "gravity_sag", "driver_linear", "driver_quadratic", "driver_gain", "gain_drift", "driver_friction",
        "driver_bouc_wen", "driver_dahl", "driver_pair", "periodic",
    )  # fmt: skip
    assert {effect.id for effect in DYNAMICS} >= {
        "constant_force", "linear_drag", "quadratic_drag", "coulomb_friction", "stribeck_friction",
        "load_dependent_friction", "cubic_stiffness", "position_periodic_force", "coupling", "hard_stop", "overflow",
        "thermal_loss", "input_delay", "input_saturation", "dead_zone", "sensor_lag", "backlash", "bouc_wen_hysteresis",
        "added_mass", "magnus_lift", "buoyancy", "hidden_lag", "hidden_mode", "power_law", "input_lag", "input_square",
        "driver_force", "driver_exchange", "driver_rate_constant", "driver_input_gain",
        "driver_parameter", "driver_parameter_quadratic", "driver_parameter_arrhenius", "constant_change",
        "driver_output", "driver_output_quadratic", "driver_output_lagged", "periodic_rate", "periodic_output",
        "input_rate_limit",
    }  # fmt: skip
    assert (*SENSOR, *ATTITUDE, *DYNAMICS, *PAIRED) == CATALOGUE
    several = (
        "unknown", "field_gradient", "power_law", "linear_drag", "thermal_loss", "backlash", "delay", "offset",
        "gravity_sag", "overflow", "driver_rate_constant", "gain",
    )  # fmt: skip
    named = [effect.id for effect in CATALOGUE if effect.id not in several]
    assert len(set(named)) == len(named)


def test_optional_abilities_of_effects():
    assert {e.id for e in CATALOGUE if e.persistent_change} == {"hard_iron_step", "offset_drift", "gain_drift"}
    assert {e.id for e in CATALOGUE if type(e).bind is not Effect.bind} == {"unknown"}
    assert {type(e) for e in CATALOGUE if e.has_basis} == {
        FieldGradient, MagneticPole, DriverOutputQuadratic, DriverParameterQuadratic,
    }  # fmt: skip
    assert {e.id for e in CATALOGUE if e.has_code} == {e.id for e in DYNAMICS} | {"output_saturation", "periodic"}
    assert {e.id for e in CATALOGUE if e.by_periodogram} == {"periodic", "periodic_rate", "periodic_output"}
    assert {e.id for e in CATALOGUE if e.simpler} == {"coupling", "sensor_lag", "sensor_clock_drift", "delay"}
    coulomb = dict.fromkeys(("stribeck_friction", "load_dependent_friction"), "coulomb_friction")
    linear = dict.fromkeys(("driver_parameter_quadratic", "driver_parameter_arrhenius"), "driver_parameter")
    linear |= {"driver_output_quadratic": "driver_output", "input_transport_delay": "input_delay"}
    assert {e.id: e.reduces_to.id for e in CATALOGUE if e.reduces_to} == coulomb | linear
    assert {e.id for e in CATALOGUE if e.is_curve} == {"unknown"}
    assert {e.id for e in CATALOGUE if e.is_generalisation} == {
        "power_law", "hidden_lag", "hidden_mode", "gravity_sag", "driver_linear", "driver_quadratic",
        "driver_gain", "driver_pair",
    }  # fmt: skip
    assert {e.id for e in SENSOR if e.continuous} == {"hard_iron_step", "offset_drift", "temperature_offset"}
    assert {e.id for e in CATALOGUE if not e.has_waveform} & {"hard_iron_step", "linear_drag", "gain"} == set()


def test_effects_of_field_and_heading_are_location_specific():
    assert {e.id for e in CATALOGUE if e.location_specific} == {"field_gradient", "heading_reset"}
    assert {e.port for e in CATALOGUE if e.location_specific} == {"field", "heading"}


def test_each_id_has_a_single_display_name():
    names = {effect.id: {e.display_name for e in CATALOGUE if e.id == effect.id} for effect in CATALOGUE}
    assert all(len(known) == 1 for known in names.values())
    assert len({name for known in names.values() for name in known}) == len(names)
    assert all({words_of(effect_id)} == known for effect_id, known in names.items())
    assert words_of("bouc_wen_hysteresis") == "Bouc Wen hysteresis"
    assert words_of("driver_linear") == "linear dependence"
    assert words_of("temperature_offset") == "temperature offset"
    assert words_of("supply_offset") == SupplyOffset().display_name == "supply offset"


def test_is_curve_is_determined_by_the_id():
    assert is_curve(Unrecorded.id)
    assert not is_curve("supply_offset")
    assert Unrecorded().is_curve


def test_former_base_classes_are_aliases_of_effect():
    for name in ("Anchored", "Continuous", "Lasting", "Linear", "Nested", "Shaped", "Signal"):
        assert getattr(effects, f"{name}Effect") is Effect


def test_missing_methods_of_an_effect_are_named():
    class Empty(GainEffect):
        id = "empty"

    with pytest.raises(NotImplementedError, match=r"effect empty .* method `waveform`"):
        Empty().change(torch.ones(3, dtype=torch.float64), {}, make_context(Empty()))

    class WithoutMethods(Effect):
        id = "without_methods"

    with pytest.raises(TypeError, match="change"):
        WithoutMethods()
