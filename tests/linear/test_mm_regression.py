"""MM-regression: published values, breakdown, efficiency at Gaussian errors."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from mkc_torch.linear import LeastSquares, LeastTrimmedSquares, MMRegression, SRegression
from mkc_torch.linear._estimator import LinearEstimator
from tests.draws import normal as sample
from tests.literature import DATA_SETS, REFERENCE


def clustered_outliers(seed: int, draws: int, spread: float = 0.3) -> tuple[Tensor, Tensor, Tensor]:
    """300 samples of 6 regressors, 45 % of them in a cluster 8 deviations away in every regressor, y near 40."""
    X, truth = sample(seed, draws, 300, 6), sample(seed + 1, draws, 6)
    y = (X @ truth.unsqueeze(-1)).squeeze(-1) + 0.1 * sample(seed + 2, draws, 300)
    X[:, :135] = 8.0 + spread * sample(seed + 3, draws, 135, 6)
    y[:, :135] = 40.0 + spread * sample(seed + 4, draws, 135)
    return X, y, truth


def relative_efficiency(estimator: LinearEstimator, draws: int, seed: int) -> float:
    """Mean squared error of least squares over that of the estimator at Gaussian errors, N = 200, n = 4."""
    X, y = sample(seed, draws, 200, 4), sample(seed + 1, draws, 200)
    squares = [e.fit(X, y).coef_.square().sum() for e in (LeastSquares(), estimator)]
    return float(squares[0] / squares[1])


@pytest.mark.parametrize("name", [n for n in REFERENCE if REFERENCE[n].mm is not None])
def test_the_published_fit_is_found(name):
    X, y = DATA_SETS[name]()
    reference = REFERENCE[name].mm
    fit = MMRegression().fit(X, y)
    assert float(fit.scale_) == pytest.approx(reference.scale, rel=1e-5)
    torch.testing.assert_close(fit.coef_, torch.tensor(reference.coef, dtype=torch.float64), rtol=1e-5, atol=1e-6)
    light = set(((fit.weights_[:, 0] < 0.01).nonzero().flatten() + 1).tolist())
    assert set(reference.rejected) <= light
    assert bool(fit.converged_)


@pytest.mark.parametrize("name", DATA_SETS)
def test_no_search_lowers_the_objective_at_the_scale_of_the_s_estimate(name):
    X, y = DATA_SETS[name]()
    fit, s = MMRegression().fit(X, y), SRegression().fit(X, y)
    torch.testing.assert_close(fit.scale_, s.scale_)
    Q, R = np.linalg.qr(X.numpy())

    def objective(b: np.ndarray) -> float:
        u = np.minimum(np.abs(y.numpy() - Q @ b) / (4.685064948543378 * float(s.scale_)), 1.0)
        return float((1 - (1 - u**2) ** 3).sum())

    at = R @ fit.coef_.numpy()
    found = minimize(objective, at, method="BFGS", options={"gtol": 1e-7})
    assert found.fun >= objective(at) * (1 - 1e-9)
    assert objective(at) <= objective(R @ s.coef_.numpy())


@pytest.mark.parametrize("spread", [0.3, 1.0])
def test_forty_five_per_cent_clustered_outliers_move_no_estimator_of_breakdown_one_half(spread):
    X, y, truth = clustered_outliers(7, 6, spread)
    for estimator in (LeastTrimmedSquares(), SRegression(), MMRegression()):
        fit = estimator.fit(X, y)
        assert float((fit.coef_ - truth).abs().max()) < 0.15
        # a point of a wide cluster may come close to the plane by chance
        assert float(fit.weights_[:, :135].sum()) <= (0.0 if spread < 1 else 8.0)


def test_efficiency_at_gaussian_errors():
    # 200 draws of 4 coefficients: two standard errors are 0.02
    assert relative_efficiency(MMRegression(starts=20), 200, seed=0) == pytest.approx(0.95, abs=0.03)
    assert relative_efficiency(SRegression(starts=20), 50, seed=0) < 0.6


def test_a_breakdown_point_of_a_fifth_fails_at_45_per_cent_outliers_and_holds_at_fewer():
    X, y, truth = clustered_outliers(0, 1)
    fit = MMRegression(breakdown=0.2).fit(X, y)
    assert float((fit.coef_ - truth).abs().max()) > 0.3
    X, y = X[:, 100:], y[:, 100:]  # 35 of 200 remain
    assert float((MMRegression(breakdown=0.2).fit(X, y).coef_ - truth).abs().max()) < 0.15


def test_an_exact_fit_is_found_with_forty_per_cent_outliers():
    X = torch.cat([torch.ones(50, 1).double(), sample(0, 50, 2)], 1)
    coef = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    y = X @ coef
    y[:20] = 50.0 + sample(1, 20)
    fit = MMRegression().fit(X, y)
    torch.testing.assert_close(fit.coef_, coef, rtol=1e-11, atol=1e-11)
    assert fit.weights_[:20].max() == 0.0
    assert fit.weights_[20:].min() > 0.99


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"efficiency": 1.0}, r"`efficiency` to be in \[0\.3, 0\.99\] but got 1\.0"),
        ({"breakdown": 0.6}, r"`breakdown` to be in \[0\.01, 0\.5\] but got 0\.6"),
        ({"starts": 2.5}, "`starts` to be a whole number of at least 1 but got 2.5"),
        ({"max_iter": 0}, "`max_iter` to be a whole number of at least 1 but got 0"),
        ({"tol": 2.0}, r"`tol` to be in \(0, 1\) but got 2.0"),
    ],
)
def test_bad_parameters_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        MMRegression(**kwargs)
