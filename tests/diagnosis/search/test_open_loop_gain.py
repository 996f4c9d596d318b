"""A rival that clearly improves the open loop replaces a candidate without an open-loop gain."""

import dataclasses
import functools
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted_with_effect
from mkc_torch.diagnosis.search.ranking import (
    LARGER,
    Ranked,
    enlarges_open_loop,
    improves_open_loop,
    with_lags_of_sensors,
    with_open_loop_gain,
)
from tests.diagnosis.search.test_free_runs import DRAG, all_terms, free_fit

AHEAD = 20.0
"""Nats by which the most likely candidate is ahead of its rival."""


@functools.cache
def fit_without_drag():
    return free_fit(DRAG)


@functools.cache
def with_effect(name):
    """Return the number and the joint fit of an effect."""
    terms = all_terms(fit_without_drag())
    number = next(n for n, term in enumerate(terms) if term.effect.id == name)
    model = fit_without_drag().model.with_term(terms[number])
    start = torch.cat([fit_without_drag().parameters, torch.zeros(model.size - fit_without_drag().model.size).double()])
    return number, fitted_with_effect(fit_without_drag(), model, start, graduate=False)


def leader_and_ranking(first, second):
    """Return the result for two effects of this order."""
    terms = all_terms(fit_without_drag())
    (one, leader), (two, rival) = with_effect(first), with_effect(second)
    ranking = (Ranked(one, 50.0, 0.0), Ranked(two, 30.0, AHEAD))
    best, moved = with_open_loop_gain(leader, ranking, [leader, rival], fit_without_drag(), {}, terms)
    return best.model.terms[-1].effect.id, [(terms[place.number].effect.id, place.gap) for place in moved]


def test_drag_replaces_a_saturation_without_an_open_loop_gain():
    name, ranking = leader_and_ranking("input_saturation", "quadratic_drag")
    assert name == "quadratic_drag"
    assert ranking[0] == ("quadratic_drag", 0.0)
    assert ranking[1] == ("input_saturation", AHEAD)


def test_a_candidate_that_improves_the_open_loop_stays_first():
    name, ranking = leader_and_ranking("quadratic_drag", "input_saturation")
    assert name == "quadratic_drag"
    assert ranking == [("quadratic_drag", 0.0), ("input_saturation", AHEAD)]


def test_without_a_better_rival_the_most_likely_candidate_stays():
    name, ranking = leader_and_ranking("input_saturation", "dead_zone")
    assert name == "input_saturation"
    assert [gap for _, gap in ranking] == [0.0, AHEAD]


def test_an_effect_that_halves_the_open_loop_residual_is_needed():
    drag, none = with_effect("quadratic_drag")[1], with_effect("input_saturation")[1]
    assert float(drag.residual.std()) < 0.3 * float(fit_without_drag().residual.std())
    assert float(none.residual.std()) == pytest.approx(float(fit_without_drag().residual.std()), rel=0.05)
    assert improves_open_loop(drag, fit_without_drag())
    assert not improves_open_loop(none, fit_without_drag())


@pytest.mark.parametrize(("ratio", "larger"), [(0.98 * LARGER, False), (1.02 * LARGER, True)])
def test_a_stretch_that_a_fit_rejects_counts_in_the_open_loop_residual(ratio, larger):
    """The middle half of the residual, and so its robust size, is smaller; a stretch of a tenth of it grows."""
    residual = fit_without_drag().residual - fit_without_drag().residual.mean()
    moved, N = residual.clone(), len(residual)
    moved[: N // 2] *= 0.5
    wanted = ratio**2 * residual.square().sum() - moved[: -N // 10].square().sum()
    moved[-N // 10 :] = (wanted / len(moved[-N // 10 :])).sqrt()
    assert (
        enlarges_open_loop(
            dataclasses.replace(fit_without_drag(), residual=moved),
            dataclasses.replace(fit_without_drag(), residual=residual),
        )
        is larger
    )


def stub(effect_id, likelihood=0.0, *, remembers=True, port="output"):
    effect = SimpleNamespace(remembers=remembers)
    term = SimpleNamespace(effect=effect, key=(effect_id, (), port))
    return SimpleNamespace(model=SimpleNamespace(terms=(term,)), log_likelihood=likelihood)


@pytest.mark.parametrize(
    ("remembers", "port", "nearer"), [(True, "output", True), (False, "output", False), (True, "input u", False)]
)
def test_a_lag_of_a_sensor_is_as_far_behind_as_in_the_open_loop(remembers, port, nearer):
    """The filter puts it 160 nats behind the lag of the actuator, the open loop 0.5."""
    first, rival = stub("input_lag", 590.0, port="input u"), stub("rival", 430.0, remembers=remembers, port=port)
    runs = {0: stub("input_lag", -88.0, port="input u"), 1: stub("rival", -88.5, remembers=remembers, port=port)}
    terms = tuple(fit.model.terms[-1] for fit in (first, rival, stub("other")))
    ranking = (Ranked(0, 600.0, 0.0), Ranked(2, 500.0, 100.0), Ranked(1, 440.0, 160.0))
    moved, fits = with_lags_of_sensors(first, ranking, (first, rival), runs, terms)
    expected = [(0, 0.0), (1, 0.5), (2, 100.0)] if nearer else [(0, 0.0), (2, 100.0), (1, 160.0)]
    assert [(place.number, place.gap) for place in moved] == expected
    assert fits == (first, runs[1] if nearer else rival)


def test_lags_stay_where_the_open_loop_of_the_first_is_unknown():
    first, rival = stub("constant_force", 590.0, port="rate of x"), stub("sensor_lag", 430.0)
    terms = (first.model.terms[-1], rival.model.terms[-1])
    ranking = (Ranked(0, 600.0, 0.0), Ranked(1, 440.0, 160.0))
    assert with_lags_of_sensors(first, ranking, (first, rival), {1: rival}, terms) == (ranking, (first, rival))
