"""Diagnoses of equations that lack a recorded cause, and where none acts."""

import json

import pytest

from mkc_torch import diagnose
from tests.gate.recorded_causes import COLUMN_OF, EFFECTS, EMPTY, Body, HiddenCause, main, recording, table

SIZES = {"driver_force": 0.15, "driver_exchange": 0.02, "driver_rate_constant": 0.008, "driver_input_gain": 0.08}


@pytest.mark.e2e
@pytest.mark.parametrize("effect", [EFFECTS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in EFFECTS[1:])])
def test_a_recorded_cause_is_named_with_its_column_and_size(effect):
    column, size = COLUMN_OF.get(effect, "sun"), SIZES[effect]
    found = diagnose(Body(), recording(HiddenCause(effect, column, size), "white", 4), max_findings=2)
    first = found.findings[0]
    assert (first.effect, first.drivers, first.grade) == (effect, (column,), "left_out")
    gain = first.parameters[0]
    assert abs(gain.value - size) < 4.0 * gain.standard_error + 0.02 * size
    assert first.held_out.outputs["temp"].after < 0.5 * first.held_out.outputs["temp"].before


@pytest.mark.e2e
def test_columns_that_do_nothing_are_not_named():
    found = diagnose(Body(), recording(HiddenCause(EMPTY), "white", 4), max_findings=2)
    assert found.findings == ()
    assert found.verdict == "adequate"


def test_a_rate_by_hand():
    now = {"heat": 2.0, "ambient": 10.0, "sun": 3.0, "temperature_cellar": 15.0, "supply": 25.0}
    means = {"sun": 1.0, "supply": 24.0}
    plain = HiddenCause(EMPTY).rate(20.0, now, means)
    assert plain == pytest.approx(0.7)
    added = {
        effect: HiddenCause(effect, COLUMN_OF.get(effect, "sun"), 0.1).rate(20.0, now, means) for effect in EFFECTS
    }
    assert {effect: rate - plain for effect, rate in added.items()} == pytest.approx(
        {"driver_force": 0.3, "driver_exchange": -0.5, "driver_rate_constant": -2.0, "driver_input_gain": 0.1}
    )


def test_kinds_of_noise_add_to_the_same_recording():
    white, slow, disturbed = (
        recording(HiddenCause(EMPTY), noise, 2)["temp"] for noise in ("white", "slow", "disturbed")
    )
    assert 0.05 < float((slow - white).std()) < 0.2
    assert float((disturbed - white).std()) > 0.2


def test_the_table_counts_names_and_wrong_columns():
    rows = [
        {"effect": "driver_force", "named": True, "wrong": False},
        {"effect": "driver_force", "named": False, "wrong": True},
        {"effect": EMPTY, "named": False, "wrong": False},
    ]
    assert table(rows)[2:] == ["| `driver_force` | 2 | 1 | 1 to 99 % | 1 |", "| `nothing` | 1 |  |  | 0 |"]


def test_a_second_run_continues_the_first(tmp_path, monkeypatch):
    calls = []

    def judged(effect, index, seed):
        calls.append((effect, index, seed))
        return {"effect": effect, "named": True, "wrong": False, "claimed": []}

    monkeypatch.setattr("tests.gate.recorded_causes.diagnosed", judged)
    for count in (1, 2):
        main(["--output", str(tmp_path), "--per-effect", str(count), "--effects", "driver_force", EMPTY])
    assert calls == [("driver_force", 0, 1), (EMPTY, 100, 1), ("driver_force", 1, 1), (EMPTY, 101, 1)]
    assert len(json.loads((tmp_path / "rows.json").read_text())["rows"]) == 4
