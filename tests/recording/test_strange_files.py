"""A simulated recording in the formats of various loggers, spreadsheets and scripts: equal samples, or an error."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np
import pytest
import torch

pytest.importorskip("pandas")
pytest.importorskip("polars")
pytest.importorskip("typer")

import pandas as pd
from typer.testing import CliRunner

from mkc_torch import Recording
from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.cli.app import app
from mkc_torch.cli.recorded import read_magnetometer, sensor_names
from mkc_torch.recording.clock_faults import interleaved
from mkc_torch.recording.inspection import inspect_file
from mkc_torch.recording.recording import RecordingError

ROWS = 200
TIME = 0.02 * np.arange(ROWS)
START = datetime(2024, 5, 3, 23, 59, 58)


def simulated_field(offset):
    """A field of 48 µT that turns slowly, about an offset, in tenths of nT."""
    way = np.linspace(0.0, 18.0, ROWS)
    high = np.sin(0.37 * way)
    flat = np.sqrt(1.0 - high**2)
    field = 48.0 * np.stack([flat * np.cos(way), flat * np.sin(way), high], -1)
    return np.round(field + offset + 0.1 * np.random.default_rng(3).normal(size=(ROWS, 3)), 4)


FIELD, OTHER = simulated_field([12.0, -8.0, 21.0]), simulated_field([-30.0, 5.0, 9.0])


def cell(value):
    return value if isinstance(value, str) else f"{value:.4f}"


def table(names, *columns, sep=","):
    rows = [sep.join(map(cell, row)) for row in zip(*columns, strict=True)]
    return "\n".join([sep.join(names.split(",")), *rows]) + "\n"


def stamps(form, digits=3):
    cut = None if digits == 6 else digits - 6
    return [(START + timedelta(seconds=t)).strftime(form)[:cut] for t in TIME.round(3).tolist()]


def german(value):
    return f"{value:,.4f}".replace(",", "_").replace(".", ",").replace("_", ".")


def whole_numbers(values):
    return [f"{round(value)}" for value in np.asarray(values, dtype=float).tolist()]


def ros_stamp(since):
    """Seconds and nanoseconds of a stamp."""
    ns = [round(t * 1e9) + 500_000_000 for t in TIME.tolist()]
    return [f"{since + n // 10**9}" for n in ns], [f"{n % 10**9}" for n in ns]


SEC, NSEC = ros_stamp(1_700_000_000)
MAG = "time,mag_x,mag_y,mag_z"
XYZ = FIELD.T
NT = 1000.0 * FIELD
TESLA = [[f"{value * 1e-6:.10g}" for value in axis] for axis in XYZ.tolist()]
PLAIN = table(MAG, TIME, *XYZ)
LINES = PLAIN.splitlines()
CUT_HALFWAY = ("\n".join(LINES[:100]) + "\n" + LINES[100][:9]).encode() + b"\0" * 512 + b"\n"

READABLE_FILES = {
    # numbers
    "points between thousands": table(
        "Zeit [s],magX [nT],magY [nT],magZ [nT]", map(german, TIME), *(map(german, axis) for axis in NT.T), sep=";"
    ),
    "commas between thousands": table(
        "time,magX [nT],magY [nT],magZ [nT]", TIME, *([f'"{v:,.1f}"' for v in axis] for axis in NT.T)
    ),
    "apostrophes between thousands": table(
        "time,magX [nT],magY [nT],magZ [nT]", TIME, *([f"{v:,.1f}".replace(",", "'") for v in axis] for axis in NT.T)
    ),
    "blanks between thousands": table(
        "time,mx [nT],my [nT],mz [nT]", TIME, *([f"{v:,.1f}".replace(",", "\u00a0") for v in axis] for axis in NT.T)
    ),
    "units in the cells": table(MAG, [f"{t:.3f} s" for t in TIME], *([f"{v:.1f} nT" for v in axis] for axis in NT.T)),
    "typographic minus": PLAIN.replace("-", "\u2212"),
    "single quotes": "\n".join(",".join(f"'{cell}'" for cell in line.split(",")) for line in LINES),
    "Windows-1252": ("# Messung \u2013 \u201eFeld\u201c\n" + PLAIN).encode("cp1252"),
    "micro sign of DOS": table("time,mx [µT],my [µT],mz [µT]", TIME, *XYZ).encode("cp437"),
    "micro sign read as Latin-1": table("time,mx [ÂµT],my [ÂµT],mz [ÂµT]", TIME, *XYZ),
    # headers
    "units above the names": "s,nT,nT,nT\n" + table(MAG, TIME, *NT.T),
    "x, y, z in µT": table('Time (s),X (µT),Y (µT),Z (µT)', TIME, *XYZ),
    "names in German": table("Zeit,Magnetfeld X,Magnetfeld Y,Magnetfeld Z", TIME, *XYZ),
    "H": table("t,Hx,Hy,Hz", TIME, *XYZ),
    "a chip": table("t,hmc5883l_x,hmc5883l_y,hmc5883l_z", TIME, *XYZ),
    # time in two columns
    "date and time": table("date,time,mx,my,mz", stamps("%Y-%m-%d%f", 0), stamps("%H:%M:%S.%f"), *XYZ),
    "Datum und Uhrzeit": table("Datum,Uhrzeit,mx,my,mz", stamps("%d.%m.%Y%f", 0), stamps("%H:%M:%S.%f"), *XYZ, sep=";"),
    "ROS 2": table(
        "header.stamp.sec,header.stamp.nanosec,magnetic_field.x,magnetic_field.y,magnetic_field.z", SEC, NSEC, *TESLA
    ),
    "ROS 1, flattened": table(
        "header,seq,stamp,secs,nsecs,frame_id,magnetic_field,x,y,z",
        [""] * ROWS, whole_numbers(range(ROWS)), [""] * ROWS, SEC, NSEC, ['"imu"'] * ROWS, [""] * ROWS, *TESLA,
    ),
    "C's timeval": table("tv_sec,tv_usec,mx,my,mz", SEC, [f"{int(n) // 1000}" for n in NSEC], *XYZ),
    # time
    "rosbag": table("rosbagTimestamp,mx,my,mz", [s + n.zfill(9) for s, n in zip(SEC, NSEC, strict=True)], *XYZ),
    "points in a date": table(MAG, stamps("%d.%m.%Y %H:%M:%S.%f"), *XYZ),
    "year and slashes": table(MAG, stamps("%Y/%m/%d %H:%M:%S.%f"), *XYZ),
    "month first": table(MAG, stamps("%m/%d/%Y %H:%M:%S.%f"), *XYZ),
    "twelve hours": table(
        MAG,
        [f"{cell} {half}" for cell, half in zip(stamps("%m/%d/%Y %I:%M:%S.%f"), stamps("%p%f", 0), strict=True)],
        *XYZ,
    ),
    "a month's name": table(MAG, stamps("%d-%b-%Y %H:%M:%S.%f"), *XYZ),
    "comma before milliseconds": table(MAG, stamps("%Y-%m-%d %H:%M:%S,%f"), *XYZ),
    "minutes and seconds": table(MAG, stamps("%M:%S.%f"), *XYZ),
    "hours": table("time [h],mx,my,mz", [f"{t / 3600:.12f}" for t in TIME], *XYZ),
    "days of a spreadsheet": table(MAG, [f"{45415.5 + t / 86400:.10f}" for t in TIME], *XYZ),
    "32 bits of µs": table("time_us,mx,my,mz", whole_numbers((4294967296 - 2e6 + 1e6 * TIME) % 4294967296), *XYZ),
    "16 bits of ms": table("time_ms,mx,my,mz", whole_numbers((65536 - 2e3 + 1e3 * TIME) % 65536), *XYZ),
    "over midnight": table(MAG, [f"{(86399 + t) % 86400:.3f}" for t in TIME], *XYZ),
    "over the GPS week": table("GPS_TOW,mx,my,mz", [f"{(604799 + t) % 604800:.3f}" for t in TIME], *XYZ),
    "a clock of seconds": table(MAG, whole_numbers(np.floor(1_700_000_000 + TIME)), *XYZ),
    "ten stamps a second": table(MAG, np.floor(TIME * 10.0) / 10.0, *XYZ),
}  # fmt: skip


def write(folder, content, name="rec.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def assert_same(recording, field=FIELD, rows=ROWS):
    assert recording.units["mag_x"] == "µT"
    np.testing.assert_allclose(recording.magnetometer().numpy(), field, rtol=0, atol=1e-3)
    time = recording.time.numpy()
    np.testing.assert_allclose(time - time[0], TIME[:rows], rtol=0, atol=2e-5)
    assert "experiment" not in recording


@pytest.mark.parametrize("kind", READABLE_FILES)
def test_unambiguous_files_are_read_exactly(tmp_path, kind):
    assert_same(read_magnetometer(write(tmp_path, READABLE_FILES[kind]), {}, {}, None)[0])


EXPECTED_WARNINGS = {
    "points between thousands": "Thousands separators were removed",
    "typographic minus": "Typographic minus signs",
    "Windows-1252": "read as Windows-1252, first in line 1",
    "date and time": "Columns `date` and `time` are joined",
    "ROS 2": "Columns `header.stamp.sec` and `header.stamp.nanosec` are joined",
    "comma before milliseconds": "A comma before the fraction of a second was read as a point",
    "days of a spreadsheet": "The times are days, as spreadsheets count them",
    "32 bits of µs": "µs, unwrapped where the counter turned over at 4294967296",
    "over midnight": "turned over at 86400",
    "a clock of seconds": "Up to 50 samples share a time stamp",
}


@pytest.mark.parametrize("kind", EXPECTED_WARNINGS)
def test_warnings_report_what_was_done(tmp_path, kind):
    assert EXPECTED_WARNINGS[kind] in " ".join(Recording.read(write(tmp_path, READABLE_FILES[kind])).notes)


@pytest.mark.parametrize("kind", ["date and time", "ROS 2", "C's timeval"])
def test_inspect_sees_the_rate_of_a_joined_time_and_the_columns_of_the_file(tmp_path, kind):
    path = write(tmp_path, READABLE_FILES[kind])
    seen = inspect_file(path)
    assert seen.topics[0].rate == pytest.approx(50.0)
    header = path.read_text().splitlines()[0].split(",")
    assert [column.name for column in seen.topics[0].columns] == header


def test_a_column_that_the_caller_names_is_not_joined(tmp_path):
    path = write(tmp_path, READABLE_FILES["C's timeval"])
    recording = Recording.read(path, columns={"time": "tv_sec"})
    assert recording.names[0] == "time"
    assert "tv_usec" in recording


@pytest.mark.parametrize("word", ["-", "--", "?", "#N/A", "None", "nil", "1.#QNAN", "#VALUE!", "<NA>"])
def test_a_word_for_a_missing_value_is_nan(tmp_path, word):
    lines = LINES.copy()
    lines[9] = f"0.16,{word},1,2"
    recording = Recording.read(write(tmp_path, "\n".join(lines)))
    assert recording["mag_x"].isnan().nonzero().flatten().tolist() == [8]
    assert f'holds "{word}" or the like 1 time, first at line 10' in " ".join(recording.notes)


def test_a_truncated_row_is_left_out_anywhere_in_the_file(tmp_path):
    path = write(tmp_path, CUT_HALFWAY + "\n".join(LINES[101:]).encode())
    recording = Recording.read(path)
    np.testing.assert_array_equal(recording.magnetometer().numpy(), np.delete(FIELD, 99, axis=0))
    assert "1 line cut short by zero bytes left out, the first line 101" in " ".join(recording.warnings)


def test_zero_bytes_at_the_end_of_each_line_truncate_no_row(tmp_path):
    assert_same(Recording.read(write(tmp_path, PLAIN.replace("\n", "\0\n"))))


def alternating_rows(columns):
    """Alternating rows of two sensors, with a column that identifies the sensor."""
    rows = [(t, columns[k], *values[i]) for i, t in enumerate(TIME) for k, values in enumerate((FIELD, OTHER))]
    return list(zip(*rows, strict=True))


@pytest.mark.parametrize(
    ("name", "labels", "sensors"),
    [("id", ("0", "1"), ["id0", "id1"]), ("sensor", ("left", "right"), ["left", "right"])],
)
def test_alternating_rows_are_read_by_sensor(tmp_path, name, labels, sensors):
    path = write(tmp_path, table(f"time,{name},mag_x,mag_y,mag_z", *alternating_rows(labels)))
    assert sensor_names(path, {}, None) == sensors
    for sensor, field in zip(sensors, (FIELD, OTHER), strict=True):
        assert_same(read_magnetometer(path, {}, {}, sensor)[0], field)
    with pytest.raises(RecordingError, match=f"2 magnetometers, `{sensors[0]}`, `{sensors[1]}`; choose one"):
        Recording.read(path)
    assert len(Recording.read(path, recognise=False)) == 2 * ROWS


def test_rows_of_several_sensors_are_separated(tmp_path):
    path = write(tmp_path, table("time,type,x,y,z", *alternating_rows(("MAG", "ACC"))))
    recording = Recording.read(path)
    assert_same(recording)
    np.testing.assert_allclose(recording["accel_x"].numpy(), OTHER[:, 0], atol=1e-3)


@pytest.mark.e2e
def test_a_corrected_file_of_two_sensors_has_the_rows_of_the_chosen_sensor(tmp_path):
    path = write(tmp_path, table("time,id,mag_x,mag_y,mag_z", *alternating_rows(("0", "1"))))
    run = CliRunner()
    made = run.invoke(app, ["calibrate", str(path), "--output", str(tmp_path / "out")])
    assert made.exit_code == 0, made.output
    model = tmp_path / "out" / "rec" / "id1" / "calibration.json"
    target = tmp_path / "corrected.csv"
    done = run.invoke(app, ["apply", str(model), str(path), "--sensor", "id1", "--output", str(target)])
    assert done.exit_code == 0, done.output
    corrected = Recording.read(target, recognise=False)
    np.testing.assert_allclose(corrected["mag_x"].numpy(), OTHER[:, 0])
    assert corrected.stack("field_x", "field_y", "field_z").norm(dim=-1).std() < 0.5


def test_alternating_rows_without_a_sensor_column_have_a_warning(tmp_path):
    path = write(
        tmp_path, table("time,mag_x,mag_y,mag_z", *np.delete(np.array(alternating_rows((0.0, 0.0))), 1, axis=0))
    )
    assert "rows of 2 sensors seem to take turns" in " ".join(Recording.read(path).warnings)
    assert interleaved(FIELD) == interleaved(np.random.default_rng(0).normal(size=(999, 3))) == 0


def test_the_named_sensor_is_read_rather_than_the_usual_names(tmp_path):
    names = "time,mag_x,mag_y,mag_z,mag2_x,mag2_y,mag2_z"
    path = write(tmp_path, table(names, TIME, *XYZ, *OTHER.T))
    assert_same(Recording.read(path, sensor="mag2"), OTHER)
    assert_same(Recording.read(path, sensor="mag"), FIELD)
    center = calibrate(Recording.read(path, sensor="mag2")).center
    assert center == pytest.approx((-30.0, 5.0, 9.0), abs=0.2)


def test_a_contradicted_unit_has_a_warning_with_the_fitting_unit(tmp_path):
    path = write(tmp_path, table("time,mx [gauss],my [gauss],mz [gauss]", TIME, *XYZ))
    warnings = " ".join(calibrate(Recording.read(path)).warnings)
    assert (
        "converted from gauss; they may be in another unit than stated; if so, give it: `--convert mag=uT`" in warnings
    )
    assert "Nothing was converted" not in warnings


def test_a_file_with_only_an_accelerometer_gets_advice(tmp_path):
    path = write(tmp_path, table("time,acc_x,acc_y,acc_z", TIME, *XYZ))
    with pytest.raises(RecordingError, match="An accelerometer is calibrated by: `--quantity accel`") as refusal:
        read_magnetometer(path, {}, {}, None)
    assert "mag_x=acc_x" not in str(refusal.value)


@pytest.mark.parametrize("names", ["mag1,mag2,mag3", "mag_0,mag_1,mag_2", "mag(1),mag(2),mag(3)"])
def test_numbered_columns_need_the_columns_option(tmp_path, names):
    path = write(tmp_path, table(f"time,{names}", TIME, *XYZ))
    x, y, z = names.split(",")
    with pytest.raises(RecordingError) as refusal:
        read_magnetometer(path, {}, {}, None)
    assert f"mag_x={x},mag_y={y},mag_z={z}" in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("rec.csv.gz", b"\x1f\x8b", "files ending in .gz are not known; unpack it first"),
        ("rec.csv", b"\x1f\x8b\x08\x00\x00", "begins like a gzip archive; unpack it first"),
        ("rec.xlsx", b"PK", "export the sheet as CSV"),
        ("rec", PLAIN, "if it is text with separators, rename it to end in .csv"),
        ("rec.csv", "\n".join(LINES[1:]), "add a first line such as time,mag_x,mag_y,mag_z"),
        ("rec.csv", PLAIN.replace("mag_z", "mag_z,a"), "other lines are the same, so correct the header"),
    ],
)
def test_an_error_contains_a_remedy(tmp_path, name, content, message):
    with pytest.raises(RecordingError, match=message):
        Recording.read(write(tmp_path, content, name))


# frames


def frame_of(names, columns):
    return pd.DataFrame(dict(zip(names.split(","), columns, strict=True)))


def test_a_frame_is_recognised_and_converted_like_its_file():
    start = pd.Timestamp(START)
    for times in (
        pd.Series([start + pd.Timedelta(seconds=t) for t in TIME]),
        pd.Series([start.tz_localize("Europe/Berlin") + pd.Timedelta(seconds=t) for t in TIME]),
        pd.Series(np.int64(1_700_000_000_000_000_000) + (TIME * 1e9).round().astype(np.int64)),
        pd.Series(stamps("%Y-%m-%dT%H:%M:%S.%f")),
    ):
        given = frame_of("timestamp,magX [mG],magY [mG],magZ [mG]", [times, *(10.0 * XYZ)])
        recording = Recording.from_frame(given)
        assert_same(recording)
        warnings = " ".join(recording.notes)
        assert "are taken as `mag_x`, `mag_y`, `mag_z`" in warnings
        assert "converted from milligauss" in warnings


def test_a_frame_of_two_time_columns_or_of_two_sensors_is_read():
    given = frame_of("secs,nsecs,mx,my,mz", [np.array(SEC, dtype=np.int64), np.array(NSEC, dtype=np.int64), *XYZ])
    assert_same(Recording.from_frame(given))
    both = frame_of("time,mag0_x,mag0_y,mag0_z,mag1_x,mag1_y,mag1_z", [TIME, *XYZ, *OTHER.T])
    assert_same(Recording.from_frame(both, sensor="mag1"), OTHER)
    with pytest.raises(RecordingError, match="2 magnetometers, `mag0`, `mag1`; choose one"):
        Recording.from_frame(both)
    assert Recording.from_frame(both, recognise=False).names == tuple(both.columns)
    assert Recording(both).names == tuple(both.columns)


def test_a_frame_read_from_a_file_gives_the_recording_of_the_file(tmp_path):
    path = write(tmp_path, READABLE_FILES["ROS 2"])
    of_file, of_frame = Recording.read(path), Recording.from_frame(pd.read_csv(path))
    assert torch.equal(of_file.time, of_frame.time)
    torch.testing.assert_close(of_file.magnetometer(), of_frame.magnetometer(), rtol=1e-15, atol=0.0)
    assert of_file.warnings == of_frame.warnings
