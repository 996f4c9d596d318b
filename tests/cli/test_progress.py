"""A run shows on a terminal what it is doing and for how long, beside forked copies, and nothing in a pipe."""

import os
import re
import subprocess
import sys
import threading

import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")

from mkc_torch.cli.console import drawing
from tests.calibration.test_calibrate import noisy_ellipsoid
from tests.cli.test_cli import table

posix = pytest.mark.skipif(os.name == "nt", reason="there are no pseudo-terminals")


def on_a_terminal(*arguments):
    """Exit code and what a terminal of 100 columns was sent."""
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "mkc_torch.cli", *map(str, arguments)], stdin=theirs, stdout=theirs, stderr=theirs,
        env={name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "CI")}
        | {"TERM": "xterm-256color", "COLUMNS": "100", "PYTHONIOENCODING": "utf-8"},
    )  # fmt: skip
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


@posix
def test_one_recording_has_its_name_and_the_time(tmp_path):
    path = table(tmp_path / "good.csv", noisy_ellipsoid(3000), time=torch.arange(3000) / 50.0)
    code, seen = on_a_terminal("calibrate", path, "--output", tmp_path / "out")
    assert code == 0
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", seen)
    assert re.search(r"calibrating good\.csv 0:00:0\d", plain)
    assert " 0/1 " not in plain
    assert seen.count("\x1b[?25l") == seen.count("\x1b[?25h")  # the cursor is shown again
    assert "report.html" in plain


@posix
def test_experiments_are_counted_while_copies_work(tmp_path):
    count = 300
    points = noisy_ellipsoid(2 * count)
    time, run = torch.arange(2 * count) % count / 20.0, torch.arange(2 * count) // count
    path = table(tmp_path / "runs.csv", points, time=time, experiment=run)
    command = ("diagnose", path, "--simulation", "magnetometer", "--output", tmp_path / "out", "--surrogates", 19)
    code, seen = on_a_terminal(*command)
    assert code == 0, seen
    for number, label in ((1, 0), (2, 1)):
        assert f"diagnosing runs.csv, experiment {label} ({number} of 2)" in seen
    assert len(set(re.findall("[⠋⠙⠹⠸⠼⠴⠦⠧⠇⠏]", seen))) > 3
    done = subprocess.run(
        [sys.executable, "-m", "mkc_torch.cli", *map(str, command), "--force"],
        capture_output=True, text=True, encoding="utf-8", check=False,
    )  # fmt: skip
    assert done.returncode == 0
    assert done.stderr == ""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing is forked")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_nothing_is_forked_while_something_is_drawn():
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
