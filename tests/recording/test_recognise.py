"""Columns are recognised by their names, their topic's name, and the other columns."""

import re

import numpy as np
import polars as pl
import pytest

from mkc_torch.recording import formats
from mkc_torch.recording.clock import ClockError, clock_of
from mkc_torch.recording.column_names import is_about_magnetometer, meaning
from mkc_torch.recording.formats.base import FileFormat, Table, Topic
from mkc_torch.recording.join_topics import interpolated
from mkc_torch.recording.px4 import is_px4_magnetometer
from mkc_torch.recording.recognise import recognised
from mkc_torch.recording.recording import MissingColumnError, Recording, RecordingError
from mkc_torch.recording.runs import restarts
from mkc_torch.recording.unit_words import CANONICAL, conversion


def topic_of(name="", units=None, **columns):
    series = [pl.Series(values) for values in columns.values()]
    return Topic(name, Table(list(columns), series, range(1, len(series[0]) + 1), "row"), units or {})


def topic_of_names(*columns, topic=""):
    return Topic(topic, Table(list(columns), [pl.Series([1.0])] * len(columns), [1], "row"))


@pytest.mark.parametrize(
    ("name", "column", "unit"),
    [
        ("mag_x", "mag_x", ""), ("magX", "mag_x", ""), ("mx", "mag_x", ""), ("Mag.Y", "mag_y", ""),
        ("MAGZ", "mag_z", ""),
        ("magnetometer_ga[0]", "mag_x", "ga"), ("magnetic_field.z", "mag_z", ""), ("Bx", "mag_x", ""),
        ("field.magnetic_field.y", "mag_y", ""), ("mag_x_uT", "mag_x", "uT"), ("magXuT", "mag_x", "uT"),
        ("mag_y (gauss)", "mag_y", "gauss"), ("magX [uT]", "mag_x", "uT"), ("xmag", "mag_x", ""),
        ("compass_z", "mag_z", ""),
        ("Magnetic field x (µT)", "mag_x", "µT"), ("mag0_x", "mag_x", ""), ("MAG[1].MagX", "mag_x", ""),
        ("mag_x_T", "mag_x", "T"), ("mag_x_mGauss", "mag_x", "mGauss"), ("gyroX", "gyro_x", ""), ("gx", "gyro_x", ""),
        ("gyro_z_dps", "gyro_z", "dps"), ("angular_velocity.y", "gyro_y", ""), ("gyro_x_deg_s", "gyro_x", "deg/s"),
        ("ax", "accel_x", ""), ("xacc", "accel_x", ""), ("accelX(g)", "accel_x", "g"),
        ("acc_x_m_s2", "accel_x", "m/s/2"),
        ("qw", "q_w", ""), ("q[3]", "q_z", ""), ("orientation.x", "q_x", ""), ("quat_y", "q_y", ""),
        ("time_us", "time", "us"), ("timestamp [ns]", "time", "ns"), ("TimeUS", "time", "US"),
        ("millis", "time", "millis"),
        ("seconds_elapsed", "time", "seconds"), ("header.stamp", "time", ""), ("t", "time", ""),
        ("imu_temp", "temperature", ""), ("temperature_degC", "temperature", "degC"), ("current_mA", "current", "mA"),
    ],
)  # fmt: skip
def test_column_names_and_their_units_are_recognised(name, column, unit):
    found = meaning(name)
    assert found is not None
    if column == "accel_x" and unit == "m/s/2":
        assert conversion("accel", found.unit).factor == 1
    else:
        assert (found.column, found.unit) == (column, unit)


@pytest.mark.parametrize(
    "name",
    [
        "mag_heading", "magnetic_field_covariance[0]", "mag_ofs_x", "OfsX", "mag_bias_x", "mag_ref_y", "x", "motor_x",
        "mass",
        "date", "level", "max", "amx_1", "declination", "mag_status", "q_test", "position_x", "error_count", "gain_x",
        "speed",
        "mag_innov[0]", "user_acceleration_x", "ax_angle", "timer_ticks_left", "temperament", "currently",
    ],
)  # fmt: skip
def test_names_of_other_quantities_are_not_recognised(name):
    assert meaning(name) is None


@pytest.mark.parametrize(
    ("quantity", "unit", "value", "expected"),
    [
        ("mag", "nT", 5e4, 50.0), ("mag", "mT", 0.05, 50.0), ("mag", "T", 5e-5, 50.0), ("mag", "G", 0.5, 50.0),
        ("mag", "mGauss", 500.0, 50.0), ("mag", "MG", 500.0, 50.0), ("gyro", "deg/s", 180.0, np.pi),
        ("gyro", "°/s", 90, np.pi / 2),
        ("accel", "g", 1.0, 9.80665), ("temperature", "K", 300.0, 26.85), ("temperature", "F", 212.0, 100.0),
        ("current", "mA", 1500.0, 1.5), ("time", "µs", 1e6, 1.0), ("time", "millis", 20.0, 0.02),
    ],
)  # fmt: skip
def test_units_are_converted_by_their_definitions(quantity, unit, value, expected):
    found = conversion(quantity, unit)
    assert value * float(found.factor) + found.shift == pytest.approx(expected)


def test_the_command_knows_the_same_quantities():
    units_option = pytest.importorskip("mkc_torch.cli.units_option")
    assert set(units_option.QUANTITIES) == set(CANONICAL)


# --- sensors


def test_equal_sensors_are_several_and_forms_of_a_sensor_are_ambiguous():
    several = recognised([topic_of_names("mag0_x", "mag0_y", "mag0_z", "mag1_x", "mag1_y", "mag1_z")])
    assert ([sensor.name for sensor in several.sensors], several.several) == (["mag0", "mag1"], True)
    forms = recognised([topic_of_names(*(f"mag_{form}_{axis}" for form in ("raw", "cal") for axis in "xyz"))])
    assert ([sensor.name for sensor in forms.sensors], forms.several) == (["mag_raw", "mag_cal"], False)


def test_the_plain_name_takes_precedence_over_another_form():
    found = recognised([topic_of_names(*(f"{form}_{axis}" for form in ("mag", "mag_raw") for axis in "xyz"))])
    assert [sensor.columns["mag_x"] for sensor in found.sensors] == ["mag_x"]


def test_an_incomplete_triple_is_not_recognised():
    assert recognised([topic_of_names("mag_x", "mag_y", "gyro_x")]).sensors == ()


def test_companion_columns_match_the_sensors_number():
    columns = [f"{q}{n}_{axis}" for q in ("mag", "gyro") for n in (0, 1) for axis in "xyz"]
    found = recognised([topic_of_names("time", *columns)])
    assert [sensor.columns["gyro_x"] for sensor in found.sensors] == ["gyro0_x", "gyro1_x"]


@pytest.mark.parametrize("file", ["Magnetometer", "sensor_mag_0", "imu_mag_log"])
def test_x_y_z_are_a_magnetometer_by_the_name_of_the_file(file):
    assert is_about_magnetometer(file) == (file != "imu_gyro")
    assert [
        sensor.columns["mag_x"] for sensor in recognised([topic_of_names("time", "x", "y", "z")], file).sensors
    ] == ["x"]


@pytest.mark.parametrize("file", ["log", "run_3", "gyroscope", "imu", "mag_and_gyro", "position"])
def test_x_y_z_without_a_hint_are_not_recognised(file):
    assert recognised([topic_of_names("time", "x", "y", "z")], file).sensors == ()


PX4 = {"timestamp": [1], "timestamp_sample": [1], "device_id": [396825], "x": [0.1], "y": [0.2], "z": [0.3]}


@pytest.mark.parametrize(("device", "is_one"), [(396825, True), (3014666, False), (0, False), (0xE50000, True)])
def test_a_px4_device_id_identifies_a_magnetometer(device, is_one):
    """396825 = 0x060E19: type 0x06 (IST8310), address 0x0E, bus 3 of kind I2C; 3014666 = 0x2E000A, an ICM-42653."""
    table = topic_of(**PX4 | {"device_id": [device]})
    assert is_px4_magnetometer(table.table) == is_one
    found = recognised([table]).sensors
    assert bool(found) == is_one
    if is_one:
        assert (found[0].units["mag_x"], found[0].units["time"]) == ("gauss", "us")


def test_a_message_of_ros_is_in_tesla():
    """sensor_msgs/MagneticField.msg: "Measurements in Teslas"."""
    axes = [f"field.magnetic_field.{axis}" for axis in "xyz"]
    sensor = recognised([topic_of_names("%time", *axes, "field.magnetic_field_covariance0")]).sensors[0]
    assert sensor.units["mag_x"] == "tesla"
    assert "mag_x" not in recognised([topic_of_names("%time", *axes)]).sensors[0].units


# --- several topics


def log_file(tmp_path, monkeypatch, *topics):
    monkeypatch.setattr(formats, "FORMATS", (*formats.FORMATS, FileFormat((".log",), lambda _: list(topics))))
    path = tmp_path / "flight.log"
    path.write_text("x")
    return path


def mag_topic(name, start=1_000_000, count=5):
    at = [start + 100_000 * i for i in range(count)]
    field = {axis: [0.1 * (k + 1) + 0.01 * i for i in range(count)] for k, axis in enumerate("xyz")}
    return topic_of(name, {"timestamp": "us", "x": "gauss", "y": "gauss", "z": "gauss"}, timestamp=at, **field)


def test_other_topics_are_interpolated_at_the_magnetometers_times(tmp_path, monkeypatch):
    slow = [1_050_000 + 200_000 * i for i in range(2)]
    gyro = topic_of(
        "sensor_gyro_0", {"timestamp": "us", "x": "deg/s"}, timestamp=slow, x=[0.0, 180.0], y=[1.0, 3.0], z=[0, 0]
    )
    turned = topic_of("vehicle_attitude", {"timestamp": "us"}, timestamp=[0, 2_000_000], **{
        f"q[{i}]": [a, -a] for i, a in enumerate((1.0, 0.0, 0.0, 0.0))
    })  # fmt: skip
    path = log_file(tmp_path, monkeypatch, gyro, turned, mag_topic("sensor_mag_0"))
    recording = Recording.read(path)
    assert recording.time.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert recording["mag_x"].tolist() == pytest.approx([10.0, 11.0, 12.0, 13.0, 14.0])
    assert recording["gyro_x"].isnan().tolist() == [True, False, False, True, True]
    assert recording["gyro_x"][1:3].tolist() == pytest.approx([np.pi / 4, 3 * np.pi / 4])
    assert recording["gyro_y"][1:3].tolist() == pytest.approx([1.5, 2.5])
    assert recording["q_w"].tolist() == pytest.approx([1.0] * 5)  # q and -q are the same rotation
    warnings = " ".join(recording.notes)
    assert "of topic `sensor_gyro_0`, interpolated linearly" in warnings
    assert "3 samples outside of its times or in its gaps have no value" in warnings


def test_topics_are_sensors_and_derived_topics_of_px4_are_left_out(tmp_path, monkeypatch):
    path = log_file(tmp_path, monkeypatch, mag_topic("sensor_mag_0"), mag_topic("sensor_mag_1", 2_000_000))
    with pytest.raises(RecordingError, match="2 magnetometers, `sensor_mag_0`, `sensor_mag_1`; choose one"):
        Recording.read(path)
    assert len(Recording.read(path, sensor="SENSOR_mag_1")) == 5
    with pytest.raises(RecordingError, match="no magnetometer `mag7`; there are `sensor_mag_0`, `sensor_mag_1`"):
        Recording.read(path, sensor="mag7")
    voted = mag_topic("vehicle_magnetometer")
    path = log_file(tmp_path, monkeypatch, voted, mag_topic("sensor_mag"))
    found = recognised(formats.read_topics(path))
    assert [sensor.topic for sensor in found.sensors] == [1]
    (warning,) = found.left_out
    assert re.search(r"`vehicle_magnetometer` is left out.*derived from `sensor_mag`", warning)


def test_columns_of_a_topic_are_named_with_it(tmp_path, monkeypatch):
    other = topic_of("probe", time=[0.0, 1.0], u=[1.0, 2.0], v=[1.0, 2.0], w=[1.0, 2.0])
    path = log_file(tmp_path, monkeypatch, other, topic_of("rest", time=[0.0], a=[1.0]))
    named = {"mag_x": "probe.u", "mag_y": "probe.v", "mag_z": "probe.w"}
    assert Recording.read(path, columns=named)["mag_z"].tolist() == [1.0, 2.0]
    with pytest.raises(RecordingError, match="2 topics, `probe`, `rest`, and no magnetometer is recognised"):
        Recording.read(path)
    with pytest.raises(MissingColumnError, match=r"no topic has all of `probe\.u`, `a`; .*`probe`, `rest`"):
        Recording.read(path, columns={"mag_x": "probe.u", "mag_y": "a"})


def test_interpolation_leaves_gaps_open():
    times = np.concatenate([np.arange(0.0, 10.0), np.arange(30.0, 40.0)])
    values = np.stack([2.0 * times, times**0], -1)
    at = np.array([-0.1, 0.0, 4.25, 9.0, 9.5, 29.9, 30.0, 39.0, 39.1])
    found = interpolated(at, times, values)
    known = [False, True, True, True, False, False, True, True, False]
    assert np.isfinite(found).all(-1).tolist() == known
    assert found[known, 0] == pytest.approx(2.0 * at[known])


# --- what is taken and what stays


def read(tmp_path, text, **options):
    path = tmp_path / "rec.csv"
    path.write_text(text, encoding="utf-8")
    return Recording.read(path, **options)


def test_a_table_without_a_magnetometer_keeps_its_names(tmp_path):
    recording = read(tmp_path, "timestamp_ms,temp,x,y,z,acc_x\n10,1,2,3,4,5\n20,1,2,3,4,5\n")
    assert recording.names == ("time", "temp", "x", "y", "z", "acc_x")
    assert recording.time.tolist() == pytest.approx([0.0, 0.01])


@pytest.mark.parametrize("recognise", [True, False])
def test_units_in_brackets_are_split_from_the_names_of_another_table(tmp_path, recognise):
    recording = read(
        tmp_path, "time [s],height [m],q[0],mass (kg),mass (lb)\n0,1,2,3,4\n1,1,2,3,4\n", recognise=recognise
    )
    assert recording.names == ("time", "height", "q[0]", "mass (kg)", "mass (lb)")


def test_a_column_named_by_the_caller_keeps_its_unit_in_brackets(tmp_path):
    recording = read(tmp_path, "time,height [m]\n0,1\n1,2\n", recognise=False, columns={"level": "height [m]"})
    assert recording.names == ("time", "level")


def test_without_recognition_only_the_time_is_known(tmp_path):
    recording = read(tmp_path, "time_us,mx,my,mz,temp\n0,1,2,3,4\n500,1,2,3,4\n", recognise=False)
    assert recording.names == ("time", "mx", "my", "mz", "temp")
    assert recording.time.tolist() == pytest.approx([0.0, 5e-4])


def test_requested_units_are_converted(tmp_path):
    text = "time,mag_x,mag_y,mag_z,gyro_x,temperature\n0,0.5,0.25,0.125,180,300\n1000,0.5,0.25,0.125,90,300\n"
    given = {"mag": "gauss", "time": "ms", "gyro": "deg/s", "temperature": "K"}
    recording = read(tmp_path, text, units=given)
    assert recording.magnetometer()[0].tolist() == [50.0, 25.0, 12.5]
    assert recording.time.tolist() == [0.0, 1.0]
    assert recording["gyro_x"].tolist() == pytest.approx([np.pi, np.pi / 2])
    assert recording["temperature"].tolist() == pytest.approx([26.85, 26.85])
    assert recording.units["mag_x"] == "µT"
    label = read(tmp_path, text, units={"mag": "counts"})
    assert (label["mag_x"][0].item(), label.units["mag_x"]) == (0.5, "counts")


@pytest.mark.parametrize(
    ("units", "message"),
    [
        ({"speed": "m/s"}, "`--convert speed=m/s` names no column of the file and no quantity"),
        ({"gyro": "furlongs"}, "gyro=furlongs.* known: rad/s, mrad/s, °/s"),
        ({"time": "fortnights"}, "time=fortnights.* known: s, ms, µs, ns"),
    ],
)
def test_units_that_are_not_known_are_refused(tmp_path, units, message):
    with pytest.raises(RecordingError, match=message):
        read(tmp_path, "time,mag_x,mag_y,mag_z,gyro_x\n0,1,2,3,4\n1,1,2,3,4\n", units=units)


# --- time


@pytest.mark.parametrize(
    ("cells", "unit", "expected"),
    [
        (["1700000000000000000", "1700000000007863001"], "", 0.007863001),
        (["1700000000.000000001", "1700000000.000003001"], "", 3e-6),
        (["1700000000000", "1700000000020"], "", 0.02),
        (["2024-05-03T10:00:00.123456789Z", "2024-05-03T10:00:00.123456790Z"], "", 1e-9),
        (["2024-02-29T23:59:60Z", "2024-03-01T00:00:01Z"], "", 1.0),
        (["20240503T100000", "20240503T100000.5"], "", 0.5),
        (["23:59:59.75", "00:00:00.25"], "", 0.5),
        (["-20", "5"], "ms", 0.025),
        (["1e3", "2e3"], "us", 1e-3),
        (["12.5", "13.5"], "s", 1.0),
    ],
)
def test_differences_of_times_keep_every_digit(cells, unit, expected):
    assert clock_of(pl.Series(cells), unit).since(0).tolist() == [0.0, pytest.approx(expected, rel=1e-15)]


def test_nanoseconds_of_an_uptime_are_distinguished_from_milliseconds_since_1970():
    """1.2e12 is 2008 in ms since 1970, or twenty minutes of uptime in ns; the interval distinguishes them."""
    assert clock_of(pl.Series([1_200_000_000_000, 1_200_010_000_000])).format == ""
    assert clock_of(pl.Series([1_200_000_000_000, 1_200_000_000_010])).format == "ms since 1970"


def test_an_invalid_time_is_refused_with_its_row():
    with pytest.raises(ClockError) as error:
        clock_of(pl.Series(["0", "1", "x"]))
    assert error.value.row == 2


STEADY = np.arange(0.0, 50.0, 0.5)


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        (np.concatenate([STEADY, STEADY]), [100]),
        (np.concatenate([STEADY + 20.0, STEADY + 3.0, STEADY + 3.25]), [100, 200]),
        (np.concatenate([STEADY, STEADY + 25.1]), [100]),  # into the middle of the first run, with interleaved samples
        (np.concatenate([STEADY[:60], STEADY[80:], STEADY[60:80]]), []),  # a block that was written late
        (np.where(np.arange(100) == 50, STEADY - 0.7, STEADY), []),  # a single sample that steps back
        (np.random.default_rng(0).permutation(STEADY), []),  # rows in no order
        (np.concatenate([STEADY[:99], [np.nan], STEADY]), [100]),
        (np.tile(np.arange(11.0), 6), [11, 22, 33, 44, 55]),  # short runs, in more than a twentieth of the rows
        (np.concatenate([np.arange(4.0), np.arange(7.0), np.arange(3.0)]), [4, 11]),
        (np.random.default_rng(1).permutation(np.tile(np.arange(11.0), 6)), []),
        (STEADY[::-1], []),
        (np.zeros(5), []),
        (np.array([np.nan, np.nan]), []),
    ],
)
def test_restarts_of_the_time_are_found(time, expected):
    assert restarts(time) == expected


def test_a_converted_time_starts_at_zero_in_each_run(tmp_path):
    rows = [f"{5000 + 20 * i},1,2,3" for i in range(40)] + [f"{100 + 20 * i},1,2,3" for i in range(40)]
    recording = read(tmp_path, "\n".join(["time_ms,mx,my,mz", *rows]) + "\n")
    assert recording["experiment"].unique().tolist() == [1.0, 2.0]
    assert recording.time[[0, 39, 40, 79]].tolist() == pytest.approx([0.0, 0.78, 0.0, 0.78])


def test_a_repeated_header_starts_a_run_without_a_time(tmp_path):
    recording = read(tmp_path, "mx,my,mz\n1,2,3\n2,3,4\nmx,my,mz\n3,4,5\n")
    assert recording["experiment"].tolist() == [1.0, 1.0, 2.0]
    assert "There is no time" in recording.notes[-1]
    assert "experiment" not in read(tmp_path, "mx,my,mz\n1.25,2.25,3.25\nmx,my,mz\nmx,my,mz\n3,4\n")


def text_file(path, names):
    rows = [",".join(f"{0.1 * i + j:.1f}" for j in range(len(names))) for i in range(20)]
    path.write_text("\n".join([",".join(names), *rows]) + "\n", encoding="utf-8")
    return path


def test_a_unit_of_a_magnetic_field_identifies_a_magnetometer_of_any_name(tmp_path):
    path = text_file(tmp_path / "logger.csv", ["Zeit [s]", "Feld X [nT]", "Feld Y [nT]", "Feld Z [nT]"])
    recording = Recording.read(path)
    assert recording["mag_y"].tolist()[:2] == pytest.approx([2e-3, 2.1e-3])  # µT
    assert recording.time is not None


@pytest.mark.parametrize("names", [
    ["Feld X [mG]", "Feld Y [mG]", "Feld Z [mG]"],  # also milli-g
    ["offset X [nT]", "offset Y [nT]", "offset Z [nT]"],
    ["in X [nT]", "in Y [nT]", "in Z [nT]", "out X [nT]", "out Y [nT]", "out Z [nT]"],
])  # fmt: skip
def test_an_ambiguous_unit_or_a_derived_value_identifies_no_magnetometer(tmp_path, names):
    path = text_file(tmp_path / "logger.csv", ["Zeit [s]", *names])
    assert recognised(formats.read_topics(path), path.stem).sensors == ()


@pytest.mark.parametrize(("name", "is_time"), [("t_s", True), ("t [ms]", True), ("t", False), ("T_s", False)])
def test_a_column_t_with_a_unit_of_time_is_the_time(tmp_path, name, is_time):
    path = text_file(tmp_path / "run.csv", [name, "force", "speed"])
    assert (Recording.read(path, recognise=False).time is not None) == is_time
