"""The columns that can drive an effect."""

import math

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis.model.term import find_drivers, role_of
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.recording.recording import Recording

RAMP = torch.linspace(0.0, 1.0, 100, dtype=torch.float64)
WAVES = {k: torch.sin((3.0 + k) * RAMP + k) for k in range(8)}


def drivers_of(columns, units=None, taken=frozenset({"time"})):
    return find_drivers(Recording({"time": 10.0 * RAMP} | columns, units=units), taken, DriverSettings())


@pytest.mark.parametrize(
    ("name", "unit", "role"),
    [
        ("temperature", "°C", "temperature"),
        ("temp_imu", "", "temperature"),
        ("Temperature_2", "", "temperature"),
        ("chip", "°C", "temperature"),
        ("chip", "K", "temperature"),
        ("current", "A", "current"),
        ("current_3", "", "current"),
        ("esc", "A", "current"),
        ("rpm", "", "any"),
        ("voltage", "V", "any"),
        ("current_temp", "A", "current"),
        ("attempt", "", "any"),
    ],
)
def test_roles_come_from_the_name_and_then_the_unit(name, unit, role):
    assert role_of(name, unit) == role
    (driver,) = drivers_of({name: WAVES[0]}, units={name: unit}).drivers
    assert (driver.columns, driver.role, driver.units) == ((name,), role, (unit,))


def test_driver_values_are_centred_on_their_mean():
    (driver,) = drivers_of({"load": 5.0 + WAVES[0]}).drivers
    assert driver.values.shape == (100, 1)
    assert float(driver.reference) == pytest.approx(float(5.0 + WAVES[0].mean()))
    torch.testing.assert_close(driver.values[:, 0] + driver.reference, 5.0 + WAVES[0])
    assert abs(float(driver.values.mean())) < 1e-12


def test_position_is_one_driver_of_three_columns():
    columns = {f"position_{axis}": WAVES[k] for k, axis in enumerate("xyz")}
    (driver,) = drivers_of(columns).drivers
    assert (driver.role, driver.columns, driver.units) == ("position", tuple(columns), ("m", "m", "m"))
    assert driver.values.shape == (100, 3)


def test_columns_of_the_simulation_and_run_numbers_are_not_drivers():
    result = drivers_of({"mag_x": WAVES[0], "experiment": (RAMP > 0.5).double()}, taken=frozenset({"time", "mag_x"}))
    assert result.drivers == ()
    assert result.warnings == ()


@pytest.mark.parametrize("value", [0.0, 1.0, -3e8])
def test_a_constant_column_is_not_a_driver_and_is_warned_of(value):
    result = drivers_of({"state": torch.full((100,), value), "load": WAVES[0]})
    assert [d.columns for d in result.drivers] == [("load",)]
    (warning,) = result.warnings
    assert "`state` is constant" in warning


def test_a_column_without_values_is_left_out():
    mostly = WAVES[1].clone()
    mostly[:60] = math.nan
    result = drivers_of({"empty": torch.full((100,), math.nan), "mostly": mostly, "load": WAVES[0]})
    assert [d.columns for d in result.drivers] == [("load",)]
    empty_warning, mostly_warning = result.warnings
    assert "`empty` has no finite values" in empty_warning
    assert "`mostly` has only 40% finite values" in mostly_warning


def test_missing_values_are_filled_from_their_neighbours():
    values = 4.0 * RAMP + 1.0
    values[[0, 1, 40, 41, 42, 99]] = torch.tensor(
        [math.nan, math.inf, math.nan, -math.inf, math.nan, math.nan]
    ).double()
    result = drivers_of({"load": values})
    (driver,) = result.drivers
    expected = 4.0 * RAMP + 1.0
    expected[:2], expected[99] = expected[2], expected[98].clone()
    torch.testing.assert_close(driver.values[:, 0] + driver.reference, expected)
    (warning,) = result.warnings
    assert "`load` lacks 6 values" in warning


def test_a_constant_column_with_gaps_is_not_a_driver():
    values = torch.ones(100, dtype=torch.float64)
    values[3] = math.nan
    result = drivers_of({"state": values})
    assert result.drivers == ()
    assert len(result.warnings) == 2


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (-2.0, 7.0), (1e-6, 300.0)])
def test_copies_of_a_column_are_a_single_driver(gain, offset):
    result = drivers_of({"load": WAVES[0], "rpm": WAVES[1], "power": gain * WAVES[0] + offset})
    assert [(d.columns, d.copies) for d in result.drivers] == [(("load",), ("power",)), (("rpm",), ())]
    (warning,) = result.warnings
    assert "`load` and `power` are copies" in warning


def test_a_copy_of_known_role_represents_the_others():
    result = drivers_of({"x1": WAVES[0], "rpm": WAVES[1], "x2": -WAVES[0], "temperature": 20.0 + 3.0 * WAVES[0]})
    assert [(d.columns, d.role, d.copies) for d in result.drivers] == [
        (("rpm",), "any", ()), (("temperature",), "temperature", ("x1", "x2")),
    ]  # fmt: skip


def test_a_nearly_equal_column_is_not_a_copy():
    near = WAVES[0] + 0.003 * WAVES[1]
    assert float(torch.corrcoef(torch.stack([near, WAVES[0]]))[0, 1]) > 0.9999
    assert len(drivers_of({"load": WAVES[0], "near": near}).drivers) == 2


def test_drivers_do_not_depend_on_the_order_of_columns():
    columns = {"load": WAVES[0], "temperature": WAVES[1], "position_x": WAVES[2], "rpm": WAVES[3],
               "position_y": WAVES[4], "current": WAVES[5], "position_z": WAVES[6]}  # fmt: skip
    columns["gap"] = WAVES[7].clone()
    columns["gap"][5] = math.nan
    first = drivers_of(columns)
    orders = np.random.default_rng(0)
    for _ in range(5):
        names = orders.permutation(list(columns)).tolist()
        again = drivers_of({name: columns[name] for name in names})
        assert again.warnings == first.warnings
        by_name = {d.columns: d for d in again.drivers}
        assert set(by_name) == {d.columns for d in first.drivers}
        for driver in first.drivers:
            other = by_name[driver.columns]
            assert (other.role, other.units, other.copies) == (driver.role, driver.units, driver.copies)
            assert torch.equal(other.values, driver.values)
        singles = [name for name in names if not name.startswith("position")]
        assert [d.columns[0] for d in again.drivers if len(d.columns) == 1] == singles


def test_hundreds_of_columns_are_separate_drivers():
    values = torch.randn(300, 100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    result = drivers_of({f"c{k}": row for k, row in enumerate(values)})
    assert [d.columns[0] for d in result.drivers] == [f"c{k}" for k in range(300)]
    assert result.warnings == ()


def test_a_recording_of_time_only_has_no_drivers():
    assert drivers_of({}).drivers == ()


def test_effects_can_define_their_own_roles():
    columns = {"voltage_bus": WAVES[0], "overvoltage": WAVES[1], "temperature": WAVES[2]}
    recording = Recording({"time": RAMP} | columns)
    drivers = find_drivers(
        recording, frozenset({"time"}), DriverSettings(), frozenset({"voltage", "any", "temperature"})
    ).drivers
    assert [(d.columns[0], d.role) for d in drivers] == [
        ("voltage_bus", "voltage"), ("overvoltage", "any"), ("temperature", "temperature"),
    ]  # fmt: skip


def test_columns_of_an_incomplete_position_are_separate_drivers():
    recording = Recording({"time": RAMP, "position_x": WAVES[0], "position_y": WAVES[1], "position_z": 0.0 * RAMP})
    drivers = find_drivers(recording, frozenset({"time"}), DriverSettings(), frozenset({"position", "any"})).drivers
    assert [(d.columns, d.role) for d in drivers] == [(("position_x",), "any"), (("position_y",), "any")]


@pytest.mark.parametrize("glitch", [65535.0, -999.0, 1e30])
@pytest.mark.parametrize("places", [[700], [100, 101, 650], list(range(300, 305))])
def test_a_few_values_far_from_all_others_count_as_missing(glitch, places):
    time = torch.linspace(0.0, 20.0, 1000, dtype=torch.float64)
    clean = 3.0 + torch.sin(time)
    values = clean.clone()
    values[places] = glitch
    result = find_drivers(Recording({"time": time, "current": values}), frozenset({"time"}), DriverSettings())
    (driver,) = result.drivers
    torch.testing.assert_close(driver.values[:, 0] + driver.reference, clean, atol=0.02, rtol=0.0)
    (sentence,) = result.warnings
    assert f"`current` has {len(places)} value" in sentence
    assert f"({glitch:.6g})" in sentence
    assert "far from all others" in sentence


def test_pulses_and_rare_switches_are_not_missing_values():
    """A motor that runs for 0.1 s, and a switch that is rarely on."""
    time = torch.linspace(0.0, 20.0, 1000, dtype=torch.float64)
    noise = torch.randn(1000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    on = (time - 5.0).abs() < 0.05
    assert int(on.sum()) == 5
    pulses = 0.01 * noise + 5.0 * on * (1.0 + 0.1 * noise)
    switch = on.double()
    result = find_drivers(
        Recording({"time": time, "current": pulses, "switch": switch}), frozenset({"time"}), DriverSettings()
    )
    assert result.warnings == ()
    assert [float(driver.values.max()) > 0.9 for driver in result.drivers] == [True, True]


def test_a_copy_of_a_measured_column_is_not_a_driver():
    time = torch.linspace(0.0, 20.0, 1000, dtype=torch.float64)
    measured = 40.0 * torch.sin(time)
    columns = {"time": time, "mag_x": measured, "raw_x": (6.842 * measured).round() + 17.0, "load": torch.cos(time)}
    result = find_drivers(
        Recording(columns), frozenset({"time", "mag_x"}), DriverSettings(), measured=frozenset({"mag_x"})
    )
    assert [driver.columns for driver in result.drivers] == [("load",)]
    (warning,) = result.warnings
    assert "`raw_x` repeats `mag_x`" in warning


def test_a_column_linear_in_time_is_a_driver():
    result = drivers_of({"temperature": 20.0 + 3.0 * RAMP})
    assert [driver.columns for driver in result.drivers] == [("temperature",)]
