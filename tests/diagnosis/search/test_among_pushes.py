"""The search beside pushes: what is left out has its name, in a fit of its own under the pushes that it leaves."""

import dataclasses
import importlib
import types

import pytest
import torch

from mkc_torch.diagnosis.search.with_process_noise import _needless, _plain, _within_reach, search_with_process_noise
from mkc_torch.diagnosis.settings import SearchSettings, Settings
from mkc_torch.effects import DYNAMICS
from mkc_torch.nonlinear import NoFitError
from tests.diagnosis.pushed import Pendulum, at_the_truth, candidates, swung, swung_in_the_world

of_diagnosis = importlib.import_module("mkc_torch.diagnosis.diagnose")
FEW = Settings(search=dataclasses.replace(SearchSettings(), own_noise=2))


def located(fit, draws=39, level=0.05):
    return search_with_process_noise(
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
    monkeypatch.setattr("mkc_torch.diagnosis.search.with_process_noise.joint_likelihood", lambda *_, **__: None)
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
    found = search_with_process_noise(
        base, candidates(base, DYNAMICS), level=0.05, surrogates=39, generator=torch.Generator().manual_seed(0),
        declared={}, fixed={}, settings=strict,
    )  # fmt: skip
    assert len(found.compared) == 1
    assert len({one.number for one in found.ranking}) > 4
    assert found.ranking[0].gap == 0.0 <= min(one.gap for one in found.ranking[1:])


def of_likelihood(value, size, shape=()):
    """What prices of a fit ask of it: a free run of 400 samples."""
    effect = types.SimpleNamespace(fitted_shape=shape)
    term = types.SimpleNamespace(effect=effect, key=("drag", (), "rate"))
    model = types.SimpleNamespace(size=size, sizes=[1], terms=[term], prepared=None)
    return types.SimpleNamespace(log_likelihood=value, model=model, residual=torch.zeros(400, 1), value=value)


def test_an_effect_that_gains_no_more_than_its_numbers_over_the_same_noise_is_needless():
    bare = of_likelihood(1000.0, 3)
    # two numbers: six nats by Schwarz, two by Akaike where the draws were of that noise
    for gain, drawn, needless in ((5.9, False, True), (6.1, False, False), (1.9, True, True), (2.1, True, False)):
        assert _needless(of_likelihood(1000.0 + gain, 4, ("period",)), bare, FEW, drawn=drawn) is needless


@pytest.mark.parametrize(("bare", "counts"), [(1000.0, True), (1095.0, False), (None, False)])
def test_without_draws_a_free_run_has_to_be_likelier_than_the_simulation_under_the_noise_beside_it_too(
    bare, counts, monkeypatch
):
    base, run = of_likelihood(1000.0, 3), of_likelihood(1100.0, 4)
    module = "mkc_torch.diagnosis.search.with_process_noise"
    monkeypatch.setattr(f"{module}.with_own_noise", lambda fit, *_: fit)
    monkeypatch.setattr(f"{module}._under_own_noise", lambda fit, *_: fit)
    monkeypatch.setattr(f"{module}.at_once", lambda works, *_: [work() for work in works])
    monkeypatch.setattr(f"{module}.priced", lambda fit, _: fit.value)
    monkeypatch.setattr(f"{module}._without", lambda *_: None if bare is None else of_likelihood(bare, 3))
    assert _plain(base, [run], run.model.terms, {}, FEW) is counts


@pytest.mark.e2e
def test_the_search_is_done_again_with_the_simulation_under_a_likelier_noise(monkeypatch):
    bases, once = [], of_diagnosis.begun

    def begun(base, terms, *rest):
        bases.append(base)
        found = once(base, terms, *rest)
        likelier = dataclasses.replace(base) if len(bases) == 1 else None
        return dataclasses.replace(found, first=dataclasses.replace(found.first, without_candidate=likelier))

    monkeypatch.setattr(of_diagnosis, "begun", begun)
    told = []
    found = of_diagnosis.diagnose(Pendulum(), swung("white", 2, 200)[0], surrogates=19, progress=told.append)
    assert sum("under a likelier noise" in line for line in told) == 1
    assert len(bases) == 2
    assert bases[1] is not bases[0]
    assert found.verdict == "unexplained"
