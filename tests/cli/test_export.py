"""`mkc calibrate` with `--export`, `--name` and `--compare-with`, and `mkc export`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("matplotlib")

from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.exports import EXPORTS
from mkc_torch.cli.export_options import KINDS as EVERY_KIND
from mkc_torch.recording.recording import Recording
from mkc_torch.report.calibration import page
from tests.calibration.exports import formulas
from tests.calibration.test_calibrate import noisy_ellipsoid
from tests.cli.commands import assert_refused, mkc
from tests.cli.test_cli import table
from tests.diagnosis.files.test_sensor_correction import CABLE, TEMPERATURE, model_of

KINDS = tuple(kind for kind in EVERY_KIND if kind != "imu-calib")
"""Exports of a magnetometer."""

EXPORT_ALL = tuple(word for kind in KINDS for word in ("--export", kind))


@pytest.fixture(scope="module")
def good_table(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    return table(folder / "good.csv", noisy_ellipsoid(300), time=torch.arange(300) / 50.0)


@pytest.fixture(scope="module")
def exported(good_table, tmp_path_factory):
    """Return the folder of a calibration with all exports, and the result of the command."""
    folder = tmp_path_factory.mktemp("done")
    result = mkc("calibrate", good_table, "--output", folder, "--name", "mast", "--device-id", 396825, *EXPORT_ALL)
    assert result.exit_code == 0, result.output
    return folder / "good", result


@pytest.fixture
def model(tmp_path):
    folder = tmp_path / "FLIGHT"
    folder.mkdir()
    path = folder / "model.json"
    path.write_text(model_of([CABLE, TEMPERATURE], [(0.3, -0.2, 0.4), (0.5, 0.1, -0.2)]).to_json(), encoding="utf-8")
    return path


@pytest.fixture
def without_pictures(monkeypatch):
    """Replace the report by a constant text, to save time."""
    monkeypatch.setattr(page, "calibration_report", lambda *_, **__: "Made by mkc_torch")


def file_of(kind):
    return EXPORTS[kind].file


def test_every_export_is_written_and_named(exported):
    folder, result = exported
    assert {path.name for path in folder.iterdir()} == {"calibration.json", "report.html", *map(file_of, KINDS)}
    for kind in KINDS:
        assert file_of(kind) in result.stdout
        assert "mast" in (folder / file_of(kind)).read_text(encoding="utf-8")
    assert result.stderr == ""


def test_the_px4_file_has_the_correction_of_apply(exported, good_table, tmp_path):
    folder, _ = exported
    output = tmp_path / "corrected.csv"
    assert mkc("apply", folder / "calibration.json", good_table, "--output", output).exit_code == 0
    written = Recording.read(output)
    values = formulas.qgroundcontrol((folder / "px4.params").read_text(encoding="utf-8"))
    field = formulas.px4(values, written.magnetometer().numpy() * 1e-6)
    assert np.abs(field - written.stack("field_x", "field_y", "field_z").numpy() * 1e-6).max() < 0.01e-6
    assert values["CAL_MAG0_ID"] == 396825


def test_the_name_is_in_the_calibration_the_report_and_on_the_terminal(exported):
    folder, result = exported
    calibration = Calibration.from_json((folder / "calibration.json").read_text(encoding="utf-8"))
    assert (calibration.name, calibration.recording) == ("mast", "good")
    assert result.stdout.split()[0] == "mast:"
    shown = (folder / "report.html").read_text(encoding="utf-8")
    assert "Calibration of mast" in shown
    assert "mast · good" in shown


def test_a_calibration_without_a_name_has_the_name_of_its_recording(exported):
    content = json.loads((exported[0] / "calibration.json").read_text(encoding="utf-8"))
    del content["name"]
    assert Calibration.from_json(json.dumps(content)).name == "good"


@pytest.mark.usefixtures("without_pictures")
def test_the_default_name_of_a_sensor_is_that_of_the_recording(good_table, tmp_path):
    assert mkc("calibrate", good_table, "--output", tmp_path, "--export", "json").exit_code == 0
    numbers = json.loads((tmp_path / "good" / file_of("json")).read_text(encoding="utf-8"))
    assert numbers["name"] == "good"


@pytest.mark.usefixtures("without_pictures")
def test_raw_counts_are_calibrated_and_not_exported(good_table, tmp_path):
    """The calibration stands; the exports that need a unit are refused with what to do."""
    asked = ("--unit-label", "counts", "--export", "px4", "--export", "json")
    result = mkc("calibrate", good_table, "--output", tmp_path, *asked)
    assert_refused(result, str(good_table), "in counts", "px4 needs gauss", "--convert mag=gauss")
    assert {path.name for path in (tmp_path / "good").iterdir()} == {
        "calibration.json",
        "report.html",
        file_of("json"),
    }


def test_a_file_of_the_user_is_not_replaced(good_table, tmp_path):
    (tmp_path / "good").mkdir()
    own = tmp_path / "good" / "px4.params"
    own.write_text("# mine\n")
    assert_refused(
        mkc("calibrate", good_table, "--output", tmp_path, "--export", "px4", "--force"), "px4.params", "not written by"
    )
    assert own.read_text() == "# mine\n"


@pytest.mark.usefixtures("without_pictures")
def test_exports_of_an_earlier_calibration_are_reported_and_kept(good_table, tmp_path):
    assert mkc("calibrate", good_table, "--output", tmp_path, "--export", "px4", "--export", "json").exit_code == 0
    before = (tmp_path / "good" / "px4.params").read_bytes()
    again = mkc("calibrate", good_table, "--output", tmp_path, "--export", "json", "--force", "--field-strength", 48)
    assert again.exit_code == 0
    assert "px4.params in" in again.stdout
    assert "belongs to an earlier calibration" in " ".join(again.stdout.split())
    assert (tmp_path / "good" / "px4.params").read_bytes() == before


@pytest.mark.e2e
def test_the_new_calibration_is_compared_with_the_old(exported, tmp_path):
    old = exported[0] / "calibration.json"
    before = old.read_bytes()
    other = table(tmp_path / "other.csv", noisy_ellipsoid(300, seed=5) + torch.tensor([0.0, 2.0, 0.0]))
    result = mkc("calibrate", other, "--output", tmp_path / "out", "--compare-with", old)
    assert result.exit_code == 0, result.output
    reported = " ".join(result.stdout.split())
    shown = (tmp_path / "out" / "other" / "report.html").read_text(encoding="utf-8")
    for text in (reported, shown):
        assert "Comparison with the calibration mast" in text
        assert "Significant difference: offset y by +" in text
        assert "matrix yz" in text
        assert "Over the directions of the" in text
    assert old.read_bytes() == before


@pytest.mark.usefixtures("without_pictures")
def test_the_compared_calibration_is_never_replaced(good_table, tmp_path):
    assert mkc("calibrate", good_table, "--output", tmp_path).exit_code == 0
    old = tmp_path / "good" / "calibration.json"
    before = old.read_bytes()
    result = mkc(
        "calibrate", good_table, "--output", tmp_path, "--compare-with", old, "--field-strength", 48, "--force"
    )
    assert_refused(result, "--output would replace", "choose another")
    assert old.read_bytes() == before


def test_an_invalid_old_calibration_is_refused_before_any_work(good_table, model, tmp_path):
    out = ("--output", tmp_path / "out")
    assert_refused(
        mkc("calibrate", good_table, *out, "--compare-with", tmp_path / "none.json"), "none.json", "no such file"
    )
    assert_refused(
        mkc("calibrate", good_table, *out, "--compare-with", model), "model.json", "calibration.json of `mkc calibrate`"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("without_pictures")
def test_incomparable_units_are_reported_and_the_calibration_is_written(exported, good_table, tmp_path):
    old = exported[0] / "calibration.json"
    result = mkc("calibrate", good_table, "--output", tmp_path, "--unit-label", "counts", "--compare-with", old)
    assert_refused(result, "counts", "same unit options")
    assert (tmp_path / "good" / "calibration.json").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_an_existing_calibration_is_exported(exported, tmp_path, kind):
    output = tmp_path / "file"
    command = ("export", exported[0] / "calibration.json", "--to", kind, "--output", output)
    result = mkc(*command)
    assert result.exit_code == 0, result.output
    given = (exported[0] / file_of(kind)).read_text(encoding="utf-8")
    text = output.read_text(encoding="utf-8")
    assert [line for line in text.splitlines() if "_ID" not in line] == [
        line for line in given.splitlines() if "_ID" not in line and "_ROT, the sensor" not in line
    ]
    assert str(output) in result.stdout
    assert_refused(mkc(*command), str(output), "--force")
    assert mkc(*command, "--force", "--name", "another").exit_code == 0
    assert "another" in output.read_text(encoding="utf-8")


def test_a_model_is_exported_with_its_current_and_omissions_are_reported(model, tmp_path):
    output = tmp_path / "flight.param"
    result = mkc("export", model, "--to", "ardupilot", "--output", output, "--instance", 2)
    assert result.exit_code == 0, result.output
    assert "warning: temperature_offset is left out" in result.stdout
    text = output.read_text(encoding="utf-8")
    values = formulas.mission_planner(text)
    assert values["COMPASS_MOTCT"] == 2
    assert {"COMPASS_MOT2_X", "COMPASS_OFS2_X"} <= set(values)
    assert "FLIGHT" in text


def test_export_never_overwrites_what_it_reads(exported, tmp_path):
    copy = tmp_path / "calibration.json"
    copy.write_bytes((exported[0] / "calibration.json").read_bytes())
    assert_refused(mkc("export", copy, "--to", "json", "--output", copy, "--force"), "--output is the input file")
    assert copy.read_bytes() == (exported[0] / "calibration.json").read_bytes()


def test_files_other_than_calibrations_are_refused(tmp_path, exported):
    out = ("--to", "px4", "--output", tmp_path / "a.params")
    assert_refused(mkc("export", tmp_path / "none.json", *out), "no such file")
    assert_refused(mkc("export", tmp_path, *out), "this is a folder")
    assert_refused(mkc("export", exported[0] / file_of("json"), *out), "its schema is")
    (tmp_path / "bad.json").write_text("{")
    assert_refused(mkc("export", tmp_path / "bad.json", *out), "not JSON")
    other = tmp_path / "pendulum.json"
    other.write_text(model_of([], [], simulation="Pendulum").to_json(), encoding="utf-8")
    assert_refused(mkc("export", other, *out), "Pendulum")
    assert not (tmp_path / "a.params").exists()


def test_wrong_options_are_refused_before_any_work(exported, good_table, tmp_path):
    out = ("--output", tmp_path / "out")
    model = exported[0] / "calibration.json"
    assert_refused(
        mkc("calibrate", good_table, *out, "--export", "qgc"), "--export", "px4, ardupilot, c-header", code=2
    )
    assert_refused(mkc("export", model, *out, "--to", "qgc"), "--to", "qgc", code=2)
    assert_refused(mkc("calibrate", good_table, *out, "--instance", 1), "--instance", "px4", code=2)
    assert_refused(mkc("calibrate", good_table, *out, "--instance", -1, "--export", "px4"), "at least 0", code=2)
    assert_refused(mkc("calibrate", good_table, *out, "--device-id", 7, "--export", "ardupilot"), "--device-id", code=2)
    assert_refused(mkc("calibrate", good_table, *out, "--name", " "), "--name", code=2)
    assert_refused(mkc("calibrate", good_table, model, *out, "--name", "mast"), "one REC", code=2)
    assert_refused(mkc("export", model, *out, "--to", "json", "--name", ""), "--name", code=2)
    assert_refused(mkc("export", model, *out, "--to", "px4", "--instance", 9), "0 to 3")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("without_pictures")
def test_a_full_disk_names_the_file(good_table, tmp_path, monkeypatch):
    """The system's error of a write that finds no room names none."""

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    result = mkc("calibrate", good_table, "--output", tmp_path / "out")
    assert_refused(result, str(tmp_path / "out" / "good" / "calibration.json"), "no space left on device")
    assert not (tmp_path / "out" / "good").exists()


@pytest.mark.process
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize(
    "command",
    [
        ("export", "{model}", "--to", "px4", "--output", "{out}.params"),
        pytest.param(("apply", "{model}", "{good}", "--output", "{out}.csv"), marks=pytest.mark.slow),
        ("--help",),
        *(
            pytest.param(tuple(line.split()), marks=pytest.mark.slow)
            for line in (
                "demo --output {out}",
                "diagnose {good} --simulation magnetometer --output {out}",
            )
        ),
    ],
    ids=lambda command: command[0],
)
def test_a_full_disk_of_stdout_is_reported_in_a_line(exported, good_table, tmp_path, command):
    places = {"model": exported[0] / "calibration.json", "good": good_table, "out": tmp_path / "out"}
    words = [word.format(**places) for word in command]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "mkc_torch.cli", *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert ended.returncode == 1
    assert ended.stderr == "mkc: the output could not be written: No space left on device.\n"


def test_apply_writes_the_fields_of_the_ros_message(good_table, exported, tmp_path):
    folder, _ = exported
    output = tmp_path / "messages.csv"
    result = mkc("apply", folder / "calibration.json", good_table, "--output", output, "--ros")
    assert result.exit_code == 0, result.output
    assert "median length" in result.output
    assert " T: " in result.output
    written = Recording.read(output, recognise=False)
    calibration = Calibration.from_json((folder / "calibration.json").read_text(encoding="utf-8"))
    field = torch.stack([written[f"magnetic_field.{axis}"] for axis in "xyz"], -1)
    assert torch.allclose(field, 1e-6 * calibration.corrected(Recording.read(good_table).magnetometer()), rtol=1e-9)
    covariance = torch.stack([written[f"magnetic_field_covariance[{i}]"] for i in range(9)], -1)
    assert (covariance[:, [0, 4, 8]] > 0).all()
    assert torch.equal(covariance[:, 1], covariance[:, 3])


def test_a_model_has_no_covariance_for_ros(model, good_table, tmp_path):
    result = mkc("apply", model, good_table, "--output", tmp_path / "a.csv", "--ros")
    assert result.exit_code == 1
    assert "calibration.json" in result.stderr
