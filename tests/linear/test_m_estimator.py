"""M-estimators: published coefficients, their equations against scipy, scales, starts."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.optimize import minimize, root
from scipy.stats import norm
from torch import Tensor

from mkc_torch.linear import LeastSquares, MEstimator
from mkc_torch.linear._psi import TUNING_95
from tests.draws import normal as sample
from tests.linear.test_psi import PSI
from tests.literature import DATA_SETS, REFERENCE


def contaminated_line(seed: int, N: int = 40, n: int = 3, share: float = 0.2) -> tuple[Tensor, Tensor]:
    X = torch.cat([torch.ones(N, 1).double(), sample(seed, N, n - 1)], 1)
    y = X.sum(-1) + 0.1 * sample(seed + 1, N)
    y[: int(share * N)] += 2.0 + sample(seed + 2, int(share * N))
    return X, y


@pytest.mark.parametrize("psi", ["huber", "tukey"])
@pytest.mark.parametrize("name", REFERENCE)
def test_the_published_coefficients_are_found_from_least_squares(name, psi):
    expected = torch.tensor(getattr(REFERENCE[name], psi), dtype=torch.float64)
    fit = MEstimator(psi, start="least_squares").fit(*DATA_SETS[name]())
    torch.testing.assert_close(fit.coef_, expected, rtol=1e-5, atol=0)
    assert bool(fit.converged_)


@pytest.mark.parametrize("name", REFERENCE)
def test_huber_does_not_depend_on_its_start(name):
    X, y = DATA_SETS[name]()
    expected = torch.tensor(REFERENCE[name].huber, dtype=torch.float64)
    for start in (None, "lts", "s"):
        torch.testing.assert_close(MEstimator(start=start).fit(X, y).coef_, expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("psi", PSI)
@pytest.mark.parametrize("name", ["stackloss", "hbk", "coleman"])
def test_the_equations_hold_and_no_search_lowers_the_objective(name, psi):
    X, y = DATA_SETS[name]()
    fit = MEstimator(psi).fit(X, y)
    assert bool(fit.converged_)
    tuning, scale = TUNING_95[psi], float(fit.scale_)
    residual = (y - X @ fit.coef_).numpy()
    assert scale == pytest.approx(np.median(np.abs(residual)) / norm.ppf(0.75), rel=1e-8)
    Q, R = np.linalg.qr(X.numpy())
    score = Q.T @ np.array([PSI[psi](r / scale, *tuning) for r in residual])
    assert np.abs(score).max() < 1e-7

    grid = np.linspace(0, 40, 4001)
    rho = np.concatenate([[0.0], np.cumsum(0.005 * np.array([PSI[psi](t + 0.005, *tuning) for t in grid[:-1]]) * 2)])

    def objective(b: np.ndarray) -> float:
        return float(np.interp(np.abs(y.numpy() - Q @ b) / scale, grid, rho).sum())

    at = R @ fit.coef_.numpy()
    found = minimize(objective, at, method="Nelder-Mead", options={"maxiter": 400})
    assert found.fun >= objective(at) * (1 - 1e-4)


def test_huber_at_its_scale_reaches_the_convex_optimum():
    X, y = contaminated_line(0)
    fit = MEstimator().fit(X, y)
    s, k = float(fit.scale_), 1.345

    def objective(b: np.ndarray) -> tuple[float, np.ndarray]:
        r = y.numpy() - X.numpy() @ b
        z = np.abs(r) / s
        rho = np.where(z <= k, 0.5 * z**2, k * z - 0.5 * k**2)
        return float(rho.sum()), -X.numpy().T @ np.clip(r / s, -k, k) / s

    found = minimize(objective, np.zeros(3), jac=True, method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(fit.coef_.numpy(), found.x, atol=1e-7)


@pytest.mark.parametrize("psi", ["huber", "tukey"])
def test_proposal_2_solves_its_two_equations(psi):
    X, y = contaminated_line(1)
    fit = MEstimator(psi, scale="proposal2").fit(X, y)
    tuning, k = TUNING_95[psi], 1.345
    gamma = 2 * quad(lambda t: min(t, k) ** 2 * norm.pdf(t), 0, 15, points=[k])[0]

    def equations(v: np.ndarray) -> np.ndarray:
        z = (y.numpy() - X.numpy() @ v[:3]) / np.exp(v[3])
        score = X.numpy().T @ np.array([PSI[psi](t, *tuning) for t in z])
        return np.append(score, (np.minimum(np.abs(z), k) ** 2).sum() / (37 * gamma) - 1)

    at = np.append(fit.coef_.numpy(), np.log(float(fit.scale_)))
    assert np.abs(equations(at)).max() < 1e-7
    np.testing.assert_allclose(root(equations, at + 0.01, tol=1e-12).x, at, atol=1e-7)


def test_huber_with_a_wide_constant_equals_least_squares():
    X, y = contaminated_line(2)
    torch.testing.assert_close(MEstimator(tuning=1e6).fit(X, y).coef_, LeastSquares().fit(X, y).coef_)


@pytest.mark.parametrize("scale", ["mad", "proposal2"])
def test_scale_of_gaussian_residuals_is_their_standard_deviation(scale):
    fit = MEstimator(scale=scale).fit(torch.ones(1, 20_000, 1).double(), 3.0 * sample(0, 1, 20_000))
    assert float(fit.scale_) == pytest.approx(3.0, rel=0.03)


def test_a_redescending_psi_finds_the_solution_next_to_its_start():
    X, y = DATA_SETS["hbk"]()
    robust = MEstimator("tukey").fit(X, y)
    trapped = MEstimator("tukey", start="least_squares").fit(X, y)
    assert float(robust.weights_[:10].max()) == 0.0
    assert float(trapped.weights_[:10].min()) > 0.5
    again = MEstimator("tukey", start=robust.coef_).fit(X, y)
    torch.testing.assert_close(again.coef_, robust.coef_, rtol=1e-7, atol=1e-9)
    assert int(again.n_iter_) <= 2


def test_each_channel_has_its_own_scale():
    X, Y = sample(0, 60, 2, 3), torch.zeros(60, 2).double()
    noise = sample(1, 60, 2) * torch.tensor([0.1, 100.0]).double()
    Y = X @ torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64) + noise
    fit = MEstimator().fit(X, Y)
    assert fit.scale_.shape == (2,)
    assert float(fit.scale_[1] / fit.scale_[0]) > 300
    # the noisy channel has no influence
    torch.testing.assert_close(fit.coef_, MEstimator().fit(X[:, 0], Y[:, 0]).coef_, rtol=0, atol=0.02)


def test_too_few_iterations_are_reported_as_not_converged():
    assert not bool(MEstimator(max_iter=1).fit(*DATA_SETS["telef"]()).converged_)


def test_a_median_of_fewer_than_twice_the_coefficients_is_refused():
    X, y = sample(0, 7, 4), sample(1, 7)
    with pytest.raises(ValueError, match=r"at least 8 samples .*`scale='mad'`.*4 coefficients.* got 7"):
        MEstimator().fit(X, y)
    weight = torch.ones(9).double()
    weight[7:] = 0.0
    with pytest.raises(ValueError, match="but got 7"):
        MEstimator().fit(sample(0, 9, 4), sample(1, 9), weight)
    assert bool(torch.isfinite(MEstimator(scale="proposal2", start="least_squares").fit(X, y).coef_).all())


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"scale": "iqr"}, "`scale` to be 'mad' or 'proposal2' but got 'iqr'"),
        (
            {"start": "zero"},
            "`start` to be 'lad', 'lts', 's', 'least_squares' or coefficients, or None, but got 'zero'",
        ),
        ({"max_iter": 0}, "`max_iter` to be a whole number of at least 1 but got 0"),
        ({"tol": 0.0}, r"`tol` to be in \(0, 1\) but got 0.0"),
        ({"tuning": -1.0}, "`tuning` of 'huber' to be one positive number but got -1.0"),
    ],
)
def test_bad_parameters_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        MEstimator(**kwargs)


def test_a_start_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match="`start` to be 3 finite coefficients"):
        MEstimator(start=torch.zeros(2)).fit(*contaminated_line(0))
