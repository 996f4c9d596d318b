import dataclasses
import json
import math
import re
import sys

import pytest
import torch

from mkc_torch.calibration.calibrate import Calibration, calibrate, prepared
from mkc_torch.calibration.coverage import fibonacci_sphere
from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.calibration.file import CalibrationFileError
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.linear import LeastSquares, MKCRegression
from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.disturbance import RejectedInterval, disturbed_intervals
from mkc_torch.recording.recording import MissingColumnError, Recording, RecordingError
from tests.shared_data import shared_data

AXES = ("mag_x", "mag_y", "mag_z")


def recorded(points, **columns):
    return Recording(dict(zip(AXES, points.unbind(-1), strict=True)) | columns, name="rec")


def noisy_ellipsoid(count=400, noise=0.3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = fibonacci_sphere(count) * torch.tensor([44.0, 48.0, 53.0], dtype=torch.float64)
    points = points[torch.randperm(count, generator=generator)]
    noises = noise * torch.randn(count, 3, generator=generator).double()
    return points + torch.tensor([5.0, -9.0, 20.0]) + noises


@pytest.fixture(scope="module")
def demo():
    return simulated_recording()


@pytest.fixture(scope="module")
def demo_calibration(demo):
    return calibrate(demo[0])


def test_simulated_truth_is_found_within_four_standard_errors(demo, demo_calibration):
    truth, c = demo[1], demo_calibration
    found, errors, true = c.center + c.semi_axes, c.center_se + c.semi_axes_se, truth.center + truth.semi_axes
    assert all(abs(f - t) < 4 * e for f, e, t in zip(found, errors, true, strict=True))


def test_simulated_truth_is_found_closer_than_by_least_squares(demo, demo_calibration):
    recording, truth = demo
    squares = EllipsoidFit(LeastSquares()).fit(recording.magnetometer())
    true = torch.tensor(truth.center + truth.semi_axes, dtype=torch.float64)
    error_squares = (torch.cat([squares.center_, squares.semi_axes_]) - true).abs().max()
    ours = torch.tensor(demo_calibration.center + demo_calibration.semi_axes, dtype=torch.float64)
    assert (ours - true).abs().max() < 0.2 * error_squares


def test_disturbance_of_the_simulation_is_located(demo, demo_calibration):
    (interval,) = demo_calibration.disturbed
    start, end = demo[1].disturbed
    assert abs(interval.start - start) < 1.5
    assert abs(interval.end - end) < 1.5


def test_weights_and_residuals_follow_from_the_file_alone(demo):
    points = demo[0].magnetometer()
    fit = EllipsoidFit(MKCRegression(covariance="hac")).fit(points)
    c = Calibration.from_json(calibrate(demo[0]).to_json())
    torch.testing.assert_close(c.weight(points), fit.weights_, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(c.norm_residual(points), fit.residual_, rtol=1e-9, atol=1e-9)
    assert int((c.weight(points) < 0.5).sum()) == c.rejected


def test_field_strength_scales_the_corrected_field(demo):
    recording, _ = demo
    field = calibrate(recording, field_strength=50.0).apply(recording)
    norm = torch.stack([field[f"field_{a}"] for a in "xyz"]).norm(dim=0)
    assert abs(float(norm.median()) - 50.0) < 0.05


def test_residuals_are_in_the_unit_of_the_recording_for_any_field_strength(demo):
    a, b = calibrate(demo[0]), calibrate(demo[0], field_strength=1.0)
    assert b.field_unit == "µT"
    assert b.after == pytest.approx(a.after)
    assert (b.sigma, b.d) == pytest.approx((a.sigma, a.d))


@pytest.mark.e2e
def test_standard_error_of_the_scaled_matrix_by_simulation():
    results = [calibrate(recorded(noisy_ellipsoid(200, seed=s)), field_strength=45.0) for s in range(40)]
    spread = torch.tensor([c.matrix for c in results]).double().std(0)
    claimed = torch.tensor([c.matrix_se for c in results]).double().mean(0)
    assert bool((claimed / spread > 0.6).all())
    assert bool((claimed / spread < 1.7).all())


def test_standard_errors_are_autocorrelation_consistent_with_and_without_a_time():
    points = noisy_ellipsoid()
    time = torch.arange(len(points)) / 50.0
    fit = EllipsoidFit(MKCRegression(covariance="hac")).fit(points)
    for columns in ({}, {"time": time}):
        assert calibrate(recorded(points, **columns)).center_se == pytest.approx(fit.center_se_.tolist())


def test_gaussian_noise_rejects_nothing_and_round_trips_an_infinite_sigma():
    for seed in range(10):
        c = calibrate(recorded(noisy_ellipsoid(seed=seed)))
        if math.isinf(c.sigma):
            break
    assert math.isinf(c.sigma)
    assert c.rejected == 0
    assert json.loads(c.to_json())["noise"]["sigma"] == "inf"
    assert Calibration.from_json(c.to_json()) == c


@pytest.mark.e2e
def test_gaussian_noise_is_rarely_called_heavy_tailed_for_any_sigma():
    made = [calibrate(recorded(noisy_ellipsoid(200, seed=seed))) for seed in range(20)]
    assert sum(math.isfinite(c.sigma) for c in made) > 4
    assert sum(not c.tails.is_gaussian for c in made) <= 2


def test_the_tails_of_a_disturbed_recording_are_heavy_and_round_trip(demo_calibration):
    tails = demo_calibration.tails
    assert not tails.is_gaussian
    assert tails.share_beyond == pytest.approx(demo_calibration.rejected_share, abs=2.0 * tails.share_error)
    text = demo_calibration.to_json()
    assert json.loads(text)["noise"]["share_beyond"] == tails.share_beyond
    assert Calibration.from_json(text).tails == tails
    older = json.loads(text)
    for name in tails._fields:
        del older["noise"][name]
    assert Calibration.from_json(json.dumps(older)).tails is None


def test_json_round_trips_exactly_and_is_strict(demo_calibration):
    text = demo_calibration.to_json()
    assert Calibration.from_json(text) == demo_calibration
    json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert json.loads(text)["schema"] == "mkc-calibration/1"


def test_unknown_standard_errors_are_null(demo_calibration):
    unknown = dataclasses.replace(demo_calibration, center_se=(math.nan, math.inf, 1.0))
    text = unknown.to_json()
    assert json.loads(text)["center"]["standard_error"] == [None, None, 1.0]
    assert Calibration.from_json(text).center_se == (math.inf, math.inf, 1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1 is not JSON"),
        ("[1]", "it has no schema"),
        ("{}", "it has no schema"),
        ('{"schema": "mkc-model/1"}', "mkc-model/1"),
        ('{"schema": "mkc-calibration/1"}', "no `recording`"),
        ('{"schema": NaN}', "NaN"),
    ],
)
def test_text_that_is_not_a_calibration_is_refused(text, message):
    with pytest.raises(CalibrationFileError, match=message):
        Calibration.from_json(text)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("center", "value"), [1, 2], "`center.value`.*3 numbers"),
        (("center", "value"), [1, 2, "x"], "`center.value`"),
        (("center", "value"), [1, 2, 10**400], "`center.value`"),
        (("center", "value"), [1, 2, None], "`center.value`"),
        (("matrix", "value"), [[1, 0, 0], [0, 1, 0]], "`matrix.value`.*3 rows"),
        (("matrix", "value"), [[1, 0, 0], [0, 1, 0], 3], "`matrix.value.2`"),
        (("radius",), -1, "`radius`.*positive"),
        (("radius",), True, "`radius`.*number"),
        (("samples",), 1.5, "`samples`.*whole"),
        (("noise", "sigma"), "large", "`noise.sigma`"),
        (("unit",), 3, "`unit`.*text"),
        (("warnings",), "none", "`warnings`.*list"),
        (("rejected", "intervals"), [[1.0]], "`rejected.intervals.0`"),
    ],
)
def test_a_damaged_file_is_refused_naming_the_value(demo_calibration, path, value, message):
    content = json.loads(demo_calibration.to_json())
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(CalibrationFileError, match=message):
        Calibration.from_json(json.dumps(content))


def test_apply_keeps_every_row_and_passes_missing_values_on(demo_calibration):
    table = Recording({a: torch.tensor([1.0, math.nan, 3.0]) for a in AXES})
    field = demo_calibration.apply(table)
    assert list(field) == ["field_x", "field_y", "field_z"]
    assert field["field_x"].isnan().tolist() == [False, True, False]


def test_samples_that_are_not_finite_and_unsorted_times_are_reported():
    points = noisy_ellipsoid()
    time = torch.arange(len(points)) / 50.0
    points[5, 0], points[6, 1] = math.nan, math.inf
    time[[10, 11]] = time[[11, 10]]
    time[20] = time[19]
    c = calibrate(recorded(points, time=time))
    assert c.samples == len(points) - 3
    notes = " ".join(c.notes)
    assert "2 of 400 samples that are not finite" in notes
    assert "repeat the time" in notes
    assert "ran backwards" in " ".join(c.warnings)


def test_many_rejected_samples_have_a_warning():
    points = noisy_ellipsoid()
    points[:120] += torch.tensor([0.0, 0.0, 60.0])
    c = calibrate(recorded(points))
    assert c.rejected >= 100
    assert any("do not fit the ellipsoid" in w and "`mkc diagnose`" in w for w in c.warnings)


@pytest.mark.parametrize(
    ("factor", "guess"),
    [
        (1e3, "nanotesla"),
        (1e-2, "gauss"),
        (1e-3, "millitesla"),
        (1e-6, "tesla"),
        (10.0, "milligauss"),
        (30.0, "raw counts"),
    ],
)
def test_a_radius_unlike_the_earths_field_is_in_recorded_units_with_a_warning(factor, guess):
    c = calibrate(recorded(factor * noisy_ellipsoid()))
    assert (c.unit, c.field_unit) == ("recorded units", "recorded units")
    assert any(guess in w and "--convert" in w for w in c.warnings)
    assert c.center == pytest.approx([factor * v for v in (5.0, -9.0, 20.0)], rel=0.05)
    strong = calibrate(recorded(factor * noisy_ellipsoid()), field_strength=48.0)
    assert (strong.unit, strong.field_unit) == ("recorded units", "µT")


def test_the_radius_without_the_offset_determines_the_unit():
    c = calibrate(recorded(noisy_ellipsoid() + 500.0))
    assert c.unit == "µT"
    assert not c.warnings


def test_a_given_unit_has_no_warning():
    points = 1e3 * noisy_ellipsoid()
    c = calibrate(Recording(dict(zip(AXES, points.unbind(-1), strict=True)), units=dict.fromkeys(AXES, "nT")))
    assert c.unit == "nT"
    assert not c.warnings


def test_times_in_milliseconds_have_a_warning():
    c = calibrate(recorded(noisy_ellipsoid(), time=20.0 * torch.arange(400)))
    assert any("looks like ms" in w for w in c.warnings)


def test_large_scatter_has_a_warning():
    (warning,) = calibrate(recorded(noisy_ellipsoid(2000, noise=5.1))).warnings
    assert "scatters by 10 % of the radius" in warning
    assert "mkc diagnose" in warning


def test_semi_axes_of_unusual_lengths_have_a_warning():
    points = noisy_ellipsoid()
    points[:, 2] *= 2.0
    (warning,) = calibrate(recorded(points)).warnings
    assert "longest semi-axis is 2.4 times the shortest" in warning


def test_a_warning_of_missing_directions_states_whether_the_result_is_valid():
    points = noisy_ellipsoid(4000)
    away = torch.nn.functional.normalize((points - torch.tensor([5.0, -9.0, 20.0])), dim=-1)
    small, large = points[away[:, 2] < 0.7], points[away[:, 2] < 0.0]
    (warning,) = calibrate(recorded(small)).warnings
    assert re.search(r"semi-axes to 0\.0\d % of the radius, so the calibration is still valid", warning)
    (warning,) = calibrate(recorded(large)).warnings
    assert "if nothing changed during the recording" in warning
    assert "still valid" not in warning


def test_exact_points_are_calibrated():
    c = calibrate(recorded(noisy_ellipsoid(noise=0.0)))
    assert c.center == pytest.approx((5.0, -9.0, 20.0))
    assert c.after.rms < 1e-6
    again = Calibration.from_json(c.to_json())
    assert again.center == c.center


def test_fewer_than_nine_samples_are_refused():
    with pytest.raises(RecordingError, match="rec: 8 samples are too few; an ellipsoid needs at least 9"):
        calibrate(recorded(noisy_ellipsoid(8)))
    with pytest.raises(RecordingError, match="1 sample is too few"):
        calibrate(recorded(noisy_ellipsoid(1)))


def test_a_constant_time_is_refused():
    with pytest.raises(RecordingError, match="repeat the time"):
        calibrate(recorded(noisy_ellipsoid(50), time=torch.zeros(50)))


def test_a_missing_column_is_refused_by_name():
    with pytest.raises(MissingColumnError, match="mag_z"):
        prepared(Recording({"mag_x": torch.zeros(20), "mag_y": torch.zeros(20)}))


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_field_strength_must_be_positive(value, demo):
    with pytest.raises(ValueError, match="field_strength"):
        calibrate(demo[0], field_strength=value)


def test_refusals_carry_coverage_and_directions():
    flat = noisy_ellipsoid()
    flat[:, 2] = 7.0
    with pytest.raises(NotIdentifiableError, match="z never changes") as refused:
        calibrate(recorded(flat))
    assert isinstance(refused.value, NotIdentifiableError)
    assert refused.value.directions.shape[-1] == 3
    assert refused.value.coverage.gaps
    with pytest.raises(NotIdentifiableError, match="all points are equal") as refused:
        calibrate(recorded(torch.ones(50, 3, dtype=torch.float64)))
    assert refused.value.coverage is None


def test_scattered_rejections_form_no_interval():
    time = torch.arange(5000) / 50.0
    assert disturbed_intervals(time, torch.arange(5000) % 20 == 0) == ()


def test_intervals_end_where_the_time_restarts():
    time = torch.cat([torch.arange(100), torch.arange(100)]) / 50.0
    rejected = torch.zeros(200, dtype=torch.bool)
    rejected[80:120] = True
    first, second = disturbed_intervals(time, rejected)
    assert first == pytest.approx(RejectedInterval(1.6, 1.98))
    assert second == pytest.approx(RejectedInterval(0.0, 0.38))


def test_a_few_rejections_at_the_edge_form_no_interval():
    time = torch.arange(1000) / 50.0
    rejected = torch.zeros(1000, dtype=torch.bool)
    rejected[:2] = True
    assert disturbed_intervals(time, rejected) == ()


@pytest.mark.e2e
def test_a_disturbed_recording_has_the_semi_axes_of_the_undisturbed_recording():
    c = calibrate(Recording.read(shared_data("magnetometer/broad_28_stationary_magnet.csv")))
    assert c.semi_axes == pytest.approx((44.17, 44.50, 45.61), abs=0.6)
    assert 0.02 < c.rejected_share < 0.1
    assert c.disturbed


def test_a_long_recording_is_thinned_evenly_with_a_note(monkeypatch):
    points = noisy_ellipsoid(3000)
    whole = calibrate(recorded(points))
    monkeypatch.setattr(sys.modules["mkc_torch.calibration.calibrate"], "MOST_SAMPLES", 1000)
    found = calibrate(recorded(points))
    assert (whole.samples, found.samples) == (3000, 1000)
    assert any("one in 3 is used" in note for note in found.notes)
    assert found.center == pytest.approx(whole.center, abs=6 * max(found.center_se))
