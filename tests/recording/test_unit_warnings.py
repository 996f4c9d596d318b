"""Columns whose magnitude reveals their unit."""

import pytest
import torch

from mkc_torch.recording.recording import Recording
from mkc_torch.recording.unit_warnings import unit_warnings

ANGLE = torch.linspace(0.0, 6.0, 50, dtype=torch.float64)


def vector(name, size):
    return {f"{name}_x": size * ANGLE.cos(), f"{name}_y": size * ANGLE.sin(), f"{name}_z": 0.0 * ANGLE}


def warnings_of(*columns, units=None, **single):
    table = {}
    for part in columns:
        table |= part
    return unit_warnings(Recording(table | single, units=units))


def test_plausible_magnitudes_have_no_warning():
    recorded = (vector("mag", 50.0), vector("gyro", 2.0), vector("accel", 9.8))
    assert warnings_of(*recorded, time=0.02 * torch.arange(50)) == ()


@pytest.mark.parametrize("size", [10.0, 25.0, 65.0, 200.0])
def test_fields_of_the_earth_and_some_more_are_accepted(size):
    assert warnings_of(vector("mag", size)) == ()


@pytest.mark.parametrize(
    ("size", "unit"),
    [
        (5e-5, "tesla (1 T = 1000000 µT)"),
        (0.05, "millitesla (1 mT = 1000 µT)"),
        (0.5, "gauss (1 gauss = 100 µT)"),
        (500.0, "milligauss (10 mG = 1 µT)"),
        (5e4, "nanotesla (1000 nT = 1 µT)"),
    ],
)
def test_fields_in_another_unit_have_a_warning(size, unit):
    (sentence,) = warnings_of(vector("mag", size))
    assert f"in {unit} it would be" in sentence
    assert f"{size:g} µT" in sentence
    assert "Nothing was converted" in sentence


@pytest.mark.parametrize("size", [3.0, 5e3, 1e6])
def test_raw_counts_have_a_warning(size):
    assert "may be raw counts" in warnings_of(vector("mag", size))[0]


def test_a_given_unit_has_no_warning():
    assert warnings_of(vector("mag", 500.0), units={f"mag_{a}": "counts" for a in "xyz"}) == ()


def test_outliers_and_missing_values_have_no_warning():
    mag = vector("mag", 50.0)
    mag["mag_x"][:20] = 1e6
    mag["mag_y"][20:24] = torch.nan
    assert warnings_of(mag) == ()
    assert warnings_of({name: torch.full((50,), torch.nan) for name in mag}) == ()


def test_degrees_per_second_have_a_warning():
    (sentence,) = warnings_of(vector("gyro", 115.0))
    assert "°/s" in sentence
    assert warnings_of(vector("gyro", 115.0), units={f"gyro_{a}": "°/s" for a in "xyz"}) == ()


def test_accelerations_in_g_have_a_warning():
    (sentence,) = warnings_of(vector("accel", 1.0))
    assert "may be in g" in sentence
    assert warnings_of(vector("accel", 1.0), units={f"accel_{a}": "g" for a in "xyz"}) == ()


@pytest.mark.parametrize(
    ("interval", "shown", "unit"), [(20.0, "20", "ms"), (2e4, "20000", "µs"), (2e7, "20000000", "ns")]
)
@pytest.mark.parametrize("since", [0.0, 1.7e9])
def test_times_in_other_units_have_a_warning(interval, shown, unit, since):
    time = (50.0 * since + torch.arange(50).double()) * interval
    (sentence,) = warnings_of(vector("mag", 50.0), time=time)
    assert f"lie {shown} s apart" in sentence
    assert f"looks like {unit} (50 samples a second then)" in sentence


@pytest.mark.parametrize(("turn", "hinted"), [(0.02, True), (1.0, False)])
def test_a_slow_logger_has_no_hint_if_the_motion_does_not_fit_the_other_unit(turn, hinted):
    """Of samples 2 s apart: 0.02 rad in 2 ms is a turn by hand, 1 rad is faster than any gyroscope measures."""
    angle = turn * torch.arange(60).double()
    axes = {"mag_x": 48.0 * angle.cos(), "mag_y": 48.0 * angle.sin(), "mag_z": 0.0 * angle}
    found = warnings_of(axes, time=2.0 * torch.arange(60).double())
    assert any("looks like ms" in sentence for sentence in found) == hinted


def test_several_units_have_a_warning_each():
    assert len(warnings_of(vector("mag", 0.5), vector("gyro", 115.0), vector("accel", 1.0))) == 3


def test_an_incomplete_vector_has_no_warning():
    mag = vector("mag", 500.0)
    del mag["mag_z"]
    assert warnings_of(mag) == ()


def measured_field(size, offset, share=1.0):
    """A field that a sensor with an offset measures in all directions, or in a cone about z."""
    direction = torch.randn(600, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    direction = direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
    direction[:, :2] *= share
    direction = direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
    if share < 1.0:
        direction[:, 2] = direction[:, 2].abs()
    field = size * direction + torch.tensor(offset, dtype=torch.float64)
    return {f"mag_{axis}": field[:, k] for k, axis in enumerate("xyz")}


def test_the_length_excludes_the_offset_if_the_turns_determine_it():
    assert warnings_of(measured_field(45.0, (590.0, 0.0, 0.0))) == ()
    (sentence,) = warnings_of(measured_field(450.0, (2500.0, 0.0, 0.0)))
    assert "measures about 450 µT" in sentence
    assert "milligauss" in sentence


def test_a_sensor_that_hardly_turns_is_judged_by_its_magnitude():
    (sentence,) = warnings_of(measured_field(450.0, (10.0, 0.0, 30.0), share=0.1))
    assert "milligauss" in sentence
