"""``python -m examples.blind_proof``."""

import json

import pytest

pytest.importorskip("polars")
pytest.importorskip("jinja2")

from examples.blind_proof import __main__ as command


def diagnose_adequate(paths, folder):
    for path in paths:
        (folder / path.stem).mkdir()
        reported = {"verdict": "adequate", "findings": []}
        (folder / path.stem / "diagnosis.json").write_text(json.dumps(reported))


def run(*words):
    return command.main([str(word) for word in words])


@pytest.mark.e2e
def test_scenarios_are_scored_and_printed_with_their_aims(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "diagnose", diagnose_adequate)
    folder = tmp_path / "scenarios"
    words = ("equations_scenarios", "--empty", 3, "--cases", 1, "--seed", 4, "--workers", 1, "--output", folder)
    assert run(*words, "--only", "gusts", "--only", "useless") == 0
    printed = capsys.readouterr().out
    flat = " ".join(printed.split())
    for fact in (
        "Blind proof: 7 recordings, hidden physics in 1",
        "gusts: gusts in the rate of one state",
        "verdicts of 3 unfit 0, adequate 3, explained 0, unexplained 0, failed 0",
        "false alarms 0.0 % (0 of 3; 0.0-70.8 %)",
        "at most 7 % false alarms 0.0 % held",
        "unexplained, at the right state, in at least 80 % 0.0 % not held",
        "unfit in at least 95 % 0.0 % not held",
        "adequate in none (0 %) 100.0 % not held",
        "at least 60 recordings without hidden physics 3 too few",
        "wrong sign adequate 1",
        "Too few recordings",
        "failed none",
    ):
        assert fact in flat
    assert str(folder / "proof.html") in printed
    record = json.loads((folder / "score.json").read_text(encoding="utf-8"))
    assert [scenario["name"] for scenario in record["scenarios"]] == ["gusts", "useless"]
    assert run(*words) == 1
    said = capsys.readouterr().err
    assert "not empty" in said
    assert str(folder) in said


@pytest.mark.parametrize(
    ("words", "facts"),
    [
        (("weather",), ("'weather'", "magnetometer", "equations")),
        (("magnetometer_scenarios", "--only", "held"), ("held", "white, coloured, wander")),
        (("--only", "white"), ("white", "choose from magnetometer")),
        (("--cases", 0), ("--cases and --empty are both 0",)),
        (("--cases", -1), ("--cases", "-1 is below 0")),
        (("--duration", 5), ("--duration", "5", "at least 10 s")),
        (("equations", "--duration", 20), ("--duration", "each system has a length of its own")),
    ],
)
def test_wrong_arguments_are_rejected_with_the_valid_ones(words, facts, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        run(*words, "--output", tmp_path / "a")
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert all(fact in said for fact in facts)
    assert not (tmp_path / "a").exists()


@pytest.mark.e2e
def test_a_real_diagnosis_of_a_magnetometer_is_scored(tmp_path, capsys):
    folder = tmp_path / "proof"
    assert run("--cases", 1, "--empty", 1, "--seed", 4, "--duration", 15, "--workers", 1, "--output", folder) == 0
    assert "failed none" in " ".join(capsys.readouterr().out.split())
    made = sorted(path.name for path in (folder / "diagnoses").iterdir())
    assert made == ["case_00000", "case_00001"]
    assert sorted(p.name for p in (folder / "diagnoses" / "case_00000").iterdir()) == ["diagnosis.json", "model.json"]
    record = json.loads((folder / "score.json").read_text(encoding="utf-8"))
    assert len(record["scenarios"][0]["ratios"]) <= 1
    assert "Least squares, stepwise BIC" in record["baselines"]
