"""Least trimmed squares: the published and the exhaustive optimum, breakdown, equivariance."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm
from torch import Tensor

from mkc_torch.linear import LeastSquares, LeastTrimmedSquares, least_trimmed_squares
from mkc_torch.linear._problem import linear_problem
from mkc_torch.linear.least_trimmed_squares import TrimmedScale, gaussian_consistency, order_statistic
from tests.draws import normal as sample
from tests.linear.test_mm_regression import clustered_outliers
from tests.literature import COLEMAN_LTS, DATA_SETS, REFERENCE


def lstsq(X: Tensor, y: Tensor) -> Tensor:
    return torch.linalg.lstsq(X, y.unsqueeze(-1), driver="gelsd").solution.squeeze(-1)


def contaminated_line(seed: int, N: int = 40, n: int = 3, share: float = 0.3) -> tuple[Tensor, Tensor]:
    """X with an intercept column and y = X 1 + noise, with outliers in the first rows."""
    X = torch.cat([torch.ones(N, 1).double(), sample(seed, N, n - 1)], 1)
    y = X.sum(-1) + 0.1 * sample(seed + 1, N)
    y[: int(share * N)] += 10.0 + sample(seed + 2, int(share * N))
    return X, y


def exhaustive(X: Tensor, y: Tensor, h: int) -> tuple[float, Tensor]:
    subsets = torch.tensor(list(itertools.combinations(range(len(y)), h)))
    coef = lstsq(X[subsets], y[subsets])
    sums = (y[subsets] - (X[subsets] @ coef.unsqueeze(-1)).squeeze(-1)).square().sum(-1)
    best = int(sums.argmin())
    return float(sums[best]), coef[best]


# published and exhaustive optima


@pytest.mark.parametrize("name", [n for n in REFERENCE if REFERENCE[n].lts is not None])
def test_the_published_optimum_is_found(name):
    X, y = DATA_SETS[name]()
    reference = REFERENCE[name].lts
    fit = LeastTrimmedSquares().fit(X, y)
    assert float(fit.objective_) == pytest.approx(reference.objective, rel=1e-6)
    torch.testing.assert_close(fit.coef_, torch.tensor(reference.coef, dtype=torch.float64), rtol=1e-5, atol=0)
    assert int(fit.weights_.sum()) == reference.h
    assert bool(fit.converged_)


@pytest.mark.parametrize("name", [n for n in REFERENCE if REFERENCE[n].lts is not None])
def test_rows_rejected_at_two_and_a_half_scales_include_the_published_rows(name):
    X, y = DATA_SETS[name]()
    fit = LeastTrimmedSquares().fit(X, y)
    far = (y - fit.predict(X)).abs() / fit.scale_ > 2.5
    assert {r - 1 for r in REFERENCE[name].lts.rejected} <= set(far.nonzero().flatten().tolist())


@pytest.mark.parametrize("choices", [0, 20_000], ids=["searched", "all choices"])
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("N", "n", "h"), [(9, 2, 6), (10, 3, 7), (8, 1, 5), (11, 2, 8), (12, 3, 12)])
def test_the_optimum_equals_the_search_over_all_subsets(seed, N, n, h, choices, monkeypatch):
    monkeypatch.setattr(least_trimmed_squares, "EXHAUSTIVE_CHOICES", choices)
    X, y = sample(seed, N, n), sample(seed + 100, N) * torch.exp(sample(seed + 200, N))
    objective, coef = exhaustive(X, y, h)
    fit = LeastTrimmedSquares(h=h).fit(X, y)
    assert fit.exact_ == (choices > 0 or h == N)
    assert float(fit.objective_) == pytest.approx(objective, rel=1e-9)
    torch.testing.assert_close(fit.coef_, coef, rtol=1e-6, atol=1e-8)


def test_the_optimum_of_coleman_equals_the_search_over_all_subsets():
    X, y = DATA_SETS["coleman"]()
    reference = COLEMAN_LTS
    fit = LeastTrimmedSquares().fit(X, y)
    assert int(fit.weights_.sum()) == reference.h
    assert float(fit.objective_) == pytest.approx(reference.objective, rel=1e-8)
    torch.testing.assert_close(fit.coef_, torch.tensor(reference.coef, dtype=torch.float64), rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", DATA_SETS)
def test_every_seed_finds_the_same_optimum(name):
    X, y = DATA_SETS[name]()
    found = [float(LeastTrimmedSquares(seed=s).fit(X, y).objective_) for s in range(1, 9)]
    assert max(found) == pytest.approx(min(found), rel=1e-9)


def test_no_exchange_of_two_samples_lowers_the_sum():
    X, y = contaminated_line(4)
    fit = LeastTrimmedSquares(starts=3).fit(X, y)
    keep = fit.weights_[:, 0] > 0
    pairs = [(i, j) for i in keep.nonzero().flatten().tolist() for j in (~keep).nonzero().flatten().tolist()]
    others = torch.stack([keep] * len(pairs))
    for row, (i, j) in enumerate(pairs):
        others[row, i], others[row, j] = False, True
    index = others.nonzero()[:, 1].reshape(len(pairs), -1)
    coef = lstsq(X[index], y[index])
    sums = (y[index] - (X[index] @ coef.unsqueeze(-1)).squeeze(-1)).square().sum(-1)
    assert float(sums.min()) >= float(fit.objective_) * (1 - 1e-9)


def test_the_gradient_equals_that_of_least_squares_on_the_values_kept():
    X, y = contaminated_line(0)
    keep = LeastTrimmedSquares().fit(X, y).weights_[:, 0]
    for leaf in (X, y):
        leaf.requires_grad_()
        (got,) = torch.autograd.grad(LeastTrimmedSquares().fit(X, y).coef_.sum(), leaf)
        (expected,) = torch.autograd.grad(LeastSquares().fit(X, y, keep).coef_.sum(), leaf)
        torch.testing.assert_close(got, expected)


def test_the_smallest_coverage_is_one_sample_more_than_coefficients():
    X, y = sample(1, 9, 2), sample(2, 9)
    assert int(LeastTrimmedSquares(h=3).fit(X, y).weights_.sum()) == 3
    assert int(LeastTrimmedSquares(h=9).fit(X, y).weights_.sum()) == 9
    for h in (2, 10):
        with pytest.raises(ValueError, match=rf"`h` .*3 .*9 samples.* got {h}"):
            LeastTrimmedSquares(h=h).fit(X, y)


def test_coverage_of_all_samples_equals_least_squares():
    X, y = contaminated_line(0)
    torch.testing.assert_close(LeastTrimmedSquares(h=40).fit(X, y).coef_, LeastSquares().fit(X, y).coef_)


def test_objective_scale_and_weights_follow_from_the_coefficients():
    X, y = contaminated_line(3)
    fit = LeastTrimmedSquares(h=25).fit(X, y)
    square = (y - X @ fit.coef_).square()
    kept = square.sort().values[:25]
    assert float(fit.objective_) == pytest.approx(float(kept.sum()), rel=1e-10)
    torch.testing.assert_close(fit.weights_[:, 0], (square <= kept[-1]).double())
    q = norm.ppf(0.5 * (1 + 25 / 40))
    factor = (1 - 2 * q * norm.pdf(q) / (25 / 40)) ** -0.5
    assert float(fit.scale_) == pytest.approx(factor * math.sqrt(float(kept.mean())), rel=1e-10)


def test_scale_of_gaussian_residuals_is_their_standard_deviation():
    fit = LeastTrimmedSquares(starts=20).fit(torch.ones(1, 20_000, 1).double(), 3.0 * sample(0, 1, 20_000))
    assert float(fit.scale_) == pytest.approx(3.0, rel=0.02)
    assert gaussian_consistency(1.0) == 1.0


# order statistics and the trimmed objective


def test_order_statistic_counts_ties():
    values = torch.tensor([3.0, 1.0, 2.0, 2.0, 2.0, 5.0], dtype=torch.float64).reshape(1, 6, 1)
    assert [float(order_statistic(values, None, h)) for h in range(1, 7)] == [1, 2, 2, 2, 3, 5]
    unit_weight = torch.ones_like(values)
    assert [float(order_statistic(values, unit_weight, h)) for h in range(1, 7)] == [1, 2, 2, 2, 3, 5]


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    values=st.lists(st.tuples(st.integers(0, 4), st.integers(1, 3)), min_size=3, max_size=8),
    share=st.floats(0.05, 1.0),
)
def test_weighted_order_statistic_equals_that_of_repeated_values(values, share):
    value = torch.tensor([float(v) for v, _ in values], dtype=torch.float64)
    count = torch.tensor([c for _, c in values])
    repeated = value.repeat_interleave(count).sort().values
    h = share * len(values)
    position = math.ceil(h / len(values) * int(count.sum()) - 1e-9)
    got = order_statistic(value.reshape(1, -1, 1), count.double().reshape(1, -1, 1), h)
    assert float(got) == float(repeated[position - 1])


@settings(derandomize=True, deadline=None, max_examples=20)
@given(values=st.lists(st.tuples(st.integers(-3, 3), st.integers(1, 3)), min_size=4, max_size=9), h=st.integers(2, 4))
def test_trimmed_scale_with_ties_equals_that_of_repeated_values(values, h):
    residual = torch.tensor([float(v) for v, _ in values], dtype=torch.float64)
    count = torch.tensor([c for _, c in values])
    N = len(values)
    problem = linear_problem(torch.ones(N, 1).double(), residual, count.double())
    got = TrimmedScale(h / N).scale(problem, residual.reshape(1, 1, N, 1))
    # h / N of the total weight, the last value in part
    square = residual.repeat_interleave(count).square().sort().values
    total = h / N * len(square)
    whole = int(total + 1e-9)
    expected = float(square[:whole].sum()) + (total - whole) * (float(square[whole]) if whole < len(square) else 0.0)
    assert float(got) ** 2 == pytest.approx(expected / total, abs=1e-12)


def test_integer_weights_equal_repetition():
    X, y = contaminated_line(0)
    weight = 1.0 + (torch.arange(40) % 2).double()
    repeated = LeastTrimmedSquares(h=33).fit(X.repeat_interleave(weight.long(), 0), y.repeat_interleave(weight.long()))
    fit = LeastTrimmedSquares(h=22).fit(X, y, weight)  # 22 / 40 = 33 / 60
    torch.testing.assert_close(fit.objective_, repeated.objective_, rtol=1e-9, atol=0)
    torch.testing.assert_close(fit.coef_, repeated.coef_, rtol=1e-9, atol=1e-10)


def test_weight_zero_equals_removal():
    X, y = contaminated_line(0, 30)
    junk_X, junk_y = 5.0 + sample(9, 20, 3), torch.full((20,), 1e3, dtype=torch.float64)
    weight = torch.cat([torch.ones(30), torch.zeros(20)]).double()
    fit = LeastTrimmedSquares(h=30).fit(torch.cat([X, junk_X]), torch.cat([y, junk_y]), weight)
    alone = LeastTrimmedSquares(h=18).fit(X, y)  # 30 / 50 = 18 / 30
    torch.testing.assert_close(fit.coef_, alone.coef_, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(fit.objective_, alone.objective_, rtol=1e-8, atol=0)


# equivariance


def test_the_fit_is_equivariant_to_column_scales():
    X, y = contaminated_line(0)
    factor = torch.tensor([1e-8, 1.0, 1e8], dtype=torch.float64)
    coef = LeastTrimmedSquares().fit(X, y).coef_
    torch.testing.assert_close(LeastTrimmedSquares().fit(X * factor, y).coef_ * factor, coef, rtol=1e-8, atol=1e-9)


def test_a_shared_design_equals_a_loop_over_targets():
    X, y = contaminated_line(0)
    Y = torch.stack([y, y.flip(0), 3.0 * y])
    fit = LeastTrimmedSquares().fit(X, Y)
    for i in range(3):
        torch.testing.assert_close(fit.coef_[i], LeastTrimmedSquares().fit(X, Y[i]).coef_, rtol=1e-8, atol=1e-9)


# breakdown and exact fits


def test_a_fit_of_many_samples_is_a_fixed_point_on_all_samples():
    X = torch.cat([torch.ones(4000, 1).double(), sample(0, 4000, 2)], 1)
    y = X.sum(-1) + 0.1 * sample(1, 4000)
    y[:1600] = 30.0 + 5.0 * sample(2, 1600)
    fit = LeastTrimmedSquares(starts=50).fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.ones(3).double(), rtol=0, atol=0.03)
    kept = (y - X @ fit.coef_).square().sort().values[: int(fit.weights_.sum())]
    assert float(fit.objective_) == pytest.approx(float(kept.sum()), rel=1e-9)
    keep = fit.weights_[:, 0] > 0
    torch.testing.assert_close(lstsq(X[keep], y[keep]), fit.coef_, rtol=1e-6, atol=1e-8)


def test_an_exact_fit_is_found_with_forty_per_cent_outliers():
    X = torch.cat([torch.ones(50, 1).double(), sample(0, 50, 2)], 1)
    y = X @ torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    y[:20] = 50.0 + sample(1, 20)
    fit = LeastTrimmedSquares().fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64), rtol=1e-12, atol=1e-12)
    assert float(fit.scale_) < 1e-13
    assert bool(torch.isfinite(fit.weights_).all())
    assert float(fit.weights_[:20].sum()) == 0.0


# channels


def two_channels(seed: int, factor: float) -> tuple[Tensor, Tensor]:
    X = torch.stack([torch.cat([torch.ones(60, 1).double(), sample(seed + k, 60, 1)], 1) for k in range(2)], -2)
    Y = X.sum(-1) + 0.1 * sample(seed + 2, 60, 2)
    Y[:20, 0] += 9.0
    Y[30:55, 1] -= 7.0
    unit = torch.tensor([1.0, factor], dtype=torch.float64)
    return X * unit.unsqueeze(-1), Y * unit


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_the_fit_is_equivariant_to_the_unit_of_a_channel(factor):
    reference, other = (
        LeastTrimmedSquares().fit(*two_channels(0, 1.0)),
        LeastTrimmedSquares().fit(*two_channels(0, factor)),
    )
    torch.testing.assert_close(other.coef_, reference.coef_, rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(other.scale_, reference.scale_ * torch.tensor([1.0, factor]).double(), rtol=1e-7, atol=0)
    torch.testing.assert_close(other.weights_, reference.weights_)
    torch.testing.assert_close(reference.coef_, torch.ones(2).double(), rtol=0, atol=0.1)


def test_each_channel_is_trimmed_separately():
    fit = LeastTrimmedSquares().fit(*two_channels(0, 1.0))
    h = int(fit.weights_[:, 0].sum())
    assert h == (60 + 1 + 1) // 2
    assert fit.weights_.sum(0).tolist() == [h, h]
    assert float(fit.weights_[:20, 0].sum()) == 0.0
    assert float(fit.weights_[30:55, 1].sum()) == 0.0


def test_a_channel_fitted_exactly_does_not_hide_the_others():
    X, Y = two_channels(0, 1.0)
    Y[:, 0] = X[:, 0].sum(-1)
    fit = LeastTrimmedSquares().fit(X, Y)
    torch.testing.assert_close(fit.coef_, torch.ones(2).double(), rtol=0, atol=1e-9)
    assert bool(torch.isfinite(fit.scale_).all())


# parameters


@pytest.mark.parametrize("h", [1, 3, 41])
def test_a_coverage_out_of_range_is_refused(h):
    with pytest.raises(ValueError, match=r"`h` .*4 .*40 samples.* got"):
        LeastTrimmedSquares(h=h).fit(*contaminated_line(0))


def test_zero_starts_are_refused():
    with pytest.raises(ValueError, match="`starts`"):
        LeastTrimmedSquares(starts=0)


def test_equal_seeds_give_equal_results():
    X, y = sample(0, 30, 4), sample(1, 30)
    state = torch.random.get_rng_state()
    reference, other = LeastTrimmedSquares(starts=3, seed=5).fit(X, y), LeastTrimmedSquares(starts=3, seed=5).fit(X, y)
    assert torch.equal(reference.coef_, other.coef_)
    assert torch.equal(torch.random.get_rng_state(), state)  # the global generator is not used


def test_the_seed_chooses_the_starts():
    X, y, _ = clustered_outliers(0, 1)
    # with weights no exchange improves the result of the starts
    found = {float(LeastTrimmedSquares(starts=4, seed=s).fit(X[0], y[0], torch.ones(300)).objective_) for s in range(8)}
    assert len(found) > 1


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_order_statistic_equals_that_of_torch_in_any_layout_and_under_any_transform(channels, dtype):
    values = torch.randn(channels, 9, 4, generator=torch.Generator().manual_seed(5)).to(dtype).movedim(0, -1)
    expected = values.kthvalue(3, dim=-2).values
    assert torch.equal(order_statistic(values, None, 3), expected)
    assert torch.equal(order_statistic(values.mT.contiguous().mT, None, 2.5), expected)
    assert torch.equal(torch.func.vmap(lambda v: order_statistic(v, None, 3))(values), expected)
    tangent = torch.func.jvp(lambda v: order_statistic(v, None, 3), (values,), (2.0 * values,))[1]
    assert torch.equal(tangent, 2.0 * expected)
    leaf = values.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(order_statistic(leaf, None, 3).sum(), leaf)
    assert torch.equal(gradient, (values == expected.unsqueeze(-2)).to(dtype))
