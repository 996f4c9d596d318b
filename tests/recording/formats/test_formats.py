"""Features of each format: instances, nesting, text, units, and warnings about what is left out."""

import sqlite3
import struct
import sys

import numpy as np
import pytest

pytest.importorskip("polars")

from mkc_torch import Recording
from mkc_torch.recording.formats import RecordingError, encoded, read_topics
from mkc_torch.recording.formats.message_rows import MessageRows
from mkc_torch.recording.formats.ros_messages import RosReader, parsed_definitions
from tests.recording.formats import writers
from tests.recording.formats.test_same_samples import KINDS, topic_named, values_of
from tests.recording.formats.writers import TOPIC, samples

GIVEN = samples(50)


def test_a_log_of_one_table_is_read_as_a_recording(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["time"] = np.arange(50) * 0.01
        file["mag"] = 100.0 * GIVEN.mag
    recording = Recording.read(tmp_path / "log.h5")
    assert recording.names == ("time", "mag_x", "mag_y", "mag_z")
    assert recording["mag_y"].tolist() == (100.0 * GIVEN.mag[:, 1]).tolist()


@pytest.mark.parametrize(("ending", "write"), [(".ulg", writers.ulog), (".bin", writers.dataflash)])
def test_each_instance_of_a_sensor_is_a_topic(ending, write, tmp_path):
    write(tmp_path / f"log{ending}", GIVEN, 3)
    names = [topic.name for topic in read_topics(tmp_path / f"log{ending}")]
    stem = "sensor_mag_{}" if ending == ".ulg" else "MAG[{}]"
    assert [name for name in names if "ag" in name.lower()] == [stem.format(place) for place in range(3)]
    for place in range(3):
        found = values_of(
            topic_named(tmp_path / f"log{ending}", stem.format(place)), "x" if ending == ".ulg" else "MagX"
        )
        # the third decimal of float32 sums differs, the instance does not
        assert np.abs(found - GIVEN.mag[:, 0] - place).max() < 1e-6


def test_text_in_a_ulog_is_reported_and_padding_is_not(tmp_path):
    writers.ulog(tmp_path / "log.ulg", GIVEN)
    (topic,) = read_topics(tmp_path / "log.ulg")
    assert topic.table.names == ["timestamp", "timestamp_sample", "x", "y", "z"]
    assert topic.warnings == ("Column `tag` holds text and is left out.",)


def test_dropouts_of_a_ulog_are_reported(tmp_path):
    writers.ulog(tmp_path / "log.ulg", GIVEN)
    with (tmp_path / "log.ulg").open("ab") as file:
        file.write(struct.pack("<HBH", 2, ord("O"), 120))
    (topic,) = read_topics(tmp_path / "log.ulg")
    assert topic.warnings[0] == "The logger lost 0.12 s of data in 1 dropout."


def test_excessively_nested_formats_of_a_ulog_are_rejected(tmp_path):
    bodies = [f"a{place}:a{place + 1}[60000] x;" for place in range(3)] + ["a3:float y;", "loop:loop x;"]
    for some in (bodies[:4], bodies[4:]):
        messages = [struct.pack("<HB", len(body), ord("F")) + body.encode() for body in some]
        name = some[0].partition(":")[0].encode()
        messages.append(struct.pack("<HB", 3 + len(name), ord("A")) + struct.pack("<BH", 0, 0) + name)
        (tmp_path / "log.ulg").write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + b"".join(messages))
        with pytest.raises(RecordingError, match="more than 65,536 fields"):
            read_topics(tmp_path / "log.ulg")


def test_a_dataset_that_claims_more_bytes_than_its_file_is_left_out(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file.create_dataset("huge", (10**12,), "f8", chunks=(1000,))
        file["mag"] = np.zeros((5, 3))
    (topic,) = read_topics(tmp_path / "log.h5")
    assert topic.table.names == ["mag_x", "mag_y", "mag_z"]
    assert "`huge` claims 8,000,000,000,000 bytes" in topic.warnings[0]


def test_a_dataflash_log_without_units_has_the_default_units(tmp_path):
    writers.dataflash(tmp_path / "log.bin", GIVEN, units=False)
    topic = topic_named(tmp_path / "log.bin", "MAG[0]")
    assert topic.units["MagX"] == "mGauss"
    assert topic.units["TimeUS"] == "us"


def test_a_dataflash_log_with_an_extension_in_capitals_is_read(tmp_path):
    writers.dataflash(tmp_path / "00000001.BIN", GIVEN)
    assert topic_named(tmp_path / "00000001.BIN", "MAG[0]")


def test_erased_pages_at_the_end_of_a_dataflash_log_have_no_warning(tmp_path):
    writers.dataflash(tmp_path / "log.bin", GIVEN)
    with (tmp_path / "log.bin").open("ab") as file:
        file.write(b"\xff" * 300)
    assert all(topic.warnings == () for topic in read_topics(tmp_path / "log.bin"))


@pytest.mark.parametrize("encoding", ["ros1", "ros2", "json", "protobuf"])
@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_an_mcap_file_of_any_encoding_and_compression_is_read(encoding, compression, tmp_path):
    writers.mcap_of(tmp_path / "log.mcap", GIVEN, encoding, compression, chunk=1000)
    (topic,) = read_topics(tmp_path / "log.mcap")
    assert topic.name == TOPIC
    assert topic.table.names[:3] == ["header.stamp", "log_time", "publish_time"]
    assert values_of(topic, "header.stamp").tolist() == (GIVEN.time * 1000).tolist()
    assert values_of(topic, "log_time").tolist() == (GIVEN.time * 1000 + 77).tolist()
    for place, axis in enumerate("xyz"):
        assert values_of(topic, f"magnetic_field.{axis}").tolist() == GIVEN.mag[:, place].tolist()


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_the_whole_messages_of_the_last_broken_chunk_of_an_mcap_file_are_kept(compression, tmp_path):
    given = samples(4000)  # compressors keep the last tens of kilobytes to themselves
    writers.mcap_of(tmp_path / "log.mcap", given, "ros2", compression, chunk=10**7)
    whole = (tmp_path / "log.mcap").read_bytes()
    # a single chunk holds all messages: without its first half, no rows would remain
    (tmp_path / "log.mcap").write_bytes(whole[: len(whole) // 2])
    (topic,) = read_topics(tmp_path / "log.mcap")
    found = values_of(topic, "magnetic_field.x").tolist()
    assert 500 <= len(found) < len(given.time)
    assert found == given.mag[: len(found), 0].tolist()
    assert "cut off" in topic.warnings[0]


def test_a_wrong_checksum_of_an_mcap_file_is_reported(tmp_path):
    writers.mcap_of(tmp_path / "log.mcap", GIVEN, "json", "NONE")
    whole = (tmp_path / "log.mcap").read_bytes()
    assert whole.count(b'"x": 0.') > 5
    (tmp_path / "log.mcap").write_bytes(whole.replace(b'"x": 0.', b'"x": 7.', 1))
    (topic,) = read_topics(tmp_path / "log.mcap")
    assert "the checksum of 1 of its chunks is wrong" in topic.warnings[0]


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
def test_a_ros1_bag_that_was_not_closed_is_read(compression, tmp_path):
    # bz2 decompresses nothing of an incomplete chunk, so there must be another chunk
    given = samples(9000 if compression == "bz2" else 4000)
    writers.rosbag1(tmp_path / "log.bag", given, compression)
    whole = (tmp_path / "log.bag").read_bytes()
    (topic,) = read_topics(tmp_path / "log.bag")
    assert topic.warnings == ("`header.frame_id` holds text and is left out.",)
    assert values_of(topic, "magnetic_field.z").tolist() == given.mag[:, 2].tolist()
    # without the index, which stands at the end, and half of its last chunk
    (tmp_path / "log.bag").write_bytes(whole[: 2 * len(whole) // 3])
    (half,) = read_topics(tmp_path / "log.bag")
    found = values_of(half, "magnetic_field.x").tolist()
    assert 500 <= len(found) < len(given.time)
    assert found == given.mag[: len(found), 0].tolist()
    assert "cut off" in " ".join(half.warnings)


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("version", [8, 9])
def test_a_ros2_bag_with_and_without_definitions_is_read(storage, version, tmp_path):
    writers.rosbag2(tmp_path / "bag", GIVEN, storage, version)
    (topic,) = read_topics(tmp_path / "bag")
    assert topic.units["magnetic_field.x"] == "T"
    assert topic.units["header.stamp"] == topic.units["log_time"] == "ns"
    assert values_of(topic, "magnetic_field.x").tolist() == GIVEN.mag[:, 0].tolist()


def test_reading_a_ros2_bag_creates_and_changes_no_files(tmp_path):
    writers.rosbag2(tmp_path / "bag", GIVEN)
    before = {path: path.read_bytes() for path in (tmp_path / "bag").iterdir()}
    read_topics(tmp_path / "bag")
    assert {path: path.read_bytes() for path in (tmp_path / "bag").iterdir()} == before


def test_a_database_that_is_not_a_bag_is_rejected_even_with_an_endless_view(tmp_path):
    base = sqlite3.connect(tmp_path / "log.db3")
    base.execute("CREATE TABLE topics (id, name, type, serialization_format)")
    base.execute(
        "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
        "SELECT id, 1 AS topic_id, 1 AS timestamp, x'00' AS data FROM n"
    )
    base.commit()
    base.close()
    with pytest.raises(RecordingError, match="holds no ROS 2 bag"):
        read_topics(tmp_path / "log.db3")


def rosbags_message_read(store, text, name, message, ros1):
    """A message serialised by rosbags and read by the package."""
    data = bytes(store.serialize_ros1(message, name) if ros1 else store.serialize_cdr(message, name))
    return RosReader(name, parsed_definitions(text, name), ros1).read(data)


@pytest.mark.parametrize("ros1", [True, False])
def test_messages_of_all_field_types_equal_those_written_by_rosbags(ros1):
    from rosbags.typesys import Stores, get_typestore

    line = "=" * 80
    text = (
        "int8 a\nfloat64 b\nuint8 c\nstring s\nint16[3] d\nfloat64[] e\nbool f\ntime t\nPart[2] p\nPart[] q\nuint64 g\n"
        f"string[] w\nfloat32 h\n{line}\nMSG: pkg/Part\nuint8 k\nfloat64 x\n"
    )
    name = "pkg/msg/All"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    definitions = parsed_definitions(text, name)
    store.register(definitions)
    part = store.types["pkg/msg/Part"]
    stamp = store.types["builtin_interfaces/msg/Time"](sec=7, nanosec=9)
    message = store.types[name](
        a=-3, b=0.1, c=200, s="höhe", d=np.array([1, -2, 3], np.int16), e=np.array([0.5, 0.25]), f=True, t=stamp,
        p=[part(k=1, x=2.5), part(k=2, x=3.5)], q=[part(k=3, x=4.5)], g=2**63 + 1, w=["a", "bc"], h=0.5,
    )  # fmt: skip
    assert rosbags_message_read(store, text, name, message, ros1) == {
        "a": -3, "b": 0.1, "c": 200, "s": "höhe", "d": (1, -2, 3), "e": (0.5, 0.25), "f": True, "t": 7_000_000_009,
        "p[0].k": 1, "p[0].x": 2.5, "p[1].k": 2, "p[1].x": 3.5, "g": 2**63 + 1, "w": "", "h": 0.5,
    }  # fmt: skip


def test_a_recursive_or_excessively_nested_definition_is_rejected():
    line = "=" * 80
    with pytest.raises(ValueError, match="contains itself"):
        RosReader("pkg/msg/A", parsed_definitions(f"B b\n{line}\nMSG: pkg/B\nA a\n", "pkg/msg/A") | {}, True)
    # ten nested messages on each level: 10²⁰ empty messages in zero bytes
    parts = "".join(f"{line}\nMSG: pkg/T{place}\nT{place + 1}[10] t\n" for place in range(20))
    text = f"T0 t\n{parts}{line}\nMSG: pkg/T20\nint8 C=1\n"
    reader = RosReader("pkg/msg/A", parsed_definitions(text, "pkg/msg/A"), True)
    with pytest.raises(ValueError, match="More than"):
        reader.read(b"")


def test_message_arrays_that_change_length_are_left_out_with_a_warning():
    rows = MessageRows("t", {"a": "m"})
    rows.add({"a": 1, "l": (1, 2), "s": "x", "n": 1})
    rows.add({"a": 2, "l": (1,), "s": "y"})
    rows.add({"a": 2.5, "l": (3, 4), "s": "y", "n": 2**70})
    topic = rows.topic(("n",), "a", ())
    assert topic.table.names == ["n", "a"]
    assert values_of(topic, "a").tolist() == [1.0, 2.0, 2.5]
    assert np.isnan(values_of(topic, "n")[1])
    assert values_of(topic, "n")[2] == 2.0**70
    assert topic.units == {"a": "m"}
    assert "`l`: an array of changing length" in topic.warnings[0]
    assert "`s` holds text" in topic.warnings[1]


def test_messages_out_of_order_are_sorted_by_log_time():
    rows = MessageRows("t", {})
    for time in (3, 1, 2):
        rows.add({"log_time": time, "a": 10 * time})
    topic = rows.topic(("log_time",), "log_time", ())
    assert values_of(topic, "a").tolist() == [10, 20, 30]


def test_groups_of_an_hdf5_file_are_topics_with_units_and_warnings(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["mag/t"] = np.arange(4.0)
        file["mag/field"] = np.arange(12.0).reshape(3, 4)  # as it lies in MATLAB
        file["mag/field"].attrs["units"] = np.array(["T"], dtype="S1")
        file["mag/rate"] = 100.0
        file["mag/name"] = np.array([b"a"] * 4)
        file["mag/when"] = np.array([f"2026-01-01T00:00:0{second}Z" for second in range(4)], dtype="S20")
        file["gyro/t"] = np.arange(9.0)
        file["gyro/rate"] = np.zeros((9, 3), np.float32)
        file["table"] = np.array([(1, 2.5), (2, 3.5)], dtype=[("n", "i4"), ("x", "f8")])
        file["mag/elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
    topics = {topic.name: topic for topic in read_topics(tmp_path / "log.h5")}
    assert set(topics) == {"mag", "gyro", "table"}
    mag = topics["mag"]
    assert mag.table.names == ["t", "field_x", "field_y", "field_z", "when"]
    assert values_of(mag, "field_y").tolist() == [4.0, 5.0, 6.0, 7.0]
    assert mag.units == {"field_x": "T", "field_y": "T", "field_z": "T"}
    warnings = " ".join(mag.warnings)
    assert "`rate`: single values" in warnings
    assert "`name` holds text" in warnings
    assert "`elsewhere` is a link to elsewhere" in warnings
    assert values_of(topics["table"], "x").tolist() == [2.5, 3.5]


def test_structs_and_columns_of_other_lengths_of_a_matlab_file_are_topics_and_cells_are_left_out(tmp_path):
    io = pytest.importorskip("scipy.io")
    times = np.arange(5.0)
    cells = np.empty(2, dtype=object)
    cells[:] = [np.zeros(3), np.zeros(4)]
    io.savemat(
        tmp_path / "log.mat",
        {
            "tout": times,
            "signals": {"values": np.arange(15.0).reshape(5, 3)},
            "imu": {"time": np.arange(7.0), "q": np.zeros((4, 7))},
            "fast": np.arange(11.0),
            "cells": cells,
            "label": "a flight",
        },
    )
    topics = {topic.name: topic for topic in read_topics(tmp_path / "log.mat")}
    # a struct of the same length as its parent and without its own time is merged into the parent
    assert topics[""].table.names == ["tout", "signals.values_x", "signals.values_y", "signals.values_z"]
    assert topics["imu"].table.names == ["time", "q[0]", "q[1]", "q[2]", "q[3]"]
    assert topics["[11 rows]"].table.names == ["fast"]
    assert "`cells` is a cell array and is left out." in topics[""].warnings


def test_a_formula_of_an_mdf_file_is_not_executed(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    from asammdf.blocks.conversion_utils import from_dict

    time = np.arange(5.0)
    with asammdf.MDF() as file:
        formula = from_dict({"formula": "X1 * 2"})
        linear = from_dict({"a": 2.0, "b": 1.0})
        file.append(
            [
                asammdf.Signal(time, time, name="a", conversion=formula),
                asammdf.Signal(time, time, name="b", conversion=linear, unit="V"),
            ]
        )
        file.save(tmp_path / "log.mf4")
    (topic,) = read_topics(tmp_path / "log.mf4")
    assert topic.table.names == ["time", "b"]
    assert values_of(topic, "b").tolist() == (2 * time + 1).tolist()
    assert "`a`: converted by a formula" in topic.warnings[0]


PACKAGES = {
    "ULog": ("pyulog", "ulog"),
    "MCAP": ("mcap", "mcap"),
    "ROS 1": ("rosbags", "rosbag"),
    "ROS 2": ("rosbags", "rosbag"),
    "MATLAB 5": ("scipy", "mat"),
    "MATLAB 7.3": ("h5py", "mat"),
    "HDF5": ("h5py", "hdf5"),
    "MDF 4": ("asammdf", "mdf"),
}


@pytest.mark.parametrize("kind", PACKAGES)
def test_without_its_package_a_format_names_the_extra(kind, tmp_path, monkeypatch):
    package, extra = PACKAGES[kind]
    ending, write, *_ = KINDS[kind]
    write(tmp_path / f"log{ending}", GIVEN)
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == package else object())
    with pytest.raises(ImportError, match=rf"mkc-torch\[{extra}\]"):
        read_topics(tmp_path / f"log{ending}")


@pytest.mark.parametrize("ending", [".ulg", ".bin", ".mcap", ".h5"])
def test_writing_a_log_format_is_refused(ending, tmp_path):
    with pytest.raises(RecordingError, match="can be read but not written"):
        encoded(tmp_path / f"log{ending}", {"a": np.zeros(2)})
