"""``mkc challenge --scenarios``."""

import json

import pytest

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("jsonschema")
pytest.importorskip("jinja2")

from mkc_torch.cli import challenge_jobs
from mkc_torch.cli.challenge_jobs import diagnose_in_scenario
from mkc_torch.cli.diagnosis_request import MAGNETOMETER
from tests.cli.test_diagnose import mkc, refused


def adequate(paths, folder):
    for path in paths:
        (folder / path.stem).mkdir()
        reported = {"verdict": "adequate", "findings": []}
        (folder / path.stem / "diagnosis.json").write_text(json.dumps(reported))


def test_scenarios_are_scored_and_printed_with_their_aims(tmp_path, monkeypatch):
    monkeypatch.setattr(challenge_jobs, "diagnose_in_scenario", adequate)
    folder = tmp_path / "scenarios"
    command = (
        "challenge",
        "--scenarios",
        "--family",
        "dynamics",
        "--per-scenario",
        3,
        "--hidden-per-scenario",
        1,
        "--seed",
        4,
    )
    result = mkc(*command, "--only", "gusts", "--only", "useless", "--workers", 1, "--output", folder)
    assert result.exit_code == 0, result.output
    flat = " ".join(result.stdout.split())
    assert "Blind proof in scenarios: 7 recordings" in flat
    assert "gusts: gusts in the rate of one state" in flat
    assert "verdicts of 3 unfit 0, adequate 3, explained 0, unexplained 0, failed 0" in flat
    assert "false alarms 0.0 % (0 of 3; 0.0-70.8 %)" in flat
    assert "at most 7 % false alarms 0.0 % held" in flat
    assert "unexplained, at the right state, in at least 80 % 0.0 % not held" in flat
    assert "unfit in at least 95 % 0.0 % not held" in flat
    assert "adequate in none (0 %) 100.0 % not held" in flat
    assert "wrong sign adequate 1" in flat
    assert str(folder / "challenge.html") in result.stdout
    record = json.loads((folder / "score.json").read_text(encoding="utf-8"))
    assert [scenario["name"] for scenario in record["scenarios"]] == ["gusts", "useless"]
    assert record["settings"]["seed"] == 4
    refused(mkc(*command, "--output", folder), "not empty", "--force")


def test_a_third_as_many_have_something_hidden_by_default(tmp_path, monkeypatch):
    monkeypatch.setattr(challenge_jobs, "diagnose_in_scenario", adequate)
    command = ("challenge", "--scenarios", "--per-scenario", 3, "--only", "white", "--duration", 12, "--workers", 1)
    result = mkc(*command, "--output", tmp_path / "a")
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "a" / "score.json").read_text(encoding="utf-8"))
    assert (record["scenarios"][0]["empty"], record["scenarios"][0]["hidden"]) == (3, 1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scenarios", "--cases", 1), ("--cases", "--per-scenario")),
        (("--scenarios", "--empty", 1), ("--empty", "--per-scenario")),
        (("--per-scenario", 2), ("--per-scenario", "add --scenarios")),
        (("--only", "white"), ("--only", "add --scenarios")),
        (("--scenarios", "--only", "held"), ("white, coloured, wander", "'held'")),
        (("--scenarios", "--per-scenario", 0), ("both 0",)),
        (("--scenarios", "--family", "dynamics", "--duration", 20), ("each system has a length of its own",)),
    ],
)
def test_what_does_not_belong_together_is_refused(tmp_path, arguments, words):
    refused(mkc("challenge", *arguments, "--output", tmp_path / "a"), *words, code=2)
    assert not (tmp_path / "a").exists()


def test_each_recording_is_compared_with_the_simulation_that_lies_ready_for_it(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        challenge_jobs, "_diagnose", lambda path, _, request: asked.append((path.stem, request.simulation))
    )
    (tmp_path / "simulations").mkdir()
    for name in ("cart_pole_00003", "case_00004"):
        (tmp_path / "simulations" / f"{name}.py").touch()
    paths = [tmp_path / "recordings" / f"{name}.csv" for name in ("cart_pole_00003", "case_00004", "case_00005")]
    diagnose_in_scenario(paths, tmp_path / "diagnoses")
    assert asked == [
        ("cart_pole_00003", f"{tmp_path / 'simulations' / 'cart_pole_00003.py'}:CartPole"),
        ("case_00004", f"{tmp_path / 'simulations' / 'case_00004.py'}:sensor"),
        ("case_00005", MAGNETOMETER),
    ]


@pytest.mark.e2e
def test_a_real_diagnosis_is_scored(tmp_path):
    command = (
        "challenge",
        "--scenarios",
        "--per-scenario",
        1,
        "--only",
        "white",
        "--hidden-per-scenario",
        0,
        "--duration",
        15,
    )
    result = mkc(*command, "--workers", 1, "--seed", 2, "--output", tmp_path / "a")
    assert result.exit_code == 0, result.output
    assert "failed 0" in result.stdout
    (name,) = [path.name for path in (tmp_path / "a" / "diagnoses").iterdir()]
    assert (tmp_path / "a" / "diagnoses" / name / "diagnosis.json").is_file()
