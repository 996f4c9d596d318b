import copy
import math
import os
import pickle
import re
import subprocess
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.recording.recording import MissingColumnError, Recording, RecordingError, write_table
from tests.shared_data import shared_data

pl = pytest.importorskip("polars")

NAN, INF = math.nan, math.inf


def column(*values):
    return torch.tensor(values, dtype=torch.float64)


def bitwise_equal(a, b):
    """Bitwise equal, except for the payload of NaNs."""
    a, b = torch.as_tensor(a, dtype=torch.float64), torch.as_tensor(b, dtype=torch.float64)
    return a.shape == b.shape and bool(((a == b) & (a.signbit() == b.signbit()) | a.isnan() & b.isnan()).all())


def write_file(tmp_path, text, name="rec.csv"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def read(tmp_path, text, name="rec.csv", **options):
    return Recording.read(write_file(tmp_path, text, name), **options)


# --- the class


def test_a_recording_has_its_columns_in_order_with_length_and_names():
    recording = Recording({"b": column(1, 2, 3), "a": column(4, 5, 6)}, name="run", warnings=["W."])
    assert recording.names == ("b", "a")
    assert list(recording.columns) == ["b", "a"]
    assert len(recording) == 3
    assert bitwise_equal(recording["a"], [4, 5, 6])
    assert "a" in recording
    assert "c" not in recording
    assert recording.name == "run"
    assert recording.warnings == ("W.",)
    assert repr(recording) == "Recording('run', 3 samples: b, a)"


@pytest.mark.parametrize("dtype", [torch.int64, torch.float32, torch.bool, torch.float16])
def test_columns_become_float64(dtype):
    recording = Recording({"a": torch.ones(2, dtype=dtype)})
    assert recording["a"].dtype == torch.float64
    assert bitwise_equal(recording["a"], [1, 1])


def test_columns_are_detached_copies():
    source = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    recording = Recording({"a": source})
    with torch.no_grad():
        source += 1
    assert bitwise_equal(recording["a"], [0, 0])
    assert not recording["a"].requires_grad


@pytest.mark.parametrize("attribute", ["name", "units", "warnings", "columns", "labels", "time", "other"])
def test_a_recording_cannot_be_assigned_to(attribute):
    with pytest.raises(AttributeError):
        setattr(Recording({"a": column(1)}), attribute, None)


@pytest.mark.parametrize("mapping", ["columns", "units", "labels"])
def test_the_mappings_of_a_recording_cannot_be_written(mapping):
    with pytest.raises(TypeError):
        getattr(Recording({"a": column(1)}), mapping)["a"] = "x"


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda r: pickle.loads(pickle.dumps(r))])
def test_a_recording_survives_pickling(clone):
    recording = Recording({"experiment": column(0)}, name="n", warnings=["W."], labels={"experiment": ["x"]})
    again = clone(recording)
    assert (again.name, again.warnings, again.labels, again.units) == ("n", ("W.",), recording.labels, recording.units)
    assert bitwise_equal(again["experiment"], [0])


def test_units_follow_from_names():
    units = {
        "time": "s",
        "mag_x": "µT",
        "field_z": "µT",
        "gyro_y": "rad/s",
        "accel_z": "m/s²",
        "temperature": "°C",
        "current": "A",
        "position_x": "m",
        "q_w": "1",
        "motor_1": "",
        "mag_status": "",
    }
    assert Recording({name: column(1) for name in units}).units == units


def test_given_units_override_default_units():
    recording = Recording({"mag_x": column(1), "temperature": column(300)}, units={"temperature": "K"})
    assert recording.units == {"mag_x": "µT", "temperature": "K"}


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({}, "at least one column"),
        ({"a": column(1), "b": column(1, 2)}, "differ in length: `a` 1, `b` 2"),
        ({"a": column()}, "no samples"),
        ({"a": torch.zeros(2, 2)}, r"shape \(N,\) but got \(2, 2\)"),
        ({"a": torch.tensor(1.0)}, r"shape \(N,\) but got \(\)"),
        ({"a": [1.0]}, "real tensor but got list"),
        ({"a": torch.zeros(2, dtype=torch.complex64)}, "real tensor but got a tensor of torch.complex64"),
        ({"": column(1)}, "cannot name a column"),
        ({" a": column(1)}, "cannot name a column"),
        ({"a\nb": column(1)}, "cannot name a column"),
    ],
)
def test_columns_that_do_not_form_a_table_are_rejected(columns, message):
    with pytest.raises(RecordingError, match=f"run: .*{message}"):
        Recording(columns, name="run")


@pytest.mark.parametrize("option", [{"units": {"b": "m"}}, {"labels": {"b": ["x"]}}])
def test_units_and_labels_of_absent_columns_are_refused(option):
    with pytest.raises(MissingColumnError, match="no column `b`; there are `a`"):
        Recording({"a": column(1)}, **option)


def test_stack_returns_columns_in_the_requested_order():
    recording = Recording({"a": column(1, 2), "b": column(3, 4)})
    assert bitwise_equal(recording.stack("b", "a"), [[3, 1], [4, 2]])


def test_stack_is_a_copy():
    recording = Recording({"a": column(1, 2)})
    recording.stack("a").zero_()
    assert bitwise_equal(recording["a"], [1, 2])


def test_stack_of_nothing_is_refused():
    with pytest.raises(ValueError, match="at least one column"):
        Recording({"a": column(1)}).stack()


def test_magnetometer_is_the_three_axes():
    recording = Recording({"mag_z": column(3), "time": column(0), "mag_y": column(2), "mag_x": column(1)})
    assert bitwise_equal(recording.magnetometer(), [[1, 2, 3]])


@pytest.mark.parametrize("use", [lambda r: r["mag_x"], lambda r: r.stack("t", "mag_x"), lambda r: r.magnetometer()])
def test_a_missing_column_error_lists_the_columns_and_how_to_rename(use):
    recording = Recording({"t": column(1), "mx": column(1)}, name="run")
    with pytest.raises(MissingColumnError, match=r"run: .*`mag_x`; there are `t`, `mx`.*`--columns mag_x=mx`"):
        use(recording)


def test_a_missing_column_error_is_a_value_error():
    assert issubclass(MissingColumnError, RecordingError)
    assert issubclass(RecordingError, ValueError)


def test_time_is_the_column_or_none():
    assert Recording({"a": column(1)}).time is None
    assert bitwise_equal(Recording({"time": column(1, 2)}).time, [1, 2])


# --- finite


def test_finite_drops_rows_and_counts_nan_and_infinite_per_column():
    recording = Recording(
        {"a": column(1, NAN, 3, INF, 5, NAN), "b": column(1, NAN, 3, 4, -INF, 6), "c": column(NAN, 1, 1, 1, 1, 1)},
        units={"a": "V"},
        name="run",
        warnings=["Before."],
    )
    kept = recording.finite("a", "b")
    assert bitwise_equal(kept.stack("a", "b"), [[1, 1], [3, 3]])
    assert bitwise_equal(kept["c"], [NAN, 1])
    assert kept.warnings[0] == "Before."
    assert re.search(r"4 of 6 samples.*not finite.*`a` 2 NaN, 1 infinite.*`b` 1 NaN, 1 infinite", kept.warnings[1])
    assert (kept.name, kept.units["a"]) == ("run", "V")


def test_finite_without_names_checks_every_column():
    assert len(Recording({"a": column(1, NAN, 1), "b": column(INF, 1, 1)}).finite()) == 1


def test_finite_has_no_warning_if_nothing_is_dropped():
    recording = Recording({"a": column(1, 2), "b": column(NAN, 1)})
    assert recording.finite("a").warnings == ()
    assert len(recording.finite("a")) == 2


def test_finite_refuses_to_leave_no_row():
    with pytest.raises(RecordingError, match=r"run: no sample .*`a`, `b`: `a` 1 NaN; `b` 1 infinite"):
        Recording({"a": column(NAN, 1), "b": column(1, INF)}, name="run").finite("a", "b")


def test_finite_counts_a_column_named_twice_once():
    kept = Recording({"a": column(1, NAN)}).finite("a", "a")
    (warning,) = kept.warnings
    assert re.search(r"1 of 2 samples.*not finite.*`a` 1 NaN", warning)
    assert warning.count("`a`") == 1


def test_finite_names_a_missing_column():
    with pytest.raises(MissingColumnError):
        Recording({"a": column(1)}).finite("b")


# --- sorted_by_time


def test_a_regular_recording_is_sorted_without_a_warning():
    recording = Recording({"time": torch.arange(10) / 10, "a": torch.arange(10)})
    again = recording.sorted_by_time()
    assert again.warnings == ()
    assert bitwise_equal(again.stack("time", "a"), recording.stack("time", "a"))


def test_unsorted_times_are_sorted_with_a_warning():
    recording = Recording({"time": column(0, 2, 1, 4, 3), "a": column(0, 20, 10, 40, 30)})
    again = recording.sorted_by_time()
    assert bitwise_equal(again["time"], [0, 1, 2, 3, 4])
    assert bitwise_equal(again["a"], [0, 10, 20, 30, 40])
    (warning,) = again.warnings
    assert re.search(r"backwards 2 times.*sorted by time", warning)
    assert bitwise_equal(recording["time"], [0, 2, 1, 4, 3])


def test_of_repeated_times_the_first_in_the_file_is_kept_and_the_others_counted():
    recording = Recording(
        {"time": column(2, 0, 1, 1, 2, 2), "a": column(5, 0, 1, 1, 6, 5), "b": column(NAN, 0, 0, 0, NAN, NAN)}
    )
    again = recording.sorted_by_time()
    assert bitwise_equal(again.stack("time", "a"), [[0, 0], [1, 1], [2, 5]])
    (warning,) = again.warnings[1:]
    assert re.search(r"3 of 6 samples.*repeat the time.*1 of them with other values", warning)


def test_times_that_are_not_finite_are_dropped_and_counted():
    recording = Recording({"time": column(0, NAN, 1, INF, 2), "a": column(0, 9, 1, 9, NAN)})
    again = recording.sorted_by_time()
    assert bitwise_equal(again.stack("time", "a"), [[0, 0], [1, 1], [2, NAN]])
    (warning,) = again.warnings
    assert re.search(r"2 of 5 samples.*finite time", warning)


def test_no_finite_time_at_all_is_an_error():
    with pytest.raises(RecordingError, match="run: no sample has a finite time"):
        Recording({"time": column(NAN, NAN)}, name="run").sorted_by_time()


def test_sorting_without_times_names_the_missing_column():
    with pytest.raises(MissingColumnError, match="no column `time`"):
        Recording({"a": column(1)}).sorted_by_time()


def test_gaps_of_more_than_ten_median_intervals_are_reported_with_place_and_length():
    again = Recording({"time": column(0, 1, 2, 3, 4, 5, 16, 17, 18, 43, 44)}).sorted_by_time()
    (note,) = again.notes
    assert re.search(r"2 gaps of more than 10 median intervals \(1 s\).*longest, 25 s, begins at 18 s", note)


def test_a_gap_of_ten_median_intervals_is_not_reported():
    assert Recording({"time": column(0, 1, 2, 12, 13)}).sorted_by_time().warnings == ()


@pytest.mark.parametrize("times", [[1.0], [0.0, 5.0], [3.0, 3.0]])
def test_very_short_recordings_have_no_gaps(times):
    again = Recording({"time": column(*times)}).sorted_by_time()
    assert not any("gap" in warning for warning in again.warnings)


def test_each_experiment_has_its_own_clock():
    recording = Recording(
        {"experiment": column(7, 7, 3, 3, 7, 3), "time": column(0, 1, 1, 2, 1, 3), "a": column(0, 1, 2, 3, 4, 5)}
    )
    again = recording.sorted_by_time()
    assert bitwise_equal(again["experiment"], [7, 7, 3, 3, 3])
    assert bitwise_equal(again["time"], [0, 1, 1, 2, 3])
    assert bitwise_equal(again["a"], [0, 1, 2, 3, 5])
    (warning,) = again.warnings
    assert re.search(r"1 of 6 samples.*repeat the time.*1 of them with other values", warning)


def test_a_gap_in_a_run_is_found_and_the_step_between_runs_is_not_a_gap():
    group, time = column(0, 0, 0, 1, 1, 1, 1, 1), column(0, 1, 2, 900, 901, 902, 903, 950)
    again = Recording({"experiment": group, "time": time}, labels={"experiment": ["up", "down"]}).sorted_by_time()
    (note,) = again.notes
    assert re.search(r"1 gap .*longest, 47 s, begins at 903 s in experiment down", note)


# --- experiments


def test_experiments_separate_a_table_by_label_and_drop_the_column():
    recording = Recording(
        {"experiment": column(1, 0, 1), "a": column(1, 2, 3)},
        name="table",
        units={"a": "V"},
        warnings=["W."],
        labels={"experiment": ["up", "down"]},
    )
    parts = recording.experiments()
    assert list(parts) == ["down", "up"]
    assert bitwise_equal(parts["down"]["a"], [1, 3])
    assert bitwise_equal(parts["up"]["a"], [2])
    assert parts["up"].names == ("a",)
    assert (parts["up"].name, parts["up"].units, parts["up"].warnings) == ("table/up", {"a": "V"}, ("W.",))


def test_experiments_without_labels_are_named_by_their_number():
    parts = Recording({"experiment": column(2, 2.5, NAN, 2, NAN), "a": column(1, 2, 3, 4, 5)}).experiments()
    assert {label: part["a"].tolist() for label, part in parts.items()} == {"2": [1, 4], "2.5": [2], "nan": [3, 5]}


def test_without_experiments_the_whole_table_is_the_only_run():
    recording = Recording({"a": column(1)}, name="run")
    assert recording.experiments() == {"run": recording}


# --- reading CSV


def test_a_csv_becomes_named_float64_columns(tmp_path):
    recording = read(tmp_path, "time,mag_x\n0,1\n1,-2.5e-3\n")
    assert recording.names == ("time", "mag_x")
    assert recording["time"].dtype == torch.float64
    assert bitwise_equal(recording.stack("time", "mag_x"), [[0, 1], [1, -2.5e-3]])
    assert recording.name == "rec"
    assert recording.warnings == ()


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("bom", ["", "\ufeff"])
def test_separator_line_ends_and_byte_order_mark_are_recognised(tmp_path, separator, end, bom):
    rows = [["time", " mag_x ", "mag_y"], ["0", " 1", "2 "], ["1", "3", "4"]]
    recording = read(tmp_path, bom + end.join(separator.join(row) for row in rows) + end)
    assert recording.names == ("time", "mag_x", "mag_y")
    assert bitwise_equal(recording.stack("time", "mag_x", "mag_y"), [[0, 1, 2], [1, 3, 4]])


@pytest.mark.parametrize("name", ["rec.CSV", "rec.tsv", "rec.txt"])
def test_text_tables_of_every_extension_are_read(tmp_path, name):
    assert read(tmp_path, "a\tb\n1\t2\n", name)["b"].tolist() == [2]


@pytest.mark.parametrize("cell", ["nan", "NaN", "NAN", "-nan", "", "  ", "NA", '""', "null"])
def test_missing_values_are_nan(tmp_path, cell):
    recording = read(tmp_path, f"time,mag_x\n0,{cell}\n1,2\n")
    assert bitwise_equal(recording["mag_x"], [NAN, 2])


def test_infinities_are_read(tmp_path):
    assert bitwise_equal(read(tmp_path, "a\ninf\n-inf\nInfinity\n")["a"], [INF, -INF, INF])


def test_a_column_of_missing_values_alone_is_kept(tmp_path):
    assert bitwise_equal(read(tmp_path, "a,b\n1,\n2,nan\n")["b"], [NAN, NAN])


def test_blank_lines_are_skipped(tmp_path):
    assert len(read(tmp_path, "\na,b\n\n1,2\n  \n3,4\n\n\n")) == 2


def test_quoted_names_and_values_may_hold_the_separator(tmp_path):
    recording = read(tmp_path, '"speed, left","b;c;d;e"\n"1","2"\n')
    assert recording.names == ("speed, left", "b;c;d;e")
    assert bitwise_equal(recording["b;c;d;e"], [2])


def test_a_column_without_a_name_is_left_out_with_a_warning(tmp_path):
    recording = read(tmp_path, ",a,\n0,1,\n1,2,\n")
    assert recording.names == ("a",)
    assert recording.notes == ("2 columns without a name left out.",)


def test_a_text_column_that_is_not_required_is_left_out_with_a_warning(tmp_path):
    recording = read(tmp_path, "time,phase,a\n0,up,1\n1,,2\n2,down,3\n")
    assert recording.names == ("time", "a")
    (note,) = recording.notes
    assert re.search(r"`phase`.*no numbers.*left out", note)


def test_text_among_experiments_is_numbered_and_labelled(tmp_path):
    recording = read(tmp_path, "experiment,a\nball/2,1\n7,2\nball/2,3\n")
    assert bitwise_equal(recording["experiment"], [0, 1, 0])
    assert recording.labels == {"experiment": ("ball/2", "7")}
    assert bitwise_equal(recording.experiments()["ball/2"]["a"], [1, 3])


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_labels_round_trip_through_a_file(tmp_path, ending):
    path = tmp_path / f"runs{ending}"
    write_table(path, {"experiment": column(0, 0, 1), "x": column(1, 2, 3)}, labels={"experiment": ["up", "down"]})
    again = Recording.read(path)
    assert again.labels == {"experiment": ("up", "down")}
    assert again["experiment"].tolist() == [0.0, 0.0, 1.0]


def test_a_renamed_column_can_be_the_experiment(tmp_path):
    recording = read(tmp_path, "run,a\nx,1\ny,2\n", columns={"experiment": "run"})
    assert recording.labels == {"experiment": ("x", "y")}


def test_columns_are_renamed(tmp_path):
    recording = read(tmp_path, "t,mx,other\n0,1,2\n", columns={"time": "t", "mag_x": "mx"})
    assert recording.names == ("time", "mag_x", "other")
    assert recording.units["mag_x"] == "µT"


def test_columns_can_be_swapped(tmp_path):
    recording = read(tmp_path, "mag_x,mag_y\n1,2\n", columns={"mag_x": "mag_y", "mag_y": "mag_x"})
    assert bitwise_equal(recording.stack("mag_x", "mag_y"), [[2, 1]])
    assert recording.warnings == ()


def test_a_renamed_column_replaces_the_files_column_with_a_warning(tmp_path):
    recording = read(tmp_path, "mag_x,mx\n1,2\n", columns={"mag_x": "mx"})
    assert bitwise_equal(recording["mag_x"], [2])
    (note,) = recording.notes
    assert re.search(r"`mag_x`.*left out.*`mx`", note)


def test_renaming_an_absent_column_lists_those_present(tmp_path):
    with pytest.raises(MissingColumnError, match=r"rec\.csv:.*`mx`.*`mag_x`; the file has `time`, `Bx`"):
        read(tmp_path, "time,Bx\n0,1\n", columns={"mag_x": "mx"})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("\n \n", "the file is empty"),
        ("\ufeff", "the file is empty"),
        ("time,mag_x\n", "a header line but no rows"),
        ("time,mag_x\n\n", "a header line but no rows"),
        ("0,1\n1,2\n", "first line holds numbers; it must hold the column names"),
        (",\n1,2\n", "no column has a name"),
        ("time,a,b,a,b\n0,1,2,3,4\n", "names `a`, `b` more than once"),
        ("time,a, a\n0,1,2\n", "names `a` more than once"),
        ("time,a\n0,1\n1\n2,3\n", "line 3 has 1 value but the header names 2 columns"),
        ("time,a\n0,1\n\n1,2,3\n", "line 4 has 3 values but the header names 2 columns"),
        ('time,a\n0,"1,5",2\n', "line 2 has 3 values"),
        ('time,a\n0,"1\n', "a header line but no rows"),
        ('time,a\n0,"1\n1,2\n', "line 2 has an unclosed quotation mark"),
        ("time,mag_x\n0,1\n\n1,abc\n2,def\n", 'column `mag_x` holds text at line 4, "abc"'),
        ("time,mag_x\n0,up\n1,down\n", 'column `mag_x` holds text at line 2, "up"'),
        ("time,a\nyesterday,1\n", 'column `time` holds text at line 2, "yesterday"; times are numbers, in seconds'),
        ("time,a\n0,1\n1,bad\n", 'column `a` holds text at line 3, "bad"; correct it, or write nan'),
        ("time;a\n0.5;1\n1;2,5\n", 'column `a` holds text at line 3, "2,5"; write decimals with a point'),
        ("a,b\nx,y\n", "no column holds numbers"),
        (b"\xff\xfet\x00i\x00", "a header line but no rows"),
        (b"time,a\n0,\x80\x81\n", "not UTF-8"),
    ],
)
def test_a_file_that_is_not_a_table_is_an_error_with_the_reason(tmp_path, text, message):
    with pytest.raises(RecordingError, match=rf"rec\.csv: .*{message}"):
        read(tmp_path, text)


def test_a_renamed_column_of_text_is_an_error(tmp_path):
    with pytest.raises(RecordingError, match='column `speed` holds text at line 2, "fast"'):
        read(tmp_path, "v,a\nfast,1\n", columns={"speed": "v"})


def test_an_absent_file_is_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"absent\.csv: there is no such file"):
        Recording.read(tmp_path / "absent.csv")


def test_a_folder_is_refused(tmp_path):
    (tmp_path / "run.csv").mkdir()
    with pytest.raises(RecordingError, match=r"run\.csv: this is a folder"):
        Recording.read(tmp_path / "run.csv")


@pytest.mark.parametrize(("name", "kind"), [("rec.xlsx", "files ending in .xlsx"), ("rec", "files without an ending")])
def test_an_unknown_extension_is_refused_with_the_known_extensions(tmp_path, name, kind):
    with pytest.raises(
        RecordingError, match=rf"{kind} are not known; .*; known endings: \.csv, \.tsv, \.txt, \.dat, \.asc, \.parquet"
    ):
        read(tmp_path, "a\n1\n", name)


# --- reading Parquet


def test_parquet_columns_of_any_number_type_become_float64(tmp_path):
    pl.DataFrame(
        {
            "time": pl.Series([0, 1, 2], dtype=pl.Int32),
            "mag_x": pl.Series([0.5, None, NAN], dtype=pl.Float32),
            "on": [True, False, None],
            "empty": [None, None, None],
            "phase": ["up", "down", None],
            "day": pl.Series(["2024-01-01"] * 3).str.to_date(),
        }
    ).write_parquet(tmp_path / "rec.parquet")
    recording = Recording.read(tmp_path / "rec.parquet")
    assert recording.names == ("time", "mag_x", "on", "empty")
    assert bitwise_equal(recording["mag_x"], [0.5, NAN, NAN])
    assert bitwise_equal(recording["on"], [1, 0, NAN])
    assert bitwise_equal(recording["empty"], [NAN, NAN, NAN])
    assert all(
        re.search(rf"`{name}`.*left out", note) for name, note in zip(("phase", "day"), recording.notes, strict=True)
    )


def test_parquet_columns_are_renamed(tmp_path):
    pl.DataFrame({"mx": [1.0]}).write_parquet(tmp_path / "rec.parquet")
    assert Recording.read(tmp_path / "rec.parquet", columns={"mag_x": "mx"}).names == ("mag_x",)


def test_a_parquet_file_name_is_not_expanded_as_a_pattern(tmp_path):
    write_table(tmp_path / "run[1].parquet", {"a": column(1)})
    assert bitwise_equal(Recording.read(tmp_path / "run[1].parquet")["a"], [1])


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"time": ["a", "b"]}, 'column `time` holds text at row 1, "a"'),
        ({"mag_x": [1.0]}, None),
        ({"a": []}, "no rows"),
    ],
)
def test_an_unusable_parquet_table_is_an_error_with_the_reason(tmp_path, columns, message):
    pl.DataFrame(columns).write_parquet(tmp_path / "rec.parquet")
    if message is None:
        assert Recording.read(tmp_path / "rec.parquet").names == ("mag_x",)
    else:
        with pytest.raises(RecordingError, match=rf"rec\.parquet: .*{message}"):
            Recording.read(tmp_path / "rec.parquet")


def test_a_file_that_only_claims_to_be_parquet_is_an_error(tmp_path):
    with pytest.raises(RecordingError, match=r"rec\.parquet: this is not a valid Parquet file"):
        read(tmp_path, "time,a\n0,1\n", "rec.parquet")


# --- the optional library


@pytest.mark.process
def test_the_module_imports_without_polars():
    code = "import sys; sys.modules['polars'] = None; import mkc_torch.recording.recording"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_reading_without_polars_names_the_extra_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(ImportError, match=r'pip install "mkc-torch\[cli\]"'):
        read(tmp_path, "a\n1\n")


def test_writing_a_csv_does_not_need_polars(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "polars", None)
    write_table(tmp_path / "a.csv", {"a": column(1)})
    assert (tmp_path / "a.csv").read_text() == "a\n1.0\n"


# --- writing

EXTREMES = [0.0, -0.0, 0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -2.2250738585072014e-308, NAN, INF, -INF, 2.0**53]


@pytest.mark.parametrize("name", ["a.csv", "a.tsv", "a.txt", "a.parquet"])
def test_a_written_table_is_read_back_to_the_bit(tmp_path, name):
    columns = {"time": torch.arange(len(EXTREMES)), "mag_x": column(*EXTREMES), "b;c": column(*EXTREMES[::-1])}
    write_table(tmp_path / name, columns)
    again = Recording.read(tmp_path / name)
    assert again.names == tuple(columns)
    assert all(bitwise_equal(again[key], values) for key, values in columns.items())


NAMES = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cf", "Z"]), min_size=1, max_size=8)


@settings(derandomize=True, deadline=None, max_examples=25)
@given(data=st.data(), names=st.lists(NAMES, unique=True, max_size=3), rows=st.integers(1, 6))
def test_any_table_is_read_back_to_the_bit(tmp_path_factory, data, names, rows):
    values = st.lists(st.floats(), min_size=rows, max_size=rows)
    columns = {name: column(*data.draw(values)) for name in ["mag_x", *names]}
    path = tmp_path_factory.mktemp("table") / "a.csv"
    write_table(path, columns)
    again = Recording.read(path)
    assert again.names == tuple(columns)
    assert all(bitwise_equal(again[key], values) for key, values in columns.items())


def test_an_existing_table_is_replaced_only_on_demand(tmp_path):
    path = tmp_path / "a.csv"
    write_table(path, {"a": column(1)})
    with pytest.raises(FileExistsError, match="--force"):
        write_table(path, {"a": column(2)})
    assert bitwise_equal(Recording.read(path)["a"], [1])
    write_table(path, {"a": column(2)}, overwrite=True)
    assert bitwise_equal(Recording.read(path)["a"], [2])


def test_a_failed_write_leaves_no_file(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        write_table(tmp_path / "a.csv", {"a": column(1)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "columns", "message"),
    [
        ("a.xlsx", {"a": column(1)}, r"known endings: \.csv"),
        ("a.csv", {"a": column(1), "b": column(1, 2)}, "differ in length"),
        ("a.csv", {"1": column(1)}, "column names `1` are all numbers"),
        ("a.csv", {}, "at least one column"),
    ],
)
def test_tables_that_could_not_be_read_back_are_refused(tmp_path, name, columns, message):
    with pytest.raises(RecordingError, match=message):
        write_table(tmp_path / name, columns)
    assert list(tmp_path.iterdir()) == []


# --- real recordings


@pytest.mark.parametrize(
    ("name", "samples", "columns", "first"),
    [
        ("broad_02_undisturbed", 11447, 17, [0.554, 15.404, -40.458]),
        ("broad_21_undisturbed_fast", 11928, 17, [-0.632, 15.556, -42.705]),
        ("broad_28_stationary_magnet", 11020, 17, [14.348, 14.948, -67.417]),
        ("broad_34_attached_magnet_3cm", 9077, 17, [-2.567, 15.031, -26.496]),
        ("broad_36_attached_magnet_5cm", 8738, 17, [-0.915, 14.432, -46.161]),
        ("full_sphere", 8190, 8, [24.1284, -33.7615, -38.8991]),
        ("quadrotor_compass1", 2219, 21, [31.4, -11.4, -79.9]),
        ("quadrotor_compass3", 2219, 21, [69.2, 21.2, -13.8]),
        ("raw_counts", 22745, 4, [6202, 682, 4812]),
    ],
)
def test_real_magnetometer_recordings_are_read_whole(name, samples, columns, first):
    recording = Recording.read(shared_data(f"magnetometer/{name}.csv"))
    assert (recording.name, len(recording), len(recording.names)) == (name, samples, columns)
    assert bitwise_equal(recording.magnetometer()[0], first)
    assert recording.warnings == ()
    in_order = recording.finite().sorted_by_time()
    assert (in_order.time.diff() > 0).all()
    dropped = samples - len(in_order)
    sentences = (*in_order.notes, *in_order.warnings)
    assert dropped == 0 or any(f"Dropped {dropped} of {samples}" in sentence for sentence in sentences)


def test_a_real_table_of_several_runs_is_separated_by_its_labels():
    table = Recording.read(shared_data("dynamics/falling_balls/ball_drops.csv"))
    parts = table.sorted_by_time().experiments()
    assert sum(map(len, parts.values())) == len(table)
    assert "Baseball/1" in parts
    assert all((part.time.diff() > 0).all() for part in parts.values())


@pytest.mark.parametrize("word", ["n/a", "NA", " null "])
def test_words_for_a_missing_value_are_reported(tmp_path, word):
    recording = read(tmp_path, f"time,a\n0,1\n1,{word}\n2,\n3,nan\n4,{word}\n")
    assert bitwise_equal(recording["a"], [1, NAN, NAN, NAN, NAN])
    (warning,) = recording.notes
    assert re.search(rf'`a` holds "{word.strip()}".* 2 times, first at line 3.*missing value', warning)


def test_a_datetime_column_is_read_as_time(tmp_path):
    path = tmp_path / "a.parquet"
    frame = pl.DataFrame({"time": [10, 250_010], "a": [1.0, 2.0]})
    frame.with_columns(pl.col("time").cast(pl.Datetime("us"))).write_parquet(path)
    assert bitwise_equal(Recording.read(path).time, [0.0, 0.25])


def test_a_datetime_column_is_refused_as_field(tmp_path):
    path = tmp_path / "a.parquet"
    frame = pl.DataFrame({"mag_x": [0, 1], "a": [1.0, 2.0]})
    frame.with_columns(pl.col("mag_x").cast(pl.Datetime)).write_parquet(path)
    with pytest.raises(RecordingError, match="column `mag_x` holds no number at row 1"):
        Recording.read(path)


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"mag_z": [math.nan] * 3}, "The axis z of the magnetometer is dead.*record again.*--columns mag_z=COLUMN"),
        ({"mag_y": [math.inf] * 3, "mag_z": [math.nan] * 3}, "axes y, z of the magnetometer are dead"),
        ({"mag_y": [1, math.nan, math.nan], "mag_z": [math.nan, 1, 1]}, "resample them to common times"),
    ],
)
def test_an_axis_without_values_has_advice(columns, words):
    axes = {name: torch.tensor(columns.get(name, [1.0, 2.0, 3.0])) for name in ("mag_x", "mag_y", "mag_z")}
    with pytest.raises(RecordingError, match=words):
        Recording(axes).finite("mag_x", "mag_y", "mag_z")
