"""Text that is not a recording: each kind is rejected with a message that names the file and the remedy."""

import re

import pytest

pytest.importorskip("polars")
pytest.importorskip("typer")

from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from mkc_torch.cli.app import app
from mkc_torch.cli.recorded import read_magnetometer
from mkc_torch.recording.inspection import inspect_file
from mkc_torch.recording.recording import Recording, RecordingError
from tests.recording.dialects import Dialect

ROWS = "".join(f"{i / 50},{30 * (i % 3) - 20},{25 * (i % 5) - 40},{20 * (i % 7) - 50}\n" for i in range(30))
HEAD = "time,mag_x,mag_y,mag_z\n"
GOOD = HEAD + ROWS


def with_line(line, text):
    """The good table with another text in a line, from 1."""
    lines = GOOD.splitlines()
    lines[line - 1] = text
    return "\n".join(lines) + "\n"


BAD = {
    # nothing there, or nothing of a table
    "empty": ("", "the file is empty"),
    "blank": ("\n \n\t\n", "the file is empty"),
    "mark alone": ("\ufeff", "the file is empty"),
    "zero bytes": (b"\0" * 4096, "the file is empty"),
    "comments alone": ("# a\n# b\n", "no rows of numbers"),
    "a header alone": (HEAD, "a header line but no rows of numbers"),
    "a header twice": (HEAD + HEAD, "no rows of numbers"),
    "a header and units": (HEAD + "s,uT,uT,uT\n", "no rows of numbers"),
    "one row that is cut": (HEAD + "0,1,2\n", "no rows of numbers.*cut short.*line 2"),
    "prose": ("Once upon a time there was\na sensor, in a box.\n", "no column holds numbers|header names|no rows"),
    "binary": (bytes(range(256)) * 16, "not text|not UTF-8"),
    "an archive": (
        b"PK\x03\x04\x14\x00\x06\x00\x08\x00" + bytes(range(64)) * 9,
        "begins like a ZIP archive; unpack it first",
    ),
    "an encoding that is not known": (
        b"time,mag_x\n0,\x81one\x94\n",
        "line 2 holds the byte 0x81; export it as CSV in UTF-8",
    ),
    "broken UTF-16": (b"\xff\xfe" + "time\n".encode("utf-16-le") + b"\x00\xdc" * 4, "begins as UTF-16.*byte 10.*UTF-8"),
    # the header
    "no header": (ROWS, "the first line holds numbers; it must hold the column names"),
    "names of nothing": (",,,\n" + ROWS, "no column has a name"),
    "a name twice": ("time,mag_x,mag_x,mag_z\n" + ROWS, "names `mag_x` more than once"),
    "a name too few": ("time,mag_x,mag_y\n" + ROWS, "line 2 has 4 values but the header names 3 columns"),
    "a name too many": (HEAD.strip() + ",extra,more\n" + ROWS, "line 2 has 4 values but the header names 6 columns"),
    "an HTML page": (
        "<html>\n<body>\n<p>404</p>\n</body>\n</html>\n",
        "no column holds numbers|header|no rows|no magn",
    ),
    "JSON": ('{"time": [0, 1],\n "mag_x": [1, 2]}\n', "no column|header|rows|no magnetometer|quotation"),
    # rows
    "a row too long": (with_line(9, "0.14,1,2,3,4"), "line 9 has 5 values but the header names 4 columns"),
    "a row too short": (
        with_line(9, "0.14,1,2"),
        "line 9 has 3 values but the header names 4 columns.*remove that line",
    ),
    "the last row too long": (GOOD + "0.7,1,2,3,4\n", "line 32 has 5 values"),
    "text between rows": (with_line(9, "sensor lost"), "line 9 has 1 value but the header names 4 columns"),
    "text in a number": (with_line(9, "0.14,1,two,3"), 'column `mag_y` holds text at line 9, "two"; correct it'),
    "two numbers in a cell": (with_line(9, "0.14,1,2 5,3"), 'column `mag_y` holds text at line 9, "2 5"'),
    "two points": (with_line(9, "0.14,1,2.3.4,3"), 'column `mag_y` holds text at line 9, "2.3.4"'),
    "underscores": (with_line(9, "0.14,1,2_000,3"), 'column `mag_y` holds text at line 9, "2_000"'),
    "hexadecimal": (with_line(9, "0.14,1,0x1F,3"), 'column `mag_y` holds text at line 9, "0x1F"'),
    "a unit in a cell": (with_line(9, "0.14,1,2 uT,3"), 'column `mag_y` holds text at line 9, "2 uT"'),
    "a quotation that does not end": (with_line(9, '0.14,1,"2,3'), "line 9 has an unclosed quotation mark"),
    "another header": (with_line(9, "time,gyro_x,gyro_y,gyro_z"), "line 9 holds words and no numbers.*split the file"),
    "decimals both ways": ("time;mag_x;mag_y;mag_z\n0.5;1,5;2;3\n1.5;2;2;3\n", '"1,5"; write decimals with a point'),
    "decimal commas between commas": (HEAD + "0,0,1,5,2,5,3,5\n" * 5, "has 8 values.*export the table with semicolons"),
    "thousands or decimals": (
        "time;mag_x;mag_y;mag_z\n" + "".join(f"{i};1,{200 + i};2,{300 + i};3,400\n" for i in range(9)),
        "may mark decimals or thousands; write decimals with a point",
    ),
    # time
    "a day as people write it": (with_line(2, "3 May,1,2,3"), 'column `time` holds text at line 2, "3 May"'),
    "an impossible day": (
        HEAD + "2024-02-30T10:00:00,1,2,3\n2024-02-30T10:00:01,1,2,3\n",
        'column `time` holds text at line 2, "2024-02-30T10:00:00"; write times as seconds, or as',
    ),
    "an impossible hour": (HEAD + "2024-02-03T31:00:00,1,2,3\n", "write times as seconds, or as 2024-05-03T10"),
    "zones and none": (
        HEAD + "2024-02-03T10:00:00Z,1,2,3\n2024-02-03T10:00:01,1,2,3\n",
        "line 3.*write all stamps with a zone",
    ),
    "stamps and numbers": (HEAD + "2024-02-03T10:00:00,1,2,3\n1.0,1,2,3\n", 'holds text at line 3, "1.0"'),
    "an impossible time of day": (HEAD + "10:00:00,1,2,3\n10:99:00,1,2,3\n", "line 3.*or as 10:00:00.25"),
    # columns
    "no magnetometer": (
        "time,speed\n0,1\n1,2\n",
        "no magnetometer is recognised among `time`, `speed`; it needs three columns",
    ),
    "a counter of runs is no axis": (
        "run,time,angle,torque\n1,0,1,2\n1,1,3,4\n",
        "no magnetometer is recognised among `run`, `time`, `angle`, `torque`; it needs three columns",
    ),
    "three that may be one": (
        "time,ux,uy,uz\n0,1,2,3\n1,2,3,4\n",
        "no magnetometer is recognised.*`--columns mag_x=ux,mag_y=uy,mag_z=uz`",
    ),
    "two that may be it": (
        "mag_raw_x,mag_raw_y,mag_raw_z,mag_cal_x,mag_cal_y,mag_cal_z\n1,2,3,4,5,6\n",
        "choose: `--columns mag_x=mag_raw_x,.*` or `--columns mag_x=mag_cal_x,",
    ),
    "two sensors": ("mag0_x,mag0_y,mag0_z,mag1_x,mag1_y,mag1_z\n1,2,3,4,5,6\n", "`mag0`, `mag1`; choose one with"),
    "a field in gauss": (
        "mag_x,mag_y,mag_z\n" + "0.3,0.2,0.3\n0.3,-0.2,0.3\n0.3,0.2,-0.3\n" * 9,
        "in gauss .* it would be.*`--convert mag=gauss`",
    ),
    "axes in different units": ("magX [uT],magY [counts],magZ [uT]\n1,2,3\n", "different units, counts, µT"),
    "no axis z": ("mag_x,mag_y\n1,2\n3,4\n", "there is no column `mag_z`"),
    "text alone": ("mag_x,mag_y,mag_z\na,b,c\n", 'column `mag_x` holds text at line 2, "a"'),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_text_is_rejected_with_the_reason(tmp_path, kind):
    content, message = BAD[kind]
    path = tmp_path / "bad.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(RecordingError) as refusal:
        read_magnetometer(path, {}, {}, None)[0].magnetometer()
    sentence = str(refusal.value)
    assert sentence.startswith((str(path), "bad: "))
    assert "\n" not in sentence
    assert not re.search(r"\b(?<!write )nan\b", sentence)
    assert re.search(message, sentence), sentence


def test_bad_texts_are_many_and_their_messages_differ():
    assert len(BAD) >= 50
    assert len({message for _, message in BAD.values()}) > 35


@pytest.mark.parametrize("kind", ["a row too short", "two sensors", "binary", "zones and none", "two that may be it"])
@pytest.mark.parametrize("command", ["calibrate", "inspect"])
def test_commands_report_bad_text_without_a_traceback_and_write_nothing(tmp_path, kind, command):
    content, _ = BAD[kind]
    path = tmp_path / "bad.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    output = ["--output", str(tmp_path / "out")] if command == "calibrate" else []
    result = CliRunner().invoke(app, [command, str(path), *output])
    assert "Traceback" not in result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    if command == "calibrate":
        assert result.exit_code == 1
        assert not list(tmp_path.rglob("calibration.json"))
    assert [found_file.name for found_file in tmp_path.iterdir() if found_file.name != "out"] == ["bad.csv"]


SOURCES = (
    Dialect(),
    Dialect(separator=";", comma=True, unit="uT", unit_in="brackets", comments=2, time="iso zone"),
    Dialect(separator=" ", time="epoch ns", header_again=True, above=2, cut=True),
    Dialect(encoding="utf-16", separator="\t"),
)
PIECES = [b",", b";", b'"', b"\n", b"\r", b"\0", b"nan", b"-", b"1e999", b"9" * 25, b"#", b"%", b" ", b"\t", b"|",
          b"time", b"mag_x", b"\xff", b"\xb5", b"2024-13-01", b"25:00", b"[uT]", b"]", b"experiment", b"inf", b"\x1a",
          b".", b"T"]  # fmt: skip


@settings(derandomize=True, deadline=None, max_examples=150)
@given(
    source=st.sampled_from(SOURCES),
    length=st.sampled_from([60, 150, 400, 4000]),
    changes=st.lists(st.tuples(st.integers(0, 400), st.sampled_from(PIECES), st.integers(0, 40)), max_size=10),
)
def test_damaged_text_is_read_or_refused(tmp_path_factory, source, length, changes):
    data = bytearray(source.bytes()[:length])
    for place, piece, gone in changes:
        data[place : place + gone] = piece
    path = tmp_path_factory.mktemp("damaged") / "rec.csv"
    path.write_bytes(bytes(data))
    for look in (Recording.read, inspect_file):
        assert _message_or_name(look, path).startswith((str(path), "rec: "))


def _message_or_name(look, path):
    """The error message if a file is rejected; its name if it is read."""
    try:
        look(path)
    except RecordingError as error:
        return str(error)
    return str(path)
