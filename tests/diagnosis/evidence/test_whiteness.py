"""Whiteness of the residual, and the lag up to which it is correlated."""

import json

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.evidence.residual_noise import whiteness
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.report.diagnosis.evidence import rows
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import tumbling

N = 2000


def draws(seed, count=N):
    return torch.as_tensor(np.random.default_rng(seed).standard_normal(count))


def whiteness_of(values, counts=None):
    return whiteness(values, torch.ones_like(values) if counts is None else counts, EvidenceSettings())


def autoregressive(seed, phi):
    values = draws(seed)
    for k in range(1, N):
        values[k] += phi * values[k - 1]
    return values


def test_one_per_cent_of_white_series_are_reported_as_correlated():
    assert sum(whiteness_of(draws(seed)).lag > 0 for seed in range(400)) <= 12
    p_values = [whiteness_of(draws(seed)).p_value for seed in range(400)]
    assert np.mean(np.less(p_values, 0.1)) == pytest.approx(0.1, abs=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_the_lag_is_that_of_a_moving_average(seed):
    mean = draws(seed).unfold(0, 8, 1).sum(-1)
    assert 4 <= whiteness_of(mean).lag <= 9
    assert whiteness_of(mean).neighbours == pytest.approx(7 / 8, abs=0.04)


def test_the_correlation_length_grows_with_the_memory():
    lags = [np.median([whiteness_of(autoregressive(seed, phi)).lag for seed in range(9)]) for phi in (0.5, 0.8, 0.95)]
    assert 1 < lags[0] < lags[1] < lags[2]


@pytest.mark.parametrize("seed", range(5))
def test_an_echo_is_found_at_its_lag(seed):
    noise = draws(seed)
    assert whiteness_of(noise[300:] + 0.5 * noise[:-300]).lag == 300


@pytest.mark.parametrize("seed", range(5))
def test_rejected_samples_do_not_count_as_correlation(seed):
    """Nor do they hide correlation."""
    counts = (draws(100 + seed) < 0.8).double()
    counts[500:700] = 0.0
    assert whiteness_of(counts * draws(seed), counts).lag == 0
    assert whiteness_of(counts * autoregressive(seed, 0.8), counts).neighbours == pytest.approx(0.8, abs=0.06)


def test_a_zero_residual_is_white():
    assert whiteness_of(torch.zeros(50, dtype=torch.float64)).lag == 0
    assert whiteness_of(torch.zeros(50, dtype=torch.float64), torch.zeros(50, dtype=torch.float64)).lag == 0
    assert whiteness_of(torch.ones(1, dtype=torch.float64)).lag == 0


def test_a_diagnosis_reports_whiteness_without_a_warning():
    slow = np.outer(autoregressive(3, 0.9).numpy(), [0.3, 0.2, -0.3])
    white, coloured = (
        diagnose(Magnetometer("norm"), tumbling(N, noise=0.3, sensor=sensor), effects=(), surrogates=19)
        for sensor in (0.0 * slow, slow)
    )
    assert rows(white.evidence) == [("residual", "white")]
    ((_, text),) = rows(coloured.evidence)
    assert text.startswith("correlated up to 0.")
    assert text.endswith(" s")
    content = json.loads(diagnosis_to_json(coloured))["evidence"]["whiteness"]
    assert content["unit"] == "s"
    (channel,) = content["channels"]
    assert (channel["channel"], channel["white"]) == ("norm", False)
    assert text == f"correlated up to {channel['lag']:.3g} s"
    assert channel["p_value"] < 0.005
    assert coloured.warnings == white.warnings
