"""Truncated, damaged, empty files and files of other formats give complete rows, or a message with a remedy."""

import functools
import io
import re
import warnings

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

pytest.importorskip("polars")

from mkc_torch.recording.formats import RecordingError, read_topics, sandbox
from tests.recording.formats import writers
from tests.recording.formats.test_same_samples import KINDS, values_of
from tests.recording.formats.writers import samples

GIVEN = samples(60)
FILES = {kind: row for kind, row in KINDS.items() if row[0]}
SEQUENTIAL = ("ULog", "DataFlash", "DataFlash text", "MCAP", "ROS 1")
"""Formats whose messages are readable up to the end of a truncated file."""


@functools.cache
def file_content(kind, tmp):
    ending, write, *_ = FILES[kind]
    path = tmp / f"whole_{kind.replace(' ', '_')}{ending}"
    write(path, GIVEN)
    return path.read_bytes()


@pytest.fixture(scope="module")
def tmp(tmp_path_factory):
    return tmp_path_factory.mktemp("damage")


def rows_or_message(path):
    """The topics, or the message of a RecordingError; no other error and no library warning is allowed."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            topics = read_topics(path)
        except RecordingError as error:
            topics, message = [], str(error)
    if not topics:
        assert str(path) in message
        assert "\n" not in message
        return [], message
    for topic in topics:
        lengths = {len(series) for series in topic.table.series}
        assert len(lengths) == 1
        assert lengths.pop() > 0
    return topics, " ".join(sentence for topic in topics for sentence in topic.warnings)


many_examples = settings(max_examples=50, deadline=None)
few_examples = settings(max_examples=25, deadline=None)


@pytest.mark.e2e
@pytest.mark.parametrize("kind", FILES)
@many_examples
@given(share=st.floats(0.0, 1.0))
def test_a_file_truncated_anywhere_gives_complete_rows_or_a_message(kind, tmp, share):
    whole = file_content(kind, tmp)
    cut = whole[: int(share * (len(whole) - 1))]
    path = tmp / f"cut{FILES[kind][0]}"
    path.write_bytes(cut)
    topics, message = rows_or_message(path)
    _, _, name, columns, time, *_ = FILES[kind]
    if not topics:
        assert message
        return
    full = {topic.name: topic for topic in _read(tmp, kind, whole)}
    # a file cut at the end of a message is complete, and some formats ignore bytes at the end
    at_end = any(whole[len(cut) :].startswith(begin) for begin in (b"\xa3\x95", b"MAG", b"BARO", b"\x22\x00D"))
    same = [len(topic.table.series[0]) for topic in topics] == [len(topic.table.series[0]) for topic in full.values()]
    assert message or at_end or same
    for topic in topics:
        if topic.name == name and kind in SEQUENTIAL:
            for column in (time, *columns):
                here = values_of(topic, column).tolist()
                there = values_of(full[name], column).tolist()
                last = -1 if kind == "DataFlash text" else None  # within a number, with a warning
                assert here[:last] == there[: len(here)][:last]


@functools.cache
def _read(tmp, kind, whole):
    path = tmp / f"full{FILES[kind][0]}"
    path.write_bytes(whole)
    return read_topics(path)


@pytest.mark.parametrize("kind", SEQUENTIAL)
def test_complete_rows_of_a_truncated_file_are_kept_with_a_warning(kind, tmp):
    whole = file_content(kind, tmp)
    path = tmp / f"half{FILES[kind][0]}"
    path.write_bytes(whole[: (3 * len(whole)) // 4 + 1])
    topics, message = rows_or_message(path)
    found = next(topic for topic in topics if topic.name == FILES[kind][2])
    # the index of a bag or an MCAP file is part of its end
    assert len(found.table.series[0]) >= (30 if kind not in ("MCAP", "ROS 1") else 15)
    assert "cut off" in message


@pytest.mark.e2e
@pytest.mark.parametrize("kind", FILES)
@few_examples
@given(places=st.lists(st.tuples(st.floats(0.0, 1.0), st.binary(min_size=1, max_size=8)), min_size=1, max_size=4))
@example(places=[(0.03125, b"\xc2\x80\n")])  # a line end in the name of a message
def test_a_file_with_wrong_bytes_gives_rows_or_a_message(kind, tmp, places):
    damaged = bytearray(file_content(kind, tmp))
    for share, data in places:
        at = int(share * (len(damaged) - 1))
        damaged[at : at + len(data)] = data
    path = tmp / f"wrong{FILES[kind][0]}"
    path.write_bytes(damaged)
    rows_or_message(path)


def test_a_parquet_file_that_makes_polars_panic_is_reported_as_damaged(tmp_path, capfd):
    pl = pytest.importorskip("polars")
    path = tmp_path / "table.parquet"
    noise = np.random.default_rng(0).normal(size=1000)
    pl.DataFrame({"time": np.arange(1000.0), "mag_x": noise}).write_parquet(path)
    whole = path.read_bytes()
    # the footer with all offsets, without the values themselves
    end = 8 + int.from_bytes(whole[-8:-4], "little")
    with pytest.raises((pl.exceptions.PanicException, pl.exceptions.PolarsError)):
        pl.read_parquet(io.BytesIO(whole[:4] + whole[-end:]))
    capfd.readouterr()
    path.write_bytes(whole[:4] + whole[-end:])
    assert "is damaged; copy it again" in rows_or_message(path)[1]
    assert capfd.readouterr().err == ""


def test_a_parquet_file_that_would_abort_the_process_is_reported_as_damaged(tmp_path, capfd):
    pl = pytest.importorskip("polars")
    path = tmp_path / "table.parquet"
    pl.DataFrame({"time": np.arange(1000.0)}).write_parquet(path)
    damaged = bytearray(path.read_bytes())
    assert damaged[13:16] == b"\x15\xd0\x0f"  # 1000 values in the first page, twice that as a zigzag number
    damaged[14] |= 1  # as many below zero: more than the memory there is
    path.write_bytes(damaged)
    assert "is damaged; copy it again" in rows_or_message(path)[1]
    assert capfd.readouterr().err == ""


@pytest.mark.e2e
def test_an_hdf5_file_that_makes_its_library_loop_forever_is_reported_as_damaged(tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    monkeypatch.setattr(sandbox, "_PATIENCE", (4.0, 0.0))
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for name in ("time", "mag_x"):
            file.create_dataset(name, data=np.arange(20.0)).attrs["units"] = "s"
    assert rows_or_message(path)[0]
    damaged = bytearray(path.read_bytes())
    heap = damaged.index(b"GCOL")  # the heap of texts, each after its length: make the first refer to itself
    damaged[heap + 24 : heap + 32] = (2**64 - 16).to_bytes(8, "little")
    path.write_bytes(damaged)
    assert "is damaged; copy it again" in rows_or_message(path)[1]


def test_a_ulog_that_ends_within_an_unknown_message_does_not_loop_forever(tmp_path):
    pytest.importorskip("pyulog")
    path = tmp_path / "log.ulg"
    flags = b"\x28\x00B" + bytes(40)
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + flags + b"\x20\x00\x00" + b"\x01" * 5)
    assert "copy it again" in rows_or_message(path)[1]


MAGIC = {
    ".ulg": b"ULog\x01\x12\x35\x01",
    ".bin": b"\xa3\x95\x80",
    ".log": b"FMT, 128, 89, FMT, BBnNZ, ",
    ".mcap": b"\x89MCAP0\r\n",
    ".bag": b"#ROSBAG V2.0\n",
    ".db3": b"SQLite format 3\x00",
    ".mat": b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM",
    ".h5": b"\x89HDF\r\n\x1a\n",
    ".mf4": b"MDF     4.10    ",
}


@pytest.mark.e2e
@pytest.mark.parametrize("ending", MAGIC)
@few_examples
@given(rest=st.binary(max_size=400))
def test_random_bytes_after_valid_magic_numbers_give_rows_or_a_message(ending, tmp, rest):
    path = tmp / f"random{ending}"
    path.write_bytes(MAGIC[ending] + rest)
    rows_or_message(path)


@pytest.mark.parametrize("ending", [*MAGIC, ".hdf5", ".mdf", ".ulog"])
def test_an_empty_file_and_a_file_of_another_format_are_reported(ending, tmp):
    path = tmp / f"foreign{ending}"
    path.write_bytes(b"")
    assert "empty" in rows_or_message(path)[1]
    path.write_bytes(b"time,mag_x,mag_y,mag_z\n0,1,2,3\n")
    message = rows_or_message(path)[1]
    assert re.search(r"this is not an? ", message)
    assert "rename it to end in .csv" in message
    for other, magic in MAGIC.items():
        if {ending, other} & {".log"} or {ending, other} in ({".h5", ".hdf5"}, {".mdf", ".mf4"}, {".ulg", ".ulog"}):
            continue
        if other != ending and (ending, other) != (".mat", ".h5"):  # version 7.3 is HDF5
            path.write_bytes(magic + b"\0" * 700)
            message = rows_or_message(path)[1]
            assert f"rename it to end in {other}" in message, (ending, other, message)


def test_a_folder_without_a_bag_and_a_bag_without_its_files_are_reported(tmp_path):
    (tmp_path / "folder").mkdir()
    assert "this is a folder" in rows_or_message(tmp_path / "folder")[1]
    (tmp_path / "folder" / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [a.db3]}")
    assert "no file of messages" in rows_or_message(tmp_path / "folder")[1]


def test_a_bag_with_damaged_metadata_is_read_from_its_files(tmp_path):
    writers.rosbag2(tmp_path / "bag", GIVEN)
    (tmp_path / "bag" / "metadata.yaml").write_text("{[")
    topics, message = rows_or_message(tmp_path / "bag")
    assert len(topics[0].table.series[0]) == len(GIVEN.time)
    assert "metadata.yaml is damaged" in message


def test_the_loss_of_a_dataflash_log_is_counted(tmp_path):
    writers.dataflash(tmp_path / "log.bin", GIVEN)
    whole = (tmp_path / "log.bin").read_bytes()
    row = whole.rindex(b"\xa3\x95\x82")
    # a message without its header in the middle of the log, and eleven bytes of a message at its end
    middle = whole.index(b"\xa3\x95\x82", len(whole) // 2)
    damaged = whole[:middle] + b"\0\0" + whole[middle + 2 : row + 11]
    (tmp_path / "log.bin").write_bytes(damaged)
    topics, message = rows_or_message(tmp_path / "log.bin")
    mag = next(topic for topic in topics if topic.name == "MAG[0]")
    assert len(mag.table.series[0]) == len(GIVEN.time) - 2
    assert f"{24 + 11} of its {len(damaged)} bytes" in message.replace(",", "")
