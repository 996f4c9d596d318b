"""Extrapolation: fitted at low values of a driver, scored at high values."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.evidence.prediction import extrapolated
from mkc_torch.diagnosis.findings.warnings import extrapolation_warnings
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Driver, Term, find_drivers
from mkc_torch.diagnosis.result import Extrapolation
from mkc_torch.diagnosis.settings import DriverSettings, EvidenceSettings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import FIELD, RESPONSE, tumbling, turns

N = 1500
TIME = np.arange(N) / 50.0
LOAD = np.sin(2.0 * np.pi * TIME / 3.7) + 0.4 * np.sin(2.0 * np.pi * TIME / 0.83)
GAIN = np.array([0.8, -0.6, 0.9])
EDGE = np.quantile(LOAD, 0.7)  # the extrapolation begins here


def outliers(share=0.1):
    random = np.random.default_rng(3)
    return 15.0 * random.standard_normal((N, 3)) * (random.random((N, 1)) < share)


def fits_without_and_with(trace, effect="driver_offset", **columns):
    """Return the fits without and with an effect of the first column."""
    sensor = trace if np.ndim(trace) == 2 else GAIN * trace[:, None]
    recording = tumbling(N, noise=0.4, sensor=sensor + outliers(), **columns)
    simulation = Magnetometer(use="norm")
    prepared = simulation.prepare(recording)
    driver = find_drivers(prepared.recording, simulation.columns, DriverSettings()).drivers[0]
    without = fitted(JointModel(prepared), prepared.start())
    physics = next(e for e in CATALOGUE if e.id == effect)
    term = Term(physics, driver, physics.shapes(prepared.time)[0])
    model = without.model.with_term(term)
    start = torch.cat([without.parameters, without.parameters.new_zeros(model.size - without.model.size)])
    return without, fitted(model, start, without.bound)


def extrapolation_of(fits, seed=0):
    without, fit = fits
    return extrapolated(without, fit, fit.model.terms[-1], seed, EvidenceSettings())


def warnings_of(found):
    effect = next(e for e in CATALOGUE if e.id == "driver_offset")
    load = Driver(("load",), "any", torch.zeros(5, 1), torch.zeros(1), ("A",))
    return () if found is None else extrapolation_warnings(found, Term(effect, load, {}), EvidenceSettings())


def test_a_linear_effect_extrapolates_to_high_values_of_its_driver():
    found = extrapolation_of(fits_without_and_with(LOAD, load=LOAD))
    assert found.confidence_interval[0] > 0.2
    assert found.confidence_interval[0] < found.log_likelihood_gain < found.confidence_interval[1]
    assert warnings_of(found) == ()


def test_an_effect_that_reverses_at_high_values_does_not_extrapolate():
    """The effect is linear at low values only; over all samples it still has a gain."""
    trace = np.where(LOAD < EDGE, LOAD, 2.0 * EDGE - LOAD)
    without, fit = fits_without_and_with(trace, load=LOAD)
    assert fit.log_likelihood > without.log_likelihood + 20.0
    found = extrapolation_of((without, fit))
    assert found.confidence_interval[1] < 0.0
    (sentence,) = warnings_of(found)
    assert "driver_offset does not extrapolate" in sentence
    assert "70 % of samples where load is lowest" in sentence


def test_without_an_effect_there_is_no_gain_and_no_warning():
    found = extrapolation_of(fits_without_and_with(np.zeros(N), load=LOAD))
    assert abs(found.log_likelihood_gain) < 0.02
    assert warnings_of(found) == ()


def test_values_of_several_columns_are_high_far_from_their_mean():
    columns = {f"position_{axis}": np.sin(TIME * (0.7 + 0.4 * k)) for k, axis in enumerate("xyz")}
    stronger = 0.8 * columns["position_x"] - 0.5 * columns["position_z"]
    direction = turns(TIME).inv().apply(FIELD / np.linalg.norm(FIELD)) @ RESPONSE.T
    found = extrapolation_of(fits_without_and_with(stronger[:, None] * direction, "field_gradient", **columns))
    assert found.confidence_interval[0] > 0.0


def test_a_switched_driver_has_no_extrapolation_test():
    switch = np.where(np.quantile(LOAD, 0.8) < LOAD, 1.0, 0.0)
    assert extrapolation_of(fits_without_and_with(switch, load=switch)) is None


def test_high_values_in_a_single_stretch_have_no_extrapolation_test():
    high = np.where(abs(TIME - 11.0) < 1.0, 4.0, 2.5 * np.minimum(np.sin(TIME), 0.0))
    high += np.where(abs(TIME - 11.0) < 1.0, np.sin(9.0 * TIME), 0.0)
    assert extrapolation_of(fits_without_and_with(high, load=high)) is None


def test_an_effect_without_a_recorded_driver_has_no_extrapolation_test():
    without, _ = fits_without_and_with(LOAD, load=LOAD)
    effect = next(e for e in CATALOGUE if e.id == "hard_iron_step")
    model = without.model.with_term(Term(effect, None, {"onset": 10.0}))
    fit = fitted(model, torch.cat([without.parameters, torch.zeros(3, dtype=torch.float64)]), without.bound)
    assert extrapolation_of((without, fit)) is None


def test_extrapolation_depends_on_the_seed_alone():
    fits = fits_without_and_with(LOAD, load=LOAD)
    assert extrapolation_of(fits, 4) == extrapolation_of(fits, 4)


def test_only_a_gain_surely_below_zero_is_a_warning():
    assert warnings_of(None) == ()
    assert warnings_of(Extrapolation(-0.1, (-0.3, 0.1))) == ()
    assert len(warnings_of(Extrapolation(-0.2, (-0.3, -0.1)))) == 1


def test_models_that_cannot_be_fitted_to_low_values_have_no_extrapolation_test():
    without, fit = fits_without_and_with(LOAD, load=LOAD)
    narrow = replace(without, bound=0.1 * without.d)
    assert extrapolation_of((narrow, fit)) is None


@pytest.fixture(scope="module")
def diagnosis():
    recording = tumbling(N, noise=0.4, sensor=GAIN * LOAD[:, None] + outliers(), current=LOAD + 2.0)
    return diagnose(Magnetometer(), recording, surrogates=19, max_findings=1)


@pytest.mark.e2e
def test_a_finding_of_a_diagnosis_has_an_extrapolation_test(diagnosis):
    (finding,) = diagnosis.findings
    assert finding.effect == "current_field"
    assert finding.extrapolation.confidence_interval[0] > 0.0
    assert not [w for w in diagnosis.warnings if "extrapolate" in w]


@pytest.mark.e2e
def test_the_extrapolation_baseline_includes_later_findings():
    """A drift that is large where the driver is high would change the gain."""
    drift = np.outer(np.maximum(TIME - 15.0, 0.0), [0.5, -0.3, 0.2])
    ramp = LOAD + 0.1 * TIME
    recording = tumbling(N, noise=0.3, sensor=GAIN * ramp[:, None] + drift, current=ramp + 2.0)
    result = diagnose(Magnetometer(), recording, surrogates=19, max_findings=2)
    assert {finding.effect for finding in result.findings} >= {"current_field"}
    current = next(finding for finding in result.findings if finding.effect == "current_field")
    assert len(result.findings) == 2
    assert current.extrapolation.confidence_interval[0] > 0.0
