"""Recordings of NumPy arrays and data frames equal those of a file with the same table."""

import re

import numpy as np
import pytest
import torch

from mkc_torch import EllipsoidFit, Recording, diagnose
from mkc_torch.recording import MissingColumnError, RecordingError
from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.recording import write_table
from mkc_torch.simulation import Magnetometer

pd = pytest.importorskip("pandas")
pl = pytest.importorskip("polars")

NAN = float("nan")
each_library = pytest.mark.parametrize("library", [pd, pl], ids=["pandas", "polars"])


def columns_of(recording):
    return {name: values.numpy() for name, values in recording.columns.items()}


def same_columns(recording, other):
    return recording.names == other.names and all(
        torch.equal(recording[name].nan_to_num(-9.0), other[name].nan_to_num(-9.0)) for name in recording.names
    )


def test_arrays_are_columns_and_are_copied():
    time, count = np.array([0.0, 0.1]), np.array([1, 2])
    recording = Recording({"time": time, "count": count, "on": np.array([True, False])})
    time[0] = 9.0
    assert recording["time"].tolist() == [0.0, 0.1]
    assert recording["count"].dtype == torch.float64
    assert recording["on"].tolist() == [1.0, 0.0]


@each_library
def test_series_are_columns(library):
    recording = Recording({"a": library.Series([1, None, 3]), "b": torch.ones(3)})
    assert recording["a"].isnan().tolist() == [False, True, False]


@each_library
def test_a_frame_becomes_a_recording(library):
    want, _ = simulated_recording()
    frame = library.DataFrame(columns_of(want))
    for got in (Recording(frame, name="r"), Recording.from_frame(frame, name="r")):
        assert same_columns(got, want)
        assert got.units == want.units
        assert (got.name, got.warnings) == ("r", ())
    points = got.finite().magnetometer()
    assert torch.equal(EllipsoidFit().fit(points).center_, EllipsoidFit().fit(want.finite().magnetometer()).center_)


@each_library
def test_a_frame_gives_the_recording_of_its_file(library, tmp_path):
    table = {
        "time": [0.0, 0.1, 0.2],
        "mx": [1, None, 3],
        "note": ["x", "y", None],
        "experiment": ["left", "right", "left"],
    }
    frame = library.DataFrame(table)
    pl.DataFrame(table).write_parquet(tmp_path / "r.parquet")
    want = Recording.read(tmp_path / "r.parquet", columns={"mag_x": "mx"})
    got = Recording.from_frame(frame, columns={"mag_x": "mx"}, name="r")
    assert same_columns(got, want)
    assert (got.labels, got.units, got.warnings) == (want.labels, want.units, want.warnings)
    (note,) = got.notes
    assert re.search(r"`note`.*left out", note)
    assert list(Recording(frame).experiments()) == ["left", "right"]


def test_missing_labels_are_nan():
    for dtype in ("string", "category", object):
        recording = Recording(pd.DataFrame({"experiment": pd.Series(["a", None, "b"], dtype=dtype), "x": [1, 2, 3]}))
        assert recording.labels["experiment"] == ("a", "b")
        assert recording["experiment"].isnan().tolist() == [False, True, False]


def test_units_and_names_are_those_after_renaming():
    frame = pd.DataFrame({"mx": [1.0, 2.0]})
    recording = Recording.from_frame(frame, columns={"mag_x": "mx"}, units={"mag_x": "G"})
    assert recording.units == {"mag_x": "µT"}
    assert recording["mag_x"].tolist() == [100.0, 200.0]
    assert Recording.from_frame(frame, columns={"mag_x": "mx"}, units={"mag_x": "LSB"}).units == {"mag_x": "LSB"}
    assert Recording(frame, units={"mx": "G"}, warnings=["w"]).warnings == ("w",)
    with pytest.raises(MissingColumnError, match="`--convert mx=G` names no column"):
        Recording.from_frame(frame, columns={"mag_x": "mx"}, units={"mx": "G"})
    with pytest.raises(MissingColumnError, match=r"no column `my`.*`mag_y`; the frame has `mx`"):
        Recording.from_frame(frame, columns={"mag_y": "my"})


def test_a_named_index_becomes_a_column():
    frame = pd.DataFrame({"time": [0.0, 0.1], "x": [1.0, 2.0]})
    assert Recording(frame.set_index("time")).names == ("time", "x")
    assert Recording(frame.set_index(pd.Index([5, 6], dtype="Int64", name="x"))).names == ("time", "x")
    assert Recording(frame.set_index(pd.Index([5, 6]))).names == ("time", "x")


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (
            pd.DataFrame({"time": pd.to_datetime(["2020-01-01"]), "x": [1.0]}),
            "column `time` .* times; .* seconds",
        ),
        (
            pl.DataFrame({"mag_x": ["a"], "x": [1.0]}),
            "r: expected column `mag_x` .* but got text, 'a'",
        ),
        (pd.DataFrame({"x": [1.0, "a"]}, dtype=object), "column `x` to hold real numbers"),
        (pd.DataFrame({"x": ["a"]}), "no column of the frame holds numbers; it has `x`"),
        (pd.DataFrame([[1.0]]), "names of a frame must be text but got 0; rename"),
        (pd.DataFrame([[1.0, 2.0]], columns=["a", "a"]), "names `a` more than once"),
        (pd.DataFrame({"a": np.empty(0)}), "the columns hold no samples"),
        (pl.DataFrame(), "no column"),
    ],
)
def test_frames_without_numbers_are_rejected(frame, message):
    with pytest.raises(RecordingError, match=message):
        Recording(frame, name="r")


def test_times_that_are_not_required_are_left_out():
    frame = pd.DataFrame({"x": [1.0], "written": pd.to_datetime(["2020-01-01"])})
    (warning,) = Recording(frame).warnings
    assert re.search(r"`written`.*left out", warning)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([1.0], "expected column `a` to be a real tensor but got list"),
        (np.ones((2, 2)), r"expected column `a` to have shape \(N,\) but got \(2, 2\)"),
        (pd.DataFrame({"a": [1.0]}), "expected column `a` to be a real tensor but got DataFrame"),
        (np.array(["x"]), r"Expected column `a` to hold real numbers but got text, 'x' say"),
        (np.array([1j]), "but got complex128"),
    ],
)
def test_columns_without_numbers_are_rejected(values, message):
    with pytest.raises(RecordingError, match=message):
        Recording({"a": values})


def test_an_object_that_is_not_a_frame_is_rejected():
    with pytest.raises(RecordingError, match="expected a DataFrame"):
        Recording.from_frame({"a": [1.0]})


def test_a_frame_is_written_as_a_recording(tmp_path):
    write_table(tmp_path / "r.csv", pd.DataFrame({"time": [0.0, 0.5], "x": [1, 2]}))
    assert Recording.read(tmp_path / "r.csv")["x"].tolist() == [1.0, 2.0]


def test_a_frame_instead_of_a_recording_is_rejected_with_advice():
    frame = pd.DataFrame({"time": [0.0, 0.1]})
    with pytest.raises(TypeError, match=r"but got a DataFrame; make one, Recording\(recording\)"):
        diagnose(Magnetometer(), frame)
