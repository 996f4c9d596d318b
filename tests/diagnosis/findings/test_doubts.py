"""Estimates at a bound or far from plausible sizes are reported."""

import dataclasses

import pytest
import torch

from mkc_torch.diagnosis import vetoes
from mkc_torch.diagnosis.findings.advice import advice_of
from mkc_torch.diagnosis.findings.finding import far_from_plausible, shape_at_ends, times_plausible
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects import DYNAMICS
from mkc_torch.effects.dynamics.hidden_lag import HiddenLag
from mkc_torch.recording import Recording
from mkc_torch.report.diagnosis.findings import grade
from mkc_torch.report.diagnosis.verdict import headline
from mkc_torch.simulation import Dynamics
from tests.diagnosis.factory import make_diagnosis

TIME = torch.arange(200, dtype=torch.float64) / 10.0


class Tank(Dynamics):
    states, inputs = ("level",), ("pump",)
    parameters = {"drain": 0.3}
    units = {"level": "cm", "pump": "V"}

    def derivative(self, time, x, u, p):
        return {"level": u.pump - p.drain * x.level}


@pytest.fixture(scope="module")
def tank():
    return Tank().prepare(
        Recording({"time": TIME, "pump": 2.0 + torch.sin(TIME), "level": 5.0 + torch.sin(0.7 * TIME)})
    )


EFFECTS = {effect.id: effect for effect in DYNAMICS}
PLACES = {"overflow": "rate of level", "hidden_lag": "lagged rate of level", "dead_zone": "input pump"}


def doubts_of(tank, name, **shape):
    term = Term(EFFECTS[name], None, shape, PLACES[name])
    return shape_at_ends(term, tank, term.context(tank, None))


def test_a_parameter_at_its_bound_is_reported(tank):
    largest = tank.ports["rate of level"].sizes["own"].largest
    (text,) = doubts_of(tank, "overflow", rim=0.98 * largest, exponent=1.7)
    assert text.startswith("overflow: its rim ended at ")
    assert "cm, the greatest bound" in text
    (text,) = doubts_of(tank, "hidden_lag", time_constant=0.4 * 19.9)
    assert "its time constant ended at 7.96 s, the greatest bound" in text
    assert doubts_of(tank, "hidden_lag", time_constant=3.0) == ()


def test_a_parameter_at_a_valid_limit_of_its_form_is_not_reported(tank):
    largest = tank.ports["rate of level"].sizes["own"].largest
    assert doubts_of(tank, "overflow", rim=0.8 * largest, exponent=1.0) == ()
    assert len(doubts_of(tank, "overflow", rim=0.8 * largest, exponent=3.0)) == 1
    assert doubts_of(tank, "dead_zone", width=0.5, softness=0.02) == ()


def test_an_amplitude_at_its_bound_or_ten_times_the_plausible_size_is_impossible(tank):
    def text(effect, gamma, place):
        term = Term(effect, None, effect.shapes(tank.time)[0], place)
        return far_from_plausible(term, torch.tensor([gamma]).double(), term.context(tank, None))

    assert text(HiddenLag(), 100.0, "lagged rate of level").startswith("Its share ended at 100, the upper bound")
    assert text(HiddenLag(), 90.0, "lagged rate of level") == ""
    assert text(EFFECTS["dead_zone"], 1.0, "input pump") == ""  # all of a dead zone

    class Known(HiddenLag):
        plausible = 0.1

    term = Term(Known(), None, Known().shapes(tank.time)[0], "lagged rate of level")
    assert times_plausible(term, torch.tensor([2.0]).double(), term.context(tank, None)) == pytest.approx(20.0)
    assert text(Known(), 2.0, "lagged rate of level").startswith("Its share is 20 times the largest plausible size")
    assert text(Known(), 0.9, "lagged rate of level") == ""


def test_an_impossible_size_is_unconfirmed_with_its_reason():
    made = make_diagnosis(1, samples=50)
    why = "Its share ended at 30, the upper bound: the recording does not limit it."
    odd = dataclasses.replace(made.findings[0], cannot_be=True, plausible=False, plausibility=why, alternatives=())
    odd = dataclasses.replace(odd, grade=vetoes.grade(vetoes.decisions_on(odd)))
    assert (made.findings[0].grade, odd.grade) == ("left_out", "unconfirmed")
    diagnosis = dataclasses.replace(made, findings=(odd,))
    assert grade(odd) == "not confirmed: impossible size"
    assert headline(diagnosis).startswith("Found, but of an impossible size: hard-iron step")
    (only, *_) = advice_of(diagnosis)
    assert only.startswith("Do not correct for hard_iron_step: its share ended at 30")
    assert "unseen" not in only
