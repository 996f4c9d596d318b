"""`mkc diagnose` stopped by a time limit or Ctrl-C writes partial results and leaves no process running."""

import io
import json
import os
import signal
import sys
import time

import pytest

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("jsonschema")

from mkc_torch._parallel import deadline
from mkc_torch._parallel.deadline import Stopped
from mkc_torch.cli import console, diagnosis_files
from mkc_torch.cli.console import progress
from mkc_torch.diagnosis.io.diagnosis_json import validate
from mkc_torch.diagnosis.pipeline.partial import PartialResult
from mkc_torch.diagnosis.result import Stop
from tests.cli.commands import assert_refused, mkc
from tests.cli.test_diagnose import STEPPED, quiet_table, sensor_columns
from tests.diagnosis.factory import make_diagnosis
from tests.started import started

FILES = {"diagnosis.json", "model.json", "report.html"}
ON_A_MAGNETOMETER = ("--simulation", "magnetometer", "--surrogates", "19")
linux = pytest.mark.skipif(sys.platform != "linux", reason="nothing is forked elsewhere")


def stopped_in_the_search(monkeypatch, reason="time limit"):
    """Stop the first diagnosis once its search has started."""
    waiting = []
    keep = PartialResult.keep_search

    def kept(self, search):
        keep(self, search)
        waiting.append(search)

    def check(_):
        if len(waiting) == 1:
            waiting.append(None)
            raise Stopped(reason)

    monkeypatch.setattr(PartialResult, "keep_search", kept)
    monkeypatch.setattr(deadline.Deadline, "check", check)


def search_of(folder):
    content = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    validate(content)
    assert {path.name for path in folder.iterdir()} - {"progress.txt"} == FILES
    return content["search"]


@pytest.mark.e2e
def test_a_time_limit_writes_partial_results_and_exits_with_3(tmp_path, monkeypatch):
    path = quiet_table(tmp_path / "a.csv")
    stopped_in_the_search(monkeypatch)
    result = mkc("diagnose", path, *ON_A_MAGNETOMETER, "--output", tmp_path / "out", "--time-limit", "3600")
    assert (result.exit_code, result.stderr) == (3, "")
    assert "Stopped after" in result.stdout.splitlines()[2]
    assert search_of(tmp_path / "out" / "a")["stopped"]["reason"] == "time limit"


@pytest.mark.e2e
def test_a_time_limit_before_the_first_fit_writes_nothing_and_exits_with_1(tmp_path):
    path = quiet_table(tmp_path / "a.csv")
    result = mkc("diagnose", path, *ON_A_MAGNETOMETER, "--output", tmp_path / "out", "--time-limit", "1e-6")
    assert_refused(result, f"mkc: {path}: the time limit of 1e-06 s was over before the simulation's first fit")
    assert not (tmp_path / "out" / "a").exists()


@pytest.mark.e2e
@pytest.mark.parametrize("how", [("--together",), ("--simulator-output",)])
def test_a_time_limit_stops_joint_diagnoses_and_those_of_simulator_outputs(tmp_path, monkeypatch, how):
    paths = [quiet_table(tmp_path / "a.csv"), quiet_table(tmp_path / "b.csv", **sensor_columns(STEPPED))]
    stopped_in_the_search(monkeypatch)
    limit = ("--output", tmp_path / "out", "--time-limit", "3600", "--surrogates", "19")
    if how == ("--together",):
        result, folder = mkc("diagnose", *paths, "--simulation", "magnetometer", *limit, *how), "together"
    else:
        result, folder = mkc("diagnose", paths[0], "--simulator-output", paths[1], *limit), "a"
    assert result.exit_code == 3, result.output
    assert search_of(tmp_path / "out" / folder)["stopped"]["reason"] == "time limit"


@pytest.mark.e2e
def test_an_interrupt_writes_and_reports_the_results_so_far_and_stops(tmp_path, monkeypatch):
    path = tmp_path / "runs.csv"
    quiet_table(path)
    lines = path.read_text().splitlines()
    runs = [f"{line},{run}" for run in (1, 2) for line in lines[1:]]
    path.write_text("\n".join([f"{lines[0]},experiment", *runs]) + "\n")
    stopped_in_the_search(monkeypatch, "interrupt")
    result = mkc("diagnose", path, *ON_A_MAGNETOMETER, "--output", tmp_path / "out")
    assert result.exit_code == 130
    assert result.stderr == f"mkc: interrupted; results so far were written for {path}.\n"
    assert search_of(tmp_path / "out" / "runs" / "1")["stopped"]["reason"] == "interrupt"
    assert not (tmp_path / "out" / "runs" / "2").exists()


def test_quick_and_time_limit_are_passed_to_diagnose_and_reported(tmp_path, monkeypatch):
    seen = {}
    limited = {
        "p_value": None,
        "quick": True,
        "stop": Stop("time limit", 8.0, ("the search",)),
        "verdict": "unexplained",
    }

    def diagnose(*_, **options):
        seen.update(options)
        return make_diagnosis(0, model=None, **limited)

    monkeypatch.setattr(diagnosis_files, "diagnose", diagnose)
    path = quiet_table(tmp_path / "a.csv")
    options = ("--quick", "--time-limit", "8", "--output", tmp_path / "out")
    result = mkc("diagnose", path, "--simulation", "magnetometer", *options)
    assert result.exit_code == 3, result.output
    assert (seen["quick"], seen["time_limit"]) == (True, 8.0)
    flat = " ".join(result.stdout.split())
    assert (
        flat.index("Stopped after 8 s") < flat.index("Quick look: no p-values") < flat.index("The search was stopped")
    )
    assert "no p-value was computed" in flat


@pytest.mark.parametrize("limit", ["0", "-1", "nan", "inf"])
def test_a_time_limit_of_0_or_less_is_refused(tmp_path, limit):
    result = mkc("diagnose", "a.csv", "--output", tmp_path, "--time-limit", limit)
    assert_refused(result, "--time-limit must be a number of seconds above 0", code=2)


def test_quick_with_surrogates_is_refused(tmp_path):
    assert_refused(
        mkc("diagnose", "a.csv", "--output", tmp_path, "--quick", "--surrogates", "99"), "--quick draws no", code=2
    )


WAITING = """
import sys
from pathlib import Path
from mkc_torch._parallel.deadline import check_deadline
from mkc_torch.diagnosis.pipeline.partial import PartialResult
from time import sleep
keep = PartialResult.keep_search

def kept(self, search):
    keep(self, search)
    begun.mkdir(exist_ok=True)
    while True:
        check_deadline()
        sleep(0.01)

PartialResult.keep_search = kept
*sys.argv, begun = sys.argv
begun = Path(begun)
from mkc_torch.cli import main
main()
"""


@pytest.mark.process
@linux
def test_ctrl_c_ends_all_processes_and_its_files_are_whole(tmp_path):
    """The process waits in its search until it is interrupted."""
    path, begun, out = quiet_table(tmp_path / "a.csv"), tmp_path / "begun", tmp_path / "out"
    code = tmp_path / "waiting.py"
    code.write_text(WAITING)
    with started(code, "diagnose", path, *ON_A_MAGNETOMETER, "--output", out, begun) as process:
        waited = time.monotonic() + 120.0
        while not begun.exists() and process.poll() is None and time.monotonic() < waited:
            time.sleep(0.05)
        assert process.poll() is None, process.communicate()
        os.killpg(process.pid, signal.SIGINT)
        # copies have the same streams, which end when the last one has
        _, reported = process.communicate(timeout=120)
    assert process.returncode == 130, reported
    assert reported.startswith(f"mkc: interrupted; results so far were written for {path}.\n")
    assert search_of(out / "a")["stopped"]["reason"] == "interrupt"


def test_progress_within_a_stage_is_shown_with_its_duration(monkeypatch):
    shown, clock = io.StringIO(), [0.0]
    monkeypatch.setattr(console, "err", lambda: console._console(True, width=120, file=shown))
    with progress(1) as step:
        assert step._bar is not None
        monkeypatch.setattr(step, "_clock", lambda: clock[0])
        step("diagnosing a.csv: trying 91 effects")
        assert step.part_done == ""
        for done in range(31):
            clock[0] = 0.5 * done
            step.part("candidate", done, 91)
        assert step.part_done == "candidate 31 of 91, 30 to 35 s for these"
        step._bar.refresh()
        assert "candidate 31 of 91, 30 to 35 s for these" in shown.getvalue()
        step.part("shape", 0, 3)
        assert step.part_done == "shape 1 of 3"
        step.part("shape", 3, 3)
        assert step.part_done == ""
        step.part("shape", 1, 3)
        step("diagnosing a.csv: checking what was found")
        assert step.part_done == ""


def test_progress_within_a_stage_is_in_the_file_and_not_in_a_pipe(tmp_path, capsys):
    with progress(1) as step:
        step("diagnosing a.csv: trying 91 effects")
        step.part("candidate", 30, 91)
        console._note(step, tmp_path, 61.0)
    assert capsys.readouterr() == ("", "")
    assert (
        "after 1 min: diagnosing a.csv: trying 91 effects; candidate 31 of 91"
        in (tmp_path / "progress.txt").read_text()
    )
