"""Reweighted least squares: (26)-(29) by hand, the published rejections, starts."""

import numpy as np
import pytest
import torch

from mkc_torch.linear import LeastAbsoluteDeviations, LeastSquares, LeastTrimmedSquares, ReweightedLeastSquares
from tests.draws import normal as sample
from tests.literature import DATA_SETS, REFERENCE

WITH_REJECTED_ROWS = [n for n in REFERENCE if REFERENCE[n].lts is not None]


@pytest.mark.parametrize("name", WITH_REJECTED_ROWS)
def test_rejected_rows_equal_those_of_r(name):
    X, y = DATA_SETS[name]()
    fit = ReweightedLeastSquares().fit(X, y)
    rejected = (fit.weights_[:, 0] == 0).nonzero().flatten() + 1
    assert tuple(rejected.tolist()) == REFERENCE[name].lts.rejected


@pytest.mark.parametrize("start", ["lts", "lms"])
def test_stackloss_has_the_coefficients_of_daniel_and_wood(start):
    # Daniel & Wood, Fitting Equations to Data (1971), without observations 1, 3, 4 and 21
    fit = ReweightedLeastSquares(start).fit(*DATA_SETS["stackloss"]())
    expected = torch.tensor([-37.65, 0.80, 0.58, -0.07], dtype=torch.float64)
    torch.testing.assert_close(fit.coef_, expected, rtol=0, atol=5e-3)
    assert float(fit.scale_) == pytest.approx(1.253, abs=5e-4)


@pytest.mark.parametrize("name", DATA_SETS)
@pytest.mark.parametrize("threshold", [2.0, 2.5])
def test_scales_weights_and_coefficients_satisfy_the_four_equations(name, threshold):
    X, y = (v.numpy() for v in DATA_SETS[name]())
    N, p = X.shape
    fit = ReweightedLeastSquares(threshold=threshold).fit(torch.from_numpy(X), torch.from_numpy(y))
    r = y - X @ fit.start_.coef_.numpy()
    h = (N + p + 1) // 2
    s0 = 1.4826 * (1 + 5 / (N - p)) * N / (N - p) * np.sort(np.abs(r))[h - 1]
    first = np.abs(r / s0) <= threshold
    sigma = np.sqrt((r[first] ** 2).sum() / (first.sum() - p))
    final = np.abs(r / sigma) <= threshold
    coef = np.linalg.lstsq(X[final], y[final], rcond=None)[0]
    np.testing.assert_allclose(fit.weights_[:, 0].numpy(), final)
    np.testing.assert_allclose(fit.coef_.numpy(), coef, rtol=1e-7)
    left = y[final] - X[final] @ coef
    assert float(fit.scale_) == pytest.approx(np.sqrt((left**2).sum() / (final.sum() - p)), rel=1e-7)


def test_an_estimator_is_accepted_as_start():
    X, y = sample(0, 50, 3), sample(1, 50)
    y[:5] += 20.0
    start = LeastAbsoluteDeviations()
    fit = ReweightedLeastSquares(start).fit(X, y)
    assert fit.start_ is start
    keep = fit.weights_[:, 0] > 0
    assert not bool(keep[:5].any())
    torch.testing.assert_close(fit.coef_, LeastSquares().fit(X[keep], y[keep]).coef_)


def test_a_wide_threshold_equals_least_squares():
    X, y = sample(0, 50, 3), sample(1, 50)
    torch.testing.assert_close(ReweightedLeastSquares(threshold=1e3).fit(X, y).coef_, LeastSquares().fit(X, y).coef_)


def test_reweighting_is_more_precise_than_its_start():
    X = sample(0, 60, 60, 3)
    y = sample(1, 60, 60)
    y[:, :15] += 30.0
    error = {
        e: float(e.fit(X, y).coef_.square().mean())
        for e in (LeastTrimmedSquares(starts=20), ReweightedLeastSquares(starts=20))
    }
    first, then = error.values()
    assert then < 0.6 * first


def test_the_gradient_equals_that_of_least_squares_on_the_values_kept():
    X, y = sample(0, 20, 2), sample(1, 20)
    y[:3] += 30.0
    keep = ReweightedLeastSquares().fit(X, y).weights_[:, 0]
    (got,) = torch.autograd.grad(ReweightedLeastSquares().fit(X, y.requires_grad_()).coef_.sum(), y)
    (expected,) = torch.autograd.grad(LeastSquares().fit(X, y, keep).coef_.sum(), y)
    torch.testing.assert_close(got, expected)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"start": "ols"}, "`start` to be 'lts', 'lms', 's' or an estimator but got 'ols'"),
        ({"threshold": 0.5}, r"`threshold` to be in \[1, inf\) but got 0\.5"),
        ({"starts": 0}, "`starts` to be a whole number of at least 1 but got 0"),
    ],
)
def test_bad_parameters_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ReweightedLeastSquares(**kwargs)
