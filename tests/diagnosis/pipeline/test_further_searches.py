"""Further searches after a finding; a failed search keeps the findings."""

import importlib
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation import Dynamics

stepwise = importlib.import_module("mkc_torch.diagnosis.pipeline.stepwise")
steps = importlib.import_module("mkc_torch.diagnosis.pipeline.steps")
search_notes = importlib.import_module("mkc_torch.diagnosis.pipeline.search_notes")


POOR_FIT_SETTINGS = replace(Settings(), evidence=replace(Settings().evidence, followed=0.0))
"""Settings that allow several findings for a simulation with a poor fit."""

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


@pytest.fixture
def diagnosed(recording, monkeypatch):
    """Return a function that diagnoses with a replaced second search."""

    def run(second_search):
        searches, first = [], []
        located = stepwise._located

        def search(base, terms, *others, **options):
            searches.append(base)
            if len(searches) == 1:
                first.append(located(base, terms, *others, **options))
                return first[0]
            return second_search(base, first[0])

        monkeypatch.setattr(stepwise, "_located", search)
        monkeypatch.setattr(stepwise, "_is_screened_out", lambda *_: False)
        return diagnose(Sled(), recording, effects=EFFECTS, settings=POOR_FIT_SETTINGS), searches

    return run


@pytest.mark.e2e
def test_a_failed_search_keeps_the_findings(diagnosed):
    def fails(*_):
        raise NoFitError("No slope by damping.")

    diagnosis, searches = diagnosed(fails)
    assert len(searches) == 2
    assert len(diagnosis.findings) == 1
    assert any("no finite trajectory" in warning for warning in diagnosis.warnings)


@pytest.mark.e2e
def test_an_error_of_a_further_search_is_a_warning_and_the_finding_stays(diagnosed):
    def broken(*_):
        raise ValueError("the effect's own")

    diagnosis, _ = diagnosed(broken)
    assert len(diagnosis.findings) == 1
    assert any("the effect's own" in warning for warning in diagnosis.warnings)


@pytest.mark.slow
def test_a_diverging_search_does_not_change_the_findings(diagnosed, recording):
    def diverging(base, first):
        base.model.residual(1.01 * base.parameters)
        return replace(first, p_value=1.0)

    (plain, *_) = diagnose(Sled(), recording, effects=EFFECTS, settings=POOR_FIT_SETTINGS).findings
    diagnosis, searches = diagnosed(diverging)
    assert len(searches) == 2
    (finding,) = diagnosis.findings
    # equal up to rounding; the second search moves the parameters by 1 %
    for found, expected in zip(finding.parameters, plain.parameters, strict=True):
        assert found == replace(expected, value=found.value, standard_error=found.standard_error)
        assert found.value == pytest.approx(expected.value, rel=1e-9)
        assert found.standard_error == pytest.approx(expected.standard_error, rel=1e-9)


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


@pytest.mark.parametrize("refused", [(), ("first",), ("first", "second")])
def test_a_candidate_that_enlarges_the_open_loop_residual_is_replaced_by_the_next(monkeypatch, refused):
    """``refused`` names the candidates that enlarge it; the search is repeated once."""
    terms = tuple(SimpleNamespace(key=name) for name in ("first", "second", "third"))
    known = SimpleNamespace(fit="without", term=SimpleNamespace(key="known"))

    def located(_fit, left, *_others, **_options):
        return SimpleNamespace(term=left[0], fit=left[0].key, p_value=0.01)

    def accept(search, _fit, found, _options):
        return replace(search, found=(*search.found, found))

    monkeypatch.setattr(stepwise, "_located", located)
    monkeypatch.setattr(stepwise, "_accept", accept)
    monkeypatch.setattr(stepwise, "_with_another", lambda _, after, *__: after)
    monkeypatch.setattr(stepwise, "_is_screened_out", lambda *_: False)
    monkeypatch.setattr(stepwise, "is_hardly_visible", lambda _: False)
    monkeypatch.setattr(stepwise, "enlarges_open_loop", lambda fit, _: fit in refused)
    before = steps.StepwiseSearch(None, (known,), None, None, (), terms)
    after = stepwise.next_step(before, SimpleNamespace(level=0.05, quick=False), torch.Generator())
    assert [found.term.key for found in after.refused] == list(refused)
    taken = [found.term.key for found in after.found[1:]]
    assert taken == {0: ["first"], 1: ["second"], 2: []}[len(refused)]
    assert after.left == (() if len(refused) == 2 else terms)


@pytest.mark.parametrize(("terms", "start"), [((), "first"), (("found",), "open loop with the findings")])
def test_a_further_search_also_starts_from_the_open_loop(monkeypatch, terms, start):
    """Process noise of the fit with the findings can mask an effect, such as a constant force."""
    fit = SimpleNamespace(model=SimpleNamespace(terms=terms))
    options = SimpleNamespace(level=0.05, surrogates=9, declared={}, fixed={}, settings=None, quick=False)
    monkeypatch.setattr(stepwise, "has_process_noise", lambda _: True)
    monkeypatch.setattr(stepwise, "refit_open_loop", lambda _: "open loop with the findings")
    monkeypatch.setattr(stepwise, "search_with_process_noise", lambda *_, free, **__: free)
    assert stepwise._located(fit, (), options, torch.Generator(), free="first") == start


def test_two_jointly_needless_findings_end_the_search(monkeypatch):
    monkeypatch.setattr(steps, "needless_terms", lambda *_: (0, 1))
    monkeypatch.setattr(steps, "without", lambda *_: "nothing")
    monkeypatch.setattr(steps, "improves_open_loop", lambda *_: False)
    found = (SimpleNamespace(fit="first"), SimpleNamespace(fit="both"))
    search = steps.StepwiseSearch(None, found, None, None, ("without", "first", "both"), ("left",))
    after = steps.eliminated(search, SimpleNamespace(declared={}, settings=None))
    assert (after.found, after.evidence, after.pairs, after.left) == ((), ("without",), (), ())


@pytest.mark.parametrize(("hidden", "reason"), [(False, "open-loop residual is larger"), (True, "changes its length")])
def test_a_refused_candidate_is_reported_with_its_reason(recording, monkeypatch, hidden, reason):
    monkeypatch.setattr(search_notes, "is_hardly_visible", lambda _: hidden)
    (term, *_) = candidate_terms(Sled().prepare(recording), (), EFFECTS)
    located, other = SimpleNamespace(term=term, fit=None, p_value=0.01), SimpleNamespace(effect="another")
    warning = search_notes._refused(located, SimpleNamespace(findings=(other,), quick=False))
    assert term.effect.id in warning
    assert f"at the {term.port}" not in warning
    assert "p = 0.01 after the whole search" in warning
    assert reason in warning


def test_a_first_candidate_that_is_hardly_visible_is_refused(monkeypatch):
    monkeypatch.setattr(stepwise, "is_hardly_visible", lambda _: True)
    located, further = (
        SimpleNamespace(p_value=p, fit=None, term=SimpleNamespace(key=key))
        for p, key in ((0.01, "step"), (0.8, "drift"))
    )
    terms = (located.term, further.term)
    monkeypatch.setattr(stepwise, "_accept", lambda search, *_: replace(search, left=()))
    search = steps.StepwiseSearch(located, (), None, None, (), terms)
    searched = []
    after = stepwise._add(
        search, None, located, SimpleNamespace(level=0.05), lambda left: searched.append(left) or further
    )
    assert searched == [(further.term,)]
    assert (after.found, after.refused, after.left, after.first) == ((), (located,), (), further)


def test_a_refused_candidate_with_the_name_of_a_finding_has_its_port(recording):
    (term, *_) = candidate_terms(Sled().prepare(recording), (), EFFECTS)
    diagnosis = SimpleNamespace(findings=(SimpleNamespace(effect=term.effect.id),), quick=False)
    assert f" at the {term.port}: p = 0.01" in search_notes._not_confirmed(
        SimpleNamespace(term=term, p_value=0.01), diagnosis
    )
