"""An internal error in any step of a diagnosis leaves files with the result so far, a warning, and exit code 3."""

import importlib
import inspect
import json
import pkgutil

import numpy as np
import pytest

pytest.importorskip("jsonschema")
pytest.importorskip("polars")
pytest.importorskip("typer")

import mkc_torch.diagnosis
from mkc_torch.diagnosis import diagnose as whole_diagnosis
from mkc_torch.diagnosis.optional import optional
from mkc_torch.recording.recording import write_table
from mkc_torch.simulation.dynamics import first_fit
from tests.cli.commands import mkc
from tests.diagnosis.duffing import Duffing, duffing_recording
from tests.diagnosis.vehicle import MASS, Vehicle, coast_down

SOURCE = f"from mkc_torch.simulation import Dynamics, Parameter\n\nMASS = {MASS}\n\n\n{inspect.getsource(Vehicle)}"
STAGES = {
    "stepwise_search": "searching for effects",
    "estimate": "checking what was found",
    "run_tests": "running the tests of evidence",
    "build_result": "describing the result",
}
LATER = ("estimate", "run_tests")
MODULES = [
    module
    for info in pkgutil.walk_packages(mkc_torch.diagnosis.__path__, "mkc_torch.diagnosis.")
    if hasattr(module := importlib.import_module(info.name), "optional") and module.optional is optional
]


def broken(*_, **__):
    raise RuntimeError("sizes 3 and 4 differ")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a vehicle's recording with hidden drag."""
    place = tmp_path_factory.mktemp("vehicle")
    (place / "vehicle.py").write_text(SOURCE, encoding="utf-8")
    write_table(place / "run.csv", dict(coast_down(0.012, 30.0, 1, "run", 150).columns))
    return place


WHOLE = ("--surrogates", 19, "--max-findings", 1)


def diagnosed(folder, output, options=WHOLE):
    """Return the result of the command, and the content of diagnosis.json."""
    of_vehicle = ("--simulation", f"{folder / 'vehicle.py'}:Vehicle", "--input-hold", "force=held")
    result = mkc("diagnose", folder / "run.csv", *of_vehicle, *options, "--output", output)
    file = output / "run" / "diagnosis.json"
    return result, json.loads(file.read_text(encoding="utf-8")) if file.exists() else None


def written(output):
    return {path.name for path in (output / "run").iterdir()}


ALL = {"diagnosis.json", "model.json", "corrected.py", "report.html"}


@pytest.mark.e2e
@pytest.mark.parametrize(
    "stage", ["stepwise_search", "build_result", *(pytest.param(s, marks=pytest.mark.slow) for s in LATER)]
)
def test_an_error_of_a_stage_leaves_the_result_so_far(folder, tmp_path, monkeypatch, stage):
    monkeypatch.setattr(importlib.import_module("mkc_torch.diagnosis.diagnose"), stage, broken)
    result, content = diagnosed(folder, tmp_path)
    assert result.exit_code == 3, result.output
    assert written(tmp_path) == ALL
    assert content["search"]["stopped"]["reason"] == "internal error"
    assert content["warnings"][0].startswith("Stopped by an internal error after ")
    assert any(f"The step '{STAGES[stage]}' ended in an internal error" in text for text in content["warnings"])
    assert content["verdict"] != "adequate"
    assert [finding["effect"] for finding in content["findings"]] == ["quadratic_drag"] * (stage != "stepwise_search")


@pytest.mark.e2e
@pytest.mark.slow
def test_an_error_of_any_optional_step_leaves_all_files(folder, tmp_path, monkeypatch):
    steps, failing = [], [""]

    def injected(step, work, otherwise, possible=lambda: True):
        steps.append(step)
        return optional(step, broken if step == failing[0] else work, otherwise, possible)

    for module in MODULES:
        monkeypatch.setattr(module, "optional", injected)
    result, content = diagnosed(folder, tmp_path / "whole")
    assert (result.exit_code, content["verdict"]) == (0, "explained"), result.output
    found = list(dict.fromkeys(steps))
    assert len(found) >= 10
    for number, step in enumerate(found):
        failing[0] = step
        result, content = diagnosed(folder, tmp_path / str(number))
        assert result.exit_code in (0, 3), (step, result.output)
        assert written(tmp_path / str(number)) >= ALL - {"corrected.py"}, step
        # without any kept search its error is that of the stage
        named = {step, STAGES["stepwise_search"]} if step == "searching models" else {step}
        sentences = {f"The step '{name}' ended in an internal error" for name in named}
        assert any(sentence in text for text in content["warnings"] for sentence in sentences), step


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("diagnosis.json", "mkc_torch.diagnosis.io.diagnosis_json.diagnosis_to_json"),
        pytest.param("model.json", "mkc_torch.diagnosis.DiagnosedModel.to_json", marks=pytest.mark.slow),
        pytest.param("corrected.py", "mkc_torch.diagnosis.DiagnosedModel.to_python", marks=pytest.mark.slow),
        ("report.html", "mkc_torch.report.diagnosis_report"),
    ],
)
def test_a_file_whose_text_fails_is_missing_and_the_others_are_written(folder, tmp_path, monkeypatch, name, function):
    monkeypatch.setattr(function, broken)
    result, content = diagnosed(folder, tmp_path, ["--quick"])
    assert result.exit_code == 3, result.output
    assert written(tmp_path) == ALL - {name}
    warning = f"The step 'writing {name}' ended in an internal error"
    assert warning in " ".join(result.output.split())
    assert content is None or any(warning in text for text in content["warnings"])


@pytest.mark.e2e
def test_an_error_of_the_summary_leaves_the_files(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("mkc_torch.cli.diagnosis_files.show", broken)
    result, content = diagnosed(folder, tmp_path, ["--quick"])
    assert (result.exit_code, content["verdict"]) == (3, "unexplained")
    assert "The step 'printing the summary' ended in an internal error" in " ".join(result.output.split())
    assert written(tmp_path) == ALL


def test_an_error_of_the_first_fit_is_raised(monkeypatch):
    monkeypatch.setattr(importlib.import_module("mkc_torch.diagnosis.diagnose"), "fit_baseline", broken)
    with pytest.raises(RuntimeError, match="sizes 3 and 4 differ"):
        whole_diagnosis(Vehicle(), coast_down(0.012, 30.0, 1, "run", 150))


def test_an_observer_that_is_lost_by_rounding_does_not_exist(monkeypatch):
    def lost(*_):
        raise np.linalg.LinAlgError("Matrix is not positive definite")

    prepared = Duffing().prepare(duffing_recording(0, 100))
    assert first_fit.strong_observer(prepared, prepared.given, 10.0) is not None
    monkeypatch.setattr(first_fit, "observer_of", lost)
    assert first_fit.strong_observer(prepared, prepared.given, 10.0) is None
