"""The search of differential equations: significance of each effect, held-out blocks, rivals and the trail."""

import functools
import math
from dataclasses import replace

import pytest
import torch

from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit, fit_alone
from mkc_torch.diagnosis.pipeline import model_search
from mkc_torch.diagnosis.pipeline.model_search import search_models
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.search.screening import screened
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.diagnosis.thresholds import FAR_LESS
from mkc_torch.effects import DYNAMICS
from mkc_torch.nonlinear import NoFitError
from tests.diagnosis.cart import DRAG, FRICTION, Cart, cart_recording, cart_terms
from tests.diagnosis.swing import candidates, fitted_pendulum, pendulum_at_truth

SURROGATES = 19
OPTIONS = SearchOptions(level=0.05, surrogates=SURROGATES, max_findings=3, seed=0, settings=Settings())
NAMES = ("quadratic_drag", "coulomb_friction", "constant_force")


@functools.cache
def baseline(drag: float = 0.0, friction: float = 0.0, seed: int = 0) -> ProcessNoiseFit:
    recording = cart_recording(drag, friction, seed=seed, samples=160, mean=0.0)
    return fit_alone(Cart().prepare(recording), {}, Settings().noise)


def searched(base: ProcessNoiseFit, options: SearchOptions = OPTIONS, names: tuple[str, ...] = NAMES) -> StepwiseSearch:
    terms = cart_terms(base.fit, *names)
    return search_models(base, terms, options, torch.Generator().manual_seed(0), lambda _: None)


@functools.cache
def found_both() -> StepwiseSearch:
    return searched(baseline(DRAG, FRICTION))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.e2e) for seed in (1, 2))])
def test_nothing_is_found_in_a_recording_without_a_hidden_effect(seed):
    search = searched(baseline(seed=seed))
    assert search.found == ()
    assert search.first is not None
    assert search.first.p_value > OPTIONS.level
    assert search.left == ()
    assert not any(model.chosen for model in search.models)


def test_a_strong_effect_has_the_smallest_p_value():
    search = searched(baseline(DRAG))
    (found,) = search.found
    assert found.term.effect.id == "quadratic_drag"
    assert found.p_value == pytest.approx(1.0 / (1 + SURROGATES))
    assert float(found.fit.parameters[-1]) == pytest.approx(DRAG, rel=0.1)
    assert len(search.evidence) == 2
    assert [pair[1] for pair in search.pairs] == [search.evidence[1]]


@pytest.mark.e2e
def test_two_effects_are_found_one_after_the_other():
    search = found_both()
    assert {found.term.effect.id for found in search.found} == {"quadratic_drag", "coulomb_friction"}
    assert [len(found.fit.model.terms) for found in search.found] == [1, 2]
    assert all(found.p_value <= OPTIONS.level for found in search.found)
    assert search.found[1].fit.model.terms[0].key == search.found[0].term.key
    assert len(search.evidence) == 3
    assert len(search.pairs) == 2


@pytest.mark.e2e
def test_a_special_case_comes_before_its_general_form_and_a_curve():
    """Quadratic drag, a power of the speed and a free curve of it all follow the recording."""
    search = searched(baseline(DRAG), names=("quadratic_drag", "power_law", "unknown"))
    (found,) = search.found
    assert found.term.effect.id == "quadratic_drag"
    assert {"quadratic_drag@speed", "power_law@speed", "unknown@speed"} <= {
        name for model in search.models for name in model.terms
    }


@pytest.mark.e2e
def test_rivals_are_ordered_by_their_gaps_and_each_effect_is_one():
    for found in found_both().found:
        terms = found.scene.terms
        keys = [terms[rival.number].key for rival in found.ranking]
        gaps = [rival.gap for rival in found.ranking]
        assert keys[0] == found.term.key
        assert gaps[0] == 0.0
        assert gaps == sorted(gaps)
        assert all(math.isfinite(gap) for gap in gaps)
        assert len(keys) == len(set(keys))


@pytest.mark.e2e
def test_the_compared_fits_have_the_effects_found_before_and_one_more():
    for number, found in enumerate(found_both().found):
        assert found.compared
        for fit in found.compared:
            assert len(fit.model.terms) == number + 1
        assert found.term.key in {fit.model.terms[-1].key for fit in found.compared}


@pytest.mark.e2e
def test_the_trail_contains_the_chosen_model():
    search = found_both()
    (chosen,) = [model for model in search.models if model.chosen]
    assert {name.partition("@")[0] for name in chosen.terms} == {found.term.effect.id for found in search.found}
    assert chosen.score == max(model.score for model in search.models if model.score is not None)
    first = search.models[0]
    assert (first.terms, first.move) == ((), "")
    assert len({tuple(sorted(model.terms)) for model in search.models}) == len(search.models)
    for model in search.models:
        if model.score is not None:
            prices = sum(nats for name, nats in model.parts.items() if name != "log_likelihood")
            assert model.score == pytest.approx(model.parts["log_likelihood"] - prices)


def test_without_findings_allowed_the_candidates_are_screened_only():
    search = searched(baseline(DRAG), replace(OPTIONS, max_findings=0))
    assert search.first is not None
    assert search.first.p_value <= OPTIONS.level
    assert (search.found, search.left, search.models) == ((), (), ())


@pytest.mark.e2e
def test_no_more_effects_are_found_than_allowed():
    search = searched(baseline(DRAG, FRICTION), replace(OPTIONS, max_findings=1))
    assert len(search.found) == 1


def test_without_candidates_there_is_only_evidence_of_the_simulation():
    search = search_models(baseline(), (), OPTIONS, torch.Generator(), lambda _: None)
    assert (search.first, search.found, search.left) == (None, (), ())
    assert len(search.evidence) == 1


@pytest.mark.e2e
def test_the_search_so_far_is_kept_with_each_finding():
    kept: list[StepwiseSearch] = []
    base = baseline(DRAG, FRICTION)
    search_models(base, cart_terms(base.fit, *NAMES), OPTIONS, torch.Generator().manual_seed(0), kept.append)
    assert [len(search.found) for search in kept] == sorted(len(search.found) for search in kept)
    assert len(kept[-1].found) == 2
    assert kept[0].first is None
    assert all(len(search.evidence) == len(search.found) + 1 for search in kept if search.found)


@pytest.mark.e2e
def test_a_failed_screening_of_a_further_effect_keeps_the_findings(monkeypatch):
    calls = []

    def failing(*given, **named):
        calls.append(given)
        if len(calls) > 1:
            raise NoFitError("No slope by the gain.")
        return screened(*given, **named)

    monkeypatch.setattr(model_search, "screened", failing)
    search = searched(baseline(DRAG, FRICTION))
    assert len(search.found) == 1
    assert search.left == ()
    assert search.given_up == "No slope by the gain."
    assert [len(model.terms) for model in search.models if model.chosen] == [1]


@pytest.mark.parametrize(("high", "count"), [(-0.5, 0), (0.5, 1)])
def test_a_candidate_that_held_out_blocks_clearly_reject_is_unconfirmed(monkeypatch, high, count):
    monkeypatch.setattr(model_search, "gain_interval", lambda *_: (-1.0, (-2.0, high)))
    search = searched(baseline(DRAG))
    assert len(search.found) == count
    assert (search.unconfirmed is not None) is (count == 0)
    assert search.left == ()


def test_errors_of_an_effect_are_raised(monkeypatch):
    def broken(*_, **__):
        raise ValueError("the effect's own")

    monkeypatch.setattr(model_search, "screened", broken)
    with pytest.raises(ValueError, match="the effect's own"):
        searched(baseline(DRAG))


@pytest.mark.e2e
def test_a_quick_look_has_no_surrogates_and_one_finding():
    options = replace(OPTIONS, quick=True, judged=False, max_findings=1)
    search = searched(baseline(DRAG), options)
    (found,) = search.found
    assert found.term.effect.id == "quadratic_drag"
    assert searched(baseline(), options).found == ()


def test_an_effect_with_which_the_simulation_follows_far_better_is_mentioned():
    """Above the level there is no finding, and the open-loop fits with a far smaller residual remain."""
    base = baseline(DRAG)
    search = searched(base, replace(OPTIONS, level=0.001))
    assert search.found == ()
    assert search.first is not None
    names = [fit.model.terms[-1].effect.id for fit in search.first.follow]
    assert names[0] == "quadratic_drag"
    assert base.free is not None
    for fit in search.first.follow:
        assert float(fit.residual.abs().median()) < 1.2 * FAR_LESS * float(base.free.residual.abs().median())


FEW = [effect for effect in DYNAMICS if effect.id in (*NAMES, "linear_drag", "input_delay")]


@pytest.mark.e2e
def test_process_noise_alone_gives_no_finding():
    fit = pendulum_at_truth("white", 2)
    found = screened(
        fit,
        candidates(fit, FEW),
        level=0.05,
        surrogates=39,
        generator=torch.Generator().manual_seed(0),
        declared={},
        settings=Settings(),
    )
    assert found.p_value > 0.05
    assert found.compared == ()


def test_a_diverging_trajectory_raises(monkeypatch):
    monkeypatch.setattr("mkc_torch.diagnosis.search.screening.joint_likelihood", lambda *_, **__: None)
    fit = pendulum_at_truth("white", 1)
    with pytest.raises(NoFitError, match="no finite trajectory"):
        screened(
            fit,
            candidates(fit, FEW),
            level=0.05,
            surrogates=19,
            generator=torch.Generator(),
            declared={},
            settings=Settings(),
        )


@pytest.mark.e2e
def test_hidden_drag_is_named_and_sized_under_process_noise():
    base = fitted_pendulum("slow", drag=0.4)
    terms, options = candidates(base.fit, DYNAMICS), replace(OPTIONS, surrogates=39, max_findings=1)
    search = search_models(base, terms, options, torch.Generator().manual_seed(0), lambda _: None)
    (found,) = search.found
    assert found.p_value <= 2.0 / 40.0  # two statistics
    assert (found.term.effect.id, found.term.port) == ("quadratic_drag", "rate of rate")
    assert found.fit.model.terms[-1] is found.term
    (drag,) = found.fit.model.gammas(found.fit.parameters)[-1].tolist()
    assert drag == pytest.approx(0.4, abs=0.15)
    # the ranking begins with it, and lists each effect once
    gaps = [rival.gap for rival in found.ranking]
    assert gaps[0] == 0.0
    assert gaps == sorted(gaps)
    keys = [terms[rival.number].key for rival in found.ranking]
    assert keys[0] == found.term.key
    assert len(keys) == len(set(keys))
