"""A special case replaces its general form unless held-out blocks prefer the general form."""

import dataclasses
import types
from typing import Any

import pytest
import torch

from mkc_torch.diagnosis.evidence.held_out import blocks_of
from mkc_torch.diagnosis.pipeline.simpler_form import REACH, with_special_case
from mkc_torch.diagnosis.search.ranking import Ranked
from mkc_torch.diagnosis.settings import NamingSettings, Settings
from mkc_torch.nonlinear import NoFitError

SAMPLES, SETTINGS = 500, NamingSettings()
NEAR, FAR = 0.8 * REACH * SETTINGS.separable, 1.2 * REACH * SETTINGS.separable


def term(name, *, general=False, curve=False, port="rate of speed"):
    effect = types.SimpleNamespace(id=name, is_generalisation=general, is_curve=curve)
    return types.SimpleNamespace(effect=effect, port=port, key=(name, port))


def fit(of, better):
    """Return a fit whose held-out samples are more likely by that many nats each, with noise."""
    return types.SimpleNamespace(model=types.SimpleNamespace(terms=[of]), better=better)


@dataclasses.dataclass(frozen=True)
class SearchResultStub:
    """The attributes of a search result that are used."""

    term: Any
    fit: Any
    compared: Any
    ranking: Any
    scene: Any


def located(special, gap, *, general_better=0.0):
    """Return a search result in which a power law is ahead of a special case."""
    power = term("power_law", general=True)
    fits = [fit(power, general_better), fit(special, 0.0)]
    ranking = (Ranked(0, 20.0, 0.0), Ranked(1, 18.0, gap))
    return SearchResultStub(power, fits[0], fits, ranking, types.SimpleNamespace(terms=[power, special]))


def scores(of):
    noise = 0.3 * torch.randn(SAMPLES, generator=torch.Generator().manual_seed(len(of.model.terms[0].effect.id)))
    return types.SimpleNamespace(log_likelihood=of.better + noise)


def selected(found, scored=scores):
    blocks = blocks_of(SAMPLES, 1, Settings().confirmation)
    return with_special_case(found, scored, blocks, 0, SETTINGS)


def test_drag_replaces_a_power_law_that_stays_an_alternative():
    found = selected(located(term("quadratic_drag"), NEAR))
    assert found.term.effect.id == found.fit.model.terms[-1].effect.id == "quadratic_drag"
    assert [(found.scene.terms[rival.number].effect.id, rival.gap) for rival in found.ranking] == [
        ("quadratic_drag", 0.0),
        ("power_law", 0.0),
    ]


@pytest.mark.parametrize(
    ("special", "gap", "better"),
    [
        (term("quadratic_drag"), NEAR, 0.5),
        (term("quadratic_drag"), FAR, 0.0),
        (term("quadratic_drag", port="rate of climb"), NEAR, 0.0),
        (term("unknown", curve=True), NEAR, 0.0),
        (term("hidden_lag", general=True), NEAR, 0.0),
    ],
    ids=[
        "held-out blocks prefer the general form",
        "far behind",
        "another port",
        "a free curve",
        "another general form",
    ],
)
def test_the_general_form_stays_unless_a_comparable_special_case_is_near(special, gap, better):
    found = located(special, gap, general_better=better)
    assert selected(found) is found


def test_a_special_case_that_cannot_be_scored_changes_nothing():
    def lost(_):
        raise NoFitError("No finite trajectory.")

    found = located(term("quadratic_drag"), NEAR)
    assert selected(found, lost) is found
