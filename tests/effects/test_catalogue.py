"""Quantities and plausible sizes of the effects on a sensor."""

import math

import pytest
import torch

from mkc_torch.effects import SENSOR
from mkc_torch.effects.sensor.field_gradient import FieldGradient
from mkc_torch.effects.sensor.magnetic_pole import MagneticPole
from mkc_torch.effects.waveforms import per
from tests.effects.contexts import make_context

# by effect, and for the gradient by number of channels: name, numbers and unit of each quantity
QUANTITIES = {
    "hard_iron_step": [("offset_change", 3, "µT")],
    "offset_drift": [("offset_change", 3, "µT")],
    "temperature_offset": [("offset_per_kelvin", 3, "µT/K")],
    "current_field": [("field_per_ampere", 3, "µT/A")],
    "driver_offset": [("offset_per_unit", 3, "µT/V")],
    "unknown": [("legendre_1", 3, "µT"), ("legendre_2", 3, "µT"), ("legendre_3", 3, "µT")],
}


@pytest.mark.parametrize("effect", [e for e in SENSOR if e.id in QUANTITIES], ids=lambda e: e.id)
def test_quantities_have_their_names_and_units(effect):
    context = make_context(effect)
    for shape in effect.shapes(context.time):
        assert [tuple(q) for q in effect.quantities(shape, context)] == QUANTITIES[effect.id]


def test_cubic_nonlinearity_has_two_forms():
    effect = next(e for e in SENSOR if e.id == "cubic_nonlinearity")
    context = make_context(effect)
    found = [[tuple(q) for q in effect.quantities(shape, context)] for shape in effect.shapes(context.time)]
    cubic, quadratic = ("coefficient", 3, "1/µT²"), ("quadratic_coefficient", 3, "1/µT")
    assert found == [[cubic], [cubic, quadratic]]


def test_a_magnet_at_the_element_adds_a_square_to_the_cube():
    """``α (B + h)³`` without the parts that offset and gain absorb."""
    effect = next(e for e in SENSOR if e.id == "cubic_nonlinearity")
    context = make_context(effect)
    alpha, magnet = 1e-6 * torch.tensor([3.0, -2.0, 5.0]).double(), torch.tensor([20.0, -35.0, 8.0]).double()
    field = context.signal
    whole = alpha * (field + magnet).pow(3)
    left = whole - 3.0 * alpha * magnet.square() * field - alpha * magnet.pow(3)
    change = effect.change(torch.cat([alpha, 3.0 * alpha * magnet]), {"terms": 2.0}, context)
    torch.testing.assert_close(change, left)


def test_quantities_of_drivers_without_a_unit_have_the_unit_of_the_port():
    assert (per("µT", ""), per("µT", "°C"), per("counts", "A")) == ("µT", "µT/K", "counts/A")


@pytest.mark.parametrize("effect", SENSOR, ids=lambda e: e.id)
def test_plausible_sizes_are_unchanged(effect):
    known = {
        "hard_iron_step": 200.0, "offset_drift": 50.0, "temperature_offset": 5.0, "current_field": 20.0,
        "cubic_nonlinearity": 4e-5, "driver_offset": math.inf, "unknown": math.inf,
    }  # fmt: skip
    by_form = {FieldGradient: 200.0, MagneticPole: 100.0}
    assert effect.plausible == (by_form[type(effect)] if type(effect) in by_form else known[effect.id])
