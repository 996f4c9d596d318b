"""Blind proofs from end to end, with a stub of the diagnosis, and once with a real diagnosis."""

import json
import math
import re
from html.parser import HTMLParser

import pytest
import torch

pytest.importorskip("polars")
pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from examples.blind_proof import diagnose as jobs
from examples.blind_proof.equations.cases import equations
from examples.blind_proof.equations.scenarios import equations_scenarios
from examples.blind_proof.key import digest
from examples.blind_proof.magnetometer.cases import magnetometer
from examples.blind_proof.magnetometer.scenarios import magnetometer_scenarios
from examples.blind_proof.proof import Address
from examples.blind_proof.run import run_proof
from mkc_torch.cli.diagnosis_request import MAGNETOMETER
from mkc_torch.recording.recording import Recording

DURATION = 10.0

PROOFS = {
    "magnetometer": magnetometer(DURATION),
    "equations": equations(),
    "magnetometer_scenarios": magnetometer_scenarios(15.0),
    "equations_scenarios": equations_scenarios(),
}


def diagnose_stub(paths, folder):
    """Report adequate, unfit and a failure in turn, and check that the key is hidden."""
    output = folder.parent
    assert (output / "key_hash.txt").is_file()
    assert not (output / "key.json").exists()
    for path in paths:
        number = int(path.stem[-5:])
        if number % 3 == 2:
            (folder / f"{path.stem}.error.txt").write_text("too few samples: record more\n")
            continue
        (folder / path.stem).mkdir()
        reported = {"verdict": ("adequate", "unfit")[number % 3], "p_value": 0.5, "findings": []}
        (folder / path.stem / "diagnosis.json").write_text(json.dumps(reported))
        (folder / path.stem / "model.json").write_text("{}")


def no_diagnosis(paths, folder):
    """Write no diagnosis."""


def diagnose_raising(*_):
    raise RuntimeError("no more")


def correct_stub(model, path):
    assert model.is_file()
    recording = Recording.read(path)
    return recording.columns | {f"field_{axis}": recording[f"mag_{axis}"] for axis in "xyz" if "mag_x" in recording}


@pytest.fixture(
    scope="module",
    params=[*list(PROOFS)[:3], pytest.param("equations_scenarios", marks=pytest.mark.slow)],
)
def run(request, tmp_path_factory):
    output = tmp_path_factory.mktemp("proof") / "out"
    reported = []
    proof = PROOFS[request.param]
    cases, empty = (1, 2) if proof.totals else (3, 3)
    result = run_proof(
        proof, diagnose_stub, correct_stub, cases=cases, empty=empty, seed=3, output=output,
        progress=lambda stage, done, total: reported.append((stage, done, total)),
    )  # fmt: skip
    return proof, result, output, reported


def test_the_published_hash_matches_the_key(run):
    _, _, output, _ = run
    assert digest((output / "key.json").read_text().rstrip("\n")) == (output / "key_hash.txt").read_text().strip()


def test_every_scenario_has_its_recordings(run):
    proof, result, output, reported = run
    assert [row.name for row in result.scenarios] == [scenario.name for scenario in proof.scenarios]
    wanted = [2 if proof.totals else 3] * len(proof.scenarios)
    assert [row.empty for row in result.scenarios] == wanted
    assert [sum(row.verdicts.values()) for row in result.scenarios] == wanted
    assert [row.hidden for row in result.scenarios] == [
        (1 if proof.totals else 3) * scenario.hides for scenario in proof.scenarios
    ]
    total = len(proof.addresses(3, wanted[0] // 2 if proof.totals else 3, wanted[0]))
    assert len(list((output / "recordings").iterdir())) == total == len(result.cases)
    assert {"draw"} <= {stage for stage, number, of in reported if number == of == total}


def test_names_and_simulations_do_not_reveal_the_hidden_physics(run):
    proof, result, output, _ = run
    known = {scenario.name for scenario in proof.scenarios}
    stems = sorted(path.stem for path in (output / "recordings").iterdir())
    assert all(re.fullmatch(r"[a-z_]+_\d{5}", stem) and stem.rpartition("_")[0] not in known for stem in stems)
    assert sorted(int(stem[-5:]) for stem in stems) == list(range(len(stems)))
    for path in (output / "simulations").iterdir():
        text = path.read_text(encoding="utf-8").lower()
        assert not any(word in text for word in ("wrong", "other", "useless", "far", "mistake"))
    hides = [case.hides for case in sorted(result.cases, key=lambda case: case.key.name[-5:])]
    assert hides not in (sorted(hides), sorted(hides, reverse=True))


def test_recordings_of_other_simulations_than_the_magnetometer_have_a_simulation_file(run):
    proof, result, output, _ = run
    given = {path.stem for path in (output / "simulations").iterdir()}
    if proof.name.startswith("equations"):
        assert given == {case.key.name for case in result.cases}
    else:
        assert given == {case.key.name for case in result.cases if case.key.useless not in ("", "unrelated field")}


def test_second_recordings_are_those_with_an_oracle(run):
    proof, result, output, _ = run
    seconds = {path.stem for path in (output / "second").iterdir()}
    assert seconds == ({case.key.name for case in result.cases if case.hides} if proof.ratio else set())
    assert {case.key.name for case in result.cases if case.ratio is not None} == seconds


def test_a_failed_recording_has_its_reason_and_is_not_an_alarm(run):
    _, result, output, _ = run
    record = json.loads((output / "score.json").read_text(encoding="utf-8"))
    assert {name[-5:] for name in result.failed} == {f"{n:05d}" for n in range(2, len(result.cases), 3)}
    assert set(record["failed"]) == set(result.failed)
    assert set(record["failed"].values()) == {"too few samples: record more"}
    assert all(row.shares["false_alarms"].count == 0 for row in result.scenarios)
    assert (record["settings"]["seed"], len(record["scenarios"])) == (3, len(result.scenarios))


def test_an_exception_of_the_diagnosis_is_a_failure(tmp_path):
    proof = PROOFS["magnetometer_scenarios"].only(["white"])
    result = run_proof(proof, diagnose_raising, correct_stub, cases=0, empty=1, output=tmp_path / "out")
    assert len(result.failed) == 1
    assert "no more" in next((tmp_path / "out" / "diagnoses").glob("*.error.txt")).read_text()


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, _):
        assert tag not in ("script", "link", "img")
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, *_):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_well_formed_and_loads_nothing(run):
    proof, _, output, _ = run
    tags = Tags()
    page = (output / "proof.html").read_text(encoding="utf-8")
    tags.feed(page)
    assert tags.open == []
    assert page.count("<svg") == 3
    assert "aims hold" in page
    assert ("Comparison with the baselines" in page) == bool(proof.baselines)


def test_the_summary_has_every_aim(run):
    proof, _, output, _ = run
    text = (output / "summary.md").read_text(encoding="utf-8")
    assert f"- proof: {proof.name}" in text
    assert all(aim.sentence in text for scenario in proof.scenarios for aim in (*scenario.aims, *proof.totals))


def test_a_larger_run_of_scenarios_contains_a_smaller_one(tmp_path):
    proof = PROOFS["magnetometer_scenarios"].only(["white"])
    small, large = (
        run_proof(proof, no_diagnosis, correct_stub, empty=n, cases=0, seed=3, output=tmp_path / str(n)) for n in (1, 3)
    )
    (item,) = small.cases
    same = next(case for case in large.cases if case.key.index == item.key.index)
    assert same.key.sensor == item.key.sensor
    first, again = (
        (tmp_path / folder / "recordings" / f"{name}.csv").read_bytes()
        for folder, name in (("1", item.key.name), ("3", same.key.name))
    )
    assert first == again


@pytest.mark.process
@pytest.mark.parametrize("name", ["magnetometer", pytest.param("equations_scenarios", marks=pytest.mark.slow)])
def test_draws_do_not_depend_on_the_number_of_processes(name, tmp_path):
    proof = PROOFS[name].only([] if name == "magnetometer" else ["gusts", "useless"])
    for workers in (1, 2):
        run_proof(
            proof,
            no_diagnosis,
            correct_stub,
            empty=1,
            cases=1,
            seed=3,
            output=tmp_path / str(workers),
            workers=workers,
        )
    assert (tmp_path / "1" / "key_hash.txt").read_text() == (tmp_path / "2" / "key_hash.txt").read_text()


def test_a_folder_in_use_an_unknown_scenario_and_an_empty_run_are_rejected(tmp_path):
    with pytest.raises(ValueError, match=r"held .* white, coloured, wander"):
        PROOFS["magnetometer_scenarios"].only(["held"])
    with pytest.raises(ValueError, match="both 0"):
        run_proof(PROOFS["magnetometer"], no_diagnosis, correct_stub, cases=0, empty=0, output=tmp_path / "a")
    assert not (tmp_path / "a").exists()
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError, match="not empty"):
        run_proof(PROOFS["magnetometer"], no_diagnosis, correct_stub, cases=1, empty=1, output=tmp_path)


@pytest.mark.parametrize(
    ("name", "cases", "empty", "sizes"),
    [
        ("magnetometer", None, None, [(240, 400)]),
        ("magnetometer", 3, None, [(3, 5)]),
        ("magnetometer", 0, 1, [(0, 1)]),
        ("equations", None, None, [(100, 150)]),
        ("equations_scenarios", None, None, [(20, 60)] * 8 + [(60, 60)] * 3 + [(0, 60)]),
        ("equations_scenarios", 5, 10, [(5, 10)] * 11 + [(0, 10)]),
    ],
)
def test_sizes_of_scenarios_follow_the_arguments(name, cases, empty, sizes):
    assert [(hidden, without) for _, hidden, without in PROOFS[name].sizes(cases, empty)] == sizes


def test_addresses_of_a_single_scenario_are_in_order_of_their_number():
    (scenario,) = PROOFS["magnetometer"].scenarios
    addresses = PROOFS["magnetometer"].addresses(1, 2, 3)
    assert addresses == [
        Address(scenario, number, hidden, number) for number, hidden in enumerate([True, True, False, False, False])
    ]


@pytest.mark.parametrize(
    ("name", "simulation"),
    [("cart_pole_00003", "cart_pole_00003.py:CartPole"), ("case_00004", "case_00004.py:sensor"), ("case_00005", "")],
)
def test_each_recording_is_compared_with_the_simulation_written_for_it(name, simulation, tmp_path):
    file = tmp_path / f"{name}.py"
    if simulation:
        file.touch()
    found = jobs.request_for(tmp_path / f"{name}.csv", file).simulation
    assert found == (str(tmp_path / simulation) if simulation else MAGNETOMETER)


def test_a_failed_diagnosis_removes_an_older_diagnosis(tmp_path):
    (tmp_path / "diagnoses" / "case_00000").mkdir(parents=True)
    (tmp_path / "recordings").mkdir()
    old = tmp_path / "diagnoses" / "case_00000" / "diagnosis.json"
    old.write_text("{}")
    path = tmp_path / "recordings" / "case_00000.csv"
    path.write_text("time,mag_x,mag_y,mag_z\n" + "".join(f"{k},{k},1,2\n" for k in range(5)))
    jobs.diagnose([path], tmp_path / "diagnoses")
    assert not old.exists()
    assert "too few" in (tmp_path / "diagnoses" / "case_00000.error.txt").read_text(encoding="utf-8")


@pytest.mark.e2e
def test_a_real_diagnosis_is_scored_and_its_model_simulates_the_recording(tmp_path):
    output = tmp_path / "out"
    result = run_proof(PROOFS["equations"], jobs.diagnose, jobs.apply, cases=0, empty=1, seed=53, output=output)
    assert result.failed == []
    assert result.total.shares["false_alarms"].total == 1
    (path,) = (output / "recordings").iterdir()
    place = output / "diagnoses" / path.stem
    assert json.loads((place / "diagnosis.json").read_text(encoding="utf-8"))["simulation"] == "Projectile"
    simulated, measured = jobs.apply(place / "model.json", path), Recording.read(path)
    for name in ("distance", "height"):
        assert float((simulated[name] - measured[name]).abs().median()) < 0.05 * float(measured[name].std())


def test_a_run_does_not_change_the_number_of_threads(run):
    assert torch.get_num_threads() == 1
    assert all(math.isfinite(p) for row in run[1].scenarios for p in row.p_values)
