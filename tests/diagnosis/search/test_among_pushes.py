"""The search beside pushes: what is left out has its name, in a fit of its own under the pushes that it leaves."""

import dataclasses

import pytest
import torch

from mkc_torch.diagnosis.search.among_pushes import located_among_pushes
from mkc_torch.diagnosis.settings import SearchSettings, Settings
from mkc_torch.effects import DYNAMICS
from mkc_torch.nonlinear import NoFitError
from tests.diagnosis.pushed import at_the_truth, candidates, swung_in_the_world

FEW = Settings(search=dataclasses.replace(SearchSettings(), own_noise=2))


def located(fit, draws=39, level=0.05):
    return located_among_pushes(
        fit,
        candidates(fit, DYNAMICS),
        level=level,
        surrogates=draws,
        generator=torch.Generator().manual_seed(0),
        declared={},
        fixed={},
        settings=FEW,
    )


def test_drag_that_is_hidden_beside_pushes_is_named_and_sized():
    base = swung_in_the_world("slow", drag=0.4).fit
    terms, found = candidates(base, DYNAMICS), located(base)
    assert found.p_value == pytest.approx(1.0 / 40.0)
    assert (found.term.effect.id, found.term.port) == ("quadratic_drag", "rate of rate")
    assert found.fit.model.terms[-1] is found.term
    (drag,) = found.fit.model.gammas(found.fit.parameters)[-1].tolist()
    assert drag == pytest.approx(0.4, abs=0.15)
    # each of those that gain most is fitted, under its own noise
    assert len(found.compared) == 4  # both, and a free curve over angle and one over rate
    assert any(one is found.fit for one in found.compared)
    assert found.fit.log_likelihood > base.log_likelihood
    # the ranking begins with it, each physics once
    gaps = [one.gap for one in found.ranking]
    assert gaps[0] == 0.0
    assert gaps == sorted(gaps)
    keys = [terms[one.number].key for one in found.ranking]
    assert keys[0] == found.term.key
    assert len(keys) == len(set(keys))


@pytest.mark.parametrize("seed", [2])
def test_beside_pushes_from_which_nothing_is_missing_nothing_is_compared(seed):
    found = located(at_the_truth("white", seed))
    assert found.p_value > 0.05
    assert found.compared == ()


def test_a_lost_trajectory_is_told(monkeypatch):
    monkeypatch.setattr("mkc_torch.diagnosis.search.among_pushes.profiled", lambda *_: None)
    with pytest.raises(NoFitError, match="trajectory is lost"):
        located(at_the_truth("white", 1))
