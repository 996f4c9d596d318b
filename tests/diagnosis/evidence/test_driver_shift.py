"""A driver shifted in time explains nothing, unless it changes so slowly that its timing is uninformative."""

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.evidence.timing import shifted
from mkc_torch.diagnosis.findings.warnings import driver_shift_warnings
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import Driver, Term, find_drivers
from mkc_torch.diagnosis.result import DriverShift
from mkc_torch.diagnosis.search.run import run_search
from mkc_torch.diagnosis.settings import DriverSettings, EvidenceSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import tumbling

GAIN = np.array([0.8, -0.6, 0.9])


def load(N):
    time = np.arange(N) / 50.0
    return np.sin(2.0 * np.pi * time / 3.7) + 0.4 * np.sin(2.0 * np.pi * time / 0.83 + 0.02 * time**2)


def shift_of(N, driver, effect="current_field", *, searched=None, **columns):
    """Return the driver shifts of the searched effect, for a sensor that follows the driver."""
    recording = tumbling(N, noise=0.4, sensor=GAIN * driver[:, None], attitude=True, gyro=True, **columns)
    simulation = Magnetometer("attitude")
    prepared = simulation.prepare(recording)
    roles = frozenset(role for element in CATALOGUE for role in element.roles)
    drivers = find_drivers(prepared.recording, simulation.columns, DriverSettings(), roles).drivers
    base = fitted(JointModel(prepared), prepared.start())
    terms = candidate_terms(prepared, drivers, [item for item in CATALOGUE if item.id == (searched or effect)])
    located = run_search(
        base, terms, level=0.05, surrogates=19, generator=torch.Generator().manual_seed(0), settings=Settings()
    )
    return shifted(base.model, located)


def warning(shift):
    effect = next(e for e in CATALOGUE if e.id == "current_field")
    column = Driver(("load",), "current", torch.zeros(5, 1), torch.zeros(1), ("A",))
    return driver_shift_warnings(shift, Term(effect, column, {}), EvidenceSettings())


@pytest.mark.e2e
def test_no_shifted_copy_of_an_oscillating_driver_gains_as_much():
    N = 2000
    assert shift_of(N, load(N), current=load(N) + 2.0) == DriverShift(38, 0, pytest.approx(10.0))


@pytest.mark.e2e
def test_shifted_copies_of_a_ramp_gain_as_much_with_a_warning():
    N = 2000
    ramp = np.linspace(0.0, 3.0, N)
    shift = shift_of(N, ramp, "temperature_offset", temperature=ramp + 25.0)
    assert shift.as_good > 4
    (sentence,) = warning(shift)
    assert f"{shift.as_good} of 38 copies of load, shifted by up to 10 s, gain as much for current_field" in sentence


@pytest.mark.e2e
def test_without_a_driver_or_in_a_short_recording_there_is_no_driver_shift():
    N = 2000
    step = np.where(np.arange(N) < 900, 0.0, 1.0)
    assert shift_of(N, step, searched="hard_iron_step", current=load(N) + 2.0) is None
    short = 390
    assert shift_of(short, 3.0 * load(short), current=load(short) + 2.0) is None


def test_only_four_copies_or_more_of_38_are_warned_of():
    assert warning(DriverShift(38, 3, 20.0)) == ()
    assert len(warning(DriverShift(38, 4, 20.0))) == 1


@pytest.mark.e2e
def test_a_finding_of_a_diagnosis_has_a_driver_shift():
    N = 1500
    recording = tumbling(N, noise=0.4, sensor=GAIN * load(N)[:, None], current=load(N) + 2.0)
    result = diagnose(Magnetometer(), recording, surrogates=19, max_findings=1)
    (finding,) = result.findings
    assert finding.driver_shift.as_good == 0
    assert not [w for w in result.warnings if "copies" in w]
