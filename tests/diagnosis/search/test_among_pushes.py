"""The search beside pushes: what is left out has its name, in a fit of its own under the pushes that it leaves."""

import dataclasses

import pytest
import torch

from mkc_torch.diagnosis.search.among_pushes import _within_reach, located_among_pushes
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


@pytest.mark.e2e
def test_drag_that_is_hidden_beside_pushes_is_named_and_sized():
    base = swung_in_the_world("slow", drag=0.4).fit
    terms, found = candidates(base, DYNAMICS), located(base)
    assert found.p_value == pytest.approx(1.0 / 40.0)
    assert (found.term.effect.id, found.term.port) == ("quadratic_drag", "rate of rate")
    assert found.fit.model.terms[-1] is found.term
    (drag,) = found.fit.model.gammas(found.fit.parameters)[-1].tolist()
    assert drag == pytest.approx(0.4, abs=0.15)
    # each of those that gain most is fitted, under its own noise
    assert 2 <= len(found.compared) <= 4  # both, and free curves over angle and rate that gain enough
    assert found.term.key in [fit.model.terms[-1].key for fit in found.compared]
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
    monkeypatch.setattr("mkc_torch.diagnosis.search.among_pushes.joint_likelihood", lambda *_, **__: None)
    with pytest.raises(NoFitError, match="trajectory is lost"):
        located(at_the_truth("white", 1))


def test_what_is_far_behind_at_first_is_not_fitted_any_further():
    fits, behind = ("best", "near", "far"), Settings(search=dataclasses.replace(SearchSettings(), behind=50.0))
    scores = [400.0, 151.0, 149.0]
    assert _within_reach([7, 3, 5], fits, scores, behind) == ([7, 3], ["best", "near"])
    # one that gains nothing is no measure of what others have to gain
    assert _within_reach([7, 3, 5], fits, [-10.0, -59.0, -61.0], behind) == ([7, 3], ["best", "near"])


@pytest.mark.e2e
def test_the_one_that_is_left_out_is_still_in_the_ranking():
    base = swung_in_the_world("slow", drag=0.4).fit
    strict = dataclasses.replace(FEW, search=dataclasses.replace(FEW.search, behind=0.0, behind_share=0.0))
    found = located_among_pushes(
        base, candidates(base, DYNAMICS), level=0.05, surrogates=39, generator=torch.Generator().manual_seed(0),
        declared={}, fixed={}, settings=strict,
    )  # fmt: skip
    assert len(found.compared) == 1
    assert len({one.number for one in found.ranking}) > 4
    assert found.ranking[0].gap == 0.0 <= min(one.gap for one in found.ranking[1:])
