"""The linear search, compared with dense algebra on a few hundred samples."""

import numpy as np
import pytest
import torch
from scipy import stats

from mkc_torch.diagnosis.search.linear_search import LinearSearch, log_survival
from mkc_torch.diagnosis.settings import NoiseSettings

M, P, K = 200, 4, 12


def randn(*size, seed=0):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def smooth(count):
    n = torch.arange(M, dtype=torch.float64) + 0.5
    return torch.cos(torch.pi / M * n.unsqueeze(-1) * torch.arange(1, count + 1))


NUISANCE = torch.cat([torch.ones(M, 1).double(), randn(M, P - 1, seed=1)], -1)
CANDIDATES = [
    randn(M, 1, seed=2),
    randn(M, 3, seed=3),
    smooth(3)[:, :1] + 0.3 * randn(M, 1, seed=4),
    randn(M, 3, seed=5),
]
DRIFT = smooth(K) * (1.0 + 0.2 * randn(M, 1, seed=6))
SCALES = torch.stack([1.0 / torch.arange(1, K + 1).double(), torch.ones(K).double()])
NO_DRIFT = (torch.zeros(M, 0).double(), torch.zeros(0, 0).double())


@pytest.fixture(scope="module")
def plain():
    return LinearSearch(NUISANCE, CANDIDATES, *NO_DRIFT, NoiseSettings().walk_first)


@pytest.fixture(scope="module")
def search():
    return LinearSearch(NUISANCE, CANDIDATES, DRIFT, SCALES, NoiseSettings().walk_first)


def squares(columns, y):
    return np.linalg.lstsq(columns, y, rcond=None)[1][0]


def drifting(size, family, seed):
    return randn(M, seed=seed) + DRIFT @ (size**0.5 * SCALES[family] * randn(K, seed=seed + 1))


class Dense:
    """The likelihood of the series without the nuisance, with an explicit covariance."""

    def __init__(self, search):
        complement = torch.linalg.qr(NUISANCE, mode="complete").Q[:, P:]
        self.complement, self.dof = complement.numpy(), M - P
        self.noises = [(0, 0.0), *((f, float(s)) for f, known in enumerate(search._families) for s in known.sizes[1:])]

    def covariance(self, family, size):
        courses = self.complement.T @ (DRIFT * SCALES[family]).numpy()
        return np.eye(self.dof) + size * courses @ courses.T

    def fits(self, y, columns=None, price=0.0):
        """For each noise: log-likelihood with the white variance profiled out, γ and its covariance.

        Other families than the first have a penalty.
        """
        z = self.complement.T @ np.asarray(y)
        for family, size in self.noises:
            factor = np.linalg.cholesky(self.covariance(family, size))
            white, log_det = np.linalg.solve(factor, z), 2.0 * np.log(np.diag(factor)).sum()
            gamma = covariance = None
            if columns is not None:
                X = np.linalg.solve(factor, self.complement.T @ np.asarray(columns))
                gamma = np.linalg.lstsq(X, white, rcond=None)[0]
                white = white - X @ gamma
                covariance = np.linalg.inv(X.T @ X) * (white @ white) / self.dof
            value = -0.5 * log_det - 0.5 * self.dof * np.log(white @ white)
            yield value - price * (family > 0), gamma, covariance

    def best(self, y, columns=None, price=0.0):
        return max(self.fits(y, columns, price), key=lambda fit: fit[0])


def test_gains_without_drift_equal_likelihood_ratios_of_least_squares(plain):
    series = randn(M, 5, seed=7) + 0.5 * CANDIDATES[1][:, :1]
    found = plain.gains(series)
    assert found.ratio.shape == (4, 5)
    assert found.dof.tolist() == [1.0, 3.0, 1.0, 3.0]
    for b in range(5):
        null = squares(NUISANCE.numpy(), series[:, b].numpy())
        for c, columns in enumerate(CANDIDATES):
            rest = squares(torch.cat([NUISANCE, columns], -1).numpy(), series[:, b].numpy())
            # the ratio is a function of the F statistic alone
            F = (null - rest) / columns.shape[1] / (rest / (M - P - columns.shape[1]))
            ratio = (M - P) * np.log1p(F * columns.shape[1] / (M - P - columns.shape[1]))
            assert float(found.ratio[c, b]) == pytest.approx(ratio, rel=1e-9)
            expected = stats.chi2.logsf(ratio, columns.shape[1])
            assert float(found.log_p[c, b]) == pytest.approx(expected, rel=1e-8)


def test_residuals_of_the_best_candidate_equal_least_squares(plain):
    series = randn(M, 4, seed=8) + torch.cat([2.0 * CANDIDATES[1][:, :1], CANDIDATES[0], 0 * DRIFT[:, :2]], -1)
    possible = torch.tensor([True, True, True, False])
    left, with_best, dof = plain.residuals_of_best(series, possible)
    torch.testing.assert_close(left, series - NUISANCE @ torch.linalg.lstsq(NUISANCE, series).solution)
    assert dof[:2].tolist() == [3.0, 1.0]
    score = 0.5 * plain.gains(series).ratio - plain.dof.unsqueeze(-1)
    for b, number in enumerate(score[:3].argmax(0).tolist()):
        columns = torch.cat([NUISANCE, CANDIDATES[number]], -1)
        rest = series[:, b] - columns @ torch.linalg.lstsq(columns, series[:, b]).solution
        torch.testing.assert_close(with_best[:, b], rest)


@pytest.mark.parametrize(("family", "size"), [(0, 0.0), (0, 1.0), (0, 300.0), (1, 0.05), (1, 5.0)])
def test_gains_with_drift_equal_the_dense_covariance(search, family, size):
    dense, series = Dense(search), drifting(size, family, seed=10) + 0.3 * CANDIDATES[2].squeeze(-1)
    found = search.gains(series.unsqueeze(-1)).ratio[:, 0]
    null = dense.best(series)[0]
    expected = [2.0 * (dense.best(series, columns)[0] - null) for columns in CANDIDATES]
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8)


def test_drift_sizes_in_blocks_give_the_same_gains(search, monkeypatch):
    series = torch.stack([drifting(3.0, 0, seed=20), drifting(0.5, 1, seed=30)], -1)
    together = search.gains(series).ratio
    monkeypatch.setattr("mkc_torch.diagnosis.search.linear_search.CELLS", 1)
    torch.testing.assert_close(search.gains(series).ratio, together, rtol=1e-9, atol=1e-9)


def test_drift_sizes_cover_the_range(search):
    gram = DRIFT - NUISANCE @ torch.linalg.lstsq(NUISANCE, DRIFT).solution
    for scale, known in zip(SCALES, search._families, strict=True):
        strongest = float(torch.linalg.matrix_norm(gram * scale, 2)) ** 2
        assert float(known.sizes[0]) == 0.0
        assert float(known.sizes[1]) * strongest < 1.0
        assert float(known.sizes[-1]) * strongest > 1e4


def test_the_noise_of_a_series_is_the_most_likely_of_the_grid(search):
    dense, series = Dense(search), drifting(30.0, 0, seed=20)
    values = [fit[0] for fit in dense.fits(series, price=NoiseSettings().walk_first)]
    found = search.noise_fit(series)
    best = int(np.argmax(values))
    assert (found.family, found.size) == pytest.approx(dense.noises[best])
    assert found.log_likelihood == pytest.approx(values[best], rel=1e-10)
    assert found.gain == pytest.approx(values[best] - values[0], rel=1e-8)
    assert found.size > 0
    nothing = search.noise_fit(randn(M, seed=3))
    assert nothing.gain < 3.0
    assert nothing.variance == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("size", [0.0, 100.0])
def test_estimates_are_those_of_generalised_least_squares(search, number, size):
    series = drifting(size, 0, seed=30) + 0.4 * CANDIDATES[number].sum(-1)
    _, expected, spread = Dense(search).best(series, CANDIDATES[number], NoiseSettings().walk_first)
    gamma, covariance = search.estimate(number, series)
    np.testing.assert_allclose(gamma, expected, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(covariance, spread, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("family", [0, 1])
def test_standard_errors_are_those_of_the_least_favourable_nearly_as_likely_drift_family(search, family):
    series = drifting(100.0, family, seed=30) + 0.4 * CANDIDATES[2].sum(-1)
    fits = list(Dense(search).fits(series, CANDIDATES[2], NoiseSettings().walk_first))
    highest = max(fit[0] for fit in fits)
    noises = Dense(search).noises
    errors = []
    for number in (None, 0, 1):
        mine = [fit for fit, (f, size) in zip(fits, noises, strict=True) if (f if size else None) == number]
        value, _, covariance = max(mine, key=lambda fit: fit[0])
        if value > highest - NoiseSettings().doubted_family:
            errors.append(np.sqrt(np.diag(covariance)))
    found = search.doubted_error(2, series, NoiseSettings().doubted_family)
    np.testing.assert_allclose(found, np.max(errors, axis=0), rtol=1e-7)
    assert float(found) >= float(search.estimate(2, series)[1].sqrt())


def test_standard_errors_are_those_of_repeated_draws(search):
    gammas, errors = [], []
    for seed in range(200):
        gamma, covariance = search.estimate(2, drifting(20.0, 0, seed=1000 + 2 * seed))
        gammas.append(float(gamma))
        errors.append(float(covariance.sqrt()))
    assert np.std(gammas) == pytest.approx(np.median(errors), rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_ratios_of_empty_draws_are_chi_square(plain, seed):
    drawn = plain.white(1500, torch.Generator().manual_seed(seed))
    found = plain.gains(drawn)
    for c in range(len(CANDIDATES)):
        # (M - P) log(1 + x / (M - P)) is x to within a per cent or two
        assert stats.kstest(found.ratio[c].numpy(), stats.chi2(CANDIDATES[c].shape[1]).cdf).pvalue > 1e-3
    assert float(drawn.var()) == pytest.approx(1.0, abs=0.02)


def test_p_values_of_surrogates_with_drift_keep_the_level(search):
    """The drift's size is fitted with each candidate, so slow candidates raise no false alarms."""
    noise = search.noise_fit(drifting(100.0, 0, seed=40))
    generator = torch.Generator().manual_seed(0)
    drawn = search.white(2000, generator) + search.drift(2000, noise, generator)
    p = search.gains(drawn).log_p.exp()
    share = (p < 0.05).double().mean(-1)
    assert float(share.max()) < 0.09
    assert float(share.min()) > 0.02
    blind = LinearSearch(NUISANCE, CANDIDATES, *NO_DRIFT, NoiseSettings().walk_first).gains(drawn).log_p.exp()
    assert float((blind[2] < 0.05).double().mean()) > 0.3


def test_the_drawn_drift_has_its_covariance(search):
    noise = search.noise_fit(drifting(100.0, 0, seed=40))
    drawn = search.drift(20_000, noise, torch.Generator().manual_seed(0))
    courses = DRIFT * SCALES[noise.family]
    expected = noise.size * courses @ courses.mT
    assert float((drawn @ drawn.mT / 20_000 - expected).abs().max()) < 0.05 * float(expected.max())
    still = search.noise_fit(randn(M, seed=3))
    if still.size == 0:
        assert not bool(search.drift(3, still, torch.Generator()).any())


def test_the_nuisance_is_projected_out(search):
    series = drifting(10.0, 0, seed=50)
    moved = series + NUISANCE @ (100.0 * randn(P, seed=9))
    torch.testing.assert_close(search.gains(moved.unsqueeze(-1)).ratio, search.gains(series.unsqueeze(-1)).ratio)
    torch.testing.assert_close(search.estimate(1, moved)[0], search.estimate(1, series)[0])


def test_gains_do_not_depend_on_scales(search):
    scaled = LinearSearch(
        NUISANCE * torch.tensor([1e-6, 1.0, 1e6, 3.0]), [1e5 * CANDIDATES[0], *CANDIDATES[1:3], 1e-7 * CANDIDATES[3]],
        DRIFT, SCALES, NoiseSettings().walk_first,
    )  # fmt: skip
    series = drifting(10.0, 0, seed=60).unsqueeze(-1)
    torch.testing.assert_close(scaled.gains(1e3 * series).ratio, search.gains(series).ratio, rtol=1e-6, atol=1e-8)


def test_directions_in_the_nuisance_are_dropped():
    inside = NUISANCE @ randn(P, 2, seed=1)
    half = torch.cat([randn(M, 1, seed=2), inside[:, :1]], -1)
    twice = torch.cat([CANDIDATES[0], 2.0 * CANDIDATES[0]], -1)
    search = LinearSearch(
        NUISANCE, [inside, half, twice, half[:, :1], CANDIDATES[0]], DRIFT, SCALES, NoiseSettings().walk_first
    )
    assert search.dof.tolist() == [0.0, 1.0, 1.0, 1.0, 1.0]
    series = drifting(10.0, 0, seed=70) + 0.3 * half[:, 0]
    found = search.gains(series.unsqueeze(-1))
    assert float(found.ratio[0]) == 0.0
    assert float(found.log_p[0]) == 0.0
    torch.testing.assert_close(found.ratio[1], found.ratio[3], rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(found.ratio[2], found.ratio[4], rtol=1e-6, atol=1e-8)


def test_the_estimate_is_zero_along_directions_in_the_nuisance():
    inside = NUISANCE @ randn(P, 1, seed=1)
    half = torch.cat([randn(M, 1, seed=2), inside], -1)
    search = LinearSearch(NUISANCE, [half, half[:, :1]], DRIFT, SCALES, NoiseSettings().walk_first)
    series = drifting(10.0, 0, seed=70) + 0.3 * half[:, 0]
    gamma, covariance = search.estimate(0, series)
    alone, spread = search.estimate(1, series)
    # along such a direction γ can be traded for the nuisance at no cost: the smallest one is taken
    torch.testing.assert_close(gamma, torch.cat([alone, torch.zeros(1).double()]), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(covariance[0, 0], spread[0, 0], rtol=1e-6, atol=1e-9)


def test_traces_are_orthogonal_to_the_nuisance(search):
    series = drifting(0.0, 0, seed=80) + CANDIDATES[1] @ torch.tensor([1.0, -2.0, 0.5]).double()
    trace, basis, share = search.trace(1, series)
    gamma = search.estimate(1, series)[0].numpy()
    whole = CANDIDATES[1].numpy() @ gamma
    left = whole - NUISANCE.numpy() @ np.linalg.lstsq(NUISANCE.numpy(), whole, rcond=None)[0]
    np.testing.assert_allclose(trace, left, atol=1e-9)
    assert share == pytest.approx(left @ left / (whole @ whole), rel=1e-9)
    assert basis.shape == (M, 3)
    torch.testing.assert_close(basis.mT @ basis, torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(basis @ (basis.mT @ trace), trace)


@pytest.mark.parametrize("dof", [1.0, 2.0, 3.0, 7.0, 12.0, 36.0])
def test_log_survival_equals_scipy_and_extends_beyond_underflow(dof):
    ratio = (
        torch.cat([torch.zeros(1), torch.logspace(-3, 4.5, 400), torch.tensor([599.9, 600.1])]).double().sort().values
    )
    found = log_survival(ratio, torch.tensor(dof, dtype=torch.float64))
    expected = stats.chi2.logsf(ratio.numpy(), dof)
    usable = np.isfinite(expected)
    np.testing.assert_allclose(found.numpy()[usable], expected[usable], rtol=1e-6, atol=1e-7)
    assert bool(found.isfinite().all())
    assert bool((found.diff() <= 0).all())
    # where SciPy underflows the tail is -x/2 and a little more
    assert float(found[-1]) == pytest.approx(-0.5 * 10**4.5, rel=0.02)


def test_survival_of_a_negative_ratio_is_one():
    assert float(log_survival(torch.tensor(-1.0).double(), torch.tensor(3.0))) == 0.0


@pytest.mark.parametrize("size", [0.0, 100.0])
def test_the_stationary_power_is_unbiased_by_nuisance_and_drift(search, size):
    """Its mean over draws is the white variance everywhere, also where tangents and slow courses are large."""
    total = torch.zeros(M, dtype=torch.float64)
    for seed in range(300):
        total += search.stationary(drifting(size, 0, seed=5000 + 2 * seed))
    mean = total / 300
    assert float(mean.mean()) == pytest.approx(1.0, abs=0.03)
    taken = torch.linalg.qr(torch.cat([NUISANCE, DRIFT[:, :3]], -1)).Q.square().sum(-1)
    assert float(mean[taken > taken.quantile(0.9)].mean()) == pytest.approx(1.0, abs=0.08)


def test_candidates_can_be_replaced(search):
    y = drifting(3.0, 0, seed=20).unsqueeze(-1)
    other = LinearSearch(NUISANCE, CANDIDATES[2:], DRIFT, SCALES, NoiseSettings().walk_first)
    torch.testing.assert_close(search.with_candidates(CANDIDATES[2:]).gains(y).ratio, other.gains(y).ratio)
    torch.testing.assert_close(search.gains(y).ratio[2:], other.gains(y).ratio)


def test_scaled_rows_equal_a_search_with_scaled_tangents(search):
    factor = 0.5 + torch.linspace(0.0, 2.0, M, dtype=torch.float64).unsqueeze(-1)
    built = LinearSearch(
        factor * NUISANCE, [factor * c for c in CANDIDATES], factor * DRIFT, SCALES, NoiseSettings().walk_first
    )
    series = factor * drifting(10.0, 0, seed=70).unsqueeze(-1)
    torch.testing.assert_close(search.scaled(factor.squeeze(-1)).gains(series).ratio, built.gains(series).ratio)


def test_channel_shares_are_their_variances():
    """Courses of two channels take turns; those of the first are three times the size of the others."""
    courses = torch.cat([smooth(30) * randn(M, 1, seed=6), smooth(30) * randn(M, 1, seed=7)], -1)
    courses = courses.unflatten(-1, (2, 30)).mT.flatten(-2)
    scales = torch.ones(1, 60).double()
    search = LinearSearch(NUISANCE, [], courses, scales, NoiseSettings().walk_first)
    size = torch.tensor([3.0, 1.0]).double().repeat(30)
    found = torch.stack(
        [search.shares(randn(M, seed=s) + courses @ (size * randn(60, seed=100 + s)), 2) for s in range(40)]
    )
    assert float(found.sum(-1).sub(2.0).abs().max()) < 1e-9
    # 1.8 and 0.2 are the shares; a few courses' worth of equal channels are in the estimate
    assert found.mean(0)[0] == pytest.approx(1.73, abs=0.08)


def test_without_drift_channels_have_equal_shares():
    quiet = LinearSearch(NUISANCE, [], DRIFT, SCALES, NoiseSettings().walk_first)
    y = randn(M, seed=5)
    y = y - DRIFT @ torch.linalg.lstsq(DRIFT, y).solution
    assert quiet.noise_fit(y).size == 0
    assert quiet.shares(y, 2).tolist() == [1.0, 1.0]
