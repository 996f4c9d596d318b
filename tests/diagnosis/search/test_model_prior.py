"""Penalties of candidates: named physics comes before curves without a name."""

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.search.ranking import ModelPrior
from mkc_torch.diagnosis.settings import DriverSettings, NamingSettings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Dynamics

TIME = torch.arange(300, dtype=torch.float64) * 0.02


class Swing(Dynamics):
    states = ("angle", "speed")
    parameters = {"stiffness": 9.0}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": -p.stiffness * torch.sin(x.angle)}


@pytest.fixture(scope="module")
def search():
    columns = {"time": TIME, "angle": torch.cos(3.0 * TIME), "battery": torch.sin(0.7 * TIME) + 11.0}
    prepared = Swing().prepare(Recording(columns))
    roles = frozenset(role for effect in CATALOGUE for role in effect.roles)
    terms = candidate_terms(
        prepared, find_drivers(prepared.recording, Swing().columns, DriverSettings(), roles).drivers, CATALOGUE
    )
    return ModelPrior(terms, prepared, NamingSettings()), terms


def test_a_named_force_has_no_penalty(search):
    prefer, terms = search
    drag = next(term for term in terms if term.effect.id == "linear_drag")
    assert prefer.penalty(drag, 100.0) == 0.0


def test_a_generalisation_has_a_penalty_of_five_nats(search):
    prefer, terms = search
    forms = {term.effect.id: prefer.penalty(term, 100.0) for term in terms if term.effect.is_generalisation}
    assert forms == {"power_law": 5.0, "hidden_lag": 5.0, "hidden_mode": 5.0}


def test_a_curve_over_the_motion_is_penalised_by_half_its_gain_and_ten_nats(search):
    prefer, terms = search
    curves = [term for term in terms if term.effect.is_curve and term.driver is None]
    assert curves
    assert all(prefer.penalty(term, 100.0) == pytest.approx(60.0) for term in curves)
    assert all(prefer.penalty(term, -5.0) == pytest.approx(10.0) for term in curves)
