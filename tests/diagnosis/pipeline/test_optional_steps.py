"""An internal error in an optional step of a diagnosis becomes a warning, and the result so far is kept."""

import json
import multiprocessing
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import mkc_torch.diagnosis.pipeline.search as search_stage
from mkc_torch import diagnose
from mkc_torch._parallel.deadline import Stopped
from mkc_torch._parallel.pool import allow_copies, shared
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, EvidenceTest
from mkc_torch.diagnosis.evidence.held_out import blocks_of, held_out
from mkc_torch.diagnosis.evidence.run import final_of, precompute, results_of_tests
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.optional import optional, optional_steps
from mkc_torch.diagnosis.pipeline.partial import PartialResult
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.settings import ConfirmationSettings, Settings
from mkc_torch.effects import DYNAMICS, Effect
from mkc_torch.nonlinear import NoFitError
from tests.diagnosis.line import Line
from tests.diagnosis.test_dynamics_diagnosis import Pendulum, pendulum_recording

WARNING = (
    "The step 'rivals' ended in an internal error (RuntimeError: sizes 3 and 4 differ); the result is that before it. "
    "Please report this."
)


def failing(error):
    def work():
        raise error

    return work


def test_an_error_of_a_step_becomes_a_warning_and_the_result_before_it_is_returned():
    with optional_steps() as warnings:
        assert optional("first", lambda: 1, lambda: 2) == 1
        assert optional("rivals", failing(RuntimeError("sizes 3\n and 4 differ")), lambda: 2) == 2
    assert warnings == [WARNING]


@pytest.mark.parametrize("error", [Stopped("time limit"), KeyboardInterrupt()])
def test_a_stop_and_an_interrupt_pass_through(error):
    with optional_steps() as warnings, pytest.raises(type(error)):
        optional("rivals", failing(error), lambda: 2)
    assert warnings == []


def test_an_error_is_raised_outside_of_a_diagnosis_and_without_an_earlier_result():
    with pytest.raises(RuntimeError, match="differ"):
        optional("rivals", failing(RuntimeError("sizes differ")), lambda: 2)
    with optional_steps() as warnings, pytest.raises(RuntimeError, match="differ"):
        optional("rivals", failing(RuntimeError("sizes differ")), lambda: 2, lambda: False)
    assert warnings == []


@pytest.mark.process
@pytest.mark.skipif(sys.platform != "linux", reason="nothing is forked elsewhere")
def test_errors_in_copies_of_the_process_become_warnings():
    works = [lambda: optional("rivals", failing(RuntimeError("sizes 3 and 4 differ")), lambda: -1)] * 8
    allow_copies(1)
    try:
        with optional_steps() as warnings:
            shared(works)  # measures the cost of a work
            warnings.clear()
            assert shared([slow, *works]) == [0, *[-1] * 8]
    finally:
        allow_copies(0)
    assert warnings == [WARNING] * 8
    assert multiprocessing.active_children() == []


def slow():
    for _ in range(200):
        torch.linalg.inv(torch.eye(200, dtype=torch.float64))
    return 0


def partial_result():
    options = SimpleNamespace(quick=False)
    problem = SimpleNamespace(options=options, simulation=None, effects=(), recordings=(), run_counts=())
    return PartialResult(problem)


def search_of(found, evidence=("alone",), left=("further",)):
    return StepwiseSearch(None, found, None, None, evidence, left)


def kept_then_failing(known, search):
    def step():
        known.keep_search(search)
        raise NoFitError("sizes differ")

    return step


def test_a_step_that_keeps_its_parts_returns_what_it_kept():
    known, one, two = partial_result(), search_of(("one",)), search_of(("one", "two"))
    with optional_steps() as warnings:
        assert known.continued("further", kept_then_failing(known, two), one) is two
        assert known.continued("further", failing(RuntimeError("sizes differ")), two) is two
    assert len(warnings) == 2


def test_without_a_finding_the_search_ends():
    known, nothing = partial_result(), search_of(())
    with optional_steps():
        assert known.continued("first", kept_then_failing(known, nothing)) == replace(nothing, left=())


def test_an_error_of_the_first_search_is_raised():
    known = partial_result()
    known.keep_search(search_of(("one",)))  # of another fit of the simulation
    with optional_steps(), pytest.raises(RuntimeError, match="differ"):
        known.continued("first", failing(RuntimeError("sizes differ")))
    with optional_steps(), pytest.raises(NoFitError, match="differ"):
        known.continued("first", kept_then_failing(known, search_of((), evidence=())))


def test_a_failed_improvement_changes_nothing():
    known, before = partial_result(), search_of(("one",))
    known.keep_search(before)
    known.keep_baseline("coarse")

    def repeated():
        known.restart()
        known.keep_baseline("fine", with_noise=True)
        known.keep_search(search_of(()))
        raise RuntimeError("sizes differ")

    with optional_steps() as warnings:
        assert known.improved("halving", repeated, before) is before
    assert (known.search, known.baseline, known.fitted) == (before, "coarse", False)
    assert len(warnings) == 1


def test_a_lost_fit_at_a_smaller_step_leaves_the_simulation_at_the_step_of_the_findings(monkeypatch):
    known, before = partial_result(), search_of(("one",))
    known.options = SimpleNamespace(settings=Settings())
    known.keep_search(before)
    known.keep_baseline("coarse", with_noise=True)
    found = SimpleNamespace(found=[SimpleNamespace(fit=None)])
    monkeypatch.setattr(search_stage, "with_smaller_step", lambda *_: "fine")
    monkeypatch.setattr(search_stage, "at_half_step", lambda _: "fine")
    monkeypatch.setattr(search_stage, "with_step_of", lambda *_: failing(NoFitError("lost"))())
    assert search_stage.at_smaller_step(known, found) is found
    assert (known.search, known.baseline) == (before, "coarse")


def context():
    line = Line(300)
    base = fitted(JointModel(line), line.start())
    blocks = blocks_of(300, 1, ConfirmationSettings())
    return EvidenceContext(base, None, (), (held_out(base, blocks),), blocks, (), 0, Settings())


def counting_evidence(case):
    return EvidenceResult("counting", 1)


def broken_evidence(case):
    raise RuntimeError("sizes differ")


def test_a_test_of_evidence_that_fails_has_no_result():
    case = context()
    tests = (
        EvidenceTest(broken_evidence),
        EvidenceTest(counting_evidence),
        EvidenceTest(counting_evidence, ahead=broken_evidence),
    )
    with optional_steps() as warnings:
        report = results_of_tests(case, [work() for work in precompute(case, tests)], tests)
    assert [result.test for result in report.of_all] == ["counting"]
    assert [sentence.partition("' ended")[0] for sentence in warnings] == [
        "The step 'test of evidence: counting",
        "The step 'test of evidence: broken",
    ]


def test_without_standard_errors_those_over_the_blocks_remain(monkeypatch):
    case = context()
    exact = final_of(case)
    monkeypatch.setattr("mkc_torch.diagnosis.search.estimate.tangents_of", broken_evidence)
    with optional_steps() as warnings:
        rough = final_of(case)
    assert len(warnings) == 1
    assert torch.equal(rough.fit.parameters, case.fit.parameters)
    torch.testing.assert_close(rough.standard_error, case.held_out[-1].jackknife)
    assert bool((rough.standard_error <= 1.0001 * exact.standard_error).all())


class Fragile(Effect):
    """Drag whose code fails during a stage of a diagnosis; it receives the diagnosis's progress."""

    drag = next(effect for effect in DYNAMICS if effect.id == "quadratic_drag")
    id, port, needs, follows_signal, lower = "fragile_drag", drag.port, drag.needs, True, 0.0

    def __init__(self, stage):
        self.stage, self.fails = stage, False

    def __call__(self, stage):
        self.fails = self.stage in stage

    def count(self, thing, done, total):
        self.fails = (self.fails and thing != "test of evidence") or thing == self.stage

    def quantities(self, shape, context):
        return self.drag.quantities(shape, context)

    def change(self, gamma, shape, context):
        if self.fails:
            raise RuntimeError("sizes 3 and 4 differ")
        return self.drag.change(gamma, shape, context)


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("stage", "step", "found"),
    [("model", "searching models", []), ("checking what was found", "checking what was found", ["fragile_drag"])],
)
def test_the_findings_so_far_are_returned_with_a_warning(stage, step, found):
    """An error in a fit of the search comes before any finding."""
    effect = Fragile(stage)
    friction = next(effect for effect in DYNAMICS if effect.id == "coulomb_friction")
    recording = pendulum_recording(lambda _, speed: -0.8 * speed * abs(speed))
    result = diagnose(Pendulum(), recording, effects=(effect, friction), surrogates=19, progress=effect)
    assert [finding.effect for finding in result.findings] == found
    (failed,) = (sentence for sentence in result.warnings if "internal error" in sentence)
    assert step in failed.partition("ended")[0]
    assert "(RuntimeError: sizes 3 and 4 differ); the result is that before it." in failed
    assert failed in json.loads(diagnosis_to_json(result))["warnings"]


@pytest.mark.e2e
def test_after_an_error_of_the_first_search_the_fit_of_the_simulation_is_returned():
    effect = Fragile("trying")
    friction = next(effect for effect in DYNAMICS if effect.id == "coulomb_friction")
    result = diagnose(Pendulum(), pendulum_recording(lambda *_: 0.0), effects=(effect, friction), progress=effect)
    assert (result.findings, result.verdict, result.stop.reason) == ((), "unexplained", "internal error")
    assert "the search for effects" in result.stop.not_done
    assert "The step 'searching for effects' ended in an internal error" in result.warnings[-1]
