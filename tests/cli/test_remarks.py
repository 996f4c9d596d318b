import io

import pytest

pytest.importorskip("rich")
pytest.importorskip("typer")

import torch
from rich.console import Console

from mkc_torch import Recording
from mkc_torch.calibration import calibrate
from mkc_torch.cli.calibration_summary import SensorResult, show, show_sensors
from mkc_torch.cli.remarks import note_rows, warning_rows
from mkc_torch.recording.demonstration import simulated_recording


def printed(work):
    stream = io.StringIO()
    work(Console(file=stream, width=100, force_terminal=False))
    return stream.getvalue()


@pytest.fixture(scope="module")
def disturbed():
    """Return the calibration of a turning sensor that a magnet approaches for three seconds."""
    recording, _ = simulated_recording()
    field, time = recording.magnetometer().clone(), recording.time
    near = (time >= 48.8) & (time <= 51.8)
    field[near] += torch.tensor([30.0, -20.0, 25.0], dtype=field.dtype)
    axes = dict(zip(("mag_x", "mag_y", "mag_z"), field.unbind(-1), strict=True))
    return calibrate(Recording({"time": time, **axes}, name="p"))


def test_the_headline_states_a_disturbance(disturbed):
    lines = printed(lambda console: show(console, disturbed, [])).strip().splitlines()
    assert lines[0].startswith("p: Calibrated. Disturbed")
    assert "48.8 to 51.8 s" in " ".join(lines[:2])


def test_the_first_warning_is_shown_and_the_others_are_counted():
    rows = list(warning_rows([f"warning {number}" for number in range(30)], "report.html"))
    assert rows[0][1] == "warning 0"
    assert len(rows) == 5
    assert rows[-1][1] == "26 more; see report.html"


def test_notes_fill_five_lines_at_most():
    rows = list(note_rows([f"note {number}" for number in range(30)], "report.html", 80))
    assert rows[-1][1] == "26 more; see report.html"
    assert len(rows) == 5


def test_the_summary_of_three_sensors_is_short_and_starts_with_their_results(disturbed):
    results = [SensorResult(name, disturbed, [], ()) for name in ("mag0", "mag1", "mag2")]
    lines = printed(lambda console: show_sensors(console, "log", results)).strip().splitlines()
    assert lines[0] == "log: 3 magnetometers"
    assert lines[2].startswith("mag0")
    assert len(lines) < 40
