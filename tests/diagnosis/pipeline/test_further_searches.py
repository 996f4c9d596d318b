"""Further searches after a finding; a failed search keeps the findings, and a hardly visible candidate is refused."""

from types import SimpleNamespace

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.pipeline import stepwise
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation import Dynamics
from tests.diagnosis.line import Line

OPTIONS = SearchOptions(level=0.05, surrogates=19, max_findings=3, seed=0, settings=Settings())

EFFECTS = [effect for effect in CATALOGUE if effect.id in ("cubic_stiffness", "quadratic_drag")]


class Sled(Dynamics):
    states = ("place", "speed")
    inputs = ("force",)
    parameters = {"damping": 0.5}

    def derivative(self, time, x, u, p):
        return {"place": x.speed, "speed": u.force - p.damping * x.speed}


@pytest.fixture(scope="module")
def recording():
    time = torch.arange(0.0, 10.0, 0.04, dtype=torch.float64)
    force = torch.sin(1.3 * time) + torch.sin(0.31 * time)
    place, speed, places = 0.0, 0.0, []
    for now in force.tolist():
        places.append(place)
        for _ in range(8):
            speed += 0.005 * (now - 0.5 * speed - 0.8 * place**3)
            place += 0.005 * speed
    noise = 0.002 * torch.randn(len(time), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return Recording({"time": time, "force": force, "place": torch.tensor(places).double() + noise})


@pytest.mark.e2e
def test_candidates_of_an_impossible_sign_are_not_findings(recording):
    diagnosis = diagnose(Sled(), recording, effects=EFFECTS)
    assert len(diagnosis.findings) == 1  # further candidates have an impossible sign
    assert not any("failed" in warning for warning in diagnosis.warnings)


@pytest.mark.e2e
def test_an_effect_whose_fit_diverges_is_refitted_from_the_initial_values(recording):
    """Without its spring the sled is fitted with a damping of thousands, where a spring has the wrong size."""
    diagnosis = diagnose(Sled(), recording, effects=EFFECTS)
    assert diagnosis.environment.goodness_of_fit[0].explained < 0.5
    (finding,) = diagnosis.findings
    assert finding.effect == "cubic_stiffness"
    (stiffness,) = finding.parameters
    assert stiffness.value == pytest.approx(0.8, rel=0.05)
    assert diagnosis.model is not None
    assert float(diagnosis.model.theta[0]) == pytest.approx(0.5, rel=0.05)


def stub(key, p_value):
    return SimpleNamespace(p_value=p_value, fit=None, term=SimpleNamespace(key=key))


def test_a_first_candidate_that_is_hardly_visible_is_refused(monkeypatch):
    """The search is repeated without its effect."""
    located, further, searched = stub("step", 0.01), stub("drift", 0.8), []

    def search(_base, terms, **_):
        searched.append(terms)
        return located if len(searched) == 1 else further

    monkeypatch.setattr(stepwise, "run_search", search)
    monkeypatch.setattr(stepwise, "is_hardly_visible", lambda fit: True)
    monkeypatch.setattr(stepwise, "located_cause", lambda *_: None)
    line = Line(300)
    base = fitted(JointModel(line), line.start())
    after = stepwise.first_step(base, (located.term, further.term), OPTIONS, torch.Generator())
    assert searched == [(located.term, further.term), (further.term,)]
    assert (after.found, after.refused, after.left, after.first) == ((), (located,), (), further)


def test_a_failed_further_search_keeps_the_findings(monkeypatch):
    def lost(*_, **__):
        raise NoFitError("No slope by damping.")

    monkeypatch.setattr(stepwise, "run_search", lost)
    monkeypatch.setattr(stepwise, "screening_p_value", lambda *_, **__: 0.0)
    monkeypatch.setattr(stepwise, "near_onset", lambda *_: 0.0)
    term = SimpleNamespace(effect=SimpleNamespace(by_periodogram=False))
    found = SimpleNamespace(fit="with the finding", scene=SimpleNamespace(terms=()), term=term)
    search = StepwiseSearch(None, (found,), None, None, (), ("left",))
    after = stepwise.next_step(search, OPTIONS, torch.Generator())
    assert (after.found, after.left, after.given_up) == ((found,), (), "No slope by damping.")
