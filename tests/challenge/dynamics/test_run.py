"""The proof of differential equations from end to end, with a diagnosis that knows nothing and one that is real."""

import json

import pytest

pytest.importorskip("polars")
pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from mkc_torch.challenge.dynamics.subject import dynamics
from mkc_torch.challenge.key import digest
from mkc_torch.challenge.run import run_challenge
from mkc_torch.cli.challenge_jobs import correct_dynamics, diagnose_dynamics
from mkc_torch.recording.recording import Recording


def always_adequate(paths, folder):
    """Report every recording as adequate, and check that the key is hidden."""
    output = folder.parent
    assert (output / "key_hash.txt").is_file()
    assert not (output / "key.json").exists()
    assert (output / "simulations.py").is_file()
    for path in paths:
        (folder / path.stem).mkdir()
        reported = {"verdict": "adequate", "p_value": 0.5, "findings": []}
        (folder / path.stem / "diagnosis.json").write_text(json.dumps(reported))
        (folder / path.stem / "model.json").write_text("{}")


def as_measured(model, path):
    assert model.is_file()
    return Recording.read(path).columns


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    output = tmp_path_factory.mktemp("dynamics") / "out"
    result = run_challenge(always_adequate, as_measured, subject=dynamics(), cases=3, empty=2, seed=53, output=output)
    return result, output


@pytest.mark.e2e
def test_the_key_is_sealed(quiet):
    _, output = quiet
    assert digest((output / "key.json").read_text().rstrip("\n")) == (output / "key_hash.txt").read_text().strip()


def test_an_empty_diagnosis_raises_no_alarm_and_names_nothing(quiet):
    result, _ = quiet
    assert (result.false_alarms.count, result.false_alarms.total) == (0, 2)
    assert result.named.count == 0
    assert result.failed == ()
    assert result.driver.total == 0


def test_thresholds_and_page_are_those_of_dynamics(quiet):
    result, output = quiet
    assert [m.threshold for m in result.measured] == list(dynamics().thresholds)
    text = (output / "summary.md").read_text(encoding="utf-8")
    assert "at most 8 % false alarms" in text
    assert "- family: dynamics" in text
    page = (output / "challenge.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 3
    assert "thresholds hold" in page


def test_recordings_do_not_reveal_the_hidden_physics(quiet):
    _, output = quiet
    stems = sorted(path.stem for path in (output / "recordings").iterdir())
    assert len(stems) == 5
    assert {stem.rpartition("_")[0] for stem in stems} <= {
        "pendulum", "cart_pole", "tanks", "motor", "projectile", "thermal", "servo",
    }  # fmt: skip


@pytest.mark.e2e
def test_a_real_diagnosis_is_scored_and_its_model_runs_free(tmp_path):
    output = tmp_path / "out"
    result = run_challenge(
        diagnose_dynamics, correct_dynamics, subject=dynamics(), cases=0, empty=1, seed=53, output=output
    )
    assert result.failed == ()
    assert result.false_alarms.total == 1
    (path,) = (output / "recordings").iterdir()
    place = output / "diagnoses" / path.stem
    assert json.loads((place / "diagnosis.json").read_text(encoding="utf-8"))["simulation"] == "Projectile"
    simulated, measured = correct_dynamics(place / "model.json", path), Recording.read(path)
    for name in ("distance", "height"):
        assert float((simulated[name] - measured[name]).abs().median()) < 0.05 * float(measured[name].std())
