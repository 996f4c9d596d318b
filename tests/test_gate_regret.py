"""The regret of the search in the gate: known sets, fits and tables."""

import json

import pytest

pytest.importorskip("polars")

from examples.concealed_physics import known
from mkc_torch.cli.diagnosis_request import Request
from mkc_torch.effects import CATALOGUE
from mkc_torch.recording.recording import write_table
from tests.diagnosis import swing
from tests.gate import __main__ as gate
from tests.gate import regret, scores
from tests.gate.known_sets import KNOWN_SETS, KnownSet
from tests.gate.work import Job, gate_folder, known_jobs

NAME = "strangers swing"


def row(name, value, returned=()):
    effects = {"known": ["quadratic_drag@rate"], "returned": list(returned)}
    open_loop = {"known": {"angle": 0.0041}, "returned": {}}
    scored = {"alone": 10.0, "known": 10.0 + value, "returned": 10.0, "regret": value, "kappa": 1.25}
    return {name: scored | {"effects": effects, "open_loop": open_loop}}


def test_known_sets_are_of_recordings_of_the_gate():
    names = {answer.name for part in (known.real, known.cases, known.strangers) for answer in part()}
    assert set(KNOWN_SETS) <= names
    catalogue = {effect.id for effect in CATALOGUE}
    for own in KNOWN_SETS.values():
        effects = {text.split("@")[0].strip() for text in own.suspect.split("+")}
        assert effects <= catalogue
        assert set(own.shapes) <= effects


def test_the_count_line_names_large_regrets_and_better_sets():
    rows = {"a": 0.1, "b": 12.34, "c": -9.0, "d": None}
    expected = "regret: at most 0.5 nats in 2 of 3, above 4.5: b (12.3); another set scores 4.5 better in: c (9.0)"
    assert regret.count_line(rows) == f"{expected}; unknown: d"
    expected = "regret: at most 0.5 nats in 1 of 1, above 4.5: none; another set scores 4.5 better in: none"
    assert regret.count_line({"a": 0.1}) == expected


def test_the_tables_have_a_line_for_each_recording():
    rows = row("real a", 8.0) | {"real b": {"failed": "over the limit of 9 s"}}
    _, first, second = regret.table(rows)
    assert first.split() == ["real", "a", "10.0", "8.0", "0.0", "8.0", "0.0041", "-", "1.2", *first.split()[9:]]
    assert first.endswith("quadratic_drag@rate | nothing")
    assert second.split(maxsplit=2)[2] == "failed: over the limit of 9 s"
    own = {"priced": 1.0, "multi_horizon": 2.0, "free_run": None}
    sets = {"alone": own, "known": own | {"priced": 11.0}, "returned": None}
    assert scores.table({"a": sets})[-1].split() == ["a", "10.0", "-", "0.0", "-", "-", "-"]


@pytest.fixture
def job(tmp_path, monkeypatch):
    """A recording of a swing with quadratic drag, whose gate returned nothing."""
    monkeypatch.setitem(KNOWN_SETS, NAME, KnownSet("quadratic_drag@rate"))
    file = tmp_path / "run.csv"
    write_table(file, dict(swing.pendulum_recording("none", 0, 300, 0.3)[0].columns))
    return Job(NAME, file, Request(simulation=f"{swing.__file__}:Pendulum", input_hold={"torque": "held"}))


def write_model(folder, drag):
    effect = {"effect": "quadratic_drag", "drivers": [], "shape": {}, "port": "rate of rate", "parameters": [drag]}
    content = {
        "schema": "mkc-model/1",
        "simulation": "Pendulum",
        "state": {"class": "Pendulum", "outputs": ["angle"], "input_hold": {"torque": "held"}},
        "parameters": [9.0, 0.15, 0.3, 0.0],
        "effects": [effect | {"equation": ""}],
    }
    folder.mkdir(parents=True)
    (folder / "model.json").write_text(json.dumps(content), encoding="utf-8")


@pytest.mark.e2e
def test_regret_is_large_for_a_missed_set_and_0_for_the_known_set(job, tmp_path):
    missed = regret.regret_of(job, tmp_path)
    assert missed["regret"] == pytest.approx(missed["known"] - missed["alone"])
    assert missed["regret"] > regret.LARGE
    assert missed["effects"] == {"known": ["quadratic_drag@rate"], "returned": []}
    write_model(gate_folder(tmp_path, NAME), 0.25)
    found = regret.regret_of(job, tmp_path)
    assert found["regret"] == pytest.approx(0.0, abs=regret.SMALL)
    assert found["open_loop"]["known"]["angle"] == pytest.approx(swing.NOISE, rel=0.15)
    sets = scores.scored_sets(job, tmp_path)
    assert sets["known"]["multi_horizon"] == pytest.approx(found["known"], abs=0.1)
    for name in scores.SCORES:
        assert sets["known"][name] > sets["alone"][name]
    assert sets["returned"] == pytest.approx(sets["known"], abs=regret.SMALL)


def test_only_recordings_with_known_sets_have_jobs(tmp_path, monkeypatch):
    for name in ("run.csv", "naive.py"):
        (tmp_path / name).write_text("", encoding="utf-8")
    file = f"{tmp_path / 'naive.py'}:Cart"
    answers = [known.Known(f"real {name}", tmp_path / "run.csv", file, known.Expected()) for name in ("a", "b")]
    monkeypatch.setattr(known, "real", lambda: iter(answers))
    assert [job.name for job in known_jobs(("real",), "", {"real b"})] == ["real b"]
    assert known_jobs(("real",), "other", {"real b"}) == []


def test_the_gate_adds_the_regret_to_its_rows(tmp_path, monkeypatch, capsys):
    for name in ("run.csv", "naive.py"):
        (tmp_path / name).write_text("", encoding="utf-8")
    file = f"{tmp_path / 'naive.py'}:Cooling"
    names = ("real mug run Cooling", "real other")
    answers = [known.Known(name, tmp_path / "run.csv", file, known.Expected()) for name in names]
    found = {"verdict": "explained", "findings": [], "residual_after": {}, "cpu_seconds": 2.0}
    monkeypatch.setattr(known, "real", lambda: iter(answers))
    monkeypatch.setattr(gate, "diagnosed", lambda jobs, *_, **__: iter([(job.name, dict(found)) for job in jobs]))
    monkeypatch.setattr(regret, "regrets", lambda _, jobs, *__: {job.name: {"regret": 8.0} for job in jobs})
    assert gate.main(["--output", str(tmp_path / "out"), "--only", "real", "--regret"]) == 0
    rows = json.loads((tmp_path / "out" / gate.RESULT).read_text(encoding="utf-8"))["recordings"]
    assert [row.get("regret") for row in rows.values()] == [8.0, None]
    assert "above 4.5: real mug run Cooling (8.0)" in capsys.readouterr().out
