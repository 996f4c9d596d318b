"""Every write of every command, killed or on a full disk: files are complete or absent, and none is lost."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("typer")
pytest.importorskip("polars")

import torch

from mkc_torch.cli import diagnosis_files
from mkc_torch.recording.recording import write_table
from tests.calibration.test_calibrate import noisy_ellipsoid
from tests.cli.commands import mkc
from tests.diagnosis.factory import make_diagnosis

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no fork")

ROOT = Path(__file__).resolve().parents[2]
AXES = ("mag_x", "mag_y", "mag_z")
ENDS = {".json": "}\n", ".html": "</html>", ".py": "\n", ".csv": "\n"}


@pytest.fixture
def recording(tmp_path):
    points = noisy_ellipsoid(300)
    columns = {"time": torch.arange(300) / 50.0} | dict(zip(AXES, points.unbind(-1), strict=True))
    write_table(tmp_path / "rec.csv", columns)
    return tmp_path / "rec.csv"


@pytest.fixture
def commands(recording, tmp_path, monkeypatch):
    """Return each command that writes, and the number of its files."""
    assert mkc("calibrate", recording, "--output", tmp_path / "before").exit_code == 0
    monkeypatch.setattr(diagnosis_files, "diagnose", lambda *_, **__: make_diagnosis())
    return {
        "calibrate": (("calibrate", recording, "--output", tmp_path / "out"), 2),
        "apply": (
            ("apply", tmp_path / "before" / "rec" / "calibration.json", recording, "--output", tmp_path / "out.csv"),
            1,
        ),
        "diagnose": (("diagnose", recording, "--simulation", "magnetometer", "--output", tmp_path / "out"), 2),
    }


IN_CHILDREN = """
import json, os, resource, signal, sys
from typer.testing import CliRunner
import mkc_torch.report
from mkc_torch.cli import calibration_files, correction, diagnosis_files
from mkc_torch.cli.app import app
from tests.diagnosis.factory import make_diagnosis

diagnosis_files.diagnose = lambda *_, **__: make_diagnosis()
kind, numbers, command = json.loads(sys.argv[1])
fsync, count = os.fsync, 0


def killed(handle):
    global count
    count += 1
    fsync(handle)
    if count == number:
        os.kill(os.getpid(), signal.SIGKILL)


for number in numbers:
    child = os.fork()  # before polars has threads, which a copy lacks
    if child == 0:
        if kind == "killed":
            os.fsync = killed
        else:
            resource.setrlimit(resource.RLIMIT_FSIZE, (number, number))
        result = CliRunner().invoke(app, command)
        fine = result.exit_code == 0 or (result.exit_code == 1 and "file too large" in result.stderr)
        os._exit(0 if fine and "Traceback" not in result.output else 3)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(json.dumps(status), flush=True)
    sys.stdin.readline()  # until what is there has been looked at
"""


def in_children(kind, numbers, command):
    """Run a command in child processes; return their exit statuses, negative if ended by a signal."""
    given = json.dumps([kind, numbers, [str(part) for part in command]])
    with subprocess.Popen(
        [sys.executable, "-c", IN_CHILDREN, given],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), *sys.path]))},
    ) as runs:
        for number in numbers:
            yield number, json.loads(runs.stdout.readline())
            runs.stdin.write("\n")
            runs.stdin.flush()


def written(folder: Path):
    """Return the files by name, without the temporary files of a killed process."""
    paths = [folder] if folder.is_file() else sorted(folder.rglob("*")) if folder.exists() else []
    return {path.name: path.read_text() for path in paths if path.is_file() and path.suffix != ".tmp"}


@pytest.mark.process
@pytest.mark.parametrize("name", ["calibrate", pytest.param("apply", marks=pytest.mark.slow), "diagnose"])
def test_a_command_killed_at_any_write_leaves_only_complete_files_and_can_be_repeated(commands, name):
    command, files = commands[name]
    place = command[-1]
    for number, status in in_children("killed", list(range(1, files + 1)), (*command, "--force")):
        assert status == -signal.SIGKILL
        there = written(place)
        assert len(there) == number - 1
        assert all(text.endswith(ENDS[Path(file).suffix]) for file, text in there.items())
    result = mkc(*command, "--force")
    assert result.exit_code == 0, result.output
    assert len(written(place)) == files
    if place.suffix != ".csv":
        assert not list(place.rglob(".*.tmp"))


@pytest.mark.process
@pytest.mark.parametrize(
    "name", ["calibrate", *(pytest.param(name, marks=pytest.mark.slow) for name in ("apply", "diagnose"))]
)
def test_a_full_disk_is_reported_and_keeps_existing_files(commands, name):
    """A limit on the size of files stands for a full disk."""
    command, files = commands[name]
    place = command[-1]
    assert mkc(*command).exit_code == 0
    before = written(place)
    assert len(before) == files
    for _, status in in_children("full", [0, 1000, 20_000], (*command, "--force")):
        assert status == 0
        after = written(place)
        assert after.keys() == before.keys()
        assert all(text.endswith(ENDS[Path(file).suffix]) for file, text in after.items())


@pytest.mark.process
def test_two_runs_into_one_folder_do_not_mix(commands, monkeypatch):
    command, files = commands["calibrate"]
    second, fsync = [], os.fsync

    def meanwhile(handle):
        monkeypatch.setattr(os, "fsync", fsync)
        second.append(mkc(*command, "--force"))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", meanwhile)
    assert mkc(*command).exit_code == 0
    assert second[0].exit_code == 1, second[0].exception
    reported = " ".join(second[0].output.split())
    assert "is being written by another mkc; wait for it, or choose another output folder" in reported
    assert len(written(command[-1])) == files
