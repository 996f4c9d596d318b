"""The gate for changes of the verdict: its judgements and comparisons, on invented diagnoses."""

import json
import sys
import time

import pytest

pytest.importorskip("polars")

from examples.concealed_physics import known
from examples.concealed_physics.judge import judged
from mkc_torch.cli.diagnosis_request import Request
from tests.gate import __main__ as gate
from tests.gate import drawn
from tests.gate.compare import differences
from tests.gate.tables import compared_lines, count_lines, wrong_lines
from tests.gate.work import Job, diagnosed

REAL = {case.name: case.expected for case in known.real()}
CASES = {case.name: case.expected for case in known.cases()}
ROCKET, PENDULUM = "real rocket juno Rocket", "real pendulum_encoder run Pendulum"


def finding(effect, grade="left_out", *, at=("rate of speed",), alternatives=(), **parameters):
    return {
        "effect": effect,
        "grade": grade,
        "drivers": [],
        "channels": list(at),
        "p_value": 0.01,
        "alternatives": [{"effect": name, "drivers": [], "separable": False} for name in alternatives],
        "parameters": [
            {"name": name, "value": value, "standard_error": error, "unit": ""}
            for name, (value, error) in parameters.items()
        ],
    }


def row(*findings, verdict="explained", after=None, sentences=(), **more):
    return {
        "verdict": verdict,
        "p_value": 0.01,
        "findings": list(findings),
        "residual_before": {},
        "residual_after": after or {},
        "sentences": list(sentences),
        "cpu_seconds": 2.0,
    } | more


def drag(value=9.3e-5, error=1e-6, **more):
    return finding("quadratic_drag", drag=(value, error), **more)


def test_right_answers_are_right_and_each_fault_of_a_wrong_answer_is_reported():
    right = judged(row(drag(), after={"altitude": 2.3}), REAL[ROCKET])
    assert right == {"right": True, "wrong": []}
    wrong = judged(row(drag(5e-5), after={"altitude": 17.0}), REAL[ROCKET])["wrong"]
    assert [fault.split(" is ")[0] for fault in wrong] == ["drag of quadratic_drag", "the residual of altitude"]
    (unnamed, *_) = judged(row(verdict="unexplained"), REAL[ROCKET])["wrong"]
    assert unnamed == "quadratic_drag is not claimed but nothing"
    (unconfirmed, *_) = judged(row(drag(grade="unconfirmed"), after={"altitude": 2.0}), REAL[ROCKET])["wrong"]
    assert unconfirmed == "quadratic_drag is not claimed but nothing"
    (failed,) = judged(row(verdict="", failed="over the limit of 9 s"), REAL[ROCKET])["wrong"]
    assert failed == "no diagnosis: over the limit of 9 s"


def test_a_residual_that_is_unknown_is_not_small_enough():
    assert judged(row(drag(), after={}), REAL[ROCKET])["wrong"] == [
        "the residual of altitude is unknown, not at most 2.64"
    ]


def test_stribeck_friction_is_right_as_an_alternative_and_wrong_as_a_claim():
    after = {"angle": 0.0061}
    assert judged(row(finding("coulomb_friction", alternatives=["stribeck_friction"]), after=after), REAL[PENDULUM])[
        "right"
    ]
    result = judged(row(finding("stribeck_friction", alternatives=["coulomb_friction"]), after=after), REAL[PENDULUM])
    assert result["wrong"] == ["stribeck_friction is claimed"]


@pytest.mark.parametrize("name", [name for name in CASES if "coloured_sensor" in name])
def test_drag_under_coloured_noise_counts_by_its_standard_error(name):
    assert judged(row(drag(9.0e-5, 1.3e-6)), CASES[name])["right"]
    assert not judged(row(drag(9.0e-5, 1.1e-6)), CASES[name])["right"]
    assert not judged(row(drag(9.0e-5, None)), CASES[name])["right"]


def test_every_required_effect_must_be_claimed():
    found, after, servo = (
        [finding(name) for name in ("backlash", "delay", "offset")],
        {"pan": 0.0025},
        "real so101 recording",
    )
    assert judged(row(*found, after=after), REAL[servo])["right"]
    result = judged(row(*found[:2], after=after), REAL[servo])["wrong"]
    assert result == ["offset or gravity_sag is not claimed but backlash, delay"]


def test_a_claim_in_the_wrong_place_is_wrong():
    there, elsewhere = (
        judged(row(finding("overflow", at=[at]), after={"level2": 0.41}), CASES["cases tanks fit Tanks"])
        for at in ("rate of level1", "rate of level2")
    )
    assert there["right"]
    assert elsewhere["wrong"] == ["overflow is claimed at rate of level2"]
    both = [finding("overflow", at=[at]) for at in ("rate of level2", "rate of level1")]
    assert judged(row(*both, after={"level2": 0.28}), CASES["cases tanks fit Tanks"])["right"]


def test_another_effect_claimed_first_is_wrong():
    result = judged(row(finding("constant_force"), drag(), after={"altitude": 2.0}), REAL[ROCKET])["wrong"]
    assert result == ["constant_force is claimed first"]


def test_air_drag_reported_as_possible_is_right_and_no_report_is_wrong():
    coast = CASES["cases coastdown runs Coast"]
    stated = "quadratic_drag would explain what is left best, but noise makes as much of it by chance."
    assert judged(row(verdict="adequate", sentences=[stated]), coast)["right"]
    assert not judged(row(verdict="adequate", sentences=["Use the simulation as it is."]), coast)["right"]
    assert judged(row(drag(0.0006, 1e-4)), coast)["right"]
    assert not judged(row(drag(0.0008, 1e-4)), coast)["right"]


@pytest.mark.parametrize(
    ("name", "verdict"),
    [
        ("cases simulated/held_input run Pendulum", "adequate"),
        ("cases simulated/gusts run Pendulum", "unexplained"),
        ("cases simulated/unrelated run Pendulum", "unfit"),
        ("cases simulated/held_input run UpsideDown", "unfit"),
        ("cases ball_beam run Ball", "unfit"),
    ],
)
def test_without_hidden_effects_the_verdict_decides(name, verdict):
    for stated in ("adequate", "unexplained", "unfit", "explained"):
        assert judged(row(verdict=stated), CASES[name])["right"] == (stated == verdict)
    assert not judged(row(finding("input_delay"), verdict=verdict), CASES[name])["right"]


def test_recordings_have_unique_names_and_existing_files():
    everything = [*known.real(), *known.cases()]
    assert len({case.name for case in everything}) == len(everything) == 29
    arm = next(case for case in everything if "propeller_arm" in case.name)
    assert arm.request.input_hold == {"voltage": "held"}
    assert arm.request.simulation.endswith("propeller_arm/naive.py:Arm")
    commanded = next(case for case in everything if case.name == "real so101 recording")
    assert (commanded.request.simulation, commanded.request.simulator_output) == ("", commanded.file)


def test_pairs_differ_in_verdict_names_sizes_and_residuals():
    stored = {
        "same": row(drag(), after={"altitude": 2.0}),
        "verdict": row(verdict="explained", right=True),
        "grade": row(drag()),
        "size": row(drag(9.0e-5, 1e-6)),
        "within": row(drag(9.0e-5, 1e-6)),
        "residual": row(after={"altitude": 2.0}),
        "gone": row(),
    }
    found = {
        "same": row(drag(), after={"altitude": 2.01}, cpu_seconds=1.0),
        "verdict": row(verdict="unfit", right=False),
        "grade": row(drag(grade="unconfirmed")),
        "size": row(drag(9.1e-5, 1e-6)),
        "within": row(drag(9.04e-5, 1e-6)),
        "residual": row(after={"altitude": 17.0}),
        "new": row(),
    }
    assert differences(stored, found) == {
        "verdict": ["verdict explained -> unfit", "right True -> False"],
        "grade": ["findings quadratic_drag (left_out; rate of speed) -> quadratic_drag (unconfirmed; rate of speed)"],
        "size": ["drag of quadratic_drag 9e-05 -> 9.1e-05"],
        "residual": ["residual of altitude 2 -> 17"],
    }


def test_the_comparison_prints_counts_and_seconds():
    stored = {"counts": {"real": {"right": "1/2"}}, "recordings": {"real a": row(), "real b": row()}}
    found = {"counts": {"real": {"right": "2/2"}}, "recordings": {"real a": row(cpu_seconds=0.5)}}
    assert compared_lines(stored, found, {"real a": ["right False -> True"]}) == [
        "compared: 1 of 1 pairs differ",
        "  real a: right False -> True",
        "  real: right 1/2 -> 2/2",
        "  CPU seconds of the same 1 recordings: 2 -> 0",
    ]
    assert count_lines(stored)[0] == "real: right 1/2"
    assert wrong_lines({"a": {"wrong": ["too large"]}}) == ["  not right: a: too large"]


def write_row(job, folder):
    """In place of a diagnosis."""
    if "slow" in job.name:
        time.sleep(60.0)
    if "dies" in job.name:
        sys.exit(1)
    (folder / "row.json").write_text(json.dumps(row(drag(), after={"altitude": 2.0})), encoding="utf-8")


@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
def test_a_recording_over_its_time_limit_counts_as_failed(tmp_path):
    jobs = [Job(name, tmp_path / "a.csv", Request()) for name in ("dies", "quick")]
    rows = dict(diagnosed(jobs, tmp_path, workers=2, limit_s=120.0, task=write_row))
    assert rows["quick"]["verdict"] == "explained"
    assert (rows["dies"]["verdict"], rows["dies"]["failed"]) == ("", "the process ended")
    ((_, slow),) = diagnosed(
        [Job("slow", tmp_path / "a.csv", Request())], tmp_path, workers=1, limit_s=1.0, task=write_row
    )
    assert (slow["verdict"], slow["failed"]) == ("", "over the limit of 1 s")


def test_the_command_counts_writes_and_compares(tmp_path, monkeypatch, capsys):
    recording = tmp_path / "juno.csv"
    recording.write_text("time,altitude\n", encoding="utf-8")
    (tmp_path / "naive.py").write_text("", encoding="utf-8")
    present = known.Known(ROCKET, recording, f"{tmp_path / 'naive.py'}:Rocket", REAL[ROCKET])
    absent = known.Known("real away", tmp_path / "away.csv", f"{tmp_path / 'naive.py'}:Rocket", REAL[ROCKET])
    stated = row(drag(), after={"altitude": 2.0})
    monkeypatch.setattr(known, "real", lambda: iter([present, absent]))
    monkeypatch.setattr(gate, "diagnosed", lambda jobs, *_, **__: iter([(job.name, stated) for job in jobs]))
    assert gate.main(["--output", str(tmp_path / "before"), "--only", "real"]) == 0
    printed = capsys.readouterr().out
    assert "real: right 1/1" in printed
    assert f"left out: {tmp_path / 'away.csv'} is absent" in printed
    stated = row(verdict="unexplained")
    stored = str(tmp_path / "before" / gate.RESULT)
    assert gate.main(["--output", str(tmp_path / "after"), "--only", "real", "--compare", stored]) == 1
    assert "real: right 1/1 -> 0/1" in capsys.readouterr().out


def test_draws_are_scored_by_their_keys(tmp_path):
    sizes = {"magnetometer": 1, "dynamics": 0, "mujoco": 0}
    (family, *_) = drawn.all_proofs(tmp_path, match="proof magnetometer", sizes=sizes)
    hidden, empty = (next(job.name for job in family.jobs if kind in job.name) for kind in ("hidden", "empty"))
    truth = family.truths[hidden]["hidden"][0]
    claim = finding(truth["effect"], at=[]) | {"drivers": truth["drivers"]}
    rows = {hidden: row(claim), empty: row(claim)}
    assert family.outcomes(rows) == {hidden: {"named": True}, empty: {"false_alarm": True}}
    assert family.counts(rows)["false alarms"] == "1/1"
    rows = {hidden: row(verdict="adequate"), empty: row(verdict="adequate")}
    assert family.outcomes(rows) == {hidden: {"named": False}, empty: {"false_alarm": False}}
    assert all(job.recording.is_file() for job in family.jobs)
    again = next(iter(drawn.all_proofs(tmp_path / "again", match="hidden", sizes=sizes)))
    assert again.truths[hidden] == family.truths[hidden]


def test_scenarios_are_scored_by_their_keys(tmp_path):
    (_, family) = drawn.all_scenarios(tmp_path, match="scenario magnetometer", empty=1, hidden=0)
    assert len(family.jobs) == 6
    useless = next(name for name in family.truths if "useless" in name)
    rows = {job.name: row(verdict="unfit" if job.name == useless else "adequate") for job in family.jobs}
    counts = family.counts(rows)
    assert (counts["false alarms"], counts["useless unfit"], counts["failed"]) == ("0/6", "1/1", "0")
    rows[useless] = row(finding("offset_drift"))
    assert family.outcomes(rows)[useless] == {"false_alarm": True}


def test_undecidable_single_runs_are_counted_apart(tmp_path):
    (family, *_) = drawn.all_scenarios(tmp_path, match="scenario dynamics lasting_push empty", empty=2, hidden=0)
    assert len(family.jobs) == 2
    rival = finding("backlash", alternatives=("dead_zone",))
    rows = {job.name: row(item) for job, item in zip(family.jobs, (finding("backlash"), rival), strict=True)}
    counts = family.counts(rows)
    assert (counts["false alarms"], counts["a wrong single name in one run"]) == ("0/0", "1/2")
