"""Localised evidence: an effect that explains only one of several bursts is not named; a repeated effect is."""

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.search.significance import localised_stretch
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import FIELD, RATE, tumbling, turns

N = 2500
TIME = np.arange(N) / RATE
POSITION = {
    f"position_{axis}": 0.4 * np.sin(2 * np.pi * TIME / period + phase)
    + 0.1 * np.sin(2 * np.pi * TIME / (0.37 * period) + phase)
    for axis, period, phase in zip("xyz", (7.3, 9.1, 11.7), (0.3, 1.2, 2.5), strict=True)
}
MILD, OTHERS = {400: -1.0}, {1200: 12.0, 1900: -9.0}
"""First sample of a burst, and its size along the field in µT."""


def in_sensor_frame(field):
    return turns(TIME).inv().apply(field)


def bursts(sizes, length=40):
    added = np.zeros((N, 3))
    for begin, size in sizes.items():
        added[begin : begin + length] = size * FIELD / np.linalg.norm(FIELD)
    return in_sensor_frame(added)


def pole(place, strength=0.02):
    """Return the field of a magnetic pole, strength in µT·m², along the path."""
    away = place - np.stack(list(POSITION.values()), -1)
    return in_sensor_frame(strength * away / (np.square(away).sum(-1, keepdims=True) + 0.06**2) ** 1.5)


def diagnosis_of(sensor):
    return diagnose(Magnetometer("norm"), tumbling(N, noise=0.3, sensor=sensor, seed=1, **POSITION))


def burst_warnings(diagnosis):
    return [warning for warning in diagnosis.warnings if "counts as a burst of outliers" in warning]


@pytest.mark.e2e
def test_an_effect_that_explains_a_single_burst_is_not_a_finding():
    """A pole near the path would explain the mild burst only."""
    diagnosis = diagnosis_of(bursts(MILD | OTHERS))
    assert diagnosis.verdict == "unexplained"  # bursts are not white noise
    assert diagnosis.findings == ()
    (warning,) = burst_warnings(diagnosis)
    assert warning.startswith("From 6.8 to 8.8 s")
    assert "field_gradient by position_x, position_y, position_z" in warning


@pytest.mark.e2e
def test_a_pole_passed_repeatedly_is_a_finding():
    place = np.array([values[420] for values in POSITION.values()]) + 0.05
    diagnosis = diagnosis_of(pole(place) + bursts(OTHERS))
    assert [finding.effect for finding in diagnosis.findings] == ["field_gradient"]
    assert burst_warnings(diagnosis) == []


@pytest.fixture
def stretch():
    trace = torch.zeros(1000, 2, dtype=torch.float64)
    trace[400:430, 0] = 1.0
    counts = torch.ones_like(trace)
    counts[700:730] = 0.0
    return trace, counts, torch.ones(1000, 2, 1, dtype=torch.float64)


def test_the_stretch_contains_nearly_all_of_the_gain(stretch):
    trace, counts, nuisance = stretch
    first, end = localised_stretch(trace, counts, trace, nuisance, Settings())
    assert first <= 400
    assert end >= 430
    assert end - first == 40


def test_spread_evidence_has_no_stretch(stretch):
    trace, counts, nuisance = stretch
    for begin in (100, 250):
        trace[begin : begin + 30, 0] = 1.0
    assert localised_stretch(trace, counts, trace, nuisance, Settings()) is None


def test_no_stretch_without_other_bursts(stretch):
    trace, _, nuisance = stretch
    assert localised_stretch(trace, torch.ones_like(trace), trace, nuisance, Settings()) is None
    edge_rejected = torch.ones_like(trace)
    edge_rejected[395:405] = 0.0  # its own edge
    assert localised_stretch(trace, edge_rejected, trace, nuisance, Settings()) is None


def test_parameters_of_the_simulation_are_projected_out(stretch):
    trace, counts, nuisance = stretch
    offset = counts * (trace + 2.0)
    assert localised_stretch(offset, counts, offset, nuisance, Settings()) is not None
    assert localised_stretch(offset, counts, offset, nuisance[..., :0], Settings()) is None


def test_an_anticorrelated_trace_has_no_stretch(stretch):
    trace, counts, nuisance = stretch
    assert localised_stretch(-trace, counts, trace, nuisance, Settings()) is None
