"""Candidates beside pushes, each at its own size of them."""

import dataclasses
import functools

import pytest
import torch

from mkc_torch.diagnosis.linearised.tangents import tangents_of
from mkc_torch.diagnosis.search.profiled import SHARES, profiled
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects import DYNAMICS
from tests.diagnosis.pushed import at_the_truth, candidates, swung_in_the_world

DRAWS = 49
SEEDS = tuple(range(1, 5))


@functools.cache
def scene(push, seed):
    """Fit, candidates, tangents, what would have to be explained, and what counts of it."""
    fit = at_the_truth(push, seed)
    terms = candidates(fit, DYNAMICS)
    tangents = tangents_of(fit.model, fit.parameters, NoiseSettings(), terms)
    return fit, terms, tangents, fit.residual, torch.ones_like(fit.residual)


@functools.cache
def searched(push, seed):
    return profiled(*scene(push, seed), DRAWS, torch.Generator().manual_seed(seed))


def strongest(found, terms):
    """Name and number of the candidate that gains most for its numbers."""
    number = int((found.gain - found.dof).argmax())
    return terms[number].effect.id, number


@pytest.mark.e2e
@pytest.mark.parametrize("push", ["white", "slow"])
def test_beside_pushes_from_which_nothing_is_missing_p_values_are_not_small(push):
    """Of four recordings: two p-values below 0.05 come about by chance once in seventy times."""
    values = sorted(searched(push, seed).p_value for seed in SEEDS)
    assert values[1] > 0.05
    assert 0.2 < values[2] <= 1.0


@functools.cache
def hidden():
    """A search beside the fit of a pendulum with quadratic drag that nobody told it of."""
    fit = swung_in_the_world("slow", drag=0.4).fit
    terms = candidates(fit, DYNAMICS)
    tangents = tangents_of(fit.model, fit.parameters, NoiseSettings(), terms)
    parts = fit, terms, tangents, *fit.pseudo(NoiseSettings())
    return parts, profiled(*parts, DRAWS, torch.Generator().manual_seed(1))


@pytest.mark.e2e
def test_drag_that_is_hidden_beside_pushes_is_beyond_all_draws_and_has_its_name():
    (_, terms, *_), found = hidden()
    assert found.p_value == pytest.approx(1.0 / (1 + DRAWS))
    assert found.beyond > 3.0
    name, number = strongest(found, terms)
    assert name in ("quadratic_drag", "power_law")
    drag = [term.effect.id for term in terms].index("quadratic_drag")
    assert float(found.gain[number] - found.gain[drag]) < 2.0
    assert float(found.gamma[drag][0]) == pytest.approx(0.4, rel=0.5)


@pytest.mark.e2e
def test_the_observer_that_is_kept_is_for_the_pushes_that_a_candidate_leaves():
    (fit, terms, *_), found = hidden()
    known = fit.model.prepared.observer.disturbances[0].size
    for number in range(len(terms)):
        share = float(found.share[number])
        observer = found.observers[number]
        if share == 0.0:
            assert observer is None
        else:
            assert share in [pytest.approx(one) for one in SHARES]
            assert observer.disturbances[0].size == pytest.approx(share * known)


def test_what_a_parameter_of_the_simulation_does_as_well_gains_nothing():
    """The simulation has a damping of its own."""
    found, terms = searched("white", 1), scene("white", 1)[1]
    number = [(term.effect.id, term.port) for term in terms].index(("linear_drag", "rate of rate"))
    assert float(found.dof[number]) == 0.0
    assert float(found.gain[number]) == pytest.approx(0.0, abs=1e-9)
    assert not bool(found.gamma[number].any())
    assert float(found.shift.abs().max()) < 1e3


@pytest.mark.parametrize("factor", [1e-9, 1e6])
def test_gains_do_not_depend_on_the_units_of_a_candidate(factor):
    fit, terms, tangents, values, counts = scene("slow", 1)
    other = dataclasses.replace(tangents, candidates=tuple(factor * one for one in tangents.candidates))
    known = searched("slow", 1)
    found = profiled(fit, terms, other, values, counts, DRAWS, torch.Generator().manual_seed(1))
    torch.testing.assert_close(found.gain, known.gain, rtol=1e-4, atol=1e-4)
    assert found.p_value == known.p_value
    assert torch.equal(found.dof, known.dof)
    assert torch.equal(found.share, known.share)
    torch.testing.assert_close(found.shift, known.shift, rtol=1e-4, atol=1e-7)
    number = strongest(known, terms)[1]
    torch.testing.assert_close(factor * found.gamma[number], known.gamma[number], rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_gains_do_not_depend_on_the_unit_of_the_output(factor):
    """All that is in it larger by the same factor."""
    fit, terms, tangents, values, counts = scene("white", 1)
    parts = {"nuisance": factor * tangents.nuisance, "candidates": tuple(factor * one for one in tangents.candidates)}
    other = dataclasses.replace(tangents, **parts)
    found = profiled(fit, terms, other, factor * values, counts, DRAWS, torch.Generator().manual_seed(1))
    torch.testing.assert_close(found.gain, searched("white", 1).gain, rtol=1e-4, atol=1e-4)
    assert found.p_value == searched("white", 1).p_value


def test_a_candidate_without_a_trace_gains_nothing():
    fit, terms, tangents, values, counts = scene("white", 1)
    none = tuple(0.0 * one for one in tangents.candidates)
    found = profiled(
        fit, terms, dataclasses.replace(tangents, candidates=none), values, counts, 9, torch.Generator().manual_seed(0)
    )
    assert float(found.gain.abs().max()) < 1e-6
    assert not bool(found.dof.any())


def test_one_sided_candidates_gain_by_no_value_of_the_other_sign():
    found, terms = searched("white", 2), scene("white", 2)[1]
    for number, term in enumerate(terms):
        if term.effect.one_sided and float(found.gain[number]) > 1e-9:
            assert bool((found.gamma[number] >= 0.0).any()), term.effect.id


def test_a_trajectory_that_is_lost_is_not_searched(monkeypatch):
    monkeypatch.setattr("mkc_torch.diagnosis.search.profiled.rescaled", lambda *_: [])
    assert profiled(*scene("white", 1), 9, torch.Generator().manual_seed(0)) is None
