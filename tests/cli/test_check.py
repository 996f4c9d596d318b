"""`mkc check`: a table, files, exit codes and JUnit XML; `mkc apply` next to it."""

import json
from xml.etree import ElementTree

import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("jinja2")

from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.recording import Recording, write_table
from tests.cli.commands import assert_refused, flat, mkc
from tests.diagnosis.validation.tank import tank_recording, usual_model
from tests.diagnosis.validation.test_alone import SOURCE


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model, its simulation, and recordings: a new one, one without the drag, and that of the fit."""
    place = tmp_path_factory.mktemp("check")
    (place / "vessel.py").write_text(SOURCE, encoding="utf-8")
    (place / "model.json").write_text(usual_model().to_json(), encoding="utf-8")
    for name, recording in {
        "new": tank_recording(1), "other": tank_recording(2), "plain": tank_recording(3, drag=0.0),
        "fitted": tank_recording(0),
    }.items():  # fmt: skip
        write_table(place / f"{name}.csv", dict(recording.columns))
    return place


@pytest.fixture(scope="module")
def checked(folder):
    """The result of checking all of them at once."""
    names = [folder / f"{name}.csv" for name in ("new", "plain", "fitted")]
    return mkc(
        "check", folder / "model.json", *names, folder / "none.csv", "--simulation", f"{folder / 'vessel.py'}:Tank",
        "--output", folder / "out", "--junit", folder / "checks.xml",
    )  # fmt: skip


def lines_of(text, name):
    return [flat(line) for line in text.splitlines() if line.startswith(name)]


def test_the_table_has_a_verdict_for_each_recording(checked):
    assert checked.exit_code == 1
    assert flat(checked.stdout).startswith("recording output without with findings ratio (95 %) verdict")
    assert lines_of(checked.stdout, "new.csv")[0].endswith("holds")
    assert " m " in lines_of(checked.stdout, "new.csv")[0]
    assert lines_of(checked.stdout, "plain.csv")[0].endswith("does not hold")
    assert lines_of(checked.stdout, "fitted.csv")[0].endswith("used in the fit")
    text = flat(checked.stdout)
    assert "initial states from the first 1.49 s of each run; the other 135 of 150 samples are predicted" in text
    assert "plain.csv: level: the findings do not make the residual clearly smaller" in text
    assert "fitted.csv: This recording was used in the fit" in text
    assert "none.csv: there is no such file" in flat(checked.stderr)


def test_each_recording_has_its_files(checked, folder):
    assert sorted(path.name for path in (folder / "out").iterdir()) == ["fitted", "new", "plain"]
    for name, verdict in {"new": "holds", "plain": "does not hold", "fitted": "used in the fit"}.items():
        content = json.loads((folder / "out" / name / "check.json").read_text(encoding="utf-8"))
        assert (content["verdict"], content["recording"]) == (verdict, name)
        page = (folder / "out" / name / "check.html").read_text(encoding="utf-8")
        assert page.count("<svg") == 2
    assert str(folder / "out" / "new" / "check.json") in checked.stdout


def test_a_build_server_reads_the_failures(checked, folder):
    suite = ElementTree.parse(folder / "checks.xml").getroot()
    assert (suite.tag, suite.attrib["tests"], suite.attrib["failures"], suite.attrib["errors"]) == (
        "testsuite", "4", "2", "1",
    )  # fmt: skip
    cases = {case.attrib["name"]: [child.tag for child in case] for case in suite}
    assert cases == {
        "new.csv: level": ["system-out"],
        "plain.csv: level": ["failure", "system-out"],
        "fitted.csv: level": ["failure", "system-out"],
        "none.csv": ["error"],
    }
    (message,) = [case.find("failure").attrib["message"] for case in suite if "plain" in case.attrib["name"]]
    assert "do not make the residual clearly smaller" in message


@pytest.mark.e2e
@pytest.mark.parametrize(("names", "code"), [(("new",), 0), (("new", "plain"), 3), (("fitted",), 3)])
def test_the_exit_code_is_that_of_the_worst_recording(folder, tmp_path, names, code):
    paths = [folder / f"{name}.csv" for name in names]
    source = f"{folder / 'vessel.py'}:Tank"
    result = mkc("check", folder / "model.json", *paths, "--simulation", source, "--output", tmp_path)
    assert result.exit_code == code, result.output


@pytest.mark.e2e
def test_recordings_are_read_as_those_of_a_diagnosis(folder, tmp_path):
    """Renamed columns, other units of time, a column that separates runs, and the start."""
    known = Recording.read(folder / "new.csv")
    columns = {"t": 1e3 * known["time"], "q": known["inflow"], "h": known["level"], "trial": torch.ones(len(known))}
    write_table(tmp_path / "new.csv", columns)
    result = mkc(
        "check", folder / "model.json", tmp_path / "new.csv", "--simulation", f"{folder / 'vessel.py'}:Tank",
        "--columns", "time=t,inflow=q,level=h", "--convert", "time=ms", "--run-column", "trial", "--start-seconds", 4,
        "--input-hold", "inflow=held", "--output", tmp_path / "out",
    )  # fmt: skip
    assert result.exit_code in (0, 3), result.output
    content = json.loads((tmp_path / "out" / "new" / "check.json").read_text(encoding="utf-8"))
    assert (content["start_seconds"], content["samples"], content["predicted"]) == (4.0, 150, 109)


def test_wrong_arguments_are_refused(folder, tmp_path):
    new, model, source = folder / "new.csv", folder / "model.json", f"{folder / 'vessel.py'}:Tank"
    to = ("--output", tmp_path / "out")
    assert_refused(mkc("check", model, new, *to), "no code is run because a model's file names it", "FILE.py:Tank")
    assert_refused(mkc("check", new, new, "--simulation", source, *to), "new.csv", "not JSON")
    assert_refused(mkc("check", model, new, "--simulation", source, "--start-seconds", "-1"), "above 0", code=2)
    assert_refused(
        mkc("check", model, new, "--simulation", source, *to, "--start-seconds", "99"),
        "length of the shortest",
        lines=1,
    )
    assert_refused(mkc("check", model, new, "--simulation", source, "--junit", new), "input file", code=2)
    missing = tmp_path / "missing.csv"
    write_table(missing, {"time": torch.arange(9.0), "level": torch.arange(9.0)})
    assert_refused(mkc("check", model, missing, "--simulation", source, *to), "no column `inflow`")
    assert not (tmp_path / "out").exists()


@pytest.mark.e2e
def test_results_are_replaced_only_by_force(folder, tmp_path):
    command = (
        "check", folder / "model.json", folder / "new.csv", "--simulation", f"{folder / 'vessel.py'}:Tank", "--output",
        tmp_path, "--junit", tmp_path / "new.xml",
    )  # fmt: skip
    assert mkc(*command).exit_code == 0
    assert_refused(mkc(*command), "--force", lines=2)
    assert mkc(*command, "--force").exit_code == 0


@pytest.mark.e2e
def test_a_calibration_is_refused_and_names_the_command_for_it(good_calibration, folder):
    path, recording = good_calibration
    assert_refused(mkc("check", path, recording), "this is a calibration", "--compare-with")


@pytest.fixture(scope="module")
def good_calibration(tmp_path_factory):
    place = tmp_path_factory.mktemp("calibration")
    write_table(place / "sensor.csv", dict(simulated_recording()[0].columns))
    result = mkc("calibrate", place / "sensor.csv", "--output", place / "out")
    assert result.exit_code in (0, 3), result.output
    return place / "out" / "sensor" / "calibration.json", place / "sensor.csv"


@pytest.mark.e2e
def test_apply_adds_the_simulated_column_and_prints_the_residual(folder, tmp_path):
    output = tmp_path / "simulated.csv"
    known = Recording.read(folder / "new.csv")
    level = known["level"].clone()
    level[:3] = torch.nan  # these rows are not simulated
    write_table(tmp_path / "new.csv", {**known.columns, "level": level})
    for name, rows in (("new", 150), ("cut", 147)):
        source = folder / "new.csv" if name == "new" else tmp_path / "new.csv"
        result = mkc(
            "apply", folder / "model.json", source, "--simulation", f"{folder / 'vessel.py'}:Tank", "--output", output,
            "--force",
        )  # fmt: skip
        assert result.exit_code == 0, result.output
        assert f"{rows} rows of level_simulated simulated with the findings, RMSE of level 0.00" in flat(result.stdout)
        written = Recording.read(output)
        if name == "new":
            assert written.names == (*known.names, "level_simulated")
            assert all(torch.equal(written[column], known[column]) for column in known.names)
        printed = float(flat(result.stdout).split("RMSE of level ")[1].split(" m:")[0])
        measured = known["level"] if name == "new" else known["level"][3:]
        assert printed == pytest.approx(float((measured - written["level_simulated"]).square().mean().sqrt()), rel=1e-2)
