"""What every effect of the catalogue promises."""

import math
from dataclasses import replace

import pytest
import torch

from mkc_torch.effects import (
    SENSOR,
    AnchoredEffect,
    ContinuousEffect,
    GainEffect,
    LastingEffect,
    LinearEffect,
    SignalEffect,
)
from mkc_torch.effects.courses import per
from mkc_torch.effects.sensor.field_gradient import FieldGradient
from mkc_torch.effects.sensor.magnetic_pole import MagneticPole
from tests.effects.contexts import make_context, size_of

IDS = (
    "hard_iron_step", "offset_drift", "temperature_offset", "current_field", "field_gradient", "field_gradient",
    "cubic_nonlinearity", "driver_offset", "unknown",
)  # fmt: skip

# by effect, and for the gradient by number of channels: name, numbers and unit of each quantity
QUANTITIES = {
    "hard_iron_step": [("offset_change", 3, "µT")],
    "offset_drift": [("offset_change", 3, "µT")],
    "temperature_offset": [("offset_per_kelvin", 3, "µT/K")],
    "current_field": [("field_per_ampere", 3, "µT/A")],
    "driver_offset": [("offset_per_unit", 3, "µT/V")],
    "unknown": [("legendre_1", 3, "µT"), ("legendre_2", 3, "µT"), ("legendre_3", 3, "µT")],
}


def some_shapes(effect, context):
    """Every kind of shape of an effect, of those that differ in their numbers alone the first and the last."""
    kinds = {}
    for shape in effect.shapes(context.time):
        kinds.setdefault(tuple(sorted(shape)), []).append(shape)
    return [shape for alike in kinds.values() for shape in (alike[0], alike[-1])]


def cases():
    for effect in SENSOR:
        for channels in (("x", "y", "z"), ("strength",)):
            context = make_context(effect, channels=channels)
            for k, shape in enumerate(some_shapes(effect, context)):
                yield pytest.param(effect, shape, context, id=f"{effect.id}-{len(channels)}-{k}")


CASES = list(cases())


def test_ids_are_the_contract():
    assert tuple(effect.id for effect in SENSOR) == IDS


@pytest.mark.parametrize(("effect", "shape", "context"), CASES)
def test_nothing_changes_without_an_amplitude(effect, shape, context):
    gamma = torch.zeros(size_of(effect, shape, context), dtype=torch.float64)
    change = effect.change(gamma, shape, context)
    assert change.shape == context.signal.shape
    assert change.dtype == torch.float64
    assert torch.equal(change, torch.zeros_like(change))


@pytest.mark.parametrize(("effect", "shape", "context"), CASES)
def test_the_change_is_linear_in_the_amplitude(effect, shape, context):
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, size_of(effect, shape, context), generator=generator, dtype=torch.float64)
    change = effect.change(2.0 * a - 3.0 * b, shape, context)
    parts = 2.0 * effect.change(a, shape, context) - 3.0 * effect.change(b, shape, context)
    assert float(effect.change(a, shape, context).abs().max()) > 1e-3
    torch.testing.assert_close(change, parts, rtol=1e-9, atol=1e-9 * float(parts.abs().max()))


@pytest.mark.parametrize(("effect", "shape", "context"), CASES)
def test_forward_tangents_are_finite_differences(effect, shape, context):
    size = size_of(effect, shape, context)
    gamma = torch.linspace(-1.0, 1.0, size, dtype=torch.float64)
    tangent = torch.func.jacfwd(lambda g: effect.change(g, shape, context))(gamma)
    assert tangent.shape == (*context.signal.shape, size)
    step = 1e-3 * torch.eye(size, dtype=torch.float64)
    differences = [effect.change(gamma + h, shape, context) - effect.change(gamma - h, shape, context) for h in step]
    expected = torch.stack(differences, -1) / 2e-3
    torch.testing.assert_close(tangent, expected, rtol=1e-6, atol=1e-7 * float(expected.abs().max()))
    assert bool((tangent.flatten(0, 1).abs().sum(0) > 0).all())


@pytest.mark.parametrize(("effect", "shape", "context"), [c for c in CASES if isinstance(c.values[0], LinearEffect)])
def test_a_basis_is_the_slope_of_the_change(effect, shape, context):
    gamma = torch.zeros(size_of(effect, shape, context), dtype=torch.float64)
    slope = torch.func.jacfwd(lambda g: effect.change(g, shape, context))(gamma)
    torch.testing.assert_close(effect.basis(shape, context), slope)


@pytest.mark.parametrize("effect", [e for e in SENSOR if e.id in QUANTITIES], ids=lambda e: e.id)
def test_quantities_have_their_names_and_units(effect):
    context = make_context(effect)
    for shape in effect.shapes(context.time):
        assert [tuple(q) for q in effect.quantities(shape, context)] == QUANTITIES[effect.id]


def test_the_cubic_s_are_of_two_forms():
    effect = next(e for e in SENSOR if e.id == "cubic_nonlinearity")
    context = make_context(effect)
    told = [[tuple(q) for q in effect.quantities(shape, context)] for shape in effect.shapes(context.time)]
    cubic, quadratic = ("coefficient", 3, "1/µT²"), ("quadratic_coefficient", 3, "1/µT")
    assert told == [[cubic], [cubic, quadratic]]


def test_a_magnet_that_the_element_feels_is_a_square_beside_the_cube():
    """``α (B + h)³`` but for what an offset and a gain take over."""
    effect = next(e for e in SENSOR if e.id == "cubic_nonlinearity")
    context = make_context(effect)
    alpha, magnet = 1e-6 * torch.tensor([3.0, -2.0, 5.0]).double(), torch.tensor([20.0, -35.0, 8.0]).double()
    field = context.signal
    whole = alpha * (field + magnet).pow(3)
    left = whole - 3.0 * alpha * magnet.square() * field - alpha * magnet.pow(3)
    change = effect.change(torch.cat([alpha, 3.0 * alpha * magnet]), {"terms": 2.0}, context)
    torch.testing.assert_close(change, left)


def test_units_of_drivers_without_a_unit():
    assert (per("µT", ""), per("µT", "°C"), per("counts", "A")) == ("µT", "µT/K", "counts/A")


@pytest.mark.parametrize("effect", SENSOR, ids=lambda e: e.id)
def test_users_are_told_what_it_is(effect):
    assert effect.equation.startswith(("δB", "B(p)"))
    for sentence in (effect.explanation, effect.advice):
        assert sentence.endswith(".")
        assert sentence[0].isupper()
    assert len(effect.source) > 10
    assert effect.plausible > 0
    words = type(effect).__doc__
    for heading in ("Simulation:", "Drivers:", "Units:", "Plausible:", "Source:"):
        assert heading in words


@pytest.mark.parametrize("effect", SENSOR, ids=lambda e: e.id)
def test_plausible_sizes_are_those_of_the_first_edition(effect):
    known = {
        "hard_iron_step": 200.0, "offset_drift": 50.0, "temperature_offset": 5.0, "current_field": 20.0,
        "cubic_nonlinearity": 4e-5, "driver_offset": math.inf, "unknown": math.inf,
    }  # fmt: skip
    by_form = {FieldGradient: 200.0, MagneticPole: 100.0}
    assert effect.plausible == (by_form[type(effect)] if type(effect) in by_form else known[effect.id])


@pytest.mark.parametrize("effect", SENSOR, ids=lambda e: e.id)
def test_continuous_numbers_stand_in_the_shapes(effect):
    numbers = {name for shape in effect.shapes(torch.linspace(0.0, 90.0, 100).double()) for name in shape}
    assert isinstance(effect, ContinuousEffect) == hasattr(effect, "continuous")
    if isinstance(effect, ContinuousEffect):
        assert set(effect.continuous) <= numbers
        assert all(low < high for low, high in effect.continuous.values())


def test_what_effects_can_do_beside():
    lasting = {e.id for e in SENSOR if isinstance(e, LastingEffect)}
    anchored = {e.id for e in SENSOR if isinstance(e, AnchoredEffect)}
    continuous = {e.id for e in SENSOR if isinstance(e, ContinuousEffect)}
    assert lasting == {"hard_iron_step", "offset_drift"}
    assert anchored == {"unknown"}
    assert continuous == {"hard_iron_step", "offset_drift", "temperature_offset"}
    assert {type(e) for e in SENSOR if isinstance(e, LinearEffect)} == {FieldGradient, MagneticPole}


@pytest.mark.parametrize(("effect", "shape", "context"), CASES)
def test_effects_of_the_signal_say_so(effect, shape, context):
    gamma = torch.ones(size_of(effect, shape, context), dtype=torch.float64)
    doubled = replace(context, signal=2.0 * context.signal)
    follows = not torch.equal(effect.change(gamma, shape, context), effect.change(gamma, shape, doubled))
    assert follows == (isinstance(effect, SignalEffect) and effect.follows_signal)


def test_a_gain_effect_wants_a_course():
    class Empty(GainEffect):
        id = "empty"

    with pytest.raises(NotImplementedError):
        Empty().change(torch.ones(3, dtype=torch.float64), {}, make_context(Empty()))
