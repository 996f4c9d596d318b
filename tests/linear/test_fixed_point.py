"""The fixed point under the MKC loss: published solutions, equation (15), its objective and its covariance."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mkc_torch.linear import FixedPointLinear, LeastSquares, RankDeficientError, SRegression
from mkc_torch.linear._problem import linear_problem
from mkc_torch.linear._robust_start import robust_start
from mkc_torch.linear.covariance import andrews_bandwidth, long_run_covariance
from tests.draws import normal as sample
from tests.literature import DATA_SETS, REFERENCE


def lstsq(X: Tensor, y: Tensor) -> Tensor:
    return torch.linalg.lstsq(X, y.unsqueeze(-1)).solution.squeeze(-1)


def contaminated_line(seed: int, N: int = 60, n: int = 3, share: float = 0.3) -> tuple[Tensor, Tensor]:
    X = torch.cat([torch.ones(N, 1).double(), sample(seed, N, n - 1)], 1)
    y = X.sum(-1) + 0.5 * sample(seed + 1, N)
    y[: int(share * N)] += 10.0 + sample(seed + 2, int(share * N))
    return X, y


def channels(seed: int, N: int = 50, m: int = 3, n: int = 4) -> tuple[Tensor, Tensor]:
    X = sample(seed, N, m, n)
    Y = X.sum(-1) + torch.tensor([0.2, 1.0, 5.0]).double()[:m] * sample(seed + 1, N, m)
    Y[:8] += 20.0
    return X, Y


def loss(X: Tensor, Y: Tensor, coef: Tensor, sigma: Tensor, d: Tensor) -> float:
    """(9) of the paper."""
    e = Y - X @ coef
    return float((sigma**2 * (1 - torch.exp(-(e**2) / (2 * d**2 * sigma**2)))).sum(-1).mean())


def equation_15(X: Tensor, Y: Tensor, coef: Tensor, sigma: Tensor, d: Tensor) -> Tensor:
    """The right-hand side of (15), by explicit sums over samples and channels."""
    n = X.shape[-1]
    gram, moment = torch.zeros(n, n, dtype=X.dtype), torch.zeros(n, dtype=X.dtype)
    for X_k, y_k in zip(X, Y, strict=True):
        e = y_k - X_k @ coef
        W = torch.diag(torch.exp(-(e**2) / (2 * d**2 * sigma**2)) / d**2)
        gram += X_k.mT @ W @ X_k
        moment += X_k.mT @ W @ y_k
    return torch.linalg.solve(gram, moment)


# least squares as the limit


def test_an_infinite_sigma_equals_least_squares():
    X, y = contaminated_line(0)
    fit = FixedPointLinear(sigma=math.inf, d=2.0).fit(X, y)
    torch.testing.assert_close(fit.coef_, lstsq(X, y), rtol=1e-12, atol=1e-12)
    assert torch.equal(fit.weights_, torch.ones(60, 1).double())
    assert bool(fit.converged_)
    torch.testing.assert_close(fit.history_[-1], 0.5 * ((y - X @ fit.coef_) / 2.0).square().mean())


def test_an_infinite_sigma_equals_least_squares_weighted_by_sample_and_channel():
    X, Y = channels(0)
    weight, d = sample(7, 50, 3).exp(), torch.tensor([0.2, 1.0, 5.0], dtype=torch.float64)
    root = (weight.sqrt() / d).flatten()
    expected = lstsq(X.reshape(150, 4) * root.unsqueeze(-1), Y.flatten() * root)
    fit = FixedPointLinear(sigma=math.inf, d=d).fit(X, Y, weight)
    torch.testing.assert_close(fit.coef_, expected, rtol=1e-10, atol=1e-11)


def test_infinite_and_finite_sigma_can_be_mixed_between_channels():
    X, Y = channels(0, m=2)
    sigma, d = torch.tensor([math.inf, 1.5], dtype=torch.float64), torch.tensor([4.0, 1.0], dtype=torch.float64)
    fit = FixedPointLinear(sigma=sigma, d=d).fit(X, Y)
    wide = torch.tensor([1e8, 1.5], dtype=torch.float64)
    torch.testing.assert_close(equation_15(X, Y, fit.coef_, wide, d), fit.coef_, rtol=1e-5, atol=1e-6)
    assert torch.equal(fit.weights_[:, 0], torch.ones(50).double())


def test_gradients_at_an_infinite_sigma_equal_those_of_least_squares():
    X, y = contaminated_line(0, N=12)
    leaf = y.clone().requires_grad_()
    (slope,) = torch.autograd.grad(FixedPointLinear(sigma=math.inf).fit(X, leaf).coef_.sum(), leaf)
    torch.testing.assert_close(slope, torch.linalg.pinv(X).sum(0))


# published fixed points


def published_coef(name: str, h: float, start: str) -> Tensor:
    found = [r for r in REFERENCE[name].mkc if r.h == h and start in (r.starts or (start,))]
    return torch.tensor(found[0].coef, dtype=torch.float64)


@pytest.mark.parametrize("start", ["least_squares", "s", "lts"])
def test_stackloss_at_h_4_has_the_published_solution(start):
    fit = FixedPointLinear(sigma=2.0, d=2.0, start=start).fit(*DATA_SETS["stackloss"]())
    torch.testing.assert_close(fit.coef_, published_coef("stackloss", 4.0, "s"), rtol=1e-5, atol=0)


def test_hbk_from_the_s_estimate_has_the_published_solution():
    X, y = DATA_SETS["hbk"]()
    fit = FixedPointLinear(sigma=1.5, d=1.0, start=SRegression().fit(X, y).coef_).fit(X, y)
    torch.testing.assert_close(fit.coef_, published_coef("hbk", 1.5, "s"), rtol=1e-5, atol=0)


def test_hbk_from_the_named_s_start_has_the_published_solution():
    fit = FixedPointLinear(sigma=1.5, d=1.0, start="s").fit(*DATA_SETS["hbk"]())
    torch.testing.assert_close(fit.coef_, published_coef("hbk", 1.5, "s"), rtol=1e-5, atol=0)


@pytest.mark.filterwarnings("ignore:FixedPointLinear follows the bad leverage points:UserWarning")
def test_hbk_from_least_squares_ends_at_the_published_local_minimum():
    fit = FixedPointLinear(sigma=1.5, d=1.0, start="least_squares").fit(*DATA_SETS["hbk"]())
    torch.testing.assert_close(fit.coef_, published_coef("hbk", 1.5, "least_squares"), rtol=1e-5, atol=0)


@pytest.mark.filterwarnings("ignore:FixedPointLinear follows the bad leverage points:UserWarning")
def test_the_robust_minimum_is_kept_where_leverage_points_form_a_lower_minimum():
    X, y = DATA_SETS["hbk"]()
    fit = FixedPointLinear(sigma=1.5, d=1.0).fit(X, y)
    trapped = FixedPointLinear(sigma=1.5, d=1.0, start="least_squares").fit(X, y)
    assert float(trapped.history_[-1]) < float(fit.history_[-1])
    torch.testing.assert_close(fit.coef_, published_coef("hbk", 1.5, "s"), rtol=1e-5, atol=1e-8)


def test_telef_at_h_1_has_the_published_solution():
    fit = FixedPointLinear(sigma=1.0, d=1.0).fit(*DATA_SETS["telef"]())
    torch.testing.assert_close(fit.coef_, published_coef("telef", 1.0, "s"), rtol=1e-5, atol=0)


@settings(derandomize=True, deadline=None, max_examples=6)
@given(ratio=st.floats(0.01, 100.0))
def test_one_channel_depends_on_sigma_times_d_alone(ratio):
    X, y = contaminated_line(0)
    reference, other = FixedPointLinear(sigma=3.0, d=0.5).fit(X, y), FixedPointLinear(sigma=3.0 * ratio, d=0.5 / ratio)
    torch.testing.assert_close(other.fit(X, y).coef_, reference.coef_, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(other.weights_, reference.weights_, rtol=0, atol=1e-6)
    torch.testing.assert_close(other.covariance_, reference.covariance_, rtol=1e-4, atol=1e-9)


# the equation and its objective


@pytest.mark.parametrize("seed", range(3))
def test_the_solution_satisfies_equation_15(seed):
    X, Y = channels(10 * seed)
    sigma, d = torch.tensor([2.0, 1.0, 4.0]).double(), torch.tensor([0.2, 1.0, 5.0]).double()
    fit = FixedPointLinear(sigma=sigma, d=d).fit(X, Y)
    torch.testing.assert_close(equation_15(X, Y, fit.coef_, sigma, d), fit.coef_, rtol=1e-5, atol=1e-6)
    e = Y - X @ fit.coef_
    torch.testing.assert_close(fit.weights_, torch.exp(-(e**2) / (2 * d**2 * sigma**2)))


def test_a_single_step_equals_equation_15():
    X, Y = channels(0)
    sigma, d, begin = torch.tensor([2.0, 1.0, 4.0]).double(), torch.tensor([0.2, 1.0, 5.0]).double(), sample(5, 4)
    fit = FixedPointLinear(sigma=sigma, d=d, start=begin, max_iter=1).fit(X, Y)
    torch.testing.assert_close(fit.coef_, equation_15(X, Y, begin, sigma, d), rtol=1e-9, atol=1e-10)
    assert fit.n_iter_ == 1


@pytest.mark.parametrize("start", ["lts", "s", "least_squares"])
def test_history_is_the_true_objective_and_never_increases(start):
    X, Y = channels(0)
    sigma, d = torch.tensor([0.7, 0.5, 1.0]).double(), torch.tensor([0.2, 1.0, 5.0]).double()
    fit = FixedPointLinear(sigma=sigma, d=d, start=start).fit(X, Y)
    assert len(fit.history_) == fit.n_iter_ + 1
    assert float(fit.history_[-1]) == pytest.approx(loss(X, Y, fit.coef_, sigma, d), rel=1e-12)
    assert bool((fit.history_.diff() <= 1e-13 * fit.history_[:-1].abs()).all())


def test_history_begins_at_the_given_start():
    X, Y = channels(0)
    sigma, d, begin = torch.full((3,), 2.0).double(), torch.tensor([0.2, 1.0, 5.0]).double(), sample(5, 4)
    fit = FixedPointLinear(sigma=sigma, d=d, start=begin).fit(X, Y)
    assert float(fit.history_[0]) == pytest.approx(loss(X, Y, begin, sigma, d), rel=1e-12)


def test_the_objective_counts_sample_weights():
    X, y = contaminated_line(0)
    count = 1 + (torch.arange(60) % 3)
    fit = FixedPointLinear(sigma=2.0).fit(X, y, count.double())
    repeated = FixedPointLinear(sigma=2.0).fit(X.repeat_interleave(count, 0), y.repeat_interleave(count))
    torch.testing.assert_close(fit.coef_, repeated.coef_, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(fit.history_[-1], repeated.history_[-1], rtol=1e-9, atol=0)


def test_convergence_is_reported():
    X, y = contaminated_line(0)
    assert bool(FixedPointLinear(sigma=2.0).fit(X, y).converged_)
    short = FixedPointLinear(sigma=2.0, max_iter=1, start=torch.zeros(3).double()).fit(X, y)
    assert short.n_iter_ == 1
    assert not bool(short.converged_)


def test_a_small_bandwidth_finds_the_majority_among_one_sided_outliers():
    X, y = contaminated_line(0, share=0.4)
    fit = FixedPointLinear(sigma=1.5, d=0.5).fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.ones(3).double(), rtol=0, atol=0.4)
    assert float(fit.weights_[:24].max()) < 1e-6


# noise covariance


def test_a_noise_covariance_equals_whitening():
    X, Y = channels(0, m=2)
    covariance = torch.tensor([[2.0, 0.6], [0.6, 0.5]], dtype=torch.float64)
    inverse = torch.from_numpy(np.linalg.inv(np.linalg.cholesky(covariance.numpy())))
    white_X, white_Y = torch.einsum("ij,kjn->kin", inverse, X), Y @ inverse.mT
    fit = FixedPointLinear(sigma=2.0, noise_covariance=covariance).fit(X, Y)
    torch.testing.assert_close(fit.coef_, FixedPointLinear(sigma=2.0).fit(white_X, white_Y).coef_)
    # at σ = inf it is generalised least squares, whatever the root
    gls = FixedPointLinear(sigma=math.inf, noise_covariance=covariance).fit(X, Y).coef_
    P = torch.linalg.inv(covariance)
    gram = torch.einsum("kin,ij,kjl->nl", X, P, X)
    torch.testing.assert_close(gls, torch.linalg.solve(gram, torch.einsum("kin,ij,kj->n", X, P, Y)))


def test_a_diagonal_noise_covariance_equals_d_squared():
    X, Y = channels(0)
    d = torch.tensor([0.2, 1.0, 5.0], dtype=torch.float64)
    fit = FixedPointLinear(sigma=2.0, noise_covariance=torch.diag(d**2)).fit(X, Y)
    torch.testing.assert_close(fit.coef_, FixedPointLinear(sigma=2.0, d=d).fit(X, Y).coef_, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    "covariance", [torch.eye(3), torch.tensor([[1.0, 2.0], [2.0, 1.0]]), torch.tensor([[1.0, 0.5], [0.0, 1.0]])]
)
def test_an_invalid_noise_covariance_is_refused(covariance):
    with pytest.raises(ValueError, match="`noise_covariance`"):
        FixedPointLinear(noise_covariance=covariance).fit(*channels(0, m=2))


def test_a_noise_covariance_of_one_channel_is_refused():
    with pytest.raises(ValueError, match="takes `d`"):
        FixedPointLinear(noise_covariance=torch.eye(1)).fit(*contaminated_line(0))


# covariance of the coefficients


def sandwich_by_hand(X: Tensor, Y: Tensor, coef: Tensor, sigma: float, d: Tensor) -> Tensor:
    n = X.shape[-1]
    H, B = torch.zeros(n, n).double(), torch.zeros(n, n).double()
    for X_k, y_k in zip(X, Y, strict=True):
        z = (y_k - X_k @ coef) / d
        w = torch.exp(-(z**2) / (2 * sigma**2))
        H += X_k.mT @ torch.diag(w * (1 - z**2 / sigma**2) / d**2) @ X_k
        score = X_k.mT @ (w * z / d)
        B += torch.outer(score, score)
    values = Y.numel()
    inverse = torch.linalg.inv(H)
    return values / (values - n) * inverse @ B @ inverse


@pytest.mark.parametrize("sigma", [1.5, 4.0, math.inf])
def test_sandwich_equals_the_formula(sigma):
    X, Y = channels(0)
    d = torch.tensor([0.2, 1.0, 5.0], dtype=torch.float64)
    fit = FixedPointLinear(sigma=sigma, d=d).fit(X, Y)
    torch.testing.assert_close(fit.covariance_, sandwich_by_hand(X, Y, fit.coef_, sigma, d), rtol=1e-8, atol=1e-12)


def test_sandwich_equals_inverse_curvature_and_scores_by_automatic_differentiation():
    X, y = contaminated_line(0)
    fit = FixedPointLinear(sigma=2.0, d=0.5).fit(X, y)

    def summed(coef: Tensor) -> Tensor:
        return (4.0 * (1 - torch.exp(-(((y - X @ coef) / 0.5) ** 2) / 8.0))).sum()

    H = torch.func.jacrev(torch.func.grad(summed))(fit.coef_)
    e = (y - X @ fit.coef_) / 0.5
    score = X * (e * torch.exp(-(e**2) / 8.0) / 0.5).unsqueeze(-1)
    expected = 60 / 57 * torch.linalg.inv(H) @ score.mT @ score @ torch.linalg.inv(H)
    torch.testing.assert_close(fit.covariance_, expected, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("sigma", [4.0, math.inf])
def test_sandwich_errors_equal_the_spread_of_repeated_experiments(sigma):
    X = torch.cat([torch.ones(80, 1).double(), sample(0, 80, 2)], 1)
    noise = sample(1, 800, 80) * (0.5 + X[:, 1].abs())  # heteroscedastic
    fit = FixedPointLinear(sigma=sigma, start=torch.ones(3).double()).fit(X, X.sum(-1) + noise)
    spread = fit.coef_.T.cov().diagonal().sqrt()
    predicted = fit.covariance_.mean(0).diagonal().sqrt()
    torch.testing.assert_close(predicted, spread, rtol=0.12, atol=0)


def bartlett_by_hand(score: np.ndarray, lags: float) -> np.ndarray:
    N = len(score)
    total = np.zeros((score.shape[1],) * 2)
    for s in range(N):
        for t in range(N):
            if abs(s - t) <= math.floor(lags):
                total += (1 - abs(s - t) / (lags + 1)) * np.outer(score[s], score[t])
    return total


@pytest.mark.parametrize("lags", [0.0, 1.0, 3.0, 7.0])
def test_hac_equals_newey_and_west(lags):
    X, y = contaminated_line(0)
    fit = FixedPointLinear(sigma=2.0, d=0.5, covariance="hac", bandwidth=lags).fit(X, y)
    z = (y - X @ fit.coef_) / 0.5
    w = torch.exp(-(z**2) / 8.0)
    score = (X * (w * z / 0.5).unsqueeze(-1)).numpy()
    H = (X.mT @ (X * (w * (1 - z**2 / 4.0) / 0.25).unsqueeze(-1))).numpy()
    expected = 60 / 57 * np.linalg.inv(H) @ bartlett_by_hand(score, lags) @ np.linalg.inv(H)
    np.testing.assert_allclose(fit.covariance_.numpy(), expected, rtol=1e-8)


def test_hac_of_no_lags_equals_the_sandwich():
    X, y = contaminated_line(0)
    plain = FixedPointLinear(sigma=2.0).fit(X, y).covariance_
    torch.testing.assert_close(
        FixedPointLinear(sigma=2.0, covariance="hac", bandwidth=0.0).fit(X, y).covariance_, plain
    )


def ar1(seed: int, rho: float, *shape: int) -> Tensor:
    steps = sample(seed, *shape)
    out = [steps[..., 0] / math.sqrt(1 - rho**2)]
    for t in range(1, shape[-1]):
        out.append(rho * out[-1] + steps[..., t])
    return torch.stack(out, -1)


def test_under_autocorrelation_hac_errors_equal_the_spread_and_sandwich_errors_are_too_small():
    X = torch.stack([torch.ones(2000), torch.linspace(-1, 1, 2000)], -1).double()
    y = X.sum(-1) + ar1(0, 0.9, 150, 2000)
    plain = FixedPointLinear(sigma=math.inf).fit(X, y)
    hac = FixedPointLinear(sigma=math.inf, covariance="hac").fit(X, y)
    spread = plain.coef_.T.cov().diagonal().sqrt()
    of_plain = plain.covariance_.mean(0).diagonal().sqrt()
    of_hac = hac.covariance_.mean(0).diagonal().sqrt()
    assert bool((of_plain < 0.4 * spread).all())
    assert bool((of_hac > 3.0 * of_plain).all())
    torch.testing.assert_close(of_hac, spread, rtol=0.25, atol=0)


def test_andrews_bandwidth_equals_the_published_formula():
    score = ar1(0, 0.6, 1, 500).mT  # (500, 1)
    e = (score[:, 0] - score.mean()).numpy()
    rho = (e[1:] * e[:-1]).sum() / (e**2).sum()
    alpha = 4 * rho**2 / ((1 - rho) ** 2 * (1 + rho) ** 2)
    assert float(andrews_bandwidth(score)) == pytest.approx(1.1447 * (alpha * 500) ** (1 / 3), rel=1e-9)


def test_long_run_covariance_of_white_noise_is_positive_semi_definite():
    score = sample(0, 5, 40, 3)
    total = long_run_covariance(score, torch.tensor([0.0, 1.0, 4.0, 10.0, 39.0], dtype=torch.float64))
    assert bool((torch.linalg.eigvalsh(total) > -1e-9).all())


# forms of input


def test_batch_equals_loop():
    problems = [channels(10 * s) for s in range(4)]
    X, Y = torch.stack([p[0] for p in problems]), torch.stack([p[1] for p in problems])
    sigma = torch.tensor([[2.0, 1.0, 4.0]]).double() * torch.arange(1, 5).double().unsqueeze(-1)
    fit = FixedPointLinear(sigma=sigma.reshape(2, 2, 3)).fit(X.reshape(2, 2, 50, 3, 4), Y.reshape(2, 2, 50, 3))
    assert fit.coef_.shape == (2, 2, 4)
    for i in range(4):
        alone = FixedPointLinear(sigma=sigma[i]).fit(X[i], Y[i])
        torch.testing.assert_close(fit.coef_.reshape(4, 4)[i], alone.coef_, rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(fit.covariance_.reshape(4, 4, 4)[i], alone.covariance_, rtol=1e-5, atol=1e-9)
        torch.testing.assert_close(fit.weights_.reshape(4, 50, 3)[i], alone.weights_, rtol=0, atol=1e-7)


def test_a_shared_design_equals_a_loop_over_targets():
    X, y = contaminated_line(0)
    Y = torch.stack([y, y.flip(0), 0.1 * y, y + 5.0])
    fit = FixedPointLinear(sigma=2.0).fit(X, Y)
    assert fit.coef_.shape == (4, 3)
    for i in range(4):
        torch.testing.assert_close(fit.coef_[i], FixedPointLinear(sigma=2.0).fit(X, Y[i]).coef_, rtol=1e-6, atol=1e-8)


def test_the_fit_is_equivariant_to_column_scales():
    X, y = contaminated_line(0, n=4)
    factor = torch.tensor([1e-8, 1.0, 1e3, 1e8], dtype=torch.float64)
    reference, other = FixedPointLinear(sigma=2.0).fit(X, y), FixedPointLinear(sigma=2.0).fit(X * factor, y)
    torch.testing.assert_close(other.coef_ * factor, reference.coef_, rtol=1e-7, atol=1e-8)
    scaled = other.covariance_ * factor * factor.unsqueeze(-1)
    torch.testing.assert_close(scaled, reference.covariance_, rtol=1e-5, atol=1e-10)


def test_dependent_columns_are_refused_by_name():
    X, y = contaminated_line(0)
    with pytest.raises(RankDeficientError, match=r"columns \[0, 3\]"):
        FixedPointLinear().fit(torch.cat([X, 2.0 * X[:, :1]], 1), y)


def test_a_zero_column_is_refused():
    X, y = contaminated_line(0)
    with pytest.raises(RankDeficientError, match="Column 1"):
        FixedPointLinear().fit(X * torch.tensor([1.0, 0.0, 1.0]).double(), y)


def test_fewer_values_than_coefficients_are_refused():
    with pytest.raises(ValueError, match=r"at least 4 .*4 coefficients.* got 3"):
        FixedPointLinear().fit(sample(0, 3, 4), sample(1, 3))


def test_as_many_values_as_coefficients_are_interpolated():
    X, y = sample(0, 4, 4), sample(1, 4)
    fit = FixedPointLinear().fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.linalg.solve(X, y), rtol=1e-9, atol=1e-10)
    assert bool(torch.isinf(fit.covariance_).all())


def test_exactly_fitted_samples_have_weight_one_and_outliers_weight_zero():
    X, _ = contaminated_line(0)
    truth = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    y = X @ truth
    y[:24] += 30.0
    fit = FixedPointLinear(sigma=1.0, d=1.0).fit(X, y)
    torch.testing.assert_close(fit.coef_, truth, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(fit.weights_[:, 0], (torch.arange(60) >= 24).double())
    assert bool(fit.converged_)


def test_weight_zero_equals_removal():
    X, y = contaminated_line(0)
    weight = (torch.arange(60) % 4 > 0).double()
    dirty = torch.where(weight > 0, y, 1e6)
    fit = FixedPointLinear(sigma=2.0).fit(X, dirty, weight)
    alone = FixedPointLinear(sigma=2.0).fit(X[weight > 0], y[weight > 0])
    torch.testing.assert_close(fit.coef_, alone.coef_, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(fit.covariance_, alone.covariance_, rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(fit.history_[-1], alone.history_[-1], rtol=1e-9, atol=0)


def test_float32_stays_float32():
    X, y = contaminated_line(0)
    fit = FixedPointLinear(sigma=2.0).fit(X.float(), y.float())
    assert fit.coef_.dtype == fit.covariance_.dtype == fit.history_.dtype == torch.float32
    assert bool(fit.converged_)
    torch.testing.assert_close(fit.coef_.double(), FixedPointLinear(sigma=2.0).fit(X, y).coef_, rtol=1e-3, atol=1e-3)


# errors


@pytest.mark.parametrize("name", ["sigma", "d"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, torch.tensor([1.0, 0.0, 1.0])])
def test_parameters_that_are_not_positive_are_refused(name, value):
    with pytest.raises(ValueError, match=f"`{name}`"):
        FixedPointLinear(**{name: value}).fit(*channels(0))


def test_an_infinite_d_is_refused():
    with pytest.raises(ValueError, match="`d`"):
        FixedPointLinear(d=math.inf).fit(*channels(0))


@pytest.mark.parametrize("name", ["sigma", "d"])
def test_parameters_of_the_wrong_shape_are_refused(name):
    with pytest.raises(ValueError, match=f"`{name}`"):
        FixedPointLinear(**{name: torch.ones(2)}).fit(*channels(0))


@pytest.mark.parametrize("name", ["sigma", "d"])
def test_parameters_of_other_batch_dimensions_are_refused(name):
    with pytest.raises(ValueError, match=f"`{name}`"):
        FixedPointLinear(**{name: torch.ones(5, 3)}).fit(*channels(0))


@pytest.mark.parametrize(("argument", "value"), [("start", "ols"), ("covariance", "iid"), ("max_iter", 0)])
def test_unknown_options_are_refused(argument, value):
    with pytest.raises(ValueError, match=f"`{argument}`"):
        FixedPointLinear(**{argument: value}).fit(*contaminated_line(0))


def test_every_start_reaches_a_unique_minimum():
    X, y = contaminated_line(0, share=0.0)
    expected = FixedPointLinear(sigma=20.0).fit(X, y).coef_
    for start in ("s", "least_squares", LeastSquares().fit(X, y).coef_):
        got = FixedPointLinear(sigma=20.0, start=start).fit(X, y).coef_
        torch.testing.assert_close(got, expected, rtol=1e-7, atol=1e-8)


def test_graduation_from_a_wide_bandwidth_reaches_a_lower_minimum():
    generator = torch.Generator().manual_seed(0)
    X = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    Y = X.sum(-1) + torch.randn(60, 100, generator=generator, dtype=torch.float64)
    Y[:, :20] += 15.0
    problem = linear_problem(X, Y)
    lower = higher = 0
    for seed in range(3):
        start = problem.coefficients(robust_start(problem, seed=seed).beta)
        led = FixedPointLinear(sigma=0.2, seed=seed).fit(X, Y)
        alone = FixedPointLinear(sigma=0.2, start=start).fit(X, Y)
        lower += int((led.history_[-1] < alone.history_[-1] - 1e-9).sum())
        higher += int((led.history_[-1] > alone.history_[-1] + 1e-9).sum())
        assert float((led.coef_ - 1).norm(dim=-1).mean()) < float((alone.coef_ - 1).norm(dim=-1).mean())
    assert lower >= 30
    assert lower > 1.25 * higher
