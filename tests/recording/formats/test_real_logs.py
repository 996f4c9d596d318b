"""A real flight log agrees with tables made of it earlier and with pymavlink's reader."""

import contextlib
import csv
import io
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("polars")

from mkc_torch.recording.formats import read_topics
from tests.recording.formats.test_damage import rows_or_message
from tests.recording.formats.test_same_samples import values_of
from tests.recording.formats.writers import dataflash, dataflash_text, samples
from tests.shared_data import shared_data

LOG = "magnetometer/quadrotor_log171.bin"


@pytest.fixture(scope="module")
def flight():
    path = shared_data(LOG)
    return {topic.name: topic for topic in read_topics(path)}


def table_of(name):
    with shared_data(f"magnetometer/{name}.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in ("time", "mag_x", "mag_y", "mag_z")}


def field_without_offsets(topic, axis):
    """The field in µT, without the autopilot's offsets that the log's values include."""
    columns = [values_of(topic, f"{name}{axis}").astype(float) for name in ("Mag", "Ofs", "MOfs")]
    return (columns[0] - columns[1] - columns[2]) / 10


def test_a_compass_of_a_flight_equals_its_table_row_by_row(flight):
    topic, table = flight["MAG"], table_of("quadrotor_compass1")
    assert topic.warnings == ()
    assert topic.units["TimeMS"] == "ms"
    assert topic.units["MagX"] == "mGauss"
    count = len(table["time"])
    assert count == 2219
    time = values_of(topic, "TimeMS").astype(float) / 1e3
    assert (time[:count] - time[0]).round(6).tolist() == table["time"].tolist()
    for axis in "XYZ":
        assert field_without_offsets(topic, axis)[:count].round(6).tolist() == table[f"mag_{axis.lower()}"].tolist()


def test_another_compass_equals_its_table_at_the_times_of_the_first(flight):
    topic, table = flight["MAG3"], table_of("quadrotor_compass3")
    first, own = (values_of(flight[name], "TimeMS").astype(float) for name in ("MAG", "MAG3"))
    count = len(table["time"])
    for axis in "XYZ":
        there = np.interp(first[:count], own, field_without_offsets(topic, axis))
        assert np.abs(there - table[f"mag_{axis.lower()}"]).max() < 0.0051  # two decimals


def columns_by_pymavlink(path, name):
    """The columns of a message as pymavlink reads them."""
    reader = pytest.importorskip("pymavlink.DFReader")
    # pymavlink prints what it skips
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        kind = reader.DFReader_text if path.suffix == ".log" else reader.DFReader_binary
        log = kind(str(path))
        rows = []
        while (message := log.recv_match(type=name)) is not None:
            rows.append(message.to_dict())
        log.data_map.close()
        log.filehandle.close()
    return {key: [row[key] for row in rows] for key in rows[0] if key != "mavpackettype"}


@pytest.mark.parametrize("name", ["MAG2", "IMU", "ATT", "GPS", "BARO"])
def test_a_flight_equals_the_reading_by_pymavlink(name, flight):
    expected = columns_by_pymavlink(shared_data(LOG), name)
    topic = flight[name]
    assert topic.table.names == list(expected)
    for column, values in expected.items():
        assert values_of(topic, column).astype(np.float64).tolist() == [float(value) for value in values]


@pytest.mark.parametrize(("write", "ending"), [(dataflash, ".bin"), (dataflash_text, ".log")])
def test_a_log_of_several_instances_equals_the_reading_by_pymavlink(write, ending, tmp_path):
    path = tmp_path / f"log{ending}"
    write(path, samples(40)) if ending == ".log" else write(path, samples(40), 2)
    topics = {topic.name: topic for topic in read_topics(path)}
    expected = columns_by_pymavlink(path, "MAG")
    names = ["MAG[0]", "MAG[1]"] if ending == ".bin" else ["MAG[0]"]
    assert sorted(topics) == ["BARO", *names]
    for place, name in enumerate(names):
        for column in ("TimeUS", "MagX", "MagZ"):
            theirs = [float(v) for v, i in zip(expected[column], expected["I"], strict=True) if int(i) == place]
            assert values_of(topics[name], column).astype(float).tolist() == theirs
    assert values_of(topics["BARO"], "Temp").tolist() == [25.31] * 40
    assert topics["MAG[0]"].units == {"TimeUS": "µs", "MagX": "mGauss", "MagY": "mGauss", "MagZ": "mGauss"}


def files_of_package(package, *folder):
    """Files of a package's own tests, written by old and new programs on various machines."""
    place = Path(pytest.importorskip(package).__file__).parent.joinpath(*folder)
    found = sorted(path for path in place.glob("*") if path.suffix in (".mat", ".h5"))
    if not found:
        pytest.skip(f"no files in {place}")
    return found


def test_files_of_matlab_from_version_4_on_are_read_or_refused():
    files = files_of_package("scipy", "io", "matlab", "tests", "data")
    outcomes = {path.name: rows_or_message(path)[0] for path in files}
    assert len(files) >= 100
    for version in ("4.2c_SOL2", "6.1_SOL2", "6.5.1_GLNX86", "7.1_GLNX86", "7.4_GLNX86"):
        (topic,) = outcomes[f"testdouble_{version}.mat"]
        assert np.allclose(values_of(topic, "testdouble"), np.linspace(0, 2 * np.pi, 9), rtol=0, atol=1e-15)
    (whole,) = outcomes["testhdf5_7.4_GLNX86.mat"]  # version 7.3, by MATLAB itself
    assert np.allclose(values_of(whole, "testdouble"), np.linspace(0, 2 * np.pi, 9), rtol=0, atol=1e-15)
    assert sum(map(bool, outcomes.values())) >= 25


def test_hdf5_files_of_other_programs_give_rows_or_a_message():
    read = [rows_or_message(path)[0] for path in files_of_package("h5py", "tests", "data_files")]
    assert any(read)
