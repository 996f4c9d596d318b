"""Jumps of a recorded heading that the gyroscope does not show."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mkc_torch import Recording, diagnose
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from mkc_torch.simulation.magnetometer.heading import heading_jumps
from tests.shared_data import shared_data
from tests.simulation.tumbling import FIELD, body_rate, changed, full_truth, tumbling, turns

RATE = 50.0


def recorded(N, jumps, **kwargs):
    """Return a recording whose attitude is rotated about the vertical: first sample to size of each jump in degrees."""
    recording = tumbling(N, attitude=True, gyro=True, **kwargs)
    off = sum(((np.arange(N) >= first) * size for first, size in jumps.items()), np.zeros(N))
    turned = Rotation.from_rotvec(off[:, None] * [0.0, 0.0, 1.0], degrees=True) * turns(recording["time"].numpy())
    x, y, z, w = turned.as_quat().T
    return changed(recording, q_w=w, q_x=x, q_y=y, q_z=z)


def field_at(time):
    """Return the measurement of a magnetometer without noise."""
    return torch.from_numpy(turns(time).inv().apply(FIELD))


def jumps_of(N, jumps, rate=None):
    time = np.arange(N) / RATE
    off = sum(((np.arange(N) >= first) * size for first, size in jumps.items()), np.zeros(N))
    turned = Rotation.from_rotvec(off[:, None] * [0.0, 0.0, 1.0], degrees=True) * turns(time)
    rate = body_rate(time) if rate is None else rate
    attitude = torch.from_numpy(turned.as_matrix())
    return heading_jumps(torch.from_numpy(time), attitude, torch.from_numpy(rate), field_at(time))


@settings(deadline=None, max_examples=40)
@given(
    first=st.integers(2, 150),
    between=st.integers(60, 140),
    sizes=st.tuples(*[st.floats(5.0, 170.0) | st.floats(-170.0, -5.0)] * 2),
)
def test_every_jump_is_found_with_its_size_for_any_motion(first, between, sizes):
    found = jumps_of(300, {first: sizes[0], first + between: sizes[1]})
    assert [jump.after for jump in found] == [first - 1, first + between - 1]
    np.testing.assert_allclose([jump.size for jump in found], sizes, atol=0.3)


def test_an_attitude_that_agrees_with_the_gyroscope_has_no_jumps():
    assert jumps_of(300, {}) == ()


def test_other_axes_of_the_gyroscope_show_no_jumps():
    time = np.arange(300) / RATE
    assert jumps_of(300, {100: 40.0}, body_rate(time) * [-1.0, 1.0, -1.0]) == ()


def test_missing_rates_show_no_jumps():
    rate = body_rate(np.arange(300) / RATE)
    rate[99:101] = np.nan
    assert [jump.after for jump in jumps_of(300, {100: 40.0, 200: 30.0}, rate)] == [199]
    assert jumps_of(300, {100: 40.0}, np.full((300, 3), np.nan)) == ()


def test_a_gap_in_which_the_sensor_turns_has_no_jump():
    time = np.concatenate([np.arange(100), np.arange(170, 350)]) / RATE
    attitude = torch.from_numpy(turns(time).as_matrix())
    rate = torch.from_numpy(body_rate(time))
    measured = field_at(time)
    assert heading_jumps(torch.from_numpy(time), attitude, rate, measured) == ()
    # at rest before and after, and turned in between, as the magnetometer shows
    still = torch.where((torch.arange(280) - 100).abs()[:, None] < 3, 0.0, rate)
    assert heading_jumps(torch.from_numpy(time), attitude, still, measured) == ()
    measured[100:110] = measured[95:100].repeat(2, 1)
    assert [jump.after for jump in heading_jumps(torch.from_numpy(time), attitude, still, measured)] == [99]


@pytest.mark.parametrize("length", [1, 10, 40])
def test_a_reversed_jump_is_a_glitch(length):
    assert jumps_of(300, {100: 50.0, 100 + length: -50.0}) == ()
    found = jumps_of(300, {100: 50.0, 100 + length: -50.0, 220: 30.0})
    assert [jump.after for jump in found] == [219]


def test_the_largest_of_many_jumps_are_returned_in_order():
    sizes = {60 * k: 10.0 + 7.0 * ((5 * k) % 12) for k in range(1, 12)}
    largest = sorted(sorted(sizes, key=sizes.get, reverse=True)[:8])
    assert [jump.after + 1 for jump in jumps_of(780, sizes)] == largest


def test_a_single_sample_has_no_jumps():
    assert heading_jumps(torch.zeros(1), torch.eye(3)[None], torch.zeros(1, 3), torch.zeros(1, 3)) == ()


@pytest.mark.e2e
def test_the_heading_port_corrects_the_jumps():
    assert "heading" not in Magnetometer().prepare(tumbling(400, attitude=True, gyro=True)).ports
    assert "heading" not in Magnetometer().prepare(changed(recorded(400, {200: 20.0}), gyro_x=None)).ports
    view = Magnetometer().prepare(recorded(400, {150: 20.0, 250: -35.0}))
    assert view.ports["heading"].carries == ("since_1", "since_2")
    since = view.signals(view.start(), {})["heading"]
    assert since.sum(0).tolist() == [250.0, 150.0]
    sizes = since.new_tensor([20.0, -35.0])
    # the true direction of the field, relative to the start, which the jumps affect
    ahead = torch.from_numpy(FIELD / np.linalg.norm(FIELD))
    tilt = view._across @ ahead / (view._ahead @ ahead)
    truth = full_truth(view.strength, *tilt.tolist())
    left = view.residual(truth, {"heading": lambda signal: (signal @ sizes).unsqueeze(-1)})
    assert float(left.abs().max()) < 1e-6
    assert float(view.residual(truth, {}).abs().max()) > 5.0


@pytest.mark.e2e
def test_a_reset_and_a_current_are_found_together():
    N = 1500
    time = np.arange(N) / RATE
    current = 5.0 + 4.0 * np.sin(0.4 * time) + 3.0 * (time > 16.0)
    field = np.outer(current - current.mean(), [0.3, -0.4, 0.8])
    recording = recorded(N, {700: 14.0}, noise=0.4, sensor=field, current=current)
    result = diagnose(Magnetometer(), recording)
    found = {finding.effect: finding for finding in result.findings}
    assert set(found) == {"heading_reset", "current_field"}
    reset = found["heading_reset"].parameters[0]
    assert reset.unit == "°"
    assert "within the plausible 180 °" in found["heading_reset"].plausibility
    assert reset.value == pytest.approx(14.0, abs=3.0 * reset.standard_error)
    curve = found["heading_reset"].curve
    assert (curve.driver, curve.value_unit) == ("time", "°")
    expected = torch.where(curve.x > time[699], reset.value, 0.0).unsqueeze(-1)
    torch.testing.assert_close(curve.value, expected, check_dtype=False)
    gain = found["current_field"].parameters[0]
    np.testing.assert_allclose(gain.value, [0.3, -0.4, 0.8], atol=0.05)
    assert any("by 14.0° at 14.0 s (gyroscope: " in sentence for sentence in result.warnings)


@pytest.mark.e2e
@pytest.mark.parametrize("name", ["quadrotor_compass1", "quadrotor_compass3"])
def test_a_quadrotors_heading_reset_at_take_off_is_reported(name):
    recording = Recording.read(shared_data(f"magnetometer/{name}.csv")).sorted_by_time()
    view = Magnetometer().prepare(recording)
    warning = view.warnings[-1]
    assert "by 15.6° at 61.1 s (gyroscope: 0.2°)" in warning
    assert "at 77.8 s" in warning
    assert "at 103.2 s" in warning


@pytest.mark.e2e
@pytest.mark.slow
def test_the_first_finding_of_the_steering_compass_is_the_heading_reset():
    result = diagnose(Magnetometer(), Recording.read(shared_data("magnetometer/quadrotor_compass1.csv")))
    first = result.findings[0]
    assert first.effect == "heading_reset"
    assert first.parameters[0].value[0] == pytest.approx(10.2, abs=3.0)  # of the 15.6° that are recorded
    assert result.corrected.rmse < 0.5 * result.baseline.rmse


@pytest.mark.e2e
@pytest.mark.slow
def test_a_quadrotors_current_is_found_next_to_its_heading_jumps():
    recording = Recording.read(shared_data("magnetometer/quadrotor_compass3.csv"))
    result = diagnose(Magnetometer(), recording)
    assert [finding.effect for finding in result.findings] == ["current_field", "heading_reset"]
    current, measured = recording["current"], recording.magnetometer()
    time = recording["time"]
    idle, driven = (time > 63.3) & (time < 71.2), (time > 72.5) & (time < 73.0)  # motors on, and still on the ground
    moved = measured[driven].mean(0) - measured[idle].mean(0)
    expected = moved / (current[driven].mean() - current[idle].mean())
    gain = result.findings[0].parameters[0]
    np.testing.assert_allclose(gain.value, expected, atol=0.2)
    as_recorded = [effect for effect in CATALOGUE if effect.id != "heading_reset"]
    worse = diagnose(Magnetometer(), recording, effects=as_recorded, max_findings=1)
    np.testing.assert_allclose(worse.findings[0].parameters[0].value, [0.15, -0.26, 0.95], atol=0.05)
    assert result.corrected.rmse < 0.9 * worse.corrected.rmse


def test_an_optical_tracker_has_no_heading_jumps():
    recording = Recording.read(shared_data("magnetometer/broad_36_attached_magnet_5cm.csv")).sorted_by_time()
    assert "heading" not in Magnetometer(use="attitude").prepare(recording).ports
