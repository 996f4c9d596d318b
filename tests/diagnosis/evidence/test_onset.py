"""The confidence interval of an onset."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from mkc_torch import diagnose
from mkc_torch.diagnosis.evidence.timing import _CRITICAL, onset_interval
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.model.fit import fitted, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.problem import SearchProblem
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import RATE, tumbling

N, ONSET_INDEX = 800, 450
TRUE_ONSET = (ONSET_INDEX - 0.5) / RATE
STEP = next(effect for effect in CATALOGUE if effect.id == "hard_iron_step")
CUBIC = next(effect for effect in CATALOGUE if effect.id == "cubic_nonlinearity")


def interval(size, seed, *, corrupted=(0, 0), effect=STEP, shape=None):
    """Return the onset interval of a step fitted at its true onset, in noise of 0.5 µT."""
    random = np.random.default_rng(seed)
    sensor = size * np.array([0.8, -0.6, 0.4]) * (np.arange(N) >= ONSET_INDEX)[:, None]
    sensor[slice(*corrupted)] += 4000.0 * random.choice([-1.0, 1.0], (corrupted[1] - corrupted[0], 3))
    recording = tumbling(N, noise=0.5, sensor=sensor, seed=seed, attitude=True)
    prepared = Magnetometer("attitude").prepare(recording)
    base = fitted(JointModel(prepared), prepared.start())
    model = base.model.with_term(Term(effect, None, {"onset": TRUE_ONSET} if shape is None else shape))
    start = base.parameters.new_zeros(model.size)
    start[: len(base.parameters)] = base.parameters
    best = fitted_with_effect(base, model, start)
    tangents = tangents_of(best.model, best.parameters, NoiseSettings(), best.model.terms)
    tangents = dataclasses.replace(tangents, nuisance=tangents.nuisance[..., : base.model.size])
    pseudo, counts = best.pseudo(NoiseSettings())
    without = pseudo - counts * (tangents.candidates[0] @ best.parameters[base.model.size :])
    scene = SearchProblem(base, best, best.model.terms, tangents, without, counts, Settings())
    return onset_interval(base.model, SimpleNamespace(fit=best, scene=scene, look=scene.under()))


@pytest.mark.e2e
def test_the_interval_covers_the_onset_at_about_its_nominal_level():
    found = [interval(0.5, seed) for seed in range(25)]
    assert sum(low <= TRUE_ONSET <= high for low, high in found) >= 22
    width = np.median([high - low for low, high in found])
    assert 5.0 / RATE < width < 0.25 * N / RATE


@pytest.mark.e2e
def test_the_interval_is_shorter_for_a_larger_step():
    widths = [np.median([np.subtract(*interval(size, seed)[::-1]) for seed in range(3)]) for size in (0.4, 1.2, 6.0)]
    assert widths[0] > 2.0 * widths[1] > 2.0 * widths[2]
    assert widths[2] <= 4.0 / RATE


def test_the_interval_of_an_onset_in_a_burst_of_outliers_spans_the_burst():
    low, high = interval(3.0, 0, corrupted=(ONSET_INDEX - 25, ONSET_INDEX + 25))
    assert low <= (ONSET_INDEX - 24) / RATE
    assert high >= (ONSET_INDEX + 24) / RATE
    assert high - low < 1.5


def test_an_effect_without_an_onset_has_no_interval():
    assert interval(1.0, 0, effect=CUBIC, shape={}) is None


def test_the_critical_value_is_that_of_a_change_point():
    random = np.random.default_rng(0)
    draws, half, size = 4000, 3000, 0.1
    # twice the log-likelihood ratio along the onsets to one side, of a small change in white noise
    sides = [
        (2.0 * size * random.standard_normal((draws, half)) - size**2).cumsum(1).max(1).clip(min=0.0)
        for _ in range(2)
    ]  # fmt: skip
    assert np.mean(np.maximum(*sides) <= _CRITICAL) == pytest.approx(0.95, abs=0.01)


@pytest.mark.e2e
def test_a_diagnosis_reports_the_onset_interval():
    sensor = np.array([1.6, -1.2, 0.8]) * (np.arange(2000) >= 900)[:, None]
    diagnosis = diagnose(Magnetometer(), tumbling(2000, noise=0.5, sensor=sensor))
    (finding,) = diagnosis.findings
    low, high = finding.onset_interval
    assert low <= 899.5 / RATE <= high
    assert low <= finding.onset <= high
    assert high - low < 2.0
    assert json.loads(diagnosis_to_json(diagnosis))["findings"][0]["onset_interval"] == [low, high]
