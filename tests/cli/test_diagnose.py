import json
import math
import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool

import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("jsonschema")


from mkc_torch._support import files as _files
from mkc_torch.cli import diagnosis_files
from mkc_torch.cli.console import ConsoleStyle
from mkc_torch.cli.diagnose import _waited_for
from mkc_torch.diagnosis import DiagnosedModel, vetoes
from mkc_torch.diagnosis.decisions import Decision
from mkc_torch.diagnosis.io.diagnosis_json import validate
from mkc_torch.recording.recording import Recording, write_table
from tests.cli.commands import assert_refused, mkc
from tests.diagnosis.factory import make_diagnosis
from tests.started import started

AXES = ("mag_x", "mag_y", "mag_z")
WRITTEN = ["diagnosis.json", "model.json", "report.html"]
QUICK = ("--simulation", "magnetometer", "--surrogates", "19")
QUIET, STEPPED = 3, 1


def diagnose_magnetometer(*arguments):
    return mkc("diagnose", *arguments, *QUICK)


def sensor_columns(seed, *, step=0.0, count=500, start=0.0):
    """Return the columns of a magnetometer turned by hand for 20 s, with a step of its offset at 9 s."""
    g = torch.Generator().manual_seed(seed)
    t = torch.arange(count, dtype=torch.float64) / 25.0
    speed = 0.4 + 1.2 * torch.rand(4, 3, generator=g, dtype=torch.float64)
    phase = 2.0 * math.pi * torch.rand(4, 3, generator=g, dtype=torch.float64)
    field = 50.0 * torch.nn.functional.normalize(torch.sin(t[:, None, None] * speed + phase).sum(1), dim=-1)
    measured = field * torch.tensor([1.04, 0.97, 1.0]) + torch.tensor([4.0, -7.0, 12.0])
    measured = measured + 0.3 * torch.randn(count, 3, generator=g, dtype=torch.float64)
    measured = measured + step * torch.tensor([5.0, -4.0, 3.0]) * (t + start >= 9.0)[:, None]
    return {"time": t + start} | dict(zip(AXES, measured.unbind(-1), strict=True))


def table(path, columns):
    write_table(path, columns)
    return path


def quiet_table(path, **changes):
    """Write a recording without missing physics; columns can be changed, added, or removed by None."""
    columns = sensor_columns(QUIET) | changes
    return table(path, {name: values for name, values in columns.items() if values is not None})


def content_of(folder):
    return json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))


def warnings_of(path, output, *more):
    """Return warnings and notes of a diagnosis, and assert that the terminal shows the same warnings."""
    result = diagnose_magnetometer(path, "--output", output, *more)
    assert result.exit_code == 0, result.output
    content = content_of(output / path.stem)
    assert ("warning" in result.stdout) == bool(content["warnings"])
    return " ".join([*content["warnings"], *content["notes"]])


@pytest.fixture(scope="module")
def step_diagnosis(tmp_path_factory):
    """Return a recording with a step, the folder of its diagnosis, and the printed text."""
    folder = tmp_path_factory.mktemp("stepped")
    path = table(folder / "stepped.csv", sensor_columns(STEPPED, step=1.0))
    result = diagnose_magnetometer(path, "--output", folder / "out", "--seed", "5")
    assert result.exit_code == 0, result.output
    return path, folder / "out" / "stepped", result


def test_diagnose_writes_its_files_and_a_summary(step_diagnosis):
    path, folder, result = step_diagnosis
    assert sorted(p.name for p in folder.iterdir()) == WRITTEN
    content = content_of(folder)
    validate(content)
    assert (content["recording"], content["simulation"], content["verdict"]) == (path.stem, "magnetometer", "explained")
    search = {"candidates": content["search"]["candidates"], "surrogates": 19, "seed": 5}
    rest = {"quick": False, "stopped": None, "restart_after": None, "starts": content["search"]["starts"]}
    assert content["search"] == search | rest
    first = content["findings"][0]
    assert first["effect"] == "hard_iron_step"
    assert first["onset"] == pytest.approx(9.0, abs=0.2)
    for words in ("hard-iron step", "from 9.0 s on", "how sure", "held out", "to do", "report.html", "model.json"):
        assert words in result.stdout
    assert result.stderr == ""
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>")
    assert "hard-iron step" in page


def test_an_unconfirmed_finding_is_in_no_corrected_number_of_any_file(tmp_path, monkeypatch):
    def refused(finding, context):
        return Decision("held_out_blocks", "", 0.0, 1.0, False, "Refused.", context.number)

    monkeypatch.setattr(vetoes, "VETOES", (refused,))
    path = table(tmp_path / "stepped.csv", sensor_columns(STEPPED, step=1.0))
    result = diagnose_magnetometer(path, "--output", tmp_path / "out")
    assert result.exit_code == 3, result.output
    folder = tmp_path / "out" / "stepped"
    content = content_of(folder)
    assert [finding["grade"] for finding in content["findings"]] == ["unconfirmed"]
    assert content["corrected"] == content["baseline"]
    assert json.loads((folder / "model.json").read_text(encoding="utf-8"))["effects"] == []
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "with the findings" not in page
    assert "Residual of the fitted simulation" in page
    assert "leaves out <code>hard_iron_step</code>: not confirmed" in page


def test_the_model_corrects_a_second_recording(step_diagnosis, tmp_path):
    _, folder, _ = step_diagnosis
    new = table(tmp_path / "new.csv", sensor_columns(7, step=1.0, start=100.0))
    output = tmp_path / "corrected.csv"
    result = mkc("apply", folder / "model.json", new, "--output", output)
    assert result.exit_code == 0, result.output
    assert "note: hard_iron_step depends on the time" in result.stdout
    corrected = Recording.read(output)
    assert corrected.names == (*Recording.read(new).names, "field_x", "field_y", "field_z")
    length = corrected.stack("field_x", "field_y", "field_z").norm(dim=-1)
    assert float(length.std() / length.mean()) < 0.01
    model = DiagnosedModel.from_json((folder / "model.json").read_text(encoding="utf-8"))
    assert torch.equal(corrected["field_x"], model(Recording.read(new))["field_x"])
    assert f"median length {float(length.median()):.5g} µT: {output}" in result.stdout
    assert "warning" not in result.stdout


def test_the_model_has_the_unit_and_the_strength_of_the_field(step_diagnosis, tmp_path):
    _, folder, _ = step_diagnosis
    new = sensor_columns(7, step=1.0, start=100.0)
    other = table(tmp_path / "other.csv", {n: 1e3 * v if n.startswith("mag_") else v for n, v in new.items()})
    command = ("apply", folder / "model.json", other, "--output", tmp_path / "corrected.csv")
    assert_refused(mkc(*command), "`--convert mag=nT`")
    content = json.loads((folder / "model.json").read_text(encoding="utf-8"))
    del content["state"]["unit"], content["state"]["strength"]  # of an earlier version
    (tmp_path / "old.json").write_text(json.dumps(content), encoding="utf-8")
    result = mkc("apply", tmp_path / "old.json", other, "--output", tmp_path / "old.csv")
    assert result.exit_code == 0
    assert "warning" not in result.stdout


def test_apply_distinguishes_models_from_other_files(step_diagnosis, tmp_path):
    path, folder, _ = step_diagnosis
    out = ("--output", tmp_path / "o.csv")
    assert_refused(
        mkc("apply", folder / "diagnosis.json", path, *out), "diagnosis.json", "model.json in the same folder"
    )
    assert_refused(mkc("apply", folder, path, *out), "this is a folder", "model.json")
    content = json.loads((folder / "model.json").read_text(encoding="utf-8"))
    for change, words in (
        ({"schema": "mkc-model/9"}, ['its schema is "mkc-model/9"', "mkc diagnose"]),
        ({"schema": None}, ["its schema is missing"]),
        ({"effects": [content["effects"][0] | {"effect": "of_my_own"}]}, ['"of_my_own" is unknown']),
        ({"parameters": "none"}, ["damaged"]),
    ):
        (tmp_path / "odd.json").write_text(json.dumps(content | change), encoding="utf-8")
        assert_refused(mkc("apply", tmp_path / "odd.json", path, *out), "odd.json", *words)
    (tmp_path / "odd.json").write_text("[1, 2", encoding="utf-8")
    assert_refused(mkc("apply", tmp_path / "odd.json", path, *out), "not JSON")
    assert not (tmp_path / "o.csv").exists()


def test_existing_results_are_kept_without_force(step_diagnosis):
    path, folder, _ = step_diagnosis
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert_refused(diagnose_magnetometer(path, "--output", folder.parent), "not empty", "--force")
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


@pytest.mark.e2e
def test_force_replaces_results_and_keeps_other_files(tmp_path):
    path, folder = quiet_table(tmp_path / "a.csv"), tmp_path / "a"
    folder.mkdir()
    for name in (*WRITTEN, "notes.txt"):
        (folder / name).write_text("mine")
    assert_refused(diagnose_magnetometer(path, "--output", tmp_path, "--force"), "not written by mkc")
    for name in WRITTEN:
        (folder / name).write_text('{"schema": "mkc-diagnosis/1"} Made by mkc_torch')
    assert diagnose_magnetometer(path, "--output", tmp_path, "--force").exit_code == 0
    assert sorted(p.name for p in folder.iterdir()) == sorted((*WRITTEN, "notes.txt"))
    assert (folder / "notes.txt").read_text() == "mine"
    assert content_of(folder)["verdict"] == "adequate"


@pytest.mark.e2e
def test_a_missing_time_column_is_warned_of(tmp_path):
    assert "no column `time`" in warnings_of(quiet_table(tmp_path / "a.csv", time=None), tmp_path / "out")


@pytest.mark.e2e
def test_gaps_repeated_and_reversed_times_are_warned_of(tmp_path):
    clock = sensor_columns(QUIET)["time"]
    clock[250:] += 5.0
    clock[[10, 11]] = clock[[11, 10]]
    clock[50] = clock[49]
    reported = warnings_of(quiet_table(tmp_path / "a.csv", time=clock), tmp_path / "out")
    for words in ("ran backwards 1 time", "Dropped 1 of 500 samples that repeat", "1 gap of more than"):
        assert words in reported


@pytest.mark.e2e
def test_constant_empty_and_copied_columns_are_warned_of(tmp_path):
    slope = torch.linspace(20.0, 30.0, 500, dtype=torch.float64)
    slope = slope + 0.1 * torch.randn(500, generator=torch.Generator().manual_seed(0))
    path = quiet_table(
        tmp_path / "a.csv",
        temperature=slope,
        copy=2.0 * slope + 1.0,
        still=torch.full((500,), 3.0),
        empty=torch.full((500,), math.nan),
    )
    reported = warnings_of(path, tmp_path / "out")
    for words in ("`still` is constant", "`empty` has no finite values", "`temperature` and `copy` are copies"):
        assert words in reported


@pytest.mark.e2e
@pytest.mark.parametrize(("factor", "unit", "option"), [(0.01, "gauss", "gauss"), (1000.0, "nanotesla", "nT")])
def test_other_units_are_refused_or_converted(tmp_path, factor, unit, option):
    scaled = {name: factor * sensor_columns(QUIET)[name] for name in AXES}
    path = quiet_table(tmp_path / "a.csv", **scaled)
    assert_refused(diagnose_magnetometer(path, "--output", tmp_path / "out"), unit, f"`--convert mag={option}`")
    assert f"converted from {option}" in warnings_of(path, tmp_path / "own", "--convert", f"mag={option}")
    assert content_of(tmp_path / "own" / "a")["baseline"]["rmse"] == pytest.approx(0.3, rel=0.2)


@pytest.mark.e2e
def test_raw_counts_are_reported_and_keep_their_name(tmp_path):
    path = quiet_table(tmp_path / "a.csv", **{name: 100.0 * sensor_columns(QUIET)[name] for name in AXES})
    assert "may be raw counts" in warnings_of(path, tmp_path / "out")
    assert warnings_of(path, tmp_path / "own", "--unit-label", "counts") == ""
    assert content_of(tmp_path / "own" / "a")["baseline"]["rmse"] == pytest.approx(30.0, rel=0.2)


@pytest.mark.parametrize(
    ("changes", "rows", "words"),
    [
        ({}, 2, ["2 samples are too few", "Record"]),
        ({"mag_y": None}, 500, ["no column `mag_y`", "--columns"]),
        ({"mag_y": torch.full((500,), math.nan)}, 500, ["no sample has finite values"]),
        (dict.fromkeys(AXES, torch.full((500,), 20.0)), 500, ["all points are equal", "Turn the sensor"]),
        ({"time": torch.full((500,), math.nan)}, 500, ["no sample has a finite time"]),
    ],
)
def test_bad_recordings_are_refused_in_a_sentence(tmp_path, changes, rows, words):
    columns = {name: values for name, values in (sensor_columns(QUIET) | changes).items() if values is not None}
    path = table(tmp_path / "bad.csv", {name: values[:rows] for name, values in columns.items()})
    assert_refused(diagnose_magnetometer(path, "--output", tmp_path / "out"), f"mkc: {path}: ", *words)
    assert not (tmp_path / "out" / "bad").exists()


def test_a_sensor_at_rest_has_the_advice_to_turn_it(tmp_path):
    generator = torch.Generator().manual_seed(0)
    still = {name: 20.0 + 0.3 * torch.randn(150, generator=generator, dtype=torch.float64) for name in AXES}
    path = table(tmp_path / "a.csv", {"time": torch.arange(150) / 25.0} | still)
    result = diagnose_magnetometer(path, "--output", tmp_path / "out")
    assert result.exit_code == 1 or "warning" in result.stdout
    assert "Turn the sensor" in result.output


@pytest.mark.e2e
def test_one_failing_recording_does_not_stop_the_other(tmp_path):
    good, bad = quiet_table(tmp_path / "good.csv"), tmp_path / "bad.csv"
    bad.write_text("time,mag_x,mag_y,mag_z\n0,1,two,3\n")
    result = diagnose_magnetometer(bad, good, "--output", tmp_path / "out")
    assert_refused(result, f"mkc: {bad}: column `mag_y` holds text", "1 of 2 recordings were not diagnosed", lines=2)
    assert [p.name for p in (tmp_path / "out").iterdir() if p.is_dir()] == ["good"]
    assert sorted(p.name for p in (tmp_path / "out" / "good").iterdir()) == WRITTEN
    assert "good against magnetometer" in result.stdout


@pytest.mark.e2e
def test_runs_of_a_file_are_diagnosed_separately(tmp_path):
    long, short = sensor_columns(QUIET), {name: values[:5] for name, values in sensor_columns(QUIET).items()}
    columns = {name: torch.cat([long[name], short[name]]) for name in long}
    path = table(tmp_path / "a.csv", columns)
    text = path.read_text(encoding="utf-8").splitlines()
    labels = ["run", *["flight/1"] * 500, *["2"] * 5]
    path.write_text("\n".join(f"{a},{b}" for a, b in zip(text, labels, strict=True)), encoding="utf-8")
    result = diagnose_magnetometer(path, "--output", tmp_path / "out", "--run-column", "run")
    assert_refused(result, f"{path}, run 2: 5 samples are too few", "1 of 2 recordings", lines=2)
    assert [p.name for p in (tmp_path / "out" / "a").iterdir()] == ["flight_1"]
    assert content_of(tmp_path / "out" / "a" / "flight_1")["recording"] == "a/flight/1"


@pytest.mark.e2e
def test_recordings_are_diagnosed_together(tmp_path):
    a, b = quiet_table(tmp_path / "a.csv"), table(tmp_path / "b.csv", sensor_columns(QUIET + 1, start=7.0))
    result = diagnose_magnetometer(a, b, "--together", "--output", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "a, b against magnetometer" in result.stdout
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["together"]
    folder = tmp_path / "out" / "together"
    assert sorted(p.name for p in folder.iterdir()) == WRITTEN
    content = content_of(folder)
    validate(content)
    assert (content["recording"], content["samples"]) == (["a", "b"], 1000)
    assert "a, b" in (folder / "report.html").read_text(encoding="utf-8")
    assert_refused(diagnose_magnetometer(a, b, "--together", "--output", tmp_path / "out"), "together", "--force")


def test_recordings_of_different_columns_are_not_diagnosed_together(tmp_path):
    a, b = quiet_table(tmp_path / "a.csv"), quiet_table(tmp_path / "b.csv", current=torch.ones(500))
    assert_refused(
        diagnose_magnetometer(a, b, "--together", "--output", tmp_path / "out"),
        "b and a cannot be diagnosed together; their columns differ: b has `current`, which a has not.",
    )
    assert not list((tmp_path / "out").iterdir())


def test_together_fails_if_a_recording_cannot_be_read(tmp_path):
    a, bad = quiet_table(tmp_path / "a.csv"), tmp_path / "bad.csv"
    bad.write_text("time,mag_x,mag_y,mag_z\n0,1,two,3\n")
    assert_refused(
        diagnose_magnetometer(a, bad, "--together", "--output", tmp_path / "out"),
        f"mkc: {bad}: column `mag_y` holds text",
    )
    assert not (tmp_path / "out" / "together").exists()


@pytest.mark.e2e
def test_columns_of_other_names_are_given_by_option(tmp_path):
    columns = {name.replace("mag_", "u"): values for name, values in sensor_columns(QUIET).items()}
    path = table(tmp_path / "a.csv", columns)
    assert_refused(
        diagnose_magnetometer(path, "--output", tmp_path / "out"),
        "no magnetometer",
        "`--columns mag_x=ux,mag_y=uy,mag_z=uz`",
    )
    names = ("--columns", "mag_x=ux,mag_y=uy,mag_z=uz")
    assert diagnose_magnetometer(path, "--output", tmp_path / "out", *names).exit_code == 0


def test_usage_errors_exit_with_two(tmp_path):
    path, out = quiet_table(tmp_path / "a.csv"), ("--output", tmp_path / "out")
    known = ("--simulation", "magnetometer")
    (tmp_path / "b").mkdir()
    twin = quiet_table(tmp_path / "b" / "A.csv")
    for arguments, words in (
        ((*known, *out), "REC"),
        ((path, *out, "--simulation", "pendulum"), '"pendulum" is unknown; give magnetometer'),
        ((path, *out, *known, "--level", "1"), "--level must be"),
        ((path, *out, *known, "--level", "nan"), "--level must be"),
        ((path, *out, *known, "--surrogates", "18"), "at least 19 at level 0.05"),
        ((path, *out, *known, "--seed", "-1"), "--seed"),
        ((path, *out, *known, "--noise", "norm"), "--noise"),
        ((path, *out, *known, "--noise", "norm=much"), "is not a number"),
        ((path, *out, *known, "--noise", "norm=0"), "must be above 0"),
        ((path, *out, *known, "--noise", "norm=inf"), "must be above 0"),
        ((path, *out, *known, "--noise", "norm=1", "--noise", "norm=2"), '--noise gives "norm" twice'),
        ((path, *out, *known, "--input-hold", "torque=stepped"), "known: held, linear, smooth"),
        ((path, *out, *known, "--unit-label", " "), "--unit-label is empty"),
        ((path, *out, *known, "--run-column", ""), "--run-column is empty"),
        ((path, *out, *known, "--columns", "experiment=a", "--run-column", "b"), "different columns"),
        ((path, *out, *known, "--columns", "mag_x"), "mag_x=mx"),
        ((path, twin, *out, *known), "would both write into"),
    ):
        assert_refused(mkc("diagnose", *arguments), words, code=2)
    assert not (tmp_path / "out").exists()


def test_the_number_of_surrogates_follows_the_level(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(diagnosis_files, "diagnose", lambda *_, **given: asked.append(given) or 1 / 0)
    path = quiet_table(tmp_path / "a.csv")
    for level, surrogates in (("0.05", 99), ("0.001", 999)):
        result = mkc("diagnose", path, "--simulation", "magnetometer", "--output", tmp_path, "--level", level)
        assert (asked[-1]["level"], asked[-1]["surrogates"]) == (float(level), surrogates)
    assert asked[-1]["max_findings"] == 3
    mkc("diagnose", path, "--simulation", "magnetometer", "--output", tmp_path, "--max-findings", 5)
    assert asked[-1]["max_findings"] == 5
    assert_refused(result, "internal error (ZeroDivisionError in test_diagnose.py", "report it")
    assert not (tmp_path / "a").exists()


def test_a_failed_write_leaves_no_partial_file(step_diagnosis, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "model.json")

    diagnosis = make_diagnosis(1, model=None)
    monkeypatch.setattr(diagnosis_files, "diagnose", lambda *_, **__: diagnosis)
    monkeypatch.setattr(_files.os, "fsync", full)
    assert_refused(diagnose_magnetometer(step_diagnosis[0], "--output", tmp_path / "out"), "no space left")
    assert not (tmp_path / "out" / "stepped").exists()


def test_without_a_model_an_old_model_file_is_removed(tmp_path):
    (tmp_path / "model.json").write_text("of an earlier diagnosis")
    _, written = diagnosis_files.write_diagnosis(make_diagnosis(0, model=None), tmp_path, force=True)
    assert [path.name for path in written] == ["diagnosis.json", "report.html"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["diagnosis.json", "report.html"]


@pytest.mark.e2e
def test_text_for_a_terminal_is_styled(step_diagnosis):
    request = diagnosis_files.Request(surrogates=19, force=True, report=False)
    folder = step_diagnosis[1].parent / "wide"
    (outcome,) = diagnosis_files.diagnose_file(
        step_diagnosis[0], folder, request, ConsoleStyle(terminal=True, width=60)
    )
    assert "\x1b[" in outcome.text
    assert sorted(path.name for path in folder.iterdir()) == WRITTEN[:2]


@pytest.mark.process
@pytest.mark.skipif(os.name == "nt", reason="signals are another thing there")
def test_an_interrupt_ends_all_processes_and_leaves_nothing(tmp_path):
    recordings = [quiet_table(tmp_path / f"{name}.csv") for name in "abcdef"]
    out = tmp_path / "out"
    command = ("-m", "mkc_torch.cli", "diagnose", *recordings, "--output", out, *QUICK)
    environment = os.environ | {"PYTHONIOENCODING": "utf-8", "FORCE_COLOR": "1"}
    with started(*command, env=environment, encoding="utf-8") as process:
        waited = time.monotonic() + 60.0
        while not out.is_dir() and process.poll() is None and time.monotonic() < waited:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        _, reported = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in reported
    assert [path.name for path in out.rglob("*") if path.is_file() and path.name not in WRITTEN] == []


def test_a_killed_worker_process_is_reported(tmp_path):
    def died():
        raise BrokenProcessPool

    (outcome,) = _waited_for(died, tmp_path / "a.csv")
    assert outcome.failed
    assert "the process ended" in outcome.text


def test_the_command_line_does_not_import_matplotlib():
    code = "import sys, mkc_torch.cli.app as c; sys.exit(any(m in sys.modules for m in ('matplotlib', 'jinja2')))"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
