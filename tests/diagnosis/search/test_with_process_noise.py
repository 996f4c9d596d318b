"""The search with process noise: each leading candidate is fitted under its own process noise."""

import dataclasses
import importlib
import types

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.search.own_noise import priced
from mkc_torch.diagnosis.search.ranking import within_reach
from mkc_torch.diagnosis.search.with_process_noise import (
    _needless,
    _no_less_likely,
    _plain,
    search_with_process_noise,
)
from mkc_torch.diagnosis.settings import SearchSettings, Settings
from mkc_torch.effects import DYNAMICS
from mkc_torch.nonlinear import NoFitError
from tests.diagnosis.swing import Pendulum, candidates, fitted_pendulum, pendulum_at_truth, pendulum_recording

diagnose_module = importlib.import_module("mkc_torch.diagnosis.diagnose")
search_module = importlib.import_module("mkc_torch.diagnosis.pipeline.search")
FEW_REFITS = Settings(search=dataclasses.replace(SearchSettings(), own_noise=2))


def located(fit, draws=39, level=0.05):
    return search_with_process_noise(
        fit,
        candidates(fit, DYNAMICS),
        level=level,
        surrogates=draws,
        generator=torch.Generator().manual_seed(0),
        declared={},
        fixed={},
        settings=FEW_REFITS,
    )


@pytest.mark.e2e
def test_hidden_drag_is_named_and_sized_under_process_noise():
    base = fitted_pendulum("slow", drag=0.4).fit
    terms, found = candidates(base, DYNAMICS), located(base)
    assert found.p_value == pytest.approx(1.0 / 40.0)
    assert (found.term.effect.id, found.term.port) == ("quadratic_drag", "rate of rate")
    assert found.fit.model.terms[-1] is found.term
    (drag,) = found.fit.model.gammas(found.fit.parameters)[-1].tolist()
    assert drag == pytest.approx(0.4, abs=0.15)
    # the leading candidates are fitted, each under its own noise
    assert 2 <= len(found.compared) <= 4  # both, and free curves over angle and rate that gain enough
    assert found.term.key in [fit.model.terms[-1].key for fit in found.compared]
    assert found.fit.log_likelihood > base.log_likelihood
    # the ranking begins with it, and lists each effect once
    gaps = [rival.gap for rival in found.ranking]
    assert gaps[0] == 0.0
    assert gaps == sorted(gaps)
    keys = [terms[rival.number].key for rival in found.ranking]
    assert keys[0] == found.term.key
    assert len(keys) == len(set(keys))


@pytest.mark.parametrize("seed", [2])
def test_process_noise_alone_gives_no_finding(seed):
    found = located(pendulum_at_truth("white", seed))
    assert found.p_value > 0.05
    assert found.compared == ()


def test_a_diverging_trajectory_raises(monkeypatch):
    monkeypatch.setattr("mkc_torch.diagnosis.search.with_process_noise.joint_likelihood", lambda *_, **__: None)
    with pytest.raises(NoFitError, match="no finite trajectory"):
        located(pendulum_at_truth("white", 1))


def test_candidates_far_behind_are_not_refitted():
    settings = dataclasses.replace(SearchSettings(), behind=50.0)
    assert within_reach([400.0, 151.0, 149.0], settings) == [True, True, False]
    # a candidate without a gain sets no share for the others
    assert within_reach([-10.0, -59.0, -61.0], settings) == [True, True, False]


@pytest.mark.e2e
def test_candidates_without_a_refit_stay_in_the_ranking():
    base = fitted_pendulum("slow", drag=0.4).fit
    strict = dataclasses.replace(
        FEW_REFITS, search=dataclasses.replace(FEW_REFITS.search, behind=0.0, behind_share=0.0)
    )
    found = search_with_process_noise(
        base, candidates(base, DYNAMICS), level=0.05, surrogates=39, generator=torch.Generator().manual_seed(0),
        declared={}, fixed={}, settings=strict,
    )  # fmt: skip
    assert len(found.compared) == 1
    assert len({rival.number for rival in found.ranking}) > 4
    assert found.ranking[0].gap == 0.0 <= min(rival.gap for rival in found.ranking[1:])


def test_a_candidate_less_likely_than_the_baseline_is_refitted_from_the_noise_of_the_baseline():
    base, settings = fitted_pendulum("slow", drag=0.0).fit, Settings()
    drag = next(term for term in candidates(base, DYNAMICS) if term.effect.id == "quadratic_drag")
    model = JointModel(base.model.prepared.open_loop(), (drag,), base.model.near)
    missed = fitted(model, torch.cat([base.parameters, torch.zeros(1).double()]))
    assert priced(missed, settings) < priced(base, settings) - 20.0
    found = _no_less_likely(base, lambda: missed, {}, settings)
    assert priced(found, settings) >= priced(base, settings) - 1e-3
    assert found.model.terms[-1].key == drag.key
    kept = dataclasses.replace(found, log_likelihood=base.log_likelihood + 1.0)
    assert _no_less_likely(base, lambda: kept, {}, settings) is kept


def of_likelihood(value, size, shape=()):
    """Return a stub of an open-loop fit of 400 samples, with the fields that penalties need."""
    effect = types.SimpleNamespace(fitted_shape=shape)
    term = types.SimpleNamespace(effect=effect, key=("drag", (), "rate"))
    model = types.SimpleNamespace(size=size, sizes=[1], terms=[term], prepared=types.SimpleNamespace(observer=None))
    return types.SimpleNamespace(log_likelihood=value, model=model, residual=torch.zeros(400, 1), value=value)


def test_an_effect_that_gains_less_than_its_penalty_is_needless():
    bare = of_likelihood(1000.0, 3)
    # two numbers: six nats by Schwarz, two by Akaike where the draws were of that noise
    for gain, drawn, needless in ((5.9, False, True), (6.1, False, False), (1.9, True, True), (2.1, True, False)):
        assert _needless(of_likelihood(1000.0 + gain, 4, ("period",)), bare, FEW_REFITS, drawn=drawn) is needless


@pytest.mark.parametrize(("bare", "counts"), [(1000.0, True), (1095.0, False), (None, False)])
def test_without_surrogates_the_gain_must_hold_under_the_noise_found_with_the_effect(bare, counts, monkeypatch):
    base, run = of_likelihood(1000.0, 3), of_likelihood(1100.0, 4)
    module = "mkc_torch.diagnosis.search.with_process_noise"
    monkeypatch.setattr(f"{module}.with_own_noise", lambda fit, *_: fit)
    monkeypatch.setattr(f"{module}._under_own_noise", lambda fit, *_: fit)
    monkeypatch.setattr(f"{module}.run_parallel", lambda works, *_: [work() for work in works])
    monkeypatch.setattr(f"{module}.priced", lambda fit, _: fit.value)
    monkeypatch.setattr(f"{module}._without", lambda *_: None if bare is None else of_likelihood(bare, 3))
    assert _plain(base, [run], run.model.terms, {}, FEW_REFITS) is counts


@pytest.mark.parametrize(
    ("led_to", "again", "counts"), [(1000.0, 1000.0, True), (1095.0, 1000.0, False), (1000.0, 1095.0, False)]
)
def test_without_surrogates_the_baseline_has_the_best_reselected_noise_of_any_candidate(
    led_to, again, counts, monkeypatch
):
    base, run, other = of_likelihood(1000.0, 3), of_likelihood(1100.0, 4), of_likelihood(1001.0, 4)
    bare, selected_again = of_likelihood(1000.0, 3), of_likelihood(again, 3)
    module = "mkc_torch.diagnosis.search.with_process_noise"
    monkeypatch.setattr(f"{module}.with_own_noise", lambda fit, *_: fit)
    monkeypatch.setattr(f"{module}._under_own_noise", lambda fit, *_: selected_again if fit is bare else fit)
    monkeypatch.setattr(f"{module}.run_parallel", lambda works, *_: [work() for work in works])
    monkeypatch.setattr(f"{module}.priced", lambda fit, _: fit.value)
    monkeypatch.setattr(f"{module}._without", lambda _, fit, *__: bare if fit is run else of_likelihood(led_to, 3))
    assert _plain(base, [run, other], run.model.terms, {}, FEW_REFITS) is counts


@pytest.mark.e2e
def test_the_search_is_repeated_under_a_more_likely_noise(monkeypatch):
    bases, original = [], search_module.first_step

    def first_step(base, terms, *rest):
        bases.append(base)
        found = original(base, terms, *rest)
        better = dataclasses.replace(base) if len(bases) == 1 else None
        return dataclasses.replace(found, first=dataclasses.replace(found.first, without_candidate=better))

    monkeypatch.setattr(search_module, "first_step", first_step)
    messages = []
    found = diagnose_module.diagnose(
        Pendulum(), pendulum_recording("white", 2, 200)[0], surrogates=19, progress=messages.append
    )
    assert sum("more likely noise" in line for line in messages) == 1
    assert len(bases) == 2
    assert bases[1] is not bases[0]
    assert found.verdict == "unexplained"
