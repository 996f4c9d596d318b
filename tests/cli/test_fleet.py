"""Several recordings on the command line: their page, and a second call that continues."""

import csv
import json

import pytest

from mkc_torch.cli.diagnosis_request import Request
from mkc_torch.cli.fleet_files import SCHEMA, WRITTEN, earlier_results, is_doubtful, write_diagnoses
from tests.cli.commands import assert_refused, mkc
from tests.cli.test_diagnose import quiet_table
from tests.report.fleet.test_fleet import content


def result(folder, name, found, **search):
    found = found | {"level": 0.05, "search": {"stopped": None, "seed": 0, "quick": True} | search}
    (folder / name).mkdir(parents=True)
    (folder / name / "diagnosis.json").write_text(json.dumps(found), encoding="utf-8")


@pytest.fixture
def results(tmp_path):
    result(tmp_path, "done", content(0.4))
    result(tmp_path, "stopped", content(0.4), stopped={"reason": "interrupt"})
    result(tmp_path, "runs/first", content(0.5))
    result(tmp_path, "runs/second", content(answer="look"))
    (tmp_path / "failed").mkdir()
    return tmp_path


def paths(folder, *names):
    return [folder / f"{name}.csv" for name in names]


def test_a_second_call_leaves_complete_results_of_the_same_options(results):
    every = paths(results, "done", "stopped", "runs", "failed", "new")
    found = earlier_results(every, results, Request(quick=True), "Cart")
    assert found.complete == paths(results, "done", "runs")
    assert found.interrupted == paths(results, "stopped")
    others = [{}, {"quick": True, "seed": 1}, {"quick": True, "level": 0.1}, {"quick": True, "force": True}]
    for other in others:
        assert earlier_results(every, results, Request(**other), "Cart") == ([], [])
    assert earlier_results(every, results, Request(quick=True), "Pendulum") == ([], [])


def test_results_to_look_at_stay_doubtful(results):
    assert is_doubtful(results / "runs")
    assert not is_doubtful(results / "done")


def test_the_files_have_every_run_and_every_size(results):
    files = write_diagnoses(paths(results, "done", "runs", "failed"), results, {"failed.csv": "no time"})
    assert [file.name for file in files] == list(WRITTEN)
    numbers = json.loads((results / "fleet.json").read_text(encoding="utf-8"))
    assert numbers["schema"] == SCHEMA
    assert [each["name"] for each in numbers["recordings"]] == ["done", "runs/first", "runs/second"]
    assert numbers["failures"] == {"failed.csv": "no time"}
    assert numbers["quantities"][0]["pooled"]["mean"] == pytest.approx(0.45)
    with (results / "fleet.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["recording"], row["effect"], row["value"]) for row in rows] == [
        ("done", "quadratic_drag", "0.4"), ("runs/first", "quadratic_drag", "0.5"), ("runs/second", "", ""),
    ]  # fmt: skip
    assert "runs/first" in (results / "fleet.html").read_text(encoding="utf-8")


@pytest.mark.e2e
def test_several_recordings_get_a_page_and_a_second_call_adds_to_it(tmp_path):
    one, two = (quiet_table(tmp_path / name) for name in ("one.csv", "two.csv"))
    given = ("--simulation", "magnetometer", "--quick", "--output", tmp_path / "out")
    first = mkc("diagnose", one, tmp_path / "absent.csv", *given)
    assert first.exit_code == 1
    assert "1 of 2 recordings diagnosed" in (tmp_path / "out" / "fleet.html").read_text(encoding="utf-8")
    before = (tmp_path / "out" / "one" / "diagnosis.json").stat().st_mtime_ns
    second = mkc("diagnose", one, two, *given)
    assert "1 recording was diagnosed before and is left as it is: one.csv" in " ".join(second.stderr.split())
    assert (tmp_path / "out" / "one" / "diagnosis.json").stat().st_mtime_ns == before
    assert "2 of 2 recordings diagnosed" in (tmp_path / "out" / "fleet.html").read_text(encoding="utf-8")
    # other options would mix two kinds of results in a folder
    assert_refused(mkc("diagnose", one, two, *given, "--seed", "1"), "one exists and is not empty", "--force", lines=3)


def test_a_table_of_the_user_is_not_replaced(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "fleet.csv").write_text("truck,driver\n", encoding="utf-8")
    paths = [quiet_table(tmp_path / name) for name in ("one.csv", "two.csv")]
    found = mkc("diagnose", *paths, "--simulation", "magnetometer", "--output", tmp_path / "out")
    assert_refused(found, "fleet.csv exists and was not written by mkc")
    assert not (tmp_path / "out" / "one").exists()
