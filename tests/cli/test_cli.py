import json
import os
import re
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import polars
import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")


from mkc_torch._support import files as _files
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.recording.demonstration import FIELD_PER_AMPERE, simulated_recording
from mkc_torch.recording.recording import Recording, write_table
from tests.calibration.test_calibrate import noisy_ellipsoid
from tests.cli.commands import assert_refused, mkc
from tests.shared_data import shared_data

AXES = ("mag_x", "mag_y", "mag_z")


def table(path, points, **columns):
    write_table(path, columns | dict(zip(AXES, points.unbind(-1), strict=True)))
    return path


@pytest.fixture
def good_table(tmp_path):
    points = noisy_ellipsoid(300)
    return table(tmp_path / "good.csv", points, time=torch.arange(300) / 50.0)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Return the folder of `mkc demo`, and its result."""
    folder = tmp_path_factory.mktemp("demo") / "out"
    result = mkc("demo", "--output", folder)
    assert result.exit_code == 0, result.output
    return folder, result


def test_the_version_is_that_of_the_package():
    result = mkc("--version")
    assert result.exit_code == 0
    assert result.output == f"mkc {version('mkc-torch')}\n"


def test_calibrate_writes_both_files_and_a_summary(good_table, tmp_path):
    result = mkc("calibrate", good_table, "--output", tmp_path / "out")
    assert result.exit_code == 0, result.output
    folder = tmp_path / "out" / "good"
    assert sorted(p.name for p in folder.iterdir()) == ["calibration.json", "report.html"]
    c = Calibration.from_json((folder / "calibration.json").read_text(encoding="utf-8"))
    assert c.center == pytest.approx((5.0, -9.0, 20.0), abs=0.3)
    for words in (
        "offset",
        "semi-axes",
        "residual",
        "noise",
        "µT along the field",
        "rejected",
        "coverage",
        "report.html",
        "±",
    ):
        assert words in result.stdout
    assert result.stderr == ""


@pytest.mark.e2e
def test_output_in_a_pipe_has_no_escape_codes(good_table, tmp_path):
    result = mkc("calibrate", good_table, tmp_path / "absent.csv", "--output", tmp_path / "out")
    assert "\x1b" not in result.stdout + result.stderr


@pytest.mark.e2e
def test_one_failing_recording_does_not_stop_the_others(good_table, tmp_path):
    other = table(tmp_path / "other.csv", noisy_ellipsoid(200, seed=3))
    result = mkc("calibrate", good_table, tmp_path / "absent.csv", other, "--output", tmp_path / "out")
    assert result.exit_code == 1
    assert sorted(p.name for p in (tmp_path / "out").iterdir() if p.is_dir()) == ["good", "other"]
    first, second = result.stderr.strip().splitlines()
    assert first == f"mkc: {tmp_path / 'absent.csv'}: there is no such file."
    assert second == "mkc: 1 of 3 recordings were not calibrated."


@pytest.mark.e2e
def test_existing_results_are_kept_without_force(good_table, tmp_path):
    assert mkc("calibrate", good_table, "--output", tmp_path).exit_code == 0
    before = (tmp_path / "good" / "calibration.json").read_bytes()
    assert_refused(mkc("calibrate", good_table, "--output", tmp_path), "not empty", "--force")
    assert (tmp_path / "good" / "calibration.json").read_bytes() == before
    forced = mkc("calibrate", good_table, "--output", tmp_path, "--field-strength", "50", "--force")
    assert forced.exit_code == 0
    assert (tmp_path / "good" / "calibration.json").read_bytes() != before


@pytest.mark.parametrize("name", ["report.html", "calibration.json"])
def test_force_replaces_no_file_of_the_user(good_table, tmp_path, name):
    (tmp_path / "good").mkdir()
    (tmp_path / "good" / name).write_text("mine")
    assert_refused(mkc("calibrate", good_table, "--output", tmp_path, "--force"), name, "not written by mkc")
    assert (tmp_path / "good" / name).read_text() == "mine"


def test_two_recordings_of_one_name_are_refused_before_any_work(good_table, tmp_path):
    (tmp_path / "more").mkdir()
    twin = table(tmp_path / "more" / "good.csv", noisy_ellipsoid(100))
    result = mkc("calibrate", good_table, twin, "--output", tmp_path / "out")
    assert_refused(result, "would both write into", code=2)
    assert_refused(
        mkc("calibrate", good_table, good_table, "--output", tmp_path / "out"), "would both write into", code=2
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", ["the file is empty"]),
        ("mag_x,mag_y,mag_z\n", ["header line but no rows"]),
        ("mag_x,mag_y,mag_z\n1,2,3\n", ["1 sample is too few", "at least 9"]),
        ("mag_x,mag_y,mag_z\n" + "1,2,3\n" * 8, ["8 samples are too few"]),
        ("mag_x,mag_y,mag_z\n" + "1,2,3\n" * 50, ["all points are equal", "report.html"]),
        ("mag_x,mag_y,mag_z\n" + "1,nan,3\n" * 50, ["no sample has finite values", "`mag_y` 50 NaN"]),
        ("mag_x,mag_y,mag_z\n" + "1,inf,3\n" * 50, ["no sample has finite values", "`mag_y` 50 infinite"]),
        ("mag_x,mag_y,mag_z\n1,2,3\n1,two,3\n", ["column `mag_y` holds text at line 3", '"two"']),
        ("mag_x,mag_y\n1,2\n3,4\n", ["no column `mag_z`", "`mag_x`, `mag_y`", "--columns"]),
        ("mag_x,mag_y,mag_z\n1,2\n", ["no rows of numbers", "cut short", "line 2"]),
    ],
)
def test_bad_files_are_refused_in_a_sentence(tmp_path, content, words):
    path = tmp_path / "bad.csv"
    path.write_text(content, encoding="utf-8")
    assert_refused(mkc("calibrate", path, "--output", tmp_path / "out"), str(path), *words)
    assert not (tmp_path / "out" / "bad" / "calibration.json").exists()


def test_absent_files_unknown_kinds_folders_and_other_encodings_are_refused(tmp_path):
    out = ("--output", tmp_path / "out")
    assert_refused(mkc("calibrate", tmp_path / "none.csv", *out), "none.csv: there is no such file")
    (tmp_path / "a.xyz").write_text("1")
    assert_refused(mkc("calibrate", tmp_path / "a.xyz", *out), ".xyz", ".csv")
    (tmp_path / "b.csv").mkdir()
    assert_refused(mkc("calibrate", tmp_path / "b.csv", *out), "this is a folder")
    (tmp_path / "c.csv").write_bytes(b"mag_x\n\x81\n")
    assert_refused(mkc("calibrate", tmp_path / "c.csv", *out), "UTF-8")


def test_constant_columns_and_coplanar_points_are_refused(tmp_path):
    points = noisy_ellipsoid()
    points[:, 1] = 3.0
    path = table(tmp_path / "constant.csv", points)
    assert_refused(mkc("calibrate", path, "--output", tmp_path / "out"), "y never changes")
    points[:, 1] = points[:, 0] - 2.0 * points[:, 2]
    path = table(tmp_path / "plane.csv", points)
    assert_refused(mkc("calibrate", path, "--output", tmp_path / "out"), "in a plane")


@pytest.mark.e2e
def test_unsorted_and_repeated_times_are_reported(tmp_path):
    time = torch.arange(300) / 50.0
    time[[4, 5]] = time[[5, 4]]
    time[50] = time[49]
    path = table(tmp_path / "times.csv", noisy_ellipsoid(300), time=time)
    result = mkc("calibrate", path, "--output", tmp_path / "out")
    assert result.exit_code == 0
    reported = " ".join(result.stdout.split())
    assert "ran backwards" in reported
    assert "repeat the time" in reported


@pytest.mark.parametrize("factor", [1e306, 1e-306])
def test_values_of_extreme_size_are_refused(tmp_path, factor):
    path = table(tmp_path / "odd.csv", noisy_ellipsoid() * factor)
    assert_refused(mkc("calibrate", path, "--output", tmp_path / "out"), str(path), "not a magnetic field")


@pytest.mark.e2e
@pytest.mark.parametrize("factor", [1e-9, 1e9])
def test_a_recording_of_any_scale_is_calibrated_with_a_unit_label(tmp_path, factor):
    path = table(tmp_path / "scaled.csv", noisy_ellipsoid() * factor)
    result = mkc("calibrate", path, "--output", tmp_path / "out", "--unit-label", "other")
    assert result.exit_code == 0, result.output
    text = (tmp_path / "out" / "scaled" / "calibration.json").read_text(encoding="utf-8")
    assert Calibration.from_json(text).center == pytest.approx((5 * factor, -9 * factor, 20 * factor), rel=0.05)


def test_an_output_folder_that_is_a_file_is_refused(good_table, tmp_path):
    (tmp_path / "file").write_text("mine")
    assert_refused(mkc("calibrate", good_table, "--output", tmp_path / "file"), str(tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="the superuser may write everywhere")
def test_an_output_folder_without_permission_is_refused(good_table, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o555)
    assert_refused(mkc("calibrate", good_table, "--output", tmp_path / "locked"), "permission denied")


@pytest.mark.e2e
def test_a_failed_write_leaves_no_partial_file(good_table, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "calibration.json")

    monkeypatch.setattr(_files.os, "fsync", full)
    assert_refused(mkc("calibrate", good_table, "--output", tmp_path / "out"), "no space left")
    assert not (tmp_path / "out" / "good").exists()


def test_usage_errors_exit_with_two(good_table, tmp_path):
    out = ("--output", tmp_path / "out")
    assert_refused(mkc("calibrate", *out), code=2)
    assert_refused(mkc("calibrate", good_table, *out, "--columns", "mag_x"), "mag_x=mx", code=2)
    assert_refused(mkc("calibrate", good_table, *out, "--columns", "mag_x=a,mag_x=b"), "twice", code=2)
    assert_refused(mkc("calibrate", good_table, *out, "--unit-label", " "), "--unit-label", code=2)
    for value in ("0", "-3", "nan", "inf"):
        assert_refused(mkc("calibrate", good_table, *out, "--field-strength", value), "positive", code=2)
    assert not (tmp_path / "out").exists()


@pytest.mark.e2e
def test_results_are_written_to_results_by_default(good_table, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = mkc("calibrate", good_table)
    assert result.exit_code == 0
    assert (tmp_path / "results" / "good" / "calibration.json").exists()
    assert f"mkc apply results/good/calibration.json {good_table} --output corrected.csv" in result.output


def test_a_doubtful_calibration_exits_with_three(tmp_path):
    path = shared_data("magnetometer/quadrotor_compass3.csv")
    result = mkc("calibrate", path, "--output", tmp_path)
    assert result.exit_code == 3
    first = " ".join(result.output.split()[:30])
    assert "Doubtful: the field's length scatters no less than before" in first
    assert (tmp_path / "quadrotor_compass3" / "calibration.json").exists()


def test_columns_and_units_given_as_options_are_used_and_repeated_in_the_command(tmp_path):
    points = 20.0 * noisy_ellipsoid(300)
    path = tmp_path / "own.csv"
    write_table(path, dict(zip(("mx", "my", "mz"), points.unbind(-1), strict=True)))
    assert_refused(
        mkc("calibrate", path, "--output", tmp_path / "out"),
        "milligauss",
        "`--convert mag=mG`",
        "`--unit-label counts`",
    )
    names = ("--columns", "mag_x=mx, mag_y=my,mag_z=mz")
    result = mkc(
        "calibrate", path, "--output", tmp_path / "out", *names, "--unit-label", "counts", "--field-strength", 48
    )
    assert result.exit_code == 0, result.output
    assert "counts" in result.stdout
    content = json.loads((tmp_path / "out" / "own" / "calibration.json").read_text(encoding="utf-8"))
    assert (content["unit"], content["field_strength"]) == ("counts", {"value": 48.0, "unit": "µT"})
    (proposed,) = [line for line in result.stdout.splitlines() if line.startswith("to do")]
    words = shlex.split(proposed.removeprefix("to do"))
    assert words[:2] == ["mkc", "apply"]
    applied = mkc(*words[1:-1], tmp_path / words[-1])  # the proposed command, as it stands
    assert applied.exit_code == 0, applied.output
    page = (tmp_path / "out" / "own" / "report.html").read_text(encoding="utf-8")
    assert "own.csv --columns mag_x=mx,mag_y=my,mag_z=mz --unit-label counts --output corrected.csv" in page
    assert_refused(mkc("calibrate", path, "--output", tmp_path / "o", "--columns", "mag_x=none"), "no column `none`")


def test_not_identifiable_writes_a_report_and_no_calibration(tmp_path):
    recording = Recording.read(shared_data("magnetometer/quadrotor_compass1.csv"))
    path = table(tmp_path / "quadrotor.csv", recording.magnetometer(), time=recording.time)  # and nothing to aid it
    folder = tmp_path / "quadrotor"
    folder.mkdir()
    (folder / "calibration.json").write_text('{"schema": "mkc-calibration/1"}')
    result = mkc("calibrate", path, "--output", tmp_path, "--force")
    assert_refused(result, "Not identifiable", "+z", "report.html")
    assert [p.name for p in folder.iterdir()] == ["report.html"]
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "not identifiable" in page
    assert "+z" in page
    assert_refused(
        mkc("calibrate", path, "--output", tmp_path), "Not identifiable"
    )  # a refusal does not block another attempt


@pytest.mark.e2e
def test_semi_axes_of_a_real_recording_are_recovered(tmp_path):
    path = shared_data("magnetometer/broad_28_stationary_magnet.csv")
    assert mkc("calibrate", path, "--output", tmp_path).exit_code == 0
    text = (tmp_path / path.stem / "calibration.json").read_text(encoding="utf-8")
    assert Calibration.from_json(text).semi_axes == pytest.approx((44.17, 44.50, 45.61), abs=0.6)


def test_applied_field_has_the_right_length(demo, tmp_path):
    folder, _ = demo
    output = tmp_path / "corrected.csv"
    result = mkc("apply", folder / "calibration.json", folder / "recording.csv", "--output", output)
    assert result.exit_code == 0, result.output
    field = Recording.read(output)
    new = ("field_x", "field_y", "field_z")
    assert field.names == (*(name for name in Recording.read(folder / "recording.csv").names), *new)
    assert len(field) == 4500
    c = Calibration.from_json((folder / "calibration.json").read_text(encoding="utf-8"))
    norm = field.stack("field_x", "field_y", "field_z").norm(dim=-1)
    assert float(norm.median()) == pytest.approx(c.field_strength, abs=0.1)


def test_apply_keeps_the_text_of_every_column(demo, tmp_path):
    """Also of time stamps, words and the digits of numbers."""
    folder, _ = demo
    new = tmp_path / "new.csv"
    header = "stamp,t,a,b,c,note,count"
    rows = ["2026-01-01T00:00:00,0.10,1,2,3,begin,1735689600000000001", "2026-01-01T00:00:01,0.20,4,5,6,,2"]
    new.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    renamed = ("--columns", "time=t,mag_x=a,mag_y=b,mag_z=c")
    output = tmp_path / "out.csv"
    assert mkc("apply", folder / "calibration.json", new, "--output", output, *renamed).exit_code == 0
    written = output.read_text(encoding="utf-8").splitlines()
    assert written[0] == f"{header},field_x,field_y,field_z"
    assert [line[: len(row)] for line, row in zip(written[1:], rows, strict=True)] == rows
    parquet = tmp_path / "out.parquet"
    assert mkc("apply", folder / "calibration.json", new, "--output", parquet, *renamed).exit_code == 0
    table = polars.read_parquet(parquet)
    assert table.columns == written[0].split(",")
    assert table["stamp"].to_list() == ["2026-01-01T00:00:00", "2026-01-01T00:00:01"]
    assert table["t"].to_list() == [0.1, 0.2]
    again = mkc("apply", folder / "calibration.json", parquet, "--output", tmp_path / "o.csv", *renamed)
    assert again.exit_code == 0, again.output


def test_apply_does_not_overwrite_and_keeps_rows_without_values(demo, tmp_path):
    folder, _ = demo
    new = tmp_path / "new.csv"
    new.write_text("time,a,b,c\n0,1,2,3\n1,,2,3\n", encoding="utf-8")
    output = tmp_path / "out.csv"
    command = ("apply", folder / "calibration.json", new, "--output", output, "--columns", "mag_x=a,mag_y=b,mag_z=c")
    result = mkc(*command)
    assert result.exit_code == 0
    assert "1 of 2 rows have no finite field" in result.stdout
    before = output.read_bytes()
    assert_refused(mkc(*command), str(output), "--force")
    assert output.read_bytes() == before
    assert mkc(*command, "--force").exit_code == 0


def test_apply_never_overwrites_what_it_reads(demo, tmp_path):
    folder, _ = demo
    recording, model = tmp_path / "mine.csv", tmp_path / "model.csv"
    recording.write_bytes((folder / "recording.csv").read_bytes())
    model.write_bytes((folder / "calibration.json").read_bytes())
    (tmp_path / "soft.csv").symlink_to(recording)
    (tmp_path / "hard.csv").hardlink_to(recording)
    (tmp_path / "folder").mkdir()
    before = recording.read_bytes(), model.read_bytes()
    for name in ("mine.csv", "soft.csv", "hard.csv", "folder/../mine.csv", "model.csv"):
        assert_refused(
            mkc("apply", model, recording, "--output", tmp_path / name, "--force"), "--output is the input file"
        )
    assert (recording.read_bytes(), model.read_bytes()) == before
    assert (tmp_path / "soft.csv").is_symlink()


def test_apply_warns_of_a_recording_at_another_place(demo, tmp_path):
    folder, _ = demo
    mine = Recording.read(folder / "recording.csv")
    other = table(tmp_path / "other.csv", 1.3 * mine.magnetometer())
    result = mkc("apply", folder / "calibration.json", other, "--output", tmp_path / "o.csv")
    assert result.exit_code == 0
    assert "times the 48.2 µT of the calibrated recording" in result.stdout
    assert "check the unit" in result.stdout
    result = mkc("apply", folder / "calibration.json", folder / "recording.csv", "--output", tmp_path / "p.csv")
    assert "warning" not in result.stdout
    assert "median length 48.2" in result.stdout


@pytest.mark.e2e
def test_text_of_the_user_is_printed_without_markup(demo, tmp_path):
    """In Rich markup, :X: is an emoji and [b] is bold."""
    odd = tmp_path / "no:X:[b]file.csv"
    result = mkc("apply", demo[0] / "calibration.json", odd, "--output", tmp_path / "o.csv")
    assert result.stderr == f"mkc: {odd}: there is no such file.\n"
    path = table(odd, noisy_ellipsoid(300))
    result = mkc("calibrate", path, "--output", tmp_path / "out", "--unit-label", ":X:[b]")
    assert result.exit_code == 0
    assert "no:X:[b]file: Calibrated" in result.stdout
    assert "± SE, :X:[b] " in result.stdout
    assert str(tmp_path / "out" / "no:X:[b]file" / "report.html") in result.stdout


def test_apply_refuses_unusable_files(demo, tmp_path):
    folder, _ = demo
    c, rec, out = folder / "calibration.json", folder / "recording.csv", ("--output", tmp_path / "o.csv")
    assert_refused(mkc("apply", tmp_path / "none.json", rec, *out), "none.json: there is no such file")
    assert_refused(mkc("apply", tmp_path, rec, *out), "this is a folder")
    assert_refused(mkc("apply", rec, rec, *out), "recording.csv", "not JSON")
    assert_refused(mkc("apply", c, tmp_path / "none.csv", *out), "none.csv: there is no such file")
    (tmp_path / "two.csv").write_text("mag_x,mag_y\n1,2\n")
    assert_refused(mkc("apply", c, tmp_path / "two.csv", *out), "no column `mag_z`")
    assert_refused(mkc("apply", c, rec, "--output", tmp_path / "o.xyz"), ".xyz")
    assert_refused(mkc("apply", c, rec, "--output", tmp_path / "none" / "o.csv"), "there is no folder")
    binary = tmp_path / "binary.json"
    binary.write_bytes(b"\xff\xfe\x80")
    assert_refused(mkc("apply", binary, rec, *out), "not a text file")
    assert not (tmp_path / "o.csv").exists()


DEMO = ["calibration.json", "concealed", "concealed.csv", "corrected.csv", "recording.csv", "report.html", "second.csv"]


def test_demo_is_marked_as_simulated_and_shows_the_truth(demo):
    folder, result = demo
    assert sorted(p.name for p in folder.iterdir()) == DEMO
    assert "SIMULATED" in result.stdout
    for row in ("truth", "least squares", "MKC-EM"):
        assert row in result.stdout
    assert "SIMULATED" in (folder / "report.html").read_text(encoding="utf-8")
    assert torch.equal(Recording.read(folder / "recording.csv").magnetometer(), simulated_recording()[0].magnetometer())


def test_demo_finds_the_concealed_current_and_corrects_a_second_recording(demo):
    folder, result = demo
    place = folder / "concealed"
    assert sorted(p.name for p in place.iterdir()) == ["diagnosis.json", "model.json", "report.html"]
    found = json.loads((place / "diagnosis.json").read_text(encoding="utf-8"))
    (finding,) = found["findings"]
    assert (finding["effect"], finding["drivers"]) == ("current_field", ["current"])
    (parameter,) = (p for p in finding["parameters"] if p["name"] == "field_per_ampere")
    for value, error, true in zip(parameter["value"], parameter["standard_error"], FIELD_PER_AMPERE, strict=True):
        assert abs(value - true) < 4.0 * error < 0.2
    assert finding["held_out"]["rmse_after"] < 0.9 * finding["held_out"]["rmse_before"]
    assert "SIMULATED: no sensor recorded this" in (place / "report.html").read_text(encoding="utf-8")
    assert "Left out of the simulation: current field (current)." in result.stdout
    alone, model = (float(x) for x in re.findall(r"(?:alone|findings)   +(\d\.\d\d) µT", result.stdout))
    assert model < 0.9 * alone
    again = mkc("apply", place / "model.json", folder / "second.csv", "--output", folder.parent / "again.csv")
    assert again.exit_code == 0
    assert (folder.parent / "again.csv").read_bytes() == (folder / "corrected.csv").read_bytes()


@pytest.mark.e2e
def test_demo_refuses_existing_folders_and_files_of_the_user(demo, tmp_path):
    folder, _ = demo
    assert_refused(mkc("demo", "--output", folder), "not empty", "--force")
    assert mkc("demo", "--output", folder, "--force").exit_code == 0
    (tmp_path / "concealed").mkdir()
    for name in ("second.csv", "concealed/report.html"):
        (tmp_path / name).write_text("mine")
        assert_refused(mkc("demo", "--output", tmp_path, "--force"), name, "not written by mkc")
        assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == [Path(name).name]
        assert (tmp_path / name).read_text() == "mine"
        (tmp_path / name).unlink()


@pytest.mark.e2e
def test_calibrate_reproduces_the_calibration_of_the_demo(demo, tmp_path):
    folder, _ = demo
    assert mkc("calibrate", folder / "recording.csv", "--output", tmp_path).exit_code == 0
    first = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    second = json.loads((tmp_path / "recording" / "calibration.json").read_text(encoding="utf-8"))
    nameless = {"recording": "", "name": ""}
    assert first | nameless == second | nameless


def run_python(*arguments, encoding_of_pipes="utf-8"):
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, encoding="utf-8", check=False, timeout=300,
        env=os.environ | {"PYTHONIOENCODING": encoding_of_pipes, "FORCE_COLOR": "1"},
    )  # fmt: skip


@pytest.mark.process
def test_output_of_a_process_in_a_pipe_has_no_control_codes(good_table, tmp_path):
    absent = tmp_path / "absent.csv"
    done = run_python(
        "-m", "mkc_torch.cli", "calibrate", str(good_table), str(absent), "--output", str(tmp_path / "out")
    )
    assert done.returncode == 1
    assert "\x1b" not in done.stdout + done.stderr
    assert "\r" not in done.stdout + done.stderr
    assert "offset" in done.stdout
    # a busy machine reports progress too
    failures = [line for line in done.stderr.splitlines() if not line.startswith("mkc: after ")]
    assert failures[0] == f"mkc: {absent}: there is no such file."


@pytest.mark.process
def test_a_pipe_in_ascii_is_written_to(demo, tmp_path):
    command = ("calibrate", str(demo[0] / "recording.csv"), "--output", str(tmp_path / "out"))
    done = run_python("-m", "mkc_torch.cli", *command, encoding_of_pipes="ascii")
    assert done.returncode == 0, done.stderr
    assert "offset" in done.stdout


@pytest.mark.parametrize("missing", ["typer", "rich", "polars", "matplotlib", "jinja2", "jsonschema", "threadpoolctl"])
def test_a_missing_extra_is_reported_in_a_line_with_the_remedy(missing):
    code = f"import sys; sys.modules[{missing!r}] = None; from mkc_torch.cli import main; main()"
    done = run_python("-c", code, "demo")
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert f"{missing} is not installed" in line
    assert 'pip install "mkc-torch[cli]"' in line


def test_a_recording_without_a_name_is_refused(good_table, tmp_path):
    nameless = tmp_path / "in" / "...csv"
    nameless.parent.mkdir()
    nameless.write_bytes(good_table.read_bytes())
    for command in (("calibrate",), ("diagnose", "--simulation", "magnetometer")):
        result = mkc(*command, nameless, "--output", tmp_path / "out")
        assert result.exit_code == 2
        assert "is not a valid name for a results folder" in " ".join(result.stderr.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.process
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_of_stdout_is_reported_in_a_line(good_table, tmp_path):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "mkc_torch.cli", "calibrate", good_table, "--output", tmp_path / "out"],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith("No space left on device.")


def test_invalid_place_date_and_sensor_are_refused_in_a_sentence(good_table, tmp_path):
    out = ("--output", tmp_path / "out")
    assert_refused(mkc("calibrate", good_table, *out, "--place", "48,11"), "--recorded-on", code=2)
    assert_refused(
        mkc("calibrate", good_table, *out, "--place", "48", "--recorded-on", "2026-01-01"), "LAT,LON", code=2
    )
    assert_refused(
        mkc("calibrate", good_table, *out, "--place", "48,11", "--recorded-on", "1.1.26"), "YYYY-MM-DD", code=2
    )
    assert_refused(
        mkc("calibrate", good_table, *out, "--place", "48,11", "--recorded-on", "1999-01-01"), "2015-01-01", code=2
    )
    assert_refused(mkc("calibrate", good_table, *out, "--sensor", "sonar"), "sonar")
    assert_refused(mkc("calibrate", good_table, *out, "--quantity", "accel"), "no column `accel_x`")
