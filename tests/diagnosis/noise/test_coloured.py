"""Shape parameters under the coloured noise of the search, after a joint fit under white noise."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.diagnosis.model.fit import fitted, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.problem import SearchProblem, middle, with_spectrum
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import RATE, tumbling

N = 2000
STEP = next(effect for effect in CATALOGUE if effect.id == "hard_iron_step")
CUBIC = next(effect for effect in CATALOGUE if effect.id == "cubic_nonlinearity")
FIRST, LAST = 990, 1040  # samples that are outliers
TRUE_ONSET = (FIRST + LAST) / 2.0 / RATE


@pytest.fixture(scope="module")
def burst():
    """Return the baseline fit of a recording with a step of 2 µT in the middle of a second of outliers."""
    sensor = np.zeros((N, 3))
    sensor[(FIRST + LAST) // 2 :] = [2.0, -1.0, 1.0]
    sensor[FIRST:LAST] += 400.0 * np.random.default_rng(1).choice([-1.0, 1.0], (LAST - FIRST, 3))
    prepared = Magnetometer("attitude").prepare(tumbling(N, noise=0.3, sensor=sensor, attitude=True))
    return fitted(JointModel(prepared), prepared.start())


def with_shape(base, effect, shape):
    """Return a fit with an effect, and the search at it."""
    model = base.model.with_term(Term(effect, None, shape))
    start = base.parameters.new_zeros(model.size)
    start[: len(base.parameters)] = base.parameters
    best = fitted_with_effect(base, model, start)
    tangents = tangents_of(best.model, best.parameters, NoiseSettings(), best.model.terms)
    tangents = dataclasses.replace(tangents, nuisance=tangents.nuisance[..., : base.model.size])
    pseudo, counts = best.pseudo(NoiseSettings())
    moved = tangents.candidates[0] @ best.parameters[base.model.size :]
    return best, SearchProblem(
        base, best, best.model.terms, tangents, pseudo - counts * moved, counts, Settings()
    ).under()


@pytest.mark.e2e
@pytest.mark.parametrize("onset", [FIRST / RATE + 0.02, LAST / RATE - 0.02])
def test_an_onset_within_a_burst_of_outliers_is_the_middle_of_the_burst(burst, onset):
    best, look = with_shape(burst, STEP, {"onset": onset})
    assert float(look.scene.counts[FIRST:LAST].mean()) == 0.0
    moved = with_spectrum(best, look)
    assert moved.model.terms[-1].shape["onset"] == pytest.approx(TRUE_ONSET, abs=0.15)
    assert moved.converged


@pytest.mark.e2e
def test_an_onset_of_much_higher_likelihood_replaces_that_of_the_fit(burst):
    best, *_ = with_shape(burst, STEP, {"onset": TRUE_ONSET - 4.0})
    _, look = with_shape(burst, STEP, {"onset": TRUE_ONSET})
    moved = with_spectrum(best, look)
    assert abs(moved.model.terms[-1].shape["onset"] - TRUE_ONSET) < 1.0
    assert moved.log_likelihood > best.log_likelihood + 10.0


@pytest.mark.e2e
def test_a_fit_without_shape_parameters_or_convergence_is_unchanged(burst, monkeypatch):
    best, look = with_shape(burst, CUBIC, {})
    assert with_spectrum(best, look) is best
    best, look = with_shape(burst, STEP, {"onset": FIRST / RATE + 0.02})

    def lost(*args, **kwargs):
        return dataclasses.replace(fitted_with_effect(*args, **kwargs), converged=False)

    monkeypatch.setattr("mkc_torch.diagnosis.search.problem.fitted_with_effect", lost)
    assert with_spectrum(best, look) is best


@given(st.lists(st.floats(-5.0, 5.0), min_size=1, max_size=20), st.data())
@settings(deadline=None)
def test_values_between_an_index_and_its_plateau_middle_are_within_the_tolerance(values, data):
    place = data.draw(st.integers(0, len(values) - 1))
    found = middle(values, place, 0.5)
    between = values[min(found, place) : max(found, place) + 1]
    assert all(abs(value - values[place]) < 0.5 for value in between)


def test_the_middle_of_a_plateau_does_not_depend_on_the_start_index():
    values = [0.0, 3.0, *[9.0] * 7, 2.0]
    assert [middle(values, place, 0.5) for place in range(2, 9)] == [5] * 7
    assert middle(values, 0, 0.5) == 0
