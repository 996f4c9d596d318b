"""A long table of plain numbers is read as the general reader reads it, and every other table by the general reader."""

import numpy as np
import pytest

pytest.importorskip("polars")

from mkc_torch.recording.formats import csv, plain_table
from mkc_torch.recording.formats.text_layout import layout_of

ROWS = 3000


def text(separator=",", end="\n", header="time,mag_x,mag_y", cells=None):
    draw = np.random.default_rng(0)
    rows = [[repr(0.01 * k), *(f"{value:.6f}" for value in draw.normal(size=2))] for k in range(ROWS)]
    for (row, column), cell in (cells or {}).items():
        rows[row][column] = cell
    lines = [header.replace(",", separator), *(separator.join(row) for row in rows)]
    return end.join([*lines, ""])


@pytest.fixture(autouse=True)
def _long(monkeypatch):
    monkeypatch.setattr(plain_table, "_LONG", 1000)


def both(path, monkeypatch):
    """The topics by both ways."""
    quick = csv.topic(path)
    monkeypatch.setattr(csv, "plain_table", lambda *_: None)
    return quick, csv.topic(path)


def assert_equal(quick, slow):
    assert quick.table.names == slow.table.names
    assert all(a.equals(b) for a, b in zip(quick.table.series, slow.table.series, strict=True))
    assert list(quick.table.lines) == list(slow.table.lines)
    assert (quick.units, quick.warnings, quick.restarts) == (slow.units, slow.warnings, slow.restarts)


@pytest.mark.parametrize(
    "content",
    [
        text(),
        text().rstrip("\n"),
        text(";"),
        text("\t", "\r\n"),
        "\ufeff" + text(),
        text(header="time [s],mag_x [nT],mag_y [nT]"),
        text(header="time,mag_x,mag_y\ns,uT,uT"),
        "# a comment\n" + text(),
        text(cells={(1500, 1): "nan", (1501, 2): "", (1502, 1): "-1.5e-7"}),
        text()[:-5],  # cut off within the last number
    ],
)
def test_plain_tables_are_read_at_once(tmp_path, monkeypatch, content):
    path = tmp_path / "a.csv"
    path.write_bytes(content.encode())
    assert plain_table.plain_table(path, layout_of) is not None
    assert_equal(*both(path, monkeypatch))


@pytest.mark.parametrize(
    "content",
    [
        text(cells={(1500, 1): "1.5 uT"}),
        text(cells={(1500, 1): "5a"}),
        text(cells={(1500, 1): '"1.5"'}),
        text(cells={(1500, 1): "1.5\ntime,mag_x,mag_y\n0,1"}),
        text(cells={(1500, 1): "\0"}),
        text(cells={(1500, 0): "\n1"}),
        text(";", cells={(1500, 1): "1,5"}),
    ],
)
def test_other_tables_are_left_to_the_general_reader(tmp_path, content):
    path = tmp_path / "a.csv"
    path.write_bytes(content.encode())
    assert plain_table.plain_table(path, layout_of) is None


def test_a_line_of_another_length_in_the_middle_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text(cells={(1500, 1): "1,2"}))
    with pytest.raises(csv.RecordingError, match="line 1502 has 4 values"):
        csv.topic(path)
