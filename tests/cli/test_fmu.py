"""`mkc diagnose` and `mkc apply` with an FMU that the test compiles."""

import pytest

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("jsonschema")
pytest.importorskip("fmpy")

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import load_simulation
from tests.cli.commands import flat, mkc
from tests.cli.test_own_simulation import tank_table
from tests.simulation.fmu.made import COMPILER, Model, make_fmu

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no compiler of C (cc, gcc or clang)")

TANK = Model(
    "Tank",
    {"level": "inflow - drain*level"},
    {"drain": (0.3, 0.0, None, "1/s")},
    ("inflow",),
    units={"level": "m", "inflow": "m/s"},
)
"""The tank of tests/cli/test_own_simulation.py."""


@pytest.mark.slow
def test_an_fmu_is_diagnosed_applied_and_corrected(tmp_path, monkeypatch):
    model = make_fmu(tmp_path / "tank.fmu", TANK)
    table = tank_table(tmp_path / "runs.csv", drag=0.15)
    result = mkc("diagnose", table, "--simulation", model, "--output", tmp_path / "out", "--surrogates", 19)
    assert result.exit_code == 0, result.output
    place = tmp_path / "out" / "runs"
    assert sorted(p.name for p in place.iterdir()) == ["corrected.py", "diagnosis.json", "model.json", "report.html"]
    new = tank_table(tmp_path / "new.csv", drag=0.15, seed=5)
    applied = mkc("apply", place / "model.json", new, "--simulation", model, "--output", tmp_path / "simulated.csv")
    assert applied.exit_code == 0, applied.output
    simulated, recorded = Recording.read(tmp_path / "simulated.csv"), Recording.read(new)
    assert float((simulated["level"] - recorded["level"]).square().mean().sqrt()) < 0.008
    text = (place / "corrected.py").read_text(encoding="utf-8")
    assert 'Tank = fmu_class("../../tank.fmu", __file__)' in text
    assert 'rates["level"] = rates["level"] - 0.1' in text
    monkeypatch.chdir(place)
    corrected = load_simulation("corrected.py:CorrectedTank")
    prepared = corrected.prepare(recorded)
    # with the parameters that it was given, and the first states of these runs
    left = prepared.residual(prepared.start(), {})
    assert float(left.square().mean().sqrt()) < 0.02
    refused = mkc("apply", "model.json", new, "--output", tmp_path / "more.csv")
    assert refused.exit_code == 1
    assert "or the FMU that was diagnosed" in flat(refused.stderr)


def test_unusable_input_is_refused_before_anything_is_written(tmp_path):
    (tmp_path / "tank.fmu").write_bytes(b"no archive")
    table = tank_table(tmp_path / "runs.csv")
    result = mkc("diagnose", table, "--simulation", tmp_path / "tank.fmu", "--output", tmp_path / "out")
    assert result.exit_code == 1
    assert "it is damaged: it is not a zip archive. Export it again." in flat(result.stderr)
    assert not (tmp_path / "out").exists()
