"""The same samples in each format give the same numbers as the CSV, to the last digit."""

import numpy as np
import pytest

pytest.importorskip("polars")

from mkc_torch import Recording
from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.recording.formats import read_topics
from tests.recording.formats import writers
from tests.recording.formats.writers import TOPIC, samples

GIVEN = samples()
FIELD = ("magnetic_field.x", "magnetic_field.y", "magnetic_field.z")
MAG = ("mag_x", "mag_y", "mag_z")
XYZ = ("x", "y", "z")
ARDUPILOT = ("MagX", "MagY", "MagZ")

KINDS = {
    "ULog": (".ulg", writers.ulog, "sensor_mag_0", XYZ, "timestamp", 1, "us", "gauss"),
    "DataFlash": (".bin", writers.dataflash, "MAG[0]", ARDUPILOT, "TimeUS", 1, "µs", "mGauss"),
    "DataFlash text": (".log", writers.dataflash_text, "MAG[0]", ARDUPILOT, "TimeUS", 1, "µs", "mGauss"),
    "MCAP": (".mcap", writers.mcap, TOPIC, FIELD, "header.stamp", 1000, "ns", "T"),
    "ROS 1": (".bag", writers.rosbag1, TOPIC, FIELD, "header.stamp", 1000, "ns", "T"),
    "ROS 2": (".db3", writers.db3, TOPIC, FIELD, "header.stamp", 1000, "ns", "T"),
    "ROS 2 folder": ("", writers.rosbag2, TOPIC, FIELD, "header.stamp", 1000, "ns", "T"),
    "MATLAB 5": (".mat", writers.mat, "log", MAG, "t", 1, "", ""),
    "MATLAB 4": (
        ".mat",
        lambda path, given: __import__("scipy.io").io.savemat(path, {"t": given.time, "mag": given.mag}, format="4"),
        "",
        MAG,
        "t",
        1,
        "",
        "",
    ),
    "MATLAB 7.3": (".mat", writers.mat73, "log", MAG, "t", 1, "", ""),
    "HDF5": (".h5", writers.hdf5, "imu/magnetometer", MAG, "time", 1, "us", "gauss"),
    "MDF 4": (".mf4", writers.mdf, "magnetometer", MAG, "time", 1e-6, "s", "Gauss"),
    "MDF 3": (".mdf", lambda path, given: writers.mdf(path, given, "3.30"), "group_0", MAG, "time", 1e-6, "s", "Gauss"),
}


def values_of(topic, name):
    return topic.table.series[topic.table.names.index(name)].to_numpy()


def topic_named(path, name):
    return next(topic for topic in read_topics(path) if topic.name == name)


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_times_and_units_equal_those_of_the_csv(kind, tmp_path):
    ending, write, name, columns, time, factor, time_unit, unit = KINDS[kind]
    write(tmp_path / f"recording{ending}", GIVEN)
    writers.csv(tmp_path / "recording.csv", GIVEN)
    plain = Recording.read(tmp_path / "recording.csv")
    topic = topic_named(tmp_path / f"recording{ending}", name)
    assert topic.table.names[0] == time
    for mine, theirs in zip(columns, MAG, strict=True):
        assert values_of(topic, mine).astype(np.float64).tolist() == plain[theirs].tolist()
    expected = plain["time"].numpy().astype(np.int64) * factor if factor >= 1 else plain["time"].numpy() / 1e6
    assert values_of(topic, time).tolist() == expected.tolist()
    assert topic.units.get(time, "") == time_unit
    assert [topic.units.get(column, "") for column in columns] == [unit] * 3
    assert not [sentence for sentence in topic.warnings if "damaged" in sentence]


@pytest.mark.parametrize("kind", KINDS)
def test_the_calibration_equals_that_of_the_csv_to_the_last_digit(kind, tmp_path):
    ending, write, name, columns, *_ = KINDS[kind]
    write(tmp_path / f"recording{ending}", GIVEN)
    writers.csv(tmp_path / "recording.csv", GIVEN)
    plain = Recording.read(tmp_path / "recording.csv")
    topic = topic_named(tmp_path / f"recording{ending}", name)
    mine = {new: values_of(topic, old).astype(np.float64) for new, old in zip(MAG, columns, strict=True)}
    same = Recording({"time": plain["time"], **mine}, name=plain.name)
    found, expected = calibrate(same), calibrate(plain)
    assert found.center == expected.center
    assert found.matrix == expected.matrix
    assert found.center_se == expected.center_se
    assert found.semi_axes == expected.semi_axes
