"""The same samples in every dialect of text give the same recording, to the last digit."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.recording.recording import Recording, write_table
from tests.recording.dialects import FIELD, MICROTESLA, NAMES, SECONDS, TIME, TIMES, UNITS, Dialect

pytest.importorskip("polars")


def read(folder, dialect, name="rec.csv", **options):
    path = folder / name
    path.write_bytes(dialect.bytes())
    return Recording.read(path, **options)


def assert_same(recording):
    assert np.array_equal(recording.time.numpy(), SECONDS), np.abs(recording.time.numpy() - SECONDS).max()
    assert np.array_equal(recording.magnetometer().numpy(), MICROTESLA)
    assert recording.units["mag_x"] == "µT"


@st.composite
def dialects(draw):
    separator = draw(st.sampled_from([",", ";", "\t", "|", " "]))
    unit_in = draw(st.sampled_from(["none", "brackets", "parentheses", "suffix", "row"]))
    time = draw(st.sampled_from([choice for choice in TIMES if separator != " " or choice != "iso blank"]))
    names = draw(st.sampled_from([choice for choice in NAMES if separator != " " or " " not in choice]))
    if names == "magnetometer[{}]" and unit_in == "suffix":
        unit_in = "brackets"
    encoding = draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"]))
    return Dialect(
        separator=separator,
        comma=separator != "," and draw(st.booleans()),
        names=names,
        unit=draw(st.sampled_from(list(UNITS))) if unit_in != "none" else "",
        unit_in=unit_in,
        time=time,
        time_unit=time in ("ms", "us", "ns") or draw(st.booleans()),
        end=draw(st.sampled_from(["\n", "\r\n", "\r"])),
        encoding=encoding,
        comments=draw(st.integers(0, 3)),
        mark=draw(st.sampled_from(["#", "%", "//", ";"])),
        among=draw(st.booleans()),
        above=draw(st.integers(0, 2)),
        cut=draw(st.booleans()),
        zeros=draw(st.sampled_from([0, 0, 1, 700])) if not encoding.startswith("utf-16") else 0,
        header_again=draw(st.booleans()),
        quoted=draw(st.booleans()) and separator != " ",
        trailing=draw(st.booleans()) and separator != " ",
    )


@settings(derandomize=True, deadline=None, max_examples=100)
@given(dialect=dialects())
def test_every_dialect_gives_the_same_recording_to_the_last_digit(tmp_path_factory, dialect):
    assert_same(read(tmp_path_factory.mktemp("d"), dialect))


PLAIN = Dialect()
KINDS = {
    "plain": PLAIN,
    "semicolons and commas": Dialect(separator=";", comma=True, unit="uT", unit_in="brackets"),
    "blanks": Dialect(separator=" ", comments=3),
    "units in a row": Dialect(unit="gauss", unit_in="row", separator="\t"),
    "suffix": Dialect(unit="nT", unit_in="suffix", time="us", time_unit=True),
    "iso": Dialect(time="iso zone"),
    "epoch": Dialect(time="epoch ns"),
    "restarted logger": Dialect(header_again=True, cut=True, zeros=100, above=2),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_dialect_gives_the_same_calibration_to_the_last_digit(tmp_path, kind):
    columns = {"time": torch.from_numpy(SECONDS)}
    columns |= {f"mag_{axis}": torch.from_numpy(MICROTESLA[:, k]) for k, axis in enumerate("xyz")}
    expected, found = calibrate(Recording(columns)), calibrate(read(tmp_path, KINDS[kind]))
    assert (found.center, found.center_se, found.matrix) == (expected.center, expected.center_se, expected.matrix)


def test_a_parquet_file_of_the_same_samples_gives_the_same_recording(tmp_path):
    columns = {"timestamp": TIME * 100_000} | {f"mag{axis} [uT]": MICROTESLA[:, k] for k, axis in enumerate("XYZ")}
    write_table(tmp_path / "rec.parquet", columns)
    assert_same(Recording.read(tmp_path / "rec.parquet", units={"time": "ns"}))


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"plain"}))
def test_warnings_report_what_was_done(tmp_path, kind):
    assert read(tmp_path, KINDS[kind]).notes


def test_a_clean_table_is_read_without_a_warning(tmp_path):
    assert read(tmp_path, PLAIN).warnings == ()


def test_a_requested_unit_overrides_the_name(tmp_path):
    recording = read(tmp_path, Dialect(unit="gauss", unit_in="brackets"), units={"mag": "uT"})
    assert np.array_equal(recording.magnetometer().numpy(), FIELD / 1e6)


def test_every_skipped_line_is_reported_with_its_number(tmp_path):
    warnings = " ".join(read(tmp_path, Dialect(comments=2, above=1, among=True, header_again=True, cut=True)).notes)
    for words in (
        '3 comment lines skipped, the first line 1, "# recorded by a logger, 0"',
        '1 line above the first row skipped, the first line 3, "Logger v1.3"',
        "The header is repeated in line",
        '1 line of text before it skipped, the first line 56, "Logger v1.3"',
        "The last line is cut short and left out, line 68",
    ):
        assert words in warnings, warnings
