"""Progress on a terminal, with worker processes, in a pipe and in a file."""

import os
import re
import subprocess
import sys
import threading

import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")

from mkc_torch.cli import console
from mkc_torch.cli.console import drawing, progress
from tests.calibration.test_calibrate import noisy_ellipsoid
from tests.cli.test_cli import table
from tests.started import started

posix = pytest.mark.skipif(os.name == "nt", reason="there are no pseudo-terminals")


def on_a_terminal(*arguments):
    """Return the exit code, and the output to a terminal of 100 columns."""
    ours, theirs = os.openpty()
    environment = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "CI")}
    environment |= {"TERM": "xterm-256color", "COLUMNS": "100", "PYTHONIOENCODING": "utf-8"}
    command = ("-m", "mkc_torch.cli", *arguments)
    with started(*command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        seen = b""
        while True:
            try:
                part = os.read(ours, 1 << 16)
            except OSError:  # the other end is closed
                break
            if not part:
                break
            seen += part
        os.close(ours)
        return process.wait(), seen.decode()


@pytest.mark.process
@posix
def test_the_progress_of_a_recording_has_its_name_and_the_time(tmp_path):
    path = table(tmp_path / "good.csv", noisy_ellipsoid(3000), time=torch.arange(3000) / 50.0)
    code, seen = on_a_terminal("calibrate", path, "--output", tmp_path / "out")
    assert code == 0
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", seen)
    assert re.search(r"calibrating good\.csv +\S* *0:\d\d:\d\d", plain)
    assert " 0/1 " not in plain
    assert seen.count("\x1b[?25l") == seen.count("\x1b[?25h")  # the cursor is shown again
    assert "report.html" in plain


@pytest.mark.process
@posix
def test_runs_are_counted_while_worker_processes_are_busy(tmp_path):
    count = 300
    points = noisy_ellipsoid(2 * count)
    time, run = torch.arange(2 * count) % count / 20.0, torch.arange(2 * count) // count
    path = table(tmp_path / "runs.csv", points, time=time, experiment=run)
    command = ("diagnose", path, "--simulation", "magnetometer", "--output", tmp_path / "out", "--surrogates", 19)
    code, seen = on_a_terminal(*command)
    assert code == 3, seen  # a finding in the first run is not confirmed
    for number, label in ((1, 0), (2, 1)):
        assert f"diagnosing runs.csv, run {label} ({number} of 2)" in seen
    assert len(set(re.findall("[⠋⠙⠹⠸⠼⠴⠦⠧⠇⠏]", seen))) > 3
    done = subprocess.run(
        [sys.executable, "-m", "mkc_torch.cli", *map(str, command), "--force"],
        capture_output=True, text=True, encoding="utf-8", check=False,
    )  # fmt: skip
    assert done.returncode == code
    assert all(line.startswith("mkc: after ") for line in done.stderr.splitlines())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing is forked")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_no_process_is_forked_during_drawing():
    begun, done = threading.Event(), threading.Event()

    def draw():
        with drawing:
            begun.set()
            done.wait(0.3)
            done.set()

    thread = threading.Thread(target=draw)
    thread.start()
    begun.wait()
    process = os.fork()
    if process == 0:
        os._exit(0 if drawing.acquire(timeout=1.0) else 1)
    assert done.is_set()
    assert os.waitpid(process, 0)[1] == 0
    thread.join()


def test_long_work_appends_its_stage_to_a_file(tmp_path, monkeypatch):
    monkeypatch.setattr(console, "_FILE_LINE_S", 0.02)
    folder = tmp_path / "not yet there"
    with progress(3, folder) as step:
        step("diagnosing a.csv: trying 84 effects")
        lines = wait_for(folder / "progress.txt", 2)
        step(None)
        step("diagnosing b.csv: fitting the simulation alone")
        lines += wait_for(folder / "progress.txt", len(lines) + 3)
    stamp = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d  after 0 min: "
    assert re.fullmatch(stamp + r"0 of 3 done, diagnosing a\.csv: trying 84 effects", lines[0])
    assert re.fullmatch(stamp + r"1 of 3 done, diagnosing b\.csv: fitting the simulation alone", lines[-1])
    # another run is added to it
    with progress(1, folder) as step:
        step("calibrating c.csv")
        assert wait_for(folder / "progress.txt", len(lines) + 1)[-1].endswith("min: calibrating c.csv")


def test_calibrate_writes_its_stage_periodically_to_a_pipe(capfd, monkeypatch):
    monkeypatch.setattr(console, "_FIRST_LINE_S", 0.02)
    monkeypatch.setattr(console, "_LINE_S", 0.02)
    with progress(2, lines=True) as step:
        step("calibrating log.bin, sensor MAG (1 of 3)")
        seen = ""
        for _ in range(500):
            seen += capfd.readouterr().err
            if seen.count("\n") >= 2:
                break
            threading.Event().wait(0.02)
    line = r"mkc: after \d s: 0 of 2 done, calibrating log\.bin, sensor MAG \(1 of 3\)\n"
    assert re.fullmatch(f"({line}){{2,}}", seen)


def test_progress_without_lines_writes_nothing_to_a_pipe(capfd, monkeypatch):
    monkeypatch.setattr(console, "_FIRST_LINE_S", 0.02)
    monkeypatch.setattr(console, "_LINE_S", 0.02)
    with progress(2) as step:
        step("diagnosing log.bin")
        threading.Event().wait(0.2)
    assert capfd.readouterr().err == ""


def wait_for(file, lines):
    """Return the lines of a file once it has so many."""
    for _ in range(500):
        found = file.read_text().splitlines() if file.exists() else []
        if len(found) >= lines:
            return found
        threading.Event().wait(0.02)
    raise AssertionError(found)


def test_short_work_and_unwritable_folders_leave_no_progress_file(tmp_path, monkeypatch):
    with progress(1, tmp_path / "short") as step:
        step("calibrating a.csv")
    assert not (tmp_path / "short").exists()
    monkeypatch.setattr(console, "_FILE_LINE_S", 0.02)
    (tmp_path / "file").write_text("mine")
    with progress(1, tmp_path / "file") as step:
        step("calibrating a.csv")
        threading.Event().wait(0.1)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.process
def test_a_diagnosis_reports_its_stages():
    from mkc_torch import diagnose
    from mkc_torch.recording.demonstration import concealed_recording
    from mkc_torch.simulation import Magnetometer

    reported = []
    diagnose(Magnetometer(), concealed_recording(), surrogates=19, progress=reported.append)
    assert reported[:2] == ["reading the recording", "fitting the simulation alone"]
    assert re.fullmatch(r"trying \d+ effects", reported[2])
    assert re.fullmatch(r"trying \d+ effects in addition to 1 found", reported[3])
