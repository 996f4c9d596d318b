"""The series of the figures: the recording, the simulation as it was, and the corrected simulation."""

from types import SimpleNamespace

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis import vetoes
from mkc_torch.diagnosis.decisions import Decision
from mkc_torch.diagnosis.evidence.held_out import blocks_of
from mkc_torch.diagnosis.pipeline.traces import _shown_fold
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.simulation import Magnetometer, Static

TIME = torch.arange(300, dtype=torch.float64) / 10.0


class Line(Static):
    """A voltage that is proportional to a current."""

    inputs, outputs = ("current",), ("voltage",)
    parameters = {"resistance": 1.0}

    def output(self, time, u, p):
        return {"voltage": p.resistance * u.current}


def bench(offset=0.0, quadratic=0.0):
    noise = 0.01 * torch.randn(len(TIME), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    current = torch.sin(TIME) + 0.4 * torch.sin(2.7 * TIME)
    heat = torch.cos(1.9 * TIME + 0.3)
    voltage = 2.0 * current + offset * heat + quadratic * heat.square() + noise
    return Recording({"time": TIME, "current": current, "heat": heat, "voltage": voltage})


@pytest.fixture(scope="module")
def found():
    return diagnose(Line(), bench(offset=0.2), surrogates=19)


def test_the_courses_are_the_recording_and_both_simulations(found):
    t = found.traces
    assert [f.grade for f in found.findings] == ["left_out"]
    torch.testing.assert_close(t.courses.recorded[:, 0], bench(offset=0.2)["voltage"])
    seen = ~t.courses.held_out
    torch.testing.assert_close((t.courses.recorded - t.courses.before)[seen], t.before[seen])
    torch.testing.assert_close((t.courses.recorded - t.courses.corrected)[seen], t.after[seen])
    # held-out samples are predicted by fits of the others: near, not the same
    held = t.courses.held_out
    assert 0.1 < float(held.double().mean()) < 0.3
    unseen = (t.courses.recorded - t.courses.corrected)[held]
    assert not torch.equal(unseen, t.after[held])
    torch.testing.assert_close(unseen, t.after[held], rtol=0.0, atol=0.01)
    assert not t.courses.one_step


def test_the_sizes_of_the_outputs_are_those_of_the_scores(found):
    before, after = (score.outputs["voltage"] for score in (found.baseline, found.corrected))
    assert before.rmse == pytest.approx(0.14, rel=0.2)
    assert after.rmse == pytest.approx(0.01, rel=0.2)


def test_a_finding_that_is_not_confirmed_is_in_no_corrected_number(monkeypatch):
    def refused(finding, context):
        return Decision("held_out_blocks", "", 0.0, 1.0, False, "Refused.", context.number)

    monkeypatch.setattr(vetoes, "VETOES", (refused,))
    made = diagnose(Line(), bench(offset=0.2), surrogates=19)
    assert [f.grade for f in made.findings] == ["unconfirmed"]
    assert made.corrected == made.baseline
    assert made.model.terms == ()
    t = made.traces
    assert torch.equal(t.after, t.before)
    assert torch.equal(t.courses.before, t.courses.corrected)
    # the figure of the finding itself shows what it would change
    assert float(t.with_all.std()) < 0.5 * float(t.before.std())


def test_no_part_is_held_out_without_scores_on_blocks():
    blocks = blocks_of(100, 1, Settings().confirmation)
    folds, all_of_it = (SimpleNamespace(parameters=torch.zeros(count, 2)) for count in (5, 1))
    judged, quick = (SimpleNamespace(blocks=blocks, held_out=(item, item)) for item in (folds, all_of_it))
    assert int(_shown_fold(judged).sum()) == 20
    assert not bool(_shown_fold(judged)[0])
    assert not bool(_shown_fold(quick).any())


@pytest.mark.e2e
def test_the_length_of_a_field_has_no_course():
    from mkc_torch.recording.demonstration import simulated_recording

    assert diagnose(Magnetometer(), simulated_recording()[0], quick=True).traces.courses is None
