"""A real recording in messy files: each gives the calibration of the whole recording, or an error with a remedy."""

import pytest

pytest.importorskip("polars")
pytest.importorskip("typer")

from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.cli.recorded import read_magnetometer, sensor_names
from mkc_torch.recording.recording import Recording, RecordingError
from tests.shared_data import shared_case, shared_data

SAMPLES = {
    "comment_lines": 682, "decimal_comma": 684, "frozen_sensor": 2730, "header_again": 2730, "iso_timestamps": 684,
    "last_line_cut": 2729, "names_with_units": 684, "no_time": 684, "time_restarts": 2730,
    "timestamp_in_microseconds": 684, "two_topics": 684, "clipped": 2730,
}  # fmt: skip

EXPECTED_WARNINGS = {
    "comment_lines": ['3 comment lines skipped, the first line 1, "# logger v1.3"'],
    "decimal_comma": ["Decimal commas were read as points", "`magX [uT]`, `magY [uT]`, `magZ [uT]` are taken as"],
    "header_again": ["The header is repeated in line 1367", "starts again at row 1366 (line 1368)", "2 runs"],
    "iso_timestamps": ["`timestamp` is taken as `time`", "ISO 8601 stamps", "seconds from the first sample"],
    "last_line_cut": ['The last line is cut short and left out, line 2731, "106.2740,-26.7"'],
    "names_with_units": ["`magX [uT]`, `magY [uT]`, `magZ [uT]` are taken as `mag_x`, `mag_y`, `mag_z`"],
    "time_restarts": ["The time starts again at row 1366 (line 1367)", "2 runs"],
    "timestamp_in_microseconds": ["µs since 1970"],
    "two_topics": ["`x`, `y`, `z` are taken as `mag_x`", "converted from gauss, as the file", "The times are µs"],
}


@pytest.fixture(scope="module")
def whole_calibration():
    return calibrate(Recording.read(shared_data("magnetometer/full_sphere.csv")))


def messy_file(name):
    return shared_case(f"messy/{name}.csv")


def read_messy_file(name, units=None, sensor=None):
    return read_magnetometer(messy_file(name), {}, units or {}, sensor)[0]


def assert_centre(found, whole_calibration):
    """Check agreement within two standard errors of either centre."""
    for mine, other, error, other_error in zip(
        found.center, whole_calibration.center, found.center_se, whole_calibration.center_se, strict=True
    ):
        assert abs(mine - other) <= 2.0 * max(error, other_error)


@pytest.mark.e2e
@pytest.mark.parametrize("name", sorted(set(SAMPLES) - {"clipped", "frozen_sensor"}))
def test_every_file_gives_the_centre_of_the_whole_recording(name, whole_calibration):
    recording = read_messy_file(name)
    assert len(recording) == SAMPLES[name]
    found = calibrate(recording)
    assert found.unit == "µT"
    assert_centre(found, whole_calibration)


@pytest.mark.parametrize("name", sorted(EXPECTED_WARNINGS))
def test_warnings_report_what_was_done_to_read_a_file(name):
    warnings = " ".join(read_messy_file(name).notes)
    for words in EXPECTED_WARNINGS[name]:
        assert words in warnings, warnings


def test_a_field_in_gauss_requires_its_unit_and_is_converted(whole_calibration):
    with pytest.raises(RecordingError, match=r"in gauss .* it would be.*`--convert mag=gauss`"):
        read_messy_file("gauss")
    assert_centre(calibrate(read_messy_file("gauss", {"mag": "gauss"})), whole_calibration)


def test_two_sensors_give_two_calibrations(whole_calibration):
    assert sensor_names(messy_file("two_sensors"), {}, None) == ["mag0", "mag1"]
    assert_centre(calibrate(read_messy_file("two_sensors", sensor="mag0")), whole_calibration)
    other = calibrate(read_messy_file("two_sensors", sensor="mag1"))
    assert other.center == pytest.approx((-6.59, 2.34, -17.76), abs=0.1)
    with pytest.raises(RecordingError, match="2 magnetometers, `mag0`, `mag1`; choose one with `--sensor mag0`"):
        read_messy_file("two_sensors")


@pytest.mark.parametrize("name", ["header_again", "time_restarts"])
def test_a_restarted_time_begins_a_second_run(name):
    runs = read_messy_file(name).experiments()
    assert [len(run) for run in runs.values()] == [1365, 1365]
    assert all((run.time.diff() >= 0).all() for run in runs.values())
    in_order = read_messy_file(name).sorted_by_time()
    assert in_order["mag_x"][:1365].tolist() == runs["1"]["mag_x"].tolist()


@pytest.mark.parametrize("name", ["iso_timestamps", "timestamp_in_microseconds", "two_topics"])
def test_times_are_seconds_from_the_first_sample_without_loss(name):
    expected = read_messy_file("gauss", {"mag": "gauss"}).time
    assert (read_messy_file(name).time - expected).abs().max() <= 1e-6 + 1e-12  # written with a digit less


@pytest.mark.parametrize("name", ["clipped", "frozen_sensor"])
def test_clipped_and_frozen_values_are_read_unchanged(name):
    recording = read_messy_file(name)
    assert len(recording) == SAMPLES[name]
    assert recording.warnings == ()
    frozen = (recording.magnetometer().diff(dim=0) == 0).all(-1).sum()
    assert (frozen > 700) == (name == "frozen_sensor")
    assert (recording.magnetometer().abs().max() == 40.0) == (name == "clipped")


@pytest.mark.parametrize("name", ["one_block", "one_block_no_time"])
def test_the_order_of_rows_is_kept(name):
    recording = read_messy_file(name)
    assert len(recording) == 400
    assert recording["mag_x"][:3].tolist() == [8.49677, 8.60255, 40.04067]
    assert recording.warnings == ()
