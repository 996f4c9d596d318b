"""The search compares rivals at their own best shapes, under a common noise."""

import dataclasses

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.linearise import linearise
from mkc_torch.diagnosis.search.run import _settled, _with_tangents, run_search
from mkc_torch.diagnosis.search.tangents import Candidates, tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.line import Line
from tests.simulation.tumbling import tumbling

N = 2000
STEP_AND_DRIFT_EFFECTS = tuple(effect for effect in CATALOGUE if effect.id in ("hard_iron_step", "offset_drift"))
STEP = next(effect for effect in STEP_AND_DRIFT_EFFECTS if effect.id == "hard_iron_step")
STEPS = tuple(Term(STEP, None, {"onset": onset}, "mixed") for onset in (0.4, 0.9, 1.3))


@pytest.fixture(scope="module")
def step_search():
    """Return the search of a recording with a step of 0.7 µT between two onsets of the grid."""
    sensor = np.zeros((N, 3))
    sensor[671:] = [0.4, -0.4, 0.4]
    prepared = Magnetometer("attitude").prepare(tumbling(N, noise=0.3, sensor=sensor, attitude=True, gyro=True))
    base = fitted(JointModel(prepared), prepared.start())
    terms = candidate_terms(prepared, (), STEP_AND_DRIFT_EFFECTS)
    generator = torch.Generator().manual_seed(0)
    return prepared, terms, run_search(base, terms, level=0.05, surrogates=19, generator=generator, settings=Settings())


@pytest.mark.e2e
def test_the_best_candidate_has_a_shape_between_grid_points(step_search):
    prepared, terms, located = step_search
    first = located.scene.terms[located.ranking[0].number]
    assert first.effect.id == located.term.effect.id == "hard_iron_step"
    assert first not in terms
    spacing = float(terms[1].shape["onset"] - terms[0].shape["onset"])
    assert abs(first.shape["onset"] - float(prepared.time[671])) < 0.25 * spacing


@pytest.mark.e2e
def test_the_best_candidate_has_the_largest_gain_of_all_shapes(step_search):
    _, _, located = step_search
    gains = located.look.gains.ratio[:, 0]
    steps = [k for k, term in enumerate(located.scene.terms) if term.effect.id == "hard_iron_step"]
    assert float(gains[located.ranking[0].number]) == pytest.approx(float(gains[steps].max()))


def test_a_fit_without_finite_tangents_is_skipped(monkeypatch):
    line = Line(100)
    model = JointModel(line)
    fit = fitted(model, line.start())
    terms = STEPS[:2]
    fits = [dataclasses.replace(fit, model=model.with_term(term)) for term in terms]
    known = object()

    def tangents(of, _parameters, _settings, _terms):
        if of is fits[0].model:
            raise NoFitError("no finite slope")
        return known

    monkeypatch.setattr("mkc_torch.diagnosis.search.run.tangents_of", tangents)
    assert _with_tangents(fits, terms, Settings()) == (fits[1], terms, known)
    with pytest.raises(NoFitError, match="no finite slope"):
        _with_tangents(fits[:1], terms, Settings())


def test_gains_of_other_candidates_equal_a_search_with_them():
    line = Line(600)
    model = JointModel(line)
    fit = fitted(model, line.start())
    values, counts = fit.residual * 1.0, torch.ones_like(fit.residual)
    counts[100:120, 0] = 0.0
    values = values * counts
    tangents = tangents_of(model, fit.parameters, NoiseSettings(), STEPS)
    whole = linearise(model, fit.parameters, values, counts, tangents)
    bare = linearise(model, fit.parameters, values, counts, tangents.bare, spectrum=whole.spectrum)
    others = Candidates(model, fit.parameters, STEPS, tangents.pointwise)
    assert len(others) == 3
    torch.testing.assert_close(
        bare.gains_of(others, counts).ratio, whole.search.gains(whole.series.unsqueeze(-1)).ratio
    )


@pytest.mark.e2e
def test_a_joint_fit_at_a_wrong_onset_is_replaced_by_the_search(monkeypatch):
    sensor = np.zeros((N, 3))
    sensor[671:] = [0.7, -0.7, 0.7]
    prepared = Magnetometer("attitude").prepare(tumbling(N, noise=0.3, sensor=sensor, attitude=True, gyro=True))
    base = fitted(JointModel(prepared), prepared.start())
    terms = candidate_terms(prepared, (), (STEP,))
    late = max(terms, key=lambda term: term.shape["onset"])

    def strongest(base, terms, prefer, settings, *, parts):
        model = base.model.with_term(late)
        fit = fitted(model, torch.cat([base.parameters, torch.zeros(3)]), base.bound)
        return [fit], tangents_of(base.model, base.parameters, NoiseSettings(), terms)

    monkeypatch.setattr("mkc_torch.diagnosis.search.run.strongest", strongest)
    located = run_search(
        base, terms, level=0.05, surrogates=19, generator=torch.Generator().manual_seed(0), settings=Settings()
    )
    assert located.p_value <= 0.05
    assert located.term.shape["onset"] == pytest.approx(float(prepared.time[671]), abs=0.1)


def test_a_fit_that_did_not_converge_is_restarted():
    line = Line(200)
    base = fitted(JointModel(line), line.start())
    settled = fitted(base.model.with_term(STEPS[0]), torch.cat([base.parameters, torch.zeros(3)]), base.bound)
    assert settled.converged
    assert _settled(settled, base) is settled
    stopped = dataclasses.replace(
        settled, parameters=settled.parameters + 0.01, log_likelihood=settled.log_likelihood - 10.0, converged=False
    )
    again = _settled(stopped, base)
    assert again.log_likelihood == pytest.approx(settled.log_likelihood, abs=1e-3)
    torch.testing.assert_close(again.parameters, settled.parameters, rtol=0.0, atol=1e-4)
