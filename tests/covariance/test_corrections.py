"""Chi-square quantiles and correction factors, against SciPy and R."""

import pytest
from scipy.stats import chi2

from mkc_torch.covariance._chi_square import chi_square_cdf, chi_square_quantile
from mkc_torch.covariance._corrections import consistency_factor, small_sample_factor


@pytest.mark.parametrize("p", [1, 2, 3, 10, 100, 1000])
def test_chi_square_equals_scipy(p):
    for q in (1e-6, 0.025, 0.5, 0.9, 0.975, 1.0 - 1e-6):
        x = chi2.ppf(q, p)
        assert chi_square_quantile(q, p) == pytest.approx(x, rel=1e-8)
        assert chi_square_cdf(x, p) == pytest.approx(q, rel=1e-8)


def test_the_consistency_factor_is_the_share_of_variance_of_the_most_central():
    # one column at h = N / 2: 1 / (1 - 2 q φ(q) / 0.5) with q the third quartile of a Gaussian
    assert consistency_factor(0.5, 1) == pytest.approx(1.0 / (1.0 - 4.0 * 0.6744898 * 0.3177766), rel=1e-6)
    # .MCDcons of robustbase
    assert consistency_factor(39 / 75, 3) == pytest.approx(2.36792847084, rel=1e-10)
    assert consistency_factor(0.975, 5) == pytest.approx(1.05553311004, rel=1e-10)
    assert consistency_factor(1.0, 3) == 1.0


@pytest.mark.parametrize(
    ("N", "p", "fraction", "raw", "reweighted"),
    [  # raw.cnp2[2] and cnp2[2] of covMcd(matrix(rnorm(N * p), N), alpha = fraction) of robustbase 0.95-0
        (12, 1, 0.5, 1.40680661061632, 1.07506152463261),
        (47, 1, 0.9, 1.01136783535071, 1.01364524668337),
        (47, 2, 0.5, 1.15860263617696, 1.01435068828055),
        (200, 2, 0.9, 1.00440494835123, 1.0052177243549),
        (47, 3, 0.7, 1.11549708118496, 1.03329986855664),
        (47, 8, 0.5, 1.32678921454598, 1.20683820528622),
        (200, 8, 0.9, 1.02366160828289, 1.01987411281356),
    ],
)
def test_small_sample_factors_equal_robustbase(N, p, fraction, raw, reweighted):
    assert small_sample_factor(N, p, fraction, reweighted=False) == pytest.approx(raw, rel=1e-12)
    assert small_sample_factor(N, p, fraction, reweighted=True) == pytest.approx(reweighted, rel=1e-12)


@pytest.mark.parametrize("reweighted", [False, True])
def test_factors_stay_positive_and_end_at_one(reweighted):
    for p in (1, 2, 3, 5, 10, 50):
        for fraction in (0.5, 0.75, 0.875, 0.95):
            factors = [small_sample_factor(N, p, fraction, reweighted=reweighted) for N in (p + 2, 2 * p, 4 * p, 10**7)]
            assert all(0.9 < factor < 4.0 for factor in factors)
            assert factors[-1] == pytest.approx(1.0, abs=2e-3)
        assert small_sample_factor(20, p, 1.0, reweighted=reweighted) == pytest.approx(1.0)
