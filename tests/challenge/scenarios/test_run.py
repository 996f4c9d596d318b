"""The proof in scenarios from end to end, with a diagnosis that costs nothing."""

import json
import re

import pytest

pytest.importorskip("polars")
pytest.importorskip("jinja2")

from mkc_torch.challenge.dynamics.scenarios import dynamics_scenarios
from mkc_torch.challenge.key import digest
from mkc_torch.challenge.magnetometer.scenarios import magnetometer_scenarios
from mkc_torch.challenge.scenarios import run_scenarios
from mkc_torch.challenge.scenarios.run import count


def cheap(paths, folder):
    """Report adequate, unfit and a failure in turn, and check that the key is hidden."""
    output = folder.parent
    assert (output / "key_hash.txt").is_file()
    assert not (output / "key.json").exists()
    broken = ""
    for path in paths:
        number = int(path.stem[-5:])
        if number % 3 == 2:
            broken = path.stem
            continue
        (folder / path.stem).mkdir()
        reported = {"verdict": ("adequate", "unfit")[number % 3], "findings": []}
        (folder / path.stem / "diagnosis.json").write_text(json.dumps(reported))
    if broken:
        (folder / f"{broken}.error.txt").write_text("too few samples: record more\n")


FAMILIES = {"dynamics": dynamics_scenarios(), "magnetometer": magnetometer_scenarios(15.0)}


@pytest.fixture(scope="module", params=[pytest.param("dynamics", marks=pytest.mark.e2e), "magnetometer"])
def done(request, tmp_path_factory):
    output = tmp_path_factory.mktemp("scenarios") / "out"
    reported = []
    result = run_scenarios(
        cheap, FAMILIES[request.param], per_scenario=2, hidden=1, seed=3, output=output,
        progress=lambda stage, done, total: reported.append((stage, done, total)),
    )  # fmt: skip
    return FAMILIES[request.param], result, output, reported


def test_the_hash_matches_the_key_and_the_key_is_written_last(done):
    _, _, output, _ = done
    assert digest((output / "key.json").read_text().rstrip("\n")) == (output / "key_hash.txt").read_text().strip()


def test_every_scenario_has_its_recordings(done):
    scenarios, result, output, reported = done
    assert [w.name for w in result.scenarios] == [w.name for w in scenarios.scenarios]
    assert {w.empty for w in result.scenarios} == {2}
    assert [w.hidden for w in result.scenarios] == [int(w.hides) for w in scenarios.scenarios]
    total = count(scenarios, (), 2, 1)
    assert len(list((output / "recordings").iterdir())) == total == len(result.cases)
    assert {stage for stage, number, of in reported if number == of == total} == {"draw"}
    assert sum(sum(w.verdicts.values()) for w in result.scenarios) == 2 * len(scenarios.scenarios)


def test_names_and_simulations_do_not_reveal_the_scenario(done):
    scenarios, result, output, _ = done
    known = {scenario.name for scenario in scenarios.scenarios}
    for path in (output / "recordings").iterdir():
        assert re.fullmatch(r"[a-z_]+_\d{5}", path.stem)
        assert path.stem.rpartition("_")[0] not in known
    for path in (output / "simulations").iterdir():
        text = path.read_text(encoding="utf-8").lower()
        assert not any(word in text for word in ("wrong", "other", "useless", "far", "mistake"))
    order = [case.key.scenario for case in result.cases]
    assert order != sorted(order)


def test_each_differential_equation_has_a_simulation_of_its_own(done):
    scenarios, result, output, _ = done
    given = {path.stem for path in (output / "simulations").iterdir()}
    if scenarios.family == "dynamics":
        assert given == {case.key.name for case in result.cases}
    else:
        views = {case.key.name for case in result.cases if case.key.useless not in ("", "unrelated field")}
        assert given == views


def test_a_failed_recording_has_its_reason_and_is_not_an_alarm(done):
    _, result, output, _ = done
    record = json.loads((output / "score.json").read_text(encoding="utf-8"))
    failed = [name for scenario in result.scenarios for name in scenario.failed]
    assert set(record["failed"]) == set(failed)
    assert "too few samples" in "".join(record["failed"].values())
    assert all(scenario.false_alarms.count == 0 for scenario in result.scenarios)
    assert record["settings"]["seed"] == 3
    assert len(record["scenarios"]) == len(result.scenarios)
    assert "aims hold" in (output / "challenge.html").read_text(encoding="utf-8")
    assert "| scenario | aim | measured | holds |" in (output / "summary.md").read_text(encoding="utf-8")


def quiet(paths, folder):
    """Write no diagnosis."""


def test_a_larger_run_contains_a_smaller_one(tmp_path):
    scenarios = FAMILIES["magnetometer"]
    small, large = (
        run_scenarios(quiet, scenarios, only=["white"], per_scenario=n, hidden=0, seed=3, output=tmp_path / str(n))
        for n in (1, 3)
    )
    (item,) = small.cases
    same = next(case for case in large.cases if case.key.index == item.key.index)
    assert same.key.key.sensor == item.key.key.sensor
    for run, name in (("1", item.key.name), ("3", same.key.name)):
        assert (tmp_path / run / "recordings" / f"{name}.csv").is_file()
    first, again = (
        (tmp_path / run / "recordings" / f"{name}.csv").read_bytes()
        for run, name in (("1", item.key.name), ("3", same.key.name))
    )
    assert first == again


@pytest.mark.process
def test_two_processes_draw_the_same(tmp_path):
    scenarios = FAMILIES["dynamics"]
    for workers in (1, 2):
        run_scenarios(
            quiet, scenarios, only=["gusts", "useless"], per_scenario=1, hidden=0, seed=3,
            output=tmp_path / str(workers), workers=workers,
        )  # fmt: skip
    assert (tmp_path / "1" / "key_hash.txt").read_text() == (tmp_path / "2" / "key_hash.txt").read_text()


def test_a_scenario_that_is_not_there_and_a_run_of_nothing_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one of white, coloured, wander, .* but got 'held'"):
        run_scenarios(quiet, FAMILIES["magnetometer"], only=["held"], output=tmp_path / "a")
    with pytest.raises(ValueError, match="at least"):
        run_scenarios(quiet, FAMILIES["magnetometer"], per_scenario=0, output=tmp_path / "a")
    assert not (tmp_path / "a").exists()
