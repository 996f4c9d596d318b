"""A slow effect in white noise colours the noise spectrum of the search; the own-spectrum gain still finds it."""

import sys

import pytest
import torch

from mkc_torch.diagnosis.noise.imputation import Imputation
from mkc_torch.diagnosis.noise.spectrum import spectrum_of, whittle
from mkc_torch.diagnosis.search.linear_search import LinearSearch
from mkc_torch.diagnosis.search.linearise import LinearisedSearch
from mkc_torch.diagnosis.search.significance import own_spectrum_gains
from mkc_torch.diagnosis.settings import NoiseSettings

N, M = 800, 2


def randn(*size, seed):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def smooth(seed):
    """Return a random course of twelve slow cosines, with mean square 1."""
    power = torch.zeros(N).double()
    power[1:13] = 1.0
    course = randn(N, M, seed=seed) * power.unsqueeze(-1)
    return course / course.square().mean().sqrt()  # of cosine coefficients


OFFSET = torch.zeros(N, M, M).double()
OFFSET[0] = torch.eye(M).double()
EFFECT, RIVAL = smooth(1), smooth(2)
SCALE = torch.tensor([1.0, 30.0]).double()
"""Scales of the channels."""


def linearised_at(size, seed=3):
    values = SCALE * (randn(N, M, seed=seed) + size * EFFECT)
    spectrum = spectrum_of(values.square())
    nuisance, effect, rival = (
        spectrum.scaled(SCALE.unsqueeze(-1) * columns)
        for columns in (OFFSET, EFFECT.unsqueeze(-1), RIVAL.unsqueeze(-1))
    )
    search = LinearSearch(
        nuisance, [rival, effect], nuisance[:, :0], nuisance.new_zeros(0, 0), NoiseSettings().walk_first
    )
    return LinearisedSearch(
        search, spectrum.scaled(values.unsqueeze(-1)).squeeze(-1), spectrum, None, Imputation((None,) * M, 0.0)
    )


BOTH_POSSIBLE = torch.ones(2, dtype=torch.bool)


@pytest.mark.parametrize("seed", range(3))
def test_a_slow_effect_gains_more_with_its_own_spectrum(seed):
    linearised = linearised_at(0.25, seed)
    drawn = linearised.search.white(400, torch.Generator().manual_seed(4))
    series = torch.cat([linearised.series.unsqueeze(-1), drawn], -1)
    by_search = 0.5 * linearised.search.gains(series).ratio.amax(0) - 1.0
    by_own_spectrum = own_spectrum_gains(linearised, series, BOTH_POSSIBLE)
    assert float(by_own_spectrum[0]) > 1.5 * float(by_search[0])
    assert float(by_own_spectrum[0]) > float(by_own_spectrum[1:].max()) + 5.0
    assert float(by_own_spectrum[1:].median()) < 3.0


def test_the_gain_is_the_ratio_of_whittle_likelihoods():
    linearised = linearised_at(0.5)
    values = linearised.series.unflatten(0, (N, M)) * linearised.spectrum.root
    level = linearised.spectrum.root.square().mean(0).sqrt()
    values, columns = values / level, EFFECT * SCALE / level
    values[0], columns[0] = 0.0, 0.0  # the offset takes the constant
    size = (values * columns).sum() / columns.square().sum()
    both = [
        sum(whittle(series.square()[:, j : j + 1]) for j in range(M)) for series in (values - size * columns, values)
    ]
    found = own_spectrum_gains(linearised, linearised.series.unsqueeze(-1), BOTH_POSSIBLE)
    assert float(found) == pytest.approx(float(both[0] - both[1]) - 1.0, rel=1e-9)
    assert float(found) > 10.0


def test_impossible_candidates_have_no_gain():
    linearised = linearised_at(0.5)
    found = own_spectrum_gains(linearised, linearised.series.unsqueeze(-1), torch.tensor([True, False]))
    assert float(found) < 3.0


def test_gains_do_not_depend_on_units_of_the_channels(monkeypatch):
    first = linearised_at(0.3)
    monkeypatch.setattr(sys.modules[__name__], "SCALE", torch.tensor([1e6, 1e-6]).double())
    other = linearised_at(0.3)
    gains = [own_spectrum_gains(search, search.series.unsqueeze(-1), BOTH_POSSIBLE) for search in (first, other)]
    torch.testing.assert_close(*gains)


@pytest.mark.parametrize("K", [30, 400])
def test_the_whittle_likelihood_is_computed_per_series(K):
    power = (randn(K, 7, seed=5) * torch.logspace(1, -1, K).double().unsqueeze(-1) ** (0.3 * torch.arange(7))).square()
    alone = torch.cat([whittle(series.unsqueeze(-1)) for series in power.unbind(-1)])
    torch.testing.assert_close(whittle(power), alone)
