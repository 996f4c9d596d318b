"""The table of recordings with known missing physics: its cells, skipped rows, and a whole diagnosis."""

import importlib
import json
import re
from pathlib import Path

import pytest

pytest.importorskip("polars")

from mkc_torch import Recording
from tests.shared_data import ROOT

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "concealed_physics"
ROCKET = "real rocket juno Rocket"


@pytest.fixture
def load_module():
    return lambda name: importlib.import_module(f"examples.concealed_physics.{name}")


def example_row(**changes):
    region = {"state": "altitude", "unit": "m", "kind": "below", "bound": 2138.6}
    drag = {
        "effect": "quadratic_drag",
        "grade": "left_out",
        "drivers": [],
        "channels": ["rate of speed"],
        "region": region | {"share_of_gain": 0.892, "share_of_time": 0.3},
        "alternatives": [],
        "parameters": [{"name": "drag", "value": 9.3e-5, "standard_error": 1e-6, "unit": "1/m"}],
    }
    return {
        "verdict": "explained",
        "findings": [drag],
        "residual_before": {"altitude": 24.17},
        "residual_after": {"altitude": 1.946},
        "parameters": {"gravity": 9.7119},
        "sentences": [],
        "cpu_seconds": 36.06,
    } | changes


def cells_of_row(load_module, found):
    module = load_module("real")
    item = next(item for item in load_module("known").real() if item.name == ROCKET)
    return dict(zip(module.COLUMNS, module.line(item, found, load_module("by_hand").BY_HAND[ROCKET]), strict=True))


def test_a_right_diagnosis_has_a_row_with_the_reference_fit(load_module):
    assert cells_of_row(load_module, example_row()) == {
        "recording": ROCKET,
        "left out": "quadratic drag",
        "claimed": "quadratic drag (right)",
        "located": "89% in 30%: altitude below 2.14e+03 (right)",
        "size": "drag 9.3e-05 ± 1e-06, by hand 9.2e-05",
        "bias": "gravity -1.0%",
        "open loop": "altitude 24.2 → 1.95",
        "bound": "altitude 2.2",
        "CPU, s": "36",
    }


def test_the_size_of_an_inseparable_alternative_counts(load_module):
    expected = next(item for item in load_module("known").real() if item.name == ROCKET).expected
    drag = example_row()["findings"][0]
    line = {"effect": "linear_drag", "parameters": []}

    def wrong(value, *, separable=False):
        parameters = [drag["parameters"][0] | {"value": value}]
        other = {"effect": "quadratic_drag", "drivers": [], "separable": separable, "parameters": parameters}
        return load_module("judge").judged(example_row(findings=[drag | line | {"alternatives": [other]}]), expected)[
            "wrong"
        ]

    assert wrong(9.2e-5) == []
    assert wrong(2.0e-4) == ["drag of quadratic_drag is 0.0002, not 9.2e-05 +- 9.2e-06"]
    assert "no drag of quadratic_drag" in wrong(9.2e-5, separable=True)


def test_a_diagnosis_without_findings_is_wrong_and_has_no_size(load_module):
    found = cells_of_row(load_module, example_row(verdict="unexplained", findings=[], residual_after={}))
    assert found["claimed"] == "unexplained (wrong)"
    assert found["located"] == "-"
    assert found["size"] == "drag -, by hand 9.2e-05"
    assert found["open loop"] == "altitude 24.2"


def test_each_recording_with_missing_physics_has_a_reference_fit(load_module):
    known, by_hand = load_module("known"), load_module("by_hand").BY_HAND
    names = {item.name for part in (known.real, known.cases, known.data) for item in part()}
    assert set(by_hand) <= names
    adequate = {f"cases simulated/{name} run Pendulum" for name in ("held_input", "linear_input")}
    heavy = {f"data falling_balls {name} Ball" for name in load_module("known").HEAVY}
    assert names - set(by_hand) == adequate | heavy


def test_a_stopped_search_is_marked_in_its_row(load_module):
    found = cells_of_row(load_module, example_row(stopped={"reason": "time limit", "seconds": 30.2, "not_done": []}))
    assert found["claimed"] == "quadratic drag (right), search stopped after 30 s"


@pytest.mark.parametrize(
    ("name", "columns", "rows"),
    [
        ("data falling_balls Tennis_Ball Ball", {"time", "height"}, 46),
        ("data silverbox Silverbox", {"time", "input", "output"}, 8192),
        ("data servo Servo", {"time", "position", "goal_position", "torque_enable", "kp", "experiment"}, None),
    ],
)
def test_a_part_of_a_recording_has_its_columns_and_rows(load_module, tmp_path, name, columns, rows):
    item = next(item for item in load_module("known").data() if item.name == name)
    if not item.recording.exists():
        pytest.skip(f"no data file {item.recording}")
    table = Recording.read(item.file_in(tmp_path), recognise=False)
    assert set(table.names) == columns
    assert rows is None or len(table) == rows


def test_an_exceeded_time_limit_is_a_failed_row(load_module, tmp_path):
    item = next(item for item in load_module("known").real() if item.name == ROCKET)
    if not item.recording.exists():
        pytest.skip(f"no data file {item.recording}")
    name, found = load_module("real").diagnosed((item, tmp_path, 0.01))
    assert name == ROCKET
    assert "0.01 s" in found["failed"]
    assert cells_of_row(load_module, found)["claimed"] == "no answer (wrong)"


def test_absent_recordings_are_named_and_skipped(load_module, tmp_path, capsys):
    load_module("real").main(["--data", str(tmp_path), "--only", "mug", "--output", str(tmp_path / "out")])
    printed = capsys.readouterr()
    assert f"left out: {tmp_path / 'real' / 'mug' / 'run.csv'}, " in printed.err
    assert "0 of 0 right, 0 CPU seconds" in printed.out


def test_a_stored_row_is_reused(load_module, tmp_path):
    item = next(item for item in load_module("known").real() if item.name == ROCKET)
    folder = tmp_path / re.sub(r"\W", "_", ROCKET)
    folder.mkdir()
    (folder / "row.json").write_text(json.dumps(example_row()), encoding="utf-8")
    assert load_module("real").diagnosed((item, tmp_path, 300.0)) == (ROCKET, example_row())


def test_a_failed_diagnosis_is_a_failed_row(load_module, tmp_path):
    item = next(item for item in load_module("known").real(tmp_path) if item.name == ROCKET)  # there is no such file
    name, failed = load_module("real").diagnosed((item, tmp_path / "out", 300.0))
    assert name == ROCKET
    assert failed["failed"]
    assert cells_of_row(load_module, failed)["claimed"] == "no answer (wrong)"


@pytest.mark.e2e
def test_the_diagnosis_of_a_cooling_mug_is_right(load_module, tmp_path, capsys):
    recording = ROOT.parent / "real" / "mug" / "run.csv"
    if not recording.exists():
        pytest.skip(f"no data file {recording}")
    load_module("real").main(["--only", "mug", "--output", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "| power law (right) |" in printed
    assert "1 of 1 right" in printed
    assert json.loads((tmp_path / "real_mug_run_Cooling" / "row.json").read_text(encoding="utf-8"))["parameters"]
