"""The physics of each sensor effect, against independent formulas."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre

from mkc_torch.effects import SENSOR, Context
from mkc_torch.effects.waveforms import unit_step
from tests.effects.contexts import make_context

EFFECTS = {effect.id: effect for effect in SENSOR}
STEP, DRIFT = EFFECTS["hard_iron_step"], EFFECTS["offset_drift"]
TEMPERATURE, CURRENT = EFFECTS["temperature_offset"], EFFECTS["current_field"]
CUBIC, UNKNOWN, COLUMN = EFFECTS["cubic_nonlinearity"], EFFECTS["unknown"], EFFECTS["driver_offset"]
TIME = torch.linspace(7.0, 97.0, 901, dtype=torch.float64)


def time_context(time=TIME):
    return Context(time, time.new_zeros(len(time), 0), (), time.new_zeros(len(time), 3), "µT", ("x", "y", "z"))


def driver_context(values, unit):
    values = torch.as_tensor(values, dtype=torch.float64)
    time = 0.1 * torch.arange(len(values), dtype=torch.float64)
    return Context(time, values.unsqueeze(-1), (unit,), values.new_zeros(len(values), 3), "µT", ("x", "y", "z"))


def test_a_step_is_constant_after_its_onset():
    gamma = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    change = STEP.change(gamma, {"onset": 40.0}, time_context())
    before = TIME < 40.0
    assert torch.equal(change[before], torch.zeros(int(before.sum()), 3, dtype=torch.float64))
    assert torch.equal(change[~before], gamma.expand(int((~before).sum()), 3))
    assert unit_step(torch.tensor([1.0, 2.0, 3.0]), 2.0).tolist() == [0.0, 1.0, 1.0]


def test_onsets_cover_the_recording_except_its_ends():
    onsets = np.array([shape["onset"] for shape in STEP.shapes(TIME)])
    np.testing.assert_allclose(np.diff(onsets), 0.9, rtol=1e-9)
    assert 7.0 + 0.01 * 90.0 < onsets[0] < 7.0 + 0.1 * 90.0
    assert onsets[0] - 7.0 == pytest.approx(97.0 - onsets[-1])


DRIFTS = DRIFT.shapes(TIME)


@pytest.mark.parametrize("shape", DRIFTS, ids=str)
def test_a_drift_is_monotonic_from_0_to_1(shape):
    course = DRIFT.waveform(shape, time_context())
    assert float(course[0]) == pytest.approx(0.0, abs=1e-12)
    assert float(course[-1]) == pytest.approx(1.0, abs=1e-12)
    assert bool((course.diff() >= 0).all())
    assert bool((course.diff() > 0).float().mean() > 0.5)


def test_drifts_equal_their_formulas():
    t = TIME.numpy() - 7.0
    expected = {
        (): t / 90.0,
        ("power",): np.sqrt(t / 90.0),
        ("time_constant",): (1.0 - np.exp(-t / 9.0)) / (1.0 - np.exp(-10.0)),
    }
    shapes = [{}, {"power": 0.5}, {"time_constant": 9.0}]
    for shape in shapes:
        assert shape in [{k: pytest.approx(v) for k, v in s.items()} for s in DRIFTS]
        np.testing.assert_allclose(DRIFT.waveform(shape, time_context()), expected[tuple(shape)], atol=1e-12)
    middle = DRIFT.waveform({"middle": 45.0, "width": 4.5}, time_context())
    assert float(middle[450]) == pytest.approx(0.5, abs=1e-9)
    logistic = 1.0 / (1.0 + np.exp(-(t - 45.0) / 4.5))
    np.testing.assert_allclose(np.corrcoef(middle, logistic)[0, 1], 1.0, rtol=1e-12)


def test_grid_has_drifts_of_every_kind():
    kinds = [tuple(sorted(shape)) for shape in DRIFTS]
    assert {k: kinds.count(k) for k in set(kinds)} == {
        (): 1, ("power",): 1, ("time_constant",): 4, ("middle", "width"): 6,
    }  # fmt: skip


@pytest.mark.parametrize("effect", [STEP, DRIFT], ids=lambda e: e.id)
def test_lasting_change_is_the_offset_at_the_end(effect):
    gamma = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    shape = effect.shapes(TIME)[-1]
    end = effect.change(gamma, shape, time_context())[-1]
    later = time_context(torch.arange(5, dtype=torch.float64))
    torch.testing.assert_close(effect.lasting(gamma, later), end.expand(5, 3))


@pytest.mark.parametrize(("effect", "unit"), [(CURRENT, "A"), (COLUMN, "V"), (TEMPERATURE, "°C")])
def test_offsets_are_proportional_to_their_column(effect, unit):
    context = driver_context([-2.0, 0.0, 3.0], unit)
    change = effect.change(torch.tensor([1.0, 0.0, -0.5], dtype=torch.float64), {}, context)
    assert change.tolist() == [[-2.0, 0.0, 1.0], [0.0, 0.0, 0.0], [3.0, 0.0, -1.5]]


def test_temperature_offset_has_lag_and_curvature():
    context = driver_context([0.0, 10.0, 10.0, -5.0], "°C")
    shapes = TEMPERATURE.shapes(context.time)
    assert [dict(s) for s in shapes] == [{}, {"lag": 1.0}, {"lag": 5.0}, {"curvature": 0.02}, {"curvature": -0.02}]
    curved = TEMPERATURE.waveform({"curvature": 0.02}, context)
    np.testing.assert_allclose(curved, [0.0, 12.0, 12.0, -4.5])
    a = np.exp(-0.1)  # samples 0.1 s apart, linear in between
    first = 10.0 * (1.0 - (1.0 - a) / 0.1)
    second = a * first + 10.0 * (1.0 - a)
    third = a * second + 10.0 * ((1.0 - a) / 0.1 - a) - 5.0 * (1.0 - (1.0 - a) / 0.1)
    np.testing.assert_allclose(TEMPERATURE.waveform({"lag": 1.0}, context), [0.0, first, second, third])


def test_cubic_nonlinearity_acts_on_each_axis_separately():
    context = make_context(CUBIC)
    gamma = torch.tensor([1e-5, 0.0, -2e-5], dtype=torch.float64)
    B = context.signal.numpy()
    expected = np.stack([1e-5 * B[:, 0] ** 3, 0.0 * B[:, 1], -2e-5 * B[:, 2] ** 3], -1)
    np.testing.assert_allclose(CUBIC.change(gamma, {}, context), expected, rtol=1e-12)


def test_unit_of_cubic_nonlinearity_follows_the_signal():
    assert CUBIC.quantities({}, replace(make_context(CUBIC), signal_unit="counts"))[0].unit == "1/counts²"


def test_a_curve_is_a_legendre_series_in_its_own_range():
    context = driver_context(np.linspace(-3.0, 5.0, 41), "V")
    gamma = torch.arange(9, dtype=torch.float64) - 4.0
    t = np.linspace(-1.0, 1.0, 41)
    expected = np.stack([legendre.legval(t, [0.0, *gamma.reshape(3, 3)[:, c].tolist()]) for c in range(3)], -1)
    np.testing.assert_allclose(UNKNOWN.change(gamma, {}, context), expected, atol=1e-12)


def test_a_curve_keeps_its_range_on_another_recording():
    context = driver_context(np.linspace(-3.0, 5.0, 41), "V")
    gamma = torch.arange(9, dtype=torch.float64) - 4.0
    shape = UNKNOWN.bind({}, context)
    assert shape == {"low": -3.0, "high": 5.0}
    original = UNKNOWN.change(gamma, {}, context)
    other = UNKNOWN.change(gamma, shape, driver_context([-9.0, -3.0, 1.0, 5.0, 9.0], "V"))
    torch.testing.assert_close(other, original[[0, 0, 20, 40, 40]])
