"""Stretches in which most samples were rejected are reported."""

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.evidence.residual_noise import rejected_intervals
from mkc_torch.diagnosis.findings.warnings import rejected_warnings
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import tumbling

TIME = torch.arange(3000, dtype=torch.float64) / 50.0


def weights(*stretches):
    inside = sum(((first <= TIME) & (last > TIME)).double() for first, last in stretches)
    return torch.stack([torch.ones_like(TIME), 1.0 - torch.as_tensor(inside).clamp(max=1.0)], -1)


def test_the_longest_stretches_are_reported_in_order_of_time():
    stretches = weights((5.0, 6.0), (20.0, 23.0), (30.0, 30.8), (40.0, 42.0), (50.0, 50.2))
    (sentence,) = rejected_warnings(rejected_intervals(TIME, stretches, Settings()))
    assert "from 5.0 to 6.0 s, from 20.0 to 23.0 s, from 40.0 to 42.0 s and in 1 shorter" in sentence


@pytest.mark.parametrize("stretches", [(), ((5.0, 5.2), (9.0, 9.1))])
def test_short_stretches_are_not_reported(stretches):
    known = weights(*stretches) if stretches else torch.ones(3000, 1)
    assert rejected_intervals(TIME, known, Settings()) == ()
    assert rejected_warnings(()) == ()


@pytest.mark.e2e
def test_a_diagnosis_reports_a_passing_magnet():
    time = np.arange(2000) / 50.0
    away = np.stack([1.0 + 0.0 * time, 0.3 * (time - 21.0), 0.0 * time], -1)
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    pole = np.array([0.3, -0.4, 0.85])
    field = 12.0 * (3.0 * (away @ pole)[:, None] * away / distance**2 - pole) / distance**3
    result = diagnose(Magnetometer("norm"), tumbling(2000, noise=0.2, sensor=field), surrogates=19)
    assert any("Most samples were rejected" in warning and "from 18.8 to" in warning for warning in result.warnings)
