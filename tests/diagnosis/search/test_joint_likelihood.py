"""Joint selection of noise and physics for a pendulum with an unrecorded disturbance."""

import dataclasses
import functools

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis.search.joint_likelihood import joint_likelihood
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation.dynamics.noise_grid import NoiseGrid
from tests.diagnosis.swing import candidates, fitted_pendulum, pendulum_at_truth

DRAWS, LEVEL = 39, 0.05
SEEDS = tuple(range(1, 5))


@functools.cache
def scene(noise, seed):
    """Return fit, candidates, tangents, and the mask of the residual."""
    fit = pendulum_at_truth(noise, seed)
    terms = candidates(fit, DYNAMICS)
    return fit, terms, tangents_of(fit.model, fit.parameters, NoiseSettings(), terms), torch.ones_like(fit.residual)


def search(parts, draws=DRAWS, seed=1, **options):
    return joint_likelihood(*parts, draws, torch.Generator().manual_seed(seed), level=LEVEL, **options)


@functools.cache
def searched(noise, seed):
    return search(scene(noise, seed), seed=seed)


def strongest(found, terms):
    """Return name and number of the candidate with the largest gain less its numbers."""
    number = int((found.gain - found.dof).argmax())
    return terms[number].effect.id, number


@pytest.mark.parametrize("noise", ["white", "slow"])
def test_p_values_under_process_noise_alone_are_not_small(noise):
    """Two p-values of four below 0.05 have a probability of 1/70 by chance."""
    values = sorted(searched(noise, seed).p_value for seed in SEEDS)
    assert values[1] > 0.05
    assert values[2] > 0.1


@functools.cache
def hidden():
    """Search at the fit of a pendulum with a hidden quadratic drag."""
    fit = fitted_pendulum("slow", drag=0.4).fit
    terms = candidates(fit, DYNAMICS)
    tangents = tangents_of(fit.model, fit.parameters, NoiseSettings(), terms)
    parts = fit, terms, tangents, fit.pseudo(NoiseSettings())[1]
    return parts, search(parts)


def test_hidden_drag_is_beyond_all_surrogates_and_has_its_name_and_size():
    (_, terms, *_), found = hidden()
    assert found.p_value <= 2.0 / (1 + DRAWS)  # beyond all surrogates in one of two statistics, at least
    assert found.beyond > 3.0
    name, number = strongest(found, terms)
    assert name in ("quadratic_drag", "power_law")
    drag = [term.effect.id for term in terms].index("quadratic_drag")
    assert float(found.gain[number] - found.gain[drag]) < 2.0
    assert float(found.start(drag).gamma[0]) == pytest.approx(0.4, rel=0.5)
    assert float(found.gain[drag]) > float(found.needed[drag])


def test_a_candidate_that_the_parameters_span_gains_nothing():
    """The simulation has its own damping."""
    found, terms = searched("white", 1), scene("white", 1)[1]
    number = [(term.effect.id, term.port) for term in terms].index(("linear_drag", "rate of rate"))
    assert float(found.dof[number]) == 0.0
    assert float(found.gain[number]) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("factor", [1e-9, 1e6])
def test_gains_do_not_depend_on_the_units_of_a_candidate(factor):
    fit, terms, tangents, counts = scene("slow", 1)
    other = dataclasses.replace(tangents, candidates=tuple(factor * columns for columns in tangents.candidates))
    known, found = searched("slow", 1), search((fit, terms, other, counts))
    torch.testing.assert_close(found.gain, known.gain, rtol=1e-4, atol=1e-4)
    assert found.p_value == known.p_value
    assert torch.equal(found.dof, known.dof)
    number = strongest(known, terms)[1]
    torch.testing.assert_close(factor * found.start(number).gamma, known.start(number).gamma, rtol=1e-4, atol=0.0)


def test_a_candidate_with_zero_tangents_gains_nothing():
    fit, terms, tangents, counts = scene("white", 1)
    given = [number for number, term in enumerate(terms) if not term.effect.open_loop_only]
    zero = dataclasses.replace(tangents, candidates=tuple(0.0 * tangents.candidates[number] for number in given))
    found = search((fit, [terms[number] for number in given], zero, counts), draws=9)
    assert float(found.gain.abs().max()) < 1e-6
    assert not bool(found.dof.any())


def test_one_sided_candidates_gain_only_with_the_allowed_sign():
    found, terms = searched("white", 2), scene("white", 2)[1]
    for number, term in enumerate(terms):
        if term.effect.one_sided and float(found.gain[number]) > 1e-9:
            assert bool((found.start(number).gamma >= 0.0).any()), term.effect.id


def test_a_diverging_trajectory_is_not_searched(monkeypatch):
    monkeypatch.setattr("mkc_torch.diagnosis.search.joint_likelihood.flow_of", lambda *_: None)
    assert search(scene("white", 1), draws=9) is None


def test_process_noise_is_limited_by_the_rates_of_the_recording():
    found = searched("white", 1)
    scene = found.scene
    least = dataclasses.replace(scene, largest=np.array([1e-12, 1e-12]))
    models = NoiseGrid(scene.counted, dataclasses.replace(found.noise[0], components=())).singles()
    values = least.likelihoods(models).without[:, 0]
    # white noise alone is always allowed
    assert [bool(np.isfinite(value)) for value in values] == [not model.components for model in models]
    assert np.isfinite(scene.likelihoods(models).without[:, 0]).sum() > 1
