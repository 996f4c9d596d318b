"""`mkc calibrate --export`, `--name`, `--compare-with`, and `mkc export`, as a user calls them."""

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
from tests.cli.test_cli import mkc, refused, table
from tests.diagnosis.files.test_sensor_correction import CABLE, TEMPERATURE, model_of

KINDS = tuple(kind for kind in EVERY_KIND if kind != "imu-calib")
"""Exports of a magnetometer."""

EVERY = tuple(word for kind in KINDS for word in ("--export", kind))


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    return table(folder / "good.csv", noisy_ellipsoid(300), time=torch.arange(300) / 50.0)


@pytest.fixture(scope="module")
def done(good, tmp_path_factory):
    """A folder with a calibration and each export of it, and what the command said."""
    folder = tmp_path_factory.mktemp("done")
    result = mkc("calibrate", good, "--output", folder, "--name", "mast", "--device-id", 396825, *EVERY)
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
def no_pictures(monkeypatch):
    """A report in no time, where it is not what is looked at."""
    monkeypatch.setattr(page, "calibration_report", lambda *_, **__: "Made by mkc_torch")


def file_of(kind):
    return EXPORTS[kind].file


def test_every_export_is_written_and_named(done):
    folder, result = done
    assert {path.name for path in folder.iterdir()} == {"calibration.json", "report.html", *map(file_of, KINDS)}
    for kind in KINDS:
        assert file_of(kind) in result.stdout
        assert "mast" in (folder / file_of(kind)).read_text(encoding="utf-8")
    assert result.stderr == ""


def test_the_file_for_px4_corrects_as_apply_does(done, good, tmp_path):
    folder, _ = done
    output = tmp_path / "corrected.csv"
    assert mkc("apply", folder / "calibration.json", good, "--output", output).exit_code == 0
    written = Recording.read(output)
    values = formulas.qgroundcontrol((folder / "px4.params").read_text(encoding="utf-8"))
    field = formulas.px4(values, written.magnetometer().numpy() * 1e-6)
    assert np.abs(field - written.stack("field_x", "field_y", "field_z").numpy() * 1e-6).max() < 0.01e-6
    assert values["CAL_MAG0_ID"] == 396825


def test_the_name_is_in_the_calibration_the_report_and_on_the_terminal(done):
    folder, result = done
    calibration = Calibration.from_json((folder / "calibration.json").read_text(encoding="utf-8"))
    assert (calibration.name, calibration.recording) == ("mast", "good")
    assert result.stdout.split()[0] == "mast:"
    shown = (folder / "report.html").read_text(encoding="utf-8")
    assert "Calibration of mast" in shown
    assert "mast · good" in shown


def test_a_calibration_of_before_names_is_read(done):
    content = json.loads((done[0] / "calibration.json").read_text(encoding="utf-8"))
    del content["name"]
    assert Calibration.from_json(json.dumps(content)).name == "good"


@pytest.mark.usefixtures("no_pictures")
def test_without_a_name_the_sensor_is_called_as_the_recording(good, tmp_path):
    assert mkc("calibrate", good, "--output", tmp_path, "--export", "json").exit_code == 0
    numbers = json.loads((tmp_path / "good" / file_of("json")).read_text(encoding="utf-8"))
    assert numbers["name"] == "good"


@pytest.mark.usefixtures("no_pictures")
def test_raw_counts_are_calibrated_and_not_exported(good, tmp_path):
    """The calibration stands; the exports that need a unit are refused with what to do."""
    asked = ("--unit-label", "counts", "--export", "px4", "--export", "json")
    result = mkc("calibrate", good, "--output", tmp_path, *asked)
    refused(result, str(good), "in counts", "px4 needs gauss", "--convert mag=gauss")
    assert {path.name for path in (tmp_path / "good").iterdir()} == {
        "calibration.json",
        "report.html",
        file_of("json"),
    }


def test_a_file_of_the_users_own_is_not_replaced(good, tmp_path):
    (tmp_path / "good").mkdir()
    own = tmp_path / "good" / "px4.params"
    own.write_text("# mine\n")
    refused(mkc("calibrate", good, "--output", tmp_path, "--export", "px4", "--force"), "px4.params", "not written by")
    assert own.read_text() == "# mine\n"


@pytest.mark.usefixtures("no_pictures")
def test_exports_of_an_earlier_calibration_are_reported_and_kept(good, tmp_path):
    assert mkc("calibrate", good, "--output", tmp_path, "--export", "px4", "--export", "json").exit_code == 0
    before = (tmp_path / "good" / "px4.params").read_bytes()
    again = mkc("calibrate", good, "--output", tmp_path, "--export", "json", "--force", "--field-strength", 48)
    assert again.exit_code == 0
    assert "px4.params in" in again.stdout
    assert "belongs to an earlier calibration" in " ".join(again.stdout.split())
    assert (tmp_path / "good" / "px4.params").read_bytes() == before


@pytest.mark.e2e
def test_the_new_calibration_is_compared_with_the_old(done, tmp_path):
    old = done[0] / "calibration.json"
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


@pytest.mark.usefixtures("no_pictures")
def test_the_compared_calibration_is_never_replaced(good, tmp_path):
    assert mkc("calibrate", good, "--output", tmp_path).exit_code == 0
    old = tmp_path / "good" / "calibration.json"
    before = old.read_bytes()
    result = mkc("calibrate", good, "--output", tmp_path, "--compare-with", old, "--field-strength", 48, "--force")
    refused(result, "--output would replace", "choose another")
    assert old.read_bytes() == before


def test_an_invalid_old_calibration_is_refused_before_any_work(good, model, tmp_path):
    out = ("--output", tmp_path / "out")
    refused(mkc("calibrate", good, *out, "--compare-with", tmp_path / "none.json"), "none.json", "no such file")
    refused(mkc("calibrate", good, *out, "--compare-with", model), "model.json", "calibration.json of `mkc calibrate`")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_pictures")
def test_incomparable_units_are_reported_and_the_calibration_is_written(done, good, tmp_path):
    old = done[0] / "calibration.json"
    result = mkc("calibrate", good, "--output", tmp_path, "--unit-label", "counts", "--compare-with", old)
    refused(result, "counts", "same unit options")
    assert (tmp_path / "good" / "calibration.json").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_a_calibration_that_exists_is_exported(done, tmp_path, kind):
    output = tmp_path / "file"
    command = ("export", done[0] / "calibration.json", "--to", kind, "--output", output)
    result = mkc(*command)
    assert result.exit_code == 0, result.output
    given = (done[0] / file_of(kind)).read_text(encoding="utf-8")
    text = output.read_text(encoding="utf-8")
    assert [line for line in text.splitlines() if "_ID" not in line] == [
        line for line in given.splitlines() if "_ID" not in line and "_ROT, the sensor" not in line
    ]
    assert str(output) in result.stdout
    refused(mkc(*command), str(output), "--force")
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


def test_export_never_overwrites_what_it_reads(done, tmp_path):
    copy = tmp_path / "calibration.json"
    copy.write_bytes((done[0] / "calibration.json").read_bytes())
    refused(mkc("export", copy, "--to", "json", "--output", copy, "--force"), "--output is the input file")
    assert copy.read_bytes() == (done[0] / "calibration.json").read_bytes()


def test_what_is_no_calibration_is_refused(tmp_path, done):
    out = ("--to", "px4", "--output", tmp_path / "a.params")
    refused(mkc("export", tmp_path / "none.json", *out), "no such file")
    refused(mkc("export", tmp_path, *out), "this is a folder")
    refused(mkc("export", done[0] / file_of("json"), *out), "its schema is")
    (tmp_path / "bad.json").write_text("{")
    refused(mkc("export", tmp_path / "bad.json", *out), "not JSON")
    other = tmp_path / "pendulum.json"
    other.write_text(model_of([], [], simulation="Pendulum").to_json(), encoding="utf-8")
    refused(mkc("export", other, *out), "Pendulum")
    assert not (tmp_path / "a.params").exists()


def test_wrong_options_are_refused_before_any_work(done, good, tmp_path):
    out = ("--output", tmp_path / "out")
    model = done[0] / "calibration.json"
    refused(mkc("calibrate", good, *out, "--export", "qgc"), "--export", "px4, ardupilot, c-header", code=2)
    refused(mkc("export", model, *out, "--to", "qgc"), "--to", "qgc", code=2)
    refused(mkc("calibrate", good, *out, "--instance", 1), "--instance", "px4", code=2)
    refused(mkc("calibrate", good, *out, "--instance", -1, "--export", "px4"), "at least 0", code=2)
    refused(mkc("calibrate", good, *out, "--device-id", 7, "--export", "ardupilot"), "--device-id", code=2)
    refused(mkc("calibrate", good, *out, "--name", " "), "--name", code=2)
    refused(mkc("calibrate", good, model, *out, "--name", "mast"), "one REC", code=2)
    refused(mkc("export", model, *out, "--to", "json", "--name", ""), "--name", code=2)
    refused(mkc("export", model, *out, "--to", "px4", "--instance", 9), "0 to 3")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_pictures")
def test_a_full_disk_names_the_file(good, tmp_path, monkeypatch):
    """The system's error of a write that finds no room names none."""

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    result = mkc("calibrate", good, "--output", tmp_path / "out")
    refused(result, str(tmp_path / "out" / "good" / "calibration.json"), "no space left on device")
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
def test_a_full_disk_behind_stdout_is_reported_in_a_line(done, good, tmp_path, command):
    places = {"model": done[0] / "calibration.json", "good": good, "out": tmp_path / "out"}
    words = [word.format(**places) for word in command]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "mkc_torch.cli", *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert ended.returncode == 1
    assert ended.stderr == "mkc: the output could not be written: No space left on device.\n"


def test_apply_writes_the_fields_of_the_message_of_ros(good, done, tmp_path):
    folder, _ = done
    output = tmp_path / "messages.csv"
    result = mkc("apply", folder / "calibration.json", good, "--output", output, "--ros")
    assert result.exit_code == 0, result.output
    assert "median length" in result.output
    assert " T: " in result.output
    written = Recording.read(output, recognise=False)
    calibration = Calibration.from_json((folder / "calibration.json").read_text(encoding="utf-8"))
    field = torch.stack([written[f"magnetic_field.{axis}"] for axis in "xyz"], -1)
    assert torch.allclose(field, 1e-6 * calibration.corrected(Recording.read(good).magnetometer()), rtol=1e-9)
    covariance = torch.stack([written[f"magnetic_field_covariance[{i}]"] for i in range(9)], -1)
    assert (covariance[:, [0, 4, 8]] > 0).all()
    assert torch.equal(covariance[:, 1], covariance[:, 3])


def test_a_model_has_no_covariance_for_ros(model, good, tmp_path):
    result = mkc("apply", model, good, "--output", tmp_path / "a.csv", "--ros")
    assert result.exit_code == 1
    assert "calibration.json" in result.stderr
