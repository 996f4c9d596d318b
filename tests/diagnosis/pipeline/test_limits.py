"""Stopped diagnoses and quick looks report partial results and the skipped steps."""

import json
import math
import multiprocessing
import sys

import pytest

from mkc_torch import diagnose
from mkc_torch._parallel import deadline
from mkc_torch._parallel.deadline import Stopped
from mkc_torch._parallel.pool import allow_copies
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.result import Stop, notices
from mkc_torch.diagnosis.search.significance import pays, price
from mkc_torch.effects import CATALOGUE
from mkc_torch.recording.demonstration import concealed_recording
from mkc_torch.report import diagnosis_report
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.test_dynamics_diagnosis import Pendulum, pendulum_recording

EFFECTS = [effect for effect in CATALOGUE if effect.id in ("quadratic_drag", "coulomb_friction", "current_field")]
QUICK = {"surrogates": 19, "max_findings": 1, "effects": EFFECTS}
NOT_FINISHED = "The search was stopped"


class Steps:
    """Stop a diagnosis at one of its deadline checks."""

    def __init__(self, monkeypatch, at=math.inf, reason="time limit"):
        self.count, self.at, self.reason = 0, at, reason
        monkeypatch.setattr(deadline.Deadline, "check", lambda _: self.step())

    def step(self):
        self.count += 1
        if self.count >= self.at and self.at < math.inf:
            # later stages have their own deadline
            self.at = math.inf
            raise Stopped(self.reason)


def magnetometer():
    return Magnetometer(), concealed_recording()


def pendulum():
    return Pendulum(), pendulum_recording(lambda _, speed: -0.8 * speed * abs(speed))


def assert_stop_is_reported(result):
    """Check that the files of a stopped diagnosis can be written and report the stop."""
    content = json.loads(diagnosis_to_json(result))
    assert content["search"]["stopped"]["reason"] == "time limit"
    assert "the other tests of evidence" in content["search"]["stopped"]["not_done"]
    assert content["warnings"][0].startswith("Stopped after")
    assert result.verdict in ("unfit", "unexplained")
    page = diagnosis_report(result)
    assert page.index("Stopped after") < page.index("<h1")
    assert NOT_FINISHED in page or result.verdict == "unfit"
    assert NOT_FINISHED in result._repr_html_()
    return result


@pytest.mark.e2e
@pytest.mark.parametrize("case", [magnetometer, pendulum])
def test_a_diagnosis_stopped_at_any_check_reports_partial_results(monkeypatch, case):
    simulation, recording = case()
    all_steps = Steps(monkeypatch)
    assert diagnose(simulation, recording, **QUICK).stop is None
    seen = set()
    for share in (0.3, 0.6, 0.95):
        Steps(monkeypatch, round(share * all_steps.count))
        result = assert_stop_is_reported(diagnose(simulation, recording, **QUICK))
        seen.add(result.stop.not_done)
        if result.p_value is None:
            assert (result.candidates, result.candidates_tried, result.findings) == ((), 0, ())
            assert "the search for effects" in result.stop.not_done
        else:
            assert result.candidates
    assert len(seen) > 1
    # at the end only the tests of evidence are missing
    assert result.findings
    assert "the search for effects" not in result.stop.not_done


@pytest.mark.e2e
def test_a_stop_before_the_first_fit_raises(monkeypatch):
    simulation, recording = magnetometer()
    with pytest.raises(TimeoutError, match=r"^concealed: the time limit of 1e-06 s was over before .* Allow more time"):
        diagnose(simulation, recording, time_limit=1e-6)
    Steps(monkeypatch, 1, reason="interrupt")
    with pytest.raises(KeyboardInterrupt):
        diagnose(simulation, recording)


@pytest.mark.e2e
@pytest.mark.skipif(sys.platform != "linux", reason="nothing is forked elsewhere")
def test_a_stop_ends_worker_processes(monkeypatch):
    simulation, recording = pendulum()
    steps = Steps(monkeypatch)
    allow_copies(1)
    try:
        diagnose(simulation, recording, **QUICK)
        Steps(monkeypatch, steps.count // 2)
        assert_stop_is_reported(diagnose(simulation, recording, **QUICK))
    finally:
        allow_copies(0)
    assert multiprocessing.active_children() == []


@pytest.mark.e2e
def test_a_long_time_limit_changes_nothing():
    simulation, recording = magnetometer()
    limited, plain = (diagnose(simulation, recording, **QUICK, time_limit=limit) for limit in (1e6, None))
    assert diagnosis_to_json(limited) == diagnosis_to_json(plain)


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("case", "effect", "grade"),
    # without surrogates of process noise and a shape check, the finding stays unconfirmed
    [(magnetometer, "current_field", "left_out"), (pendulum, "quadratic_drag", "unconfirmed")],
)
def test_a_quick_look_finds_the_same_without_surrogates(monkeypatch, case, effect, grade):
    def refuse(*_, **__):
        raise AssertionError("noise was drawn")

    monkeypatch.setattr("mkc_torch.diagnosis.search.run.surrogate_p_value", refuse)
    monkeypatch.setattr("mkc_torch.diagnosis.search.joint_likelihood.noise_surrogates", refuse)
    monkeypatch.setattr("mkc_torch.diagnosis.findings.finding.attributed", refuse)
    result = diagnose(*case(), quick=True)
    (finding,) = result.findings
    assert (finding.effect, finding.grade, finding.p_value) == (effect, grade, None)
    assert (result.quick, result.p_value, result.surrogates, result.stop) == (True, None, 0, None)
    content = json.loads(diagnosis_to_json(result))
    assert (content["p_value"], content["search"]["quick"], content["search"]["surrogates"]) == (None, True, 0)
    assert content["warnings"][0].startswith("Quick look: no p-values, false-alarm rate not controlled. Left out: ")
    page = diagnosis_report(result)
    assert page.index("Quick look: no p-values") < page.index("<h1")
    assert "full diagnosis" in result.advice[0]


@pytest.mark.e2e
def test_a_quick_look_at_noise_finds_nothing():
    simulation, recording = pendulum()[0], pendulum_recording(lambda *_: 0.0)
    result = diagnose(simulation, recording, quick=True)
    assert (result.verdict, result.findings, result.p_value) == ("adequate", (), None)


def test_the_penalty_grows_with_numbers_samples_and_candidates():
    assert price(1, 100, 1) == pytest.approx(0.5 * math.log(100))
    assert price(2, 100, 10) == pytest.approx(math.log(100) + math.log(10))
    assert pays(price(2, 100, 10) + 1e-9, 2, 100, 10)
    assert not pays(price(2, 100, 10), 2, 100, 10)


def test_the_stop_comes_before_the_quick_look():
    sentences = notices(Stop("interrupt", 12.3, ("the search for effects", "the other tests")), quick=True)
    assert sentences[0].startswith("Stopped by an interrupt after 12 s")
    assert "not done: the search for effects; the other tests" in sentences[0]
    assert sentences[1].startswith("Quick look")
    assert notices(None, quick=False) == ()


@pytest.mark.parametrize("limit", [0.0, -1.0, math.nan, math.inf])
def test_a_time_limit_must_be_positive(limit):
    with pytest.raises(ValueError, match=r"`time_limit`.*None for no limit"):
        diagnose(*magnetometer(), time_limit=limit)


@pytest.mark.parametrize(("name", "bad"), [("time_limit", "60"), ("time_limit", True), ("quick", 1), ("quick", "yes")])
def test_limits_of_another_type_raise(name, bad):
    with pytest.raises(TypeError, match=f"`{name}`"):
        diagnose(*magnetometer(), **{name: bad})


@pytest.mark.e2e
def test_progress_counts_the_items_of_a_stage():
    class Progress:
        def __init__(self):
            self.stages, self.things = [], []

        def __call__(self, stage):
            self.stages.append(stage)

        def count(self, thing, done, total):
            assert 0 <= done <= total
            self.things.append(thing)

    progress = Progress()
    diagnose(*pendulum(), **QUICK, progress=progress)
    assert progress.stages[:2] == ["reading the recording", "fitting the simulation alone"]
    assert {"model", "part held out", "test of evidence"} <= set(progress.things)
