"""Frozen and clipped samples are reported and left out; a rest and coarse digits are not."""

import pytest
import torch
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from mkc_torch import Recording
from mkc_torch.calibration import NotIdentifiableError, calibrate
from mkc_torch.calibration.calibrate import prepared
from mkc_torch.calibration.clipped_samples import CLIPPED, distinct_rows
from mkc_torch.calibration.frozen_samples import FROZEN
from tests.shared_data import shared_case, shared_data

AXES = ("mag_x", "mag_y", "mag_z")
REAL = (
    "broad_02_undisturbed", "broad_28_stationary_magnet", "broad_34_attached_magnet_3cm", "full_sphere",
    "quadrotor_compass1", "quadrotor_compass3", "raw_counts",
)  # fmt: skip


def turned(count=2000, noise=0.3, seed=0, speed=1.0):
    """A sensor that is turned through all directions at 50 Hz, and its noise, in µT."""
    draw = torch.Generator().manual_seed(seed)
    t = torch.arange(count, dtype=torch.float64) / 50.0 * speed
    a, b = 0.9 * t, 2.0 * torch.sin(0.31 * t) + 0.7 * t
    way = torch.stack([a.cos() * b.cos(), a.sin() * b.cos(), b.sin()], -1)
    return 45.0 * way + torch.tensor([4.0, -7.0, 11.0]) + noise * torch.randn(count, 3, generator=draw)


def recorded(points, rate=50.0, **columns):
    time = torch.arange(len(points), dtype=torch.float64) / rate
    return Recording({"time": time, **dict(zip(AXES, points.unbind(-1), strict=True)), **columns})


def test_a_sensor_frozen_to_the_end_is_recognised_by_its_noise():
    points = turned()
    points[1500:] = points[1500]
    (warning,) = fault_warnings(recorded(points))
    assert "from 30 to 39.98 s (500)" in warning
    points = rounded_to(turned(noise=0.05), 0.5)
    points[1500:] = points[1500]
    assert fault_warnings(recorded(points)) == []


def fault_warnings(recording):
    return [w for w in prepared(recording).warnings if FROZEN in w or CLIPPED in w]


def rounded_to(points, step):
    return (points / step).round() * step


def test_a_frozen_sensor_of_the_stored_case_is_reported_and_left_out():
    c = calibrate(Recording.read(shared_case("messy/frozen_sensor.csv")))
    (warning,) = c.warnings
    assert "800 of 2730" in warning
    assert "from 38.8633 to 70.0038 s (800)" in warning
    assert c.samples == 1930
    whole = (-0.63, -10.54, 2.04)  # of the recording before it was frozen
    assert max(abs(a - b) / s for a, b, s in zip(c.center, whole, c.center_se, strict=True)) < 2.0


def test_clipping_of_the_stored_case_is_reported_and_left_out():
    c = calibrate(Recording.read(shared_case("messy/clipped.csv")))
    for warning in ("`mag_x` is cut off at 40", "`mag_y` is cut off at -40 (924", "Left out 2339 of 2730"):
        assert warning in " ".join(c.warnings)
    whole = (-0.63, -10.54, 2.04)  # of the recording that is not clipped
    assert max(abs(a - b) / s for a, b, s in zip(c.center, whole, c.center_se, strict=True)) < 2.0


def test_standard_errors_and_block_without_a_time_equal_those_with_a_time():
    timed = calibrate(Recording.read(shared_case("messy/one_block.csv")))
    rows = calibrate(Recording.read(shared_case("messy/one_block_no_time.csv")))
    assert rows.center == timed.center
    assert rows.center_se == timed.center_se
    assert (timed.disturbed_unit, rows.disturbed_unit) == ("s", "row")
    ((begin, end),), ((first, last),) = timed.disturbed, rows.disturbed
    assert (first, last) == pytest.approx((1 + 50.0 * begin, 1 + 50.0 * end))
    assert type(rows).from_json(rows.to_json()) == rows


@pytest.mark.parametrize("name", REAL)
def test_real_recordings_are_neither_frozen_nor_clipped(name):
    assert fault_warnings(Recording.read(shared_data(f"magnetometer/{name}.csv"))) == []


@pytest.mark.e2e
@given(st.sampled_from(REAL), st.floats(0.0, 5.0), st.integers(1, 4), st.booleans())
@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
def test_real_recordings_of_coarser_digits_repeated_samples_or_a_rest_have_no_faults(name, coarse, polled, rests):
    points = Recording.read(shared_data(f"magnetometer/{name}.csv")).magnetometer()[:3000]
    size = float(torch.linalg.vector_norm(points - points.median(0).values, dim=-1).median())
    if rests:
        points = torch.cat([points[:1000], points[1000:1001].expand(400, 3), points[1000:]])
    if coarse > 0.05:
        points = rounded_to(points, 0.01 * coarse * size)
    assert fault_warnings(recorded(points.repeat_interleave(polled, 0))) == []


@given(st.floats(0.0, 1.0), st.floats(0.05, 4.0), st.floats(0.2, 3.0), st.integers(0, 99))
@example(0.125, 4.0, 0.21875, 0)  # a slow turn with a digital step of many times the noise
@settings(max_examples=15, deadline=None)
def test_a_turning_sensor_of_any_digits_and_noise_has_no_fault(noise, step, speed, seed):
    assert fault_warnings(recorded(rounded_to(turned(noise=noise, seed=seed, speed=speed), step))) == []


@pytest.mark.e2e
@given(
    st.sampled_from([None, 0, 1, 2]), st.integers(60, 400), st.integers(100, 1400), st.integers(0, 99), st.booleans()
)
@settings(max_examples=15, deadline=None)
def test_a_freeze_of_all_axes_or_a_single_axis_is_located(axis, length, begin, seed, coarse):
    points = turned(seed=seed)
    if coarse:
        points = rounded_to(points, 0.15)
    columns = [0, 1, 2] if axis is None else [axis]
    # what stays at the end of an axis's range looks like clipping as well
    low, high = points.amin(0), points.amax(0)
    assume(bool(((points[begin] > low + 3.0) & (points[begin] < high - 3.0))[columns].all()))
    for k in columns:
        points[begin : begin + length, k] = points[begin, k]
    (warning,) = fault_warnings(recorded(points))
    names = "all of `mag_x`, `mag_y`, `mag_z`" if axis is None else f"`{AXES[axis]}`"
    assert f"{FROZEN}: {names} from " in warning
    # by chance the values before and after may be equal to it
    start, end = map(float, warning.split(" from ")[1].split(" s ")[0].split(" to "))
    assert (start, end) == pytest.approx((begin / 50.0, (begin + length - 1) / 50.0), abs=0.1)
    left = len(prepared(recorded(points)))
    assert len(points) - length - 5 <= left <= len(points) - length


@given(st.sampled_from([0, 1, 2]), st.sampled_from([-1.0, 1.0]), st.floats(0.6, 0.9), st.integers(0, 99))
@settings(max_examples=12, deadline=None)
def test_a_clipped_axis_is_reported_and_the_rest_is_calibrated(axis, side, share, seed):
    points = rounded_to(turned(seed=seed), 0.1)
    center = torch.tensor([4.0, -7.0, 11.0])
    limit = round(float(center[axis]) + side * share * 45.0, 1)
    points[:, axis] = points[:, axis].clamp(max=limit) if side > 0 else points[:, axis].clamp(min=limit)
    recording = recorded(points)
    (warning,) = fault_warnings(recording)
    assert f"`{AXES[axis]}` is cut off at {limit:.6g} (" in warning
    assert warning.count("cut off") == 1


def test_the_remaining_samples_of_a_clipped_recording_are_calibrated():
    points = rounded_to(turned(4000), 0.1)
    points[:, 0] = points[:, 0].clamp(max=40.0)
    c = calibrate(recorded(points))
    assert any(CLIPPED in w for w in c.warnings)
    assert c.center == pytest.approx((4.0, -7.0, 11.0), abs=0.3)
    assert c.semi_axes == pytest.approx((45.0, 45.0, 45.0), abs=0.4)


def test_clipping_is_reported_before_the_directions_that_it_removed():
    points = rounded_to(turned(4000), 0.1)
    points[:, 0] = points[:, 0].clamp(max=30.0)
    warnings = calibrate(recorded(points)).warnings
    assert CLIPPED in warnings[0]
    assert warnings[-1].startswith("Directions not covered")


def test_a_refusal_begins_with_the_clipping():
    points = rounded_to(turned(4000), 0.1)
    points[:, 0] = points[:, 0].clamp(max=-20.0)
    with pytest.raises(NotIdentifiableError, match=r"^Not identifiable: Left out \d+ of 4000 clipped samples"):
        calibrate(recorded(points))


@pytest.mark.e2e
def test_standard_errors_treat_runs_as_independent():
    # two runs with correlated ends: if they were joined, the lags between them would count
    points = turned(1200, noise=0.2)
    drift = torch.cat([torch.linspace(1.0, 0.0, 600), torch.linspace(0.0, 1.0, 600)]).double()
    points = points * (1.0 + 0.03 * drift[:, None])
    run = (torch.arange(1200) >= 600).double()
    forward = calibrate(recorded(points, experiment=run))
    swapped = torch.cat([torch.arange(600, 1200), torch.arange(600)])
    backward = calibrate(recorded(points[swapped], experiment=run))
    assert forward.center_se == pytest.approx(backward.center_se, rel=1e-9)
    joined, other = calibrate(recorded(points)), calibrate(recorded(points[swapped]))
    assert joined.center_se != pytest.approx(other.center_se, rel=1e-4)
    assert forward.samples == 1200


@given(st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=1, max_size=60))
def test_distinct_rows_equal_those_of_torch(rows):
    values = torch.tensor(rows, dtype=torch.float64)
    assert torch.equal(distinct_rows(values), values.unique(dim=0))
