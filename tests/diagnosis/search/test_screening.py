"""Screening after a finding: it detects a further effect, and ends the search if there is none."""

import dataclasses
import importlib

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.search.run import run_search, screening_p_value
from mkc_torch.diagnosis.settings import DriverSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import RATE, tumbling

pytestmark = pytest.mark.e2e

stepwise = importlib.import_module("mkc_torch.diagnosis.pipeline.stepwise")

N = 2000
TIME = np.arange(N) / RATE
CURRENT = np.sin(TIME) + 0.4 * np.sin(7.3 * TIME)
ALONG_CURRENT = np.array([1.2, -0.9, 1.3]) * CURRENT[:, None]
STEP = np.array([-0.6, 0.5, 0.4]) * (TIME >= 23.4)[:, None]


def recording(*effects, seed=0):
    return tumbling(N, noise=0.4, sensor=sum(effects), seed=seed, attitude=True, current=CURRENT + 2.0)


def located(*effects, seed=0):
    """Return the result of the first search."""
    simulation = Magnetometer("attitude")
    prepared = simulation.prepare(recording(*effects, seed=seed))
    roles = frozenset(role for effect in CATALOGUE for role in effect.roles)
    drivers = find_drivers(prepared.recording, simulation.columns, DriverSettings(), roles).drivers
    base = fitted(JointModel(prepared), prepared.start())
    terms = candidate_terms(prepared, drivers, CATALOGUE)
    found = run_search(
        base, terms, level=0.05, surrogates=99, generator=torch.Generator().manual_seed(0), settings=Settings()
    )
    assert found.term.effect.id == "current_field"
    return found


def p_value(found, others=lambda term: term.columns != ("current",)):
    generator = torch.Generator().manual_seed(0)
    return screening_p_value(found, [others(term) for term in found.scene.terms], 99, generator)


def test_a_further_effect_is_detected():
    assert p_value(located(ALONG_CURRENT, STEP)) == 0.01


def test_p_values_after_the_only_effect_are_not_small():
    found = [p_value(located(ALONG_CURRENT, seed=seed)) for seed in range(3)]
    assert min(found) > 0.02
    assert max(found) > 0.2


def test_the_tangents_of_the_effect_are_projected_out():
    found = located(ALONG_CURRENT)
    ratio = found.look.gains.ratio
    assert float(ratio.max()) > 1000.0
    assert p_value(found, lambda _: True) > 0.02


def test_p_value_without_further_candidates_is_one():
    assert p_value(located(ALONG_CURRENT), lambda _: False) == 1.0


def test_p_value_is_zero_for_effects_through_a_trajectory():
    found = located(ALONG_CURRENT)
    tangents = dataclasses.replace(found.scene.tangents, pointwise=dict.fromkeys(found.scene.tangents.pointwise))
    look = dataclasses.replace(found.look, scene=dataclasses.replace(found.scene, tangents=tangents))
    assert p_value(dataclasses.replace(found, look=look)) == 0.0


@pytest.mark.parametrize(("effects", "searches", "names"), [
    ((ALONG_CURRENT,), 1, ["current_field"]),
    ((ALONG_CURRENT, STEP), 2, ["current_field", "hard_iron_step"]),
])  # fmt: skip
def test_a_further_search_runs_only_after_a_small_screening_p_value(monkeypatch, effects, searches, names):
    located_by, searched, p_values = stepwise.run_search, [], []

    def counted(*arguments, **options):
        searched.append(1)
        return located_by(*arguments, **options)

    def screened(*arguments, **options):
        p_values.append(screening_p_value(*arguments, **options))
        return p_values[-1]

    monkeypatch.setattr(stepwise, "run_search", counted)
    monkeypatch.setattr(stepwise, "screening_p_value", screened)
    diagnosis = diagnose(Magnetometer("attitude"), recording(*effects))
    assert [finding.effect for finding in diagnosis.findings] == names
    assert len(searched) == searches + (p_values[-1] <= 0.1)
    assert len(p_values) == searches
