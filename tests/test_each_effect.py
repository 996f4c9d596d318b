"""Recordings with a single hidden effect that is clearly detectable, and how its name is scored."""

import json

import pytest

from examples.blind_proof.key import canonical
from tests.gate import each_effect
from tests.gate.each_effect import score_case, strong_cases


@pytest.fixture(scope="module")
def case():
    return next(strong_cases("gravity_sag", 11, 60))


def check_score(folder, key, *effects):
    (folder / key.name).mkdir(exist_ok=True)
    findings = [{"effect": effect, "grade": "left_out", "channels": ["angle"]} for effect in effects]
    reported = {"verdict": "explained", "p_value": 0.01, "findings": findings}
    (folder / key.name / "diagnosis.json").write_text(json.dumps(reported), encoding="utf-8")


def test_the_requested_effect_is_hidden_and_detectable(case):
    (truth,) = case.key.effects
    assert truth.effect == "gravity_sag"
    assert min(truth.z, truth.z_sep) >= 10.0
    assert case.key.name.startswith("servo_")


def test_the_same_seed_gives_the_same_recordings(case):
    again = next(strong_cases("gravity_sag", 11, 60))
    assert canonical([again.key]) == canonical([case.key])


def test_an_effect_that_no_system_hides_has_no_recordings():
    assert list(strong_cases("added_mass", 11, 3)) == []


def test_the_hidden_effect_is_right_and_another_is_wrong(case, tmp_path):
    for effect, right in (("gravity_sag", True), ("backlash", False)):
        check_score(tmp_path, case.key, effect)
        assert score_case(case.key, tmp_path) == (right, f"explained: {effect} at angle")
    check_score(tmp_path, case.key)
    assert score_case(case.key, tmp_path) == (False, "explained: no name")


def test_the_table_counts_right_names_and_stored_diagnoses_are_not_repeated(case, tmp_path, monkeypatch, capsys):
    asked = []

    def diagnosed(paths, folder):
        asked.extend(paths)
        check_score(folder, case.key, "gravity_sag")

    monkeypatch.setattr(each_effect, "diagnose", diagnosed)
    for _ in range(2):
        each_effect.main(["--effects", "gravity_sag", "--per-effect", "1", "--output", str(tmp_path)])
        assert "| gravity_sag | 1 of 1 |" in capsys.readouterr().out
    assert [path.stem for path in asked] == [case.key.name]
