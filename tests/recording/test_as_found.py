"""Files as loggers leave them: without a header, with a truncated end, in units that the format implies."""

import pytest
import torch

pytest.importorskip("polars")

from mkc_torch import Recording
from mkc_torch.recording.formats.base import RecordingError, UsualUnit
from mkc_torch.recording.formats.dataflash_messages import MessageFormat, units_of
from mkc_torch.recording.formats.px4_units import px4_units

ROWS = [f"{20.0 + k:.1f},{-3.0 + k:.1f},{40.0 - k:.1f}" for k in range(30)]


def read(tmp_path, lines, name="log.txt"):
    path = tmp_path / name
    path.write_text("\n".join(lines))
    return Recording.read(path)


@pytest.mark.parametrize("separator", [",", "\t", " ", ";"])
def test_three_columns_without_a_header_are_x_y_z(tmp_path, separator):
    recording = read(tmp_path, [row.replace(",", separator) for row in ROWS])
    assert recording.names == ("mag_x", "mag_y", "mag_z")
    assert recording["mag_z"].tolist() == [40.0 - k for k in range(30)]
    assert any("no header" in note for note in recording.notes)
    assert recording.warnings == ()


def test_four_columns_without_a_header_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="column names"):
        read(tmp_path, [f"{k},{row}" for k, row in enumerate(ROWS)])


def test_a_header_of_three_names_is_kept(tmp_path):
    assert read(tmp_path, ["u,v,w", *ROWS]).names == ("u", "v", "w")


@pytest.mark.parametrize("end", [["21.0,3"], ["21.0,3", "4"], ["21.0,3", "4", "5.0,6"]])
@pytest.mark.parametrize("header", [[], ["mag_x,mag_y,mag_z"]])
def test_truncated_lines_at_the_end_are_reported_and_left_out(tmp_path, end, header):
    recording = read(tmp_path, [*header, *ROWS, *end])
    assert len(recording) == len(ROWS)
    assert any("cut short and left out" in note for note in recording.notes)


def test_text_after_the_last_row_is_refused(tmp_path):
    with pytest.raises(RecordingError):
        read(tmp_path, ["mag_x,mag_y,mag_z", *ROWS, "the end", "of it"])


def test_a_unit_implied_by_the_format_is_distinguished_from_a_unit_in_the_file():
    mag = MessageFormat("MAG", "Qh", ("TimeUS", "MagX"), 13)
    implied, stated = units_of(mag, "", "", {}, {}), units_of(mag, "sG", "FC", {"s": "s", "G": "Gauss"}, {"C": 1e-3})
    assert isinstance(implied["MagX"], UsualUnit)
    assert not isinstance(stated["MagX"], UsualUnit)
    assert isinstance(px4_units("sensor_mag", ["x"])["x"], UsualUnit)


def test_the_error_for_a_missing_column_suggests_the_most_similar_column():
    with pytest.raises(ValueError, match="--columns voltage=Voltage_V"):
        Recording({"time": torch.zeros(3), "Voltage_V": torch.zeros(3)})["voltage"]
