"""Imputation of rejected samples, compared with the dense conditional expectation, and its effect on a search."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.diagnosis.noise import imputation
from mkc_torch.diagnosis.noise.imputation import MissingSamples
from mkc_torch.diagnosis.noise.spectrum import NoiseSpectrum, dct

N = 60


def basis(size, kept):
    """(kept, size), rows of the cosine basis."""
    return dct(torch.eye(size, dtype=torch.float64))[:kept]


def noise_spectrum(*spectra):
    root = torch.stack(spectra, -1).sqrt()
    return NoiseSpectrum(tuple(root.new_zeros(0) for _ in spectra), root)


def falling_spectrum(size, kept=None):
    k = torch.arange(size if kept is None else kept, dtype=torch.float64)
    return 1.0 + 40.0 / (1.0 + (k / 5.0).square())


def mask(seed, size=N, channels=1, share=0.2):
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(size, channels, generator=generator) > share).double()


def conditional_expectation(values, counts, spectrum):
    """Return series with the conditional expectation at rejected samples, and log det of the precision there."""
    rows = basis(len(values), len(values))
    precision = rows.mT @ torch.diag(1.0 / spectrum) @ rows
    lost = counts == 0
    own = precision[lost][:, lost]
    out = values.clone()
    out[lost] = -torch.linalg.solve(own, precision[lost][:, ~lost] @ values[~lost])
    return out, torch.logdet(own)


@settings(deadline=None)
@given(st.integers(0, 1000), st.sampled_from([0.05, 0.3, 0.6]))
def test_the_imputation_is_the_conditional_expectation(seed, share):
    counts = mask(seed, channels=2, share=share)
    spectra = falling_spectrum(N), 0.5 + 10.0 * torch.linspace(0.0, 1.0, N, dtype=torch.float64).square()
    values = counts * torch.randn(N, 2, generator=torch.Generator().manual_seed(seed)).double()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(imputation, "PLAIN", 0.0)
        patch.setattr(imputation, "END", N)  # the level of the last frequency only
        filling = MissingSamples(counts, N).filling(noise_spectrum(*spectra))
    found = filling(dct(values))
    total = 0.0
    for channel, spectrum in enumerate(spectra):
        series, log_det = conditional_expectation(values[:, channel], counts[:, channel], spectrum / spectrum[-1])
        torch.testing.assert_close(found[:, channel], dct(series))
        total += float(log_det)
    assert filling.log_det == pytest.approx(total, abs=1e-8)


@pytest.mark.parametrize("level", [1.0, 9.0])  # at level 1 the noise is nowhere below it
@pytest.mark.parametrize("share", [0.1, 0.7])
def test_solving_by_samples_equals_solving_by_frequencies(share, level):
    counts = mask(11, share=share)
    known, rows = MissingSamples(counts, N), torch.arange(0, N, 2)
    excess = (level / falling_spectrum(N) - 1.0)[rows]
    assert bool((excess < 0).all()) == (level == 1.0)
    by_sample, by_frequency = known._by_sample(0, rows, excess), known._by_frequency(0, rows, excess)
    values = torch.randn(N, 3, generator=torch.Generator().manual_seed(12), dtype=torch.float64)
    assert float((by_sample(values) - values).abs().max()) > 0.01
    torch.testing.assert_close(by_sample(values), by_frequency(values))
    assert by_sample.log_det == pytest.approx(by_frequency.log_det)


def test_frequencies_that_are_left_out_count_as_white():
    counts = mask(1)
    values = counts * torch.randn(N, 1, generator=torch.Generator().manual_seed(2)).double()
    kept = 30
    found = MissingSamples(counts, kept).filling(noise_spectrum(falling_spectrum(N, kept)))(dct(values, kept))
    spectrum = falling_spectrum(N, kept)
    end = spectrum[-1]
    whole = torch.cat([torch.where((end / spectrum - 1.0).abs() > 0.3, spectrum, end), end.expand(N - kept)])
    series, _ = conditional_expectation(values[:, 0], counts[:, 0], whole / end)
    torch.testing.assert_close(found[:, 0], dct(series, kept))


@pytest.mark.parametrize(
    ("counts", "spectrum"),
    [(mask(3), torch.full((N,), 2.0).double()), (torch.ones(N, 1).double(), falling_spectrum(N))],
)
def test_imputation_leaves_white_noise_and_complete_recordings_unchanged(counts, spectrum):
    values = dct(counts * torch.randn(N, 1, generator=torch.Generator().manual_seed(4)).double())
    filling = MissingSamples(counts, N).filling(noise_spectrum(spectrum))
    assert filling(values) is values
    assert filling.log_det == 0.0


def test_imputation_is_linear():
    counts, course = mask(5), torch.randn(N, 1, 2, generator=torch.Generator().manual_seed(6)).double()
    gamma = torch.tensor([2.0, -3.0], dtype=torch.float64)
    filling = MissingSamples(counts, N).filling(noise_spectrum(falling_spectrum(N)))
    masked = counts.unsqueeze(-1) * course
    torch.testing.assert_close(filling(dct(masked @ gamma)), filling(dct(masked)) @ gamma)


@pytest.mark.parametrize(("limit", "value"), [("_MOST", 12), ("_CELLS", 12 * N + 5)])
def test_only_the_most_coloured_frequencies_are_kept(limit, value, monkeypatch):
    counts = mask(7)
    values = counts * torch.randn(N, 1, generator=torch.Generator().manual_seed(8)).double()
    monkeypatch.setattr(imputation, limit, value)
    found = MissingSamples(counts, N).filling(noise_spectrum(falling_spectrum(N)))(dct(values))
    end = falling_spectrum(N)[-3:].mean()
    series, _ = conditional_expectation(
        values[:, 0], counts[:, 0], torch.where(torch.arange(N) < 12, falling_spectrum(N), end) / end
    )
    torch.testing.assert_close(found[:, 0], dct(series))


def test_rejected_samples_of_a_random_walk_give_no_false_gain():
    """Likelihood ratios of three absent slow courses, in a random walk plus white noise with 15 % rejected samples.

    Both have the same holes.
    """
    size, draws = 1500, 60
    generator = torch.Generator().manual_seed(0)
    step = 0.1
    noise = torch.randn(size, draws, generator=generator).double()
    noise += step * torch.randn(size, draws, generator=generator).double().cumsum(0)
    k = torch.arange(size, dtype=torch.float64)
    spectrum = 1.0 + (0.5 * step / torch.sin(0.5 * math.pi * k.clamp(min=0.5) / size)).square()
    known = noise_spectrum(spectrum)
    slow = torch.sin(
        torch.linspace(0.0, 1.0, size, dtype=torch.float64).unsqueeze(-1) * torch.tensor([5.0, 11.0, 23.0])
    )
    counts = mask(9, size, share=0.15)

    def ratio(filled):
        filling = MissingSamples(counts, size).filling(known) if filled else lambda c: c
        series = known.scaled(filling(dct((counts * noise).unsqueeze(1))))
        columns = known.scaled(filling(dct((counts * slow).unsqueeze(1))))
        explained = torch.linalg.qr(columns).Q.mT @ series
        white = series.square().mean(0)
        return float((explained.square().sum(0) / white).mean())

    assert ratio(filled=True) < 4.5
    assert ratio(filled=False) > 6.0
