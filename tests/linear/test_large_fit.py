"""MKC-EM on many rows: converged, the same function as on few rows, in few passes and without copies of the data."""

import math

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from mkc_torch.density.likelihood import energy_derivatives
from mkc_torch.linear import MKCRegression, RankDeficientError, _block_sums, _large, _rows, em
from mkc_torch.linear._blocks import Density, energy_of
from mkc_torch.linear._many_rows import sandwich_of
from mkc_torch.linear._mkc import coefficient_covariance
from mkc_torch.linear._pilot import drawn_rows, pilot_problem
from mkc_torch.linear._problem import checked_shapes, linear_problem
from mkc_torch.linear._rows import Rows, blocks
from tests.draws import normal

N = 24_000
"""Rows of a fit that starts with a pilot."""


def sample(seed: int = 0, rows: int = N, n: int = 5, share: float = 0.1) -> tuple[Tensor, Tensor]:
    """y = X 1 + noise, the first rows with an outlier of 15: sorted, so that no block of rows is representative."""
    X = normal(seed, rows, n)
    X[:, 0] = 1.0
    y = X.sum(-1) + normal(seed + 1, rows)
    y[: int(share * rows)] += 15.0
    return X, y


def clustered() -> tuple[Tensor, Tensor]:
    """Two fifths of the rows are a far cluster of X with wrong y."""
    X, y = sample(share=0.0)
    bad = 2 * N // 5
    X[:bad, 1:] = 8.0 + 0.1 * normal(4, bad, 4)
    y[:bad] = X[:bad].sum(-1) - 40.0 + normal(5, bad)
    return X, y


def heavy_tailed() -> tuple[Tensor, Tensor]:
    X, y = sample(share=0.0)
    return X, y + 0.3 * normal(6, N) / normal(7, N).abs()


def channels() -> tuple[Tensor, Tensor]:
    """Two channels with their own columns and a common column, the first with outliers."""
    X = torch.zeros(N, 2, 3, dtype=torch.float64)
    X[..., 0] = 1.0
    X[:, 0, 1], X[:, 1, 2] = normal(2, N), normal(3, N)
    Y = X.sum(-1) + torch.tensor([0.5, 2.0]).double() * normal(4, N, 2)
    Y[: N // 5, 0] += 10.0
    return X, Y


def rare_column() -> tuple[Tensor, Tensor]:
    """A column that is 1 in 30 rows and 0 elsewhere."""
    X, y = sample()
    X = torch.cat([X, torch.zeros(N, 1).double()], 1)
    X[:: N // 30, -1] = 1.0
    return X, y + 1.5 * X[:, -1]


def rescaled_sample(
    move_x: float = 0.0, move_y: float = 0.0, unit_x: float = 1.0, unit_y: float = 1.0
) -> tuple[Tensor, Tensor]:
    X, y = sample()
    X[:, 1] = unit_x * X[:, 1] + move_x
    return X, unit_y * y + move_y


def sample_of_rounded_targets() -> tuple[Tensor, Tensor]:
    X, y = sample()
    return X, y.round()


HARD_CASES = {
    "sorted": sample,
    "forty per cent on one side": lambda: sample(share=0.4),
    "near outliers": lambda: (sample(share=0.0)[0], sample(share=0.0)[1] + 3.5 * (torch.arange(N) < N // 20)),
    "Gaussian": lambda: sample(share=0.0),
    "clustered at a leverage point": clustered,
    "heavy tails": heavy_tailed,
    "ties": sample_of_rounded_targets,
    "two channels": channels,
    "a column that is seldom other than 0": rare_column,
    "a column far from 0": lambda: rescaled_sample(move_x=1e8),
    "targets far from 0": lambda: rescaled_sample(move_y=1e8),
    "columns of different size": lambda: rescaled_sample(unit_x=1e-8),
    "targets of another unit": lambda: rescaled_sample(unit_y=1e-6),
}


@pytest.fixture
def ended_as_large(monkeypatch) -> list[bool]:
    """For each large fit, whether it ended by passes over blocks and not by the alternation over all rows."""
    ends: list[bool] = []
    whole = _large.large_maximum

    def recorded(*args, **kwargs):
        found = whole(*args, **kwargs)
        ends.append(found is not None)
        return found

    monkeypatch.setattr(em, "large_maximum", recorded)
    return ends


def fit_directly(monkeypatch) -> None:
    """Make all later fits direct, without a pilot sample."""
    monkeypatch.setattr(_large, "LARGE", 1 << 60)


def converged_fit(
    fit: MKCRegression, X: Tensor, Y: Tensor, weight: Tensor | None = None, **given: float
) -> MKCRegression:
    """The converged fit on the same domain, by the Newton steps of a differentiable fit."""
    polished = MKCRegression(bound=fit.bound_, start=fit.coef_, **given).fit(X.clone().requires_grad_(), Y, weight)
    polished.coef_, polished.sigma_, polished.d_ = (
        polished.coef_.detach(),
        polished.sigma_.detach(),
        polished.d_.detach(),
    )
    polished.weights_, polished.log_likelihood_ = polished.weights_.detach(), polished.log_likelihood_.detach()
    return polished


def difference_in_standard_errors(fit: MKCRegression, other: MKCRegression) -> float:
    """Largest difference of the coefficients, in standard errors."""
    return float(((fit.coef_ - other.coef_).abs() / other.standard_error_).detach().max())


@pytest.mark.parametrize("case", HARD_CASES)
def test_a_large_fit_is_fully_converged(case, ended_as_large):
    X, Y = HARD_CASES[case]()
    fit = MKCRegression().fit(X, Y)
    assert ended_as_large == [True]
    polished = converged_fit(fit, X, Y)
    # coefficients of 1e8 have coarser last digits
    assert difference_in_standard_errors(fit, polished) < (1e-4 if "far" in case else 1e-6)
    gaussian = torch.isinf(polished.sigma_)
    assert torch.equal(torch.isinf(fit.sigma_), gaussian)
    torch.testing.assert_close(fit.sigma_[~gaussian], polished.sigma_[~gaussian], rtol=1e-6, atol=0.0)
    torch.testing.assert_close(fit.d_, polished.d_, rtol=1e-7, atol=0.0)
    torch.testing.assert_close(fit.log_likelihood_, polished.log_likelihood_, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(fit.weights_, polished.weights_, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(fit.standard_error_, polished.standard_error_, rtol=1e-4, atol=0.0)
    assert bool(fit.converged_)
    assert not bool(fit.exact_fit_)


@pytest.mark.parametrize("case", HARD_CASES)
def test_a_large_fit_equals_a_direct_fit_of_all_rows(case, monkeypatch):
    X, Y = HARD_CASES[case]()
    fit = MKCRegression().fit(X, Y)
    fit_directly(monkeypatch)
    direct = MKCRegression().fit(X, Y)
    torch.testing.assert_close(fit.bound_, direct.bound_, rtol=0.02, atol=0.0)
    assert difference_in_standard_errors(fit, direct) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_a_large_fit_withstands_45_per_cent_outliers(seed, ended_as_large):
    X, y = sample(seed, n=15, share=0.45)
    fit = MKCRegression(seed=seed).fit(X, y)
    assert len(ended_as_large) == 1
    assert float((fit.coef_ - 1.0).abs().max()) < 0.1


@pytest.mark.parametrize(
    "given", [{"sigma": 2.0}, {"d": 1.1}, {"sigma": math.inf}, {"bound": 40.0}, {"sigma": 2.0, "d": 1.0}]
)
def test_given_parameters_are_kept(given, ended_as_large):
    X, y = sample()
    fit = MKCRegression(**given).fit(X, y)
    assert ended_as_large == [True]
    for name, value in given.items():
        assert float(getattr(fit, f"{name}_")) == pytest.approx(value)
    given.pop("bound", None)
    assert difference_in_standard_errors(fit, converged_fit(fit, X, y, **given)) < 1e-6


@pytest.mark.parametrize("start", ["s", "least_squares"])
def test_any_start_ends_at_the_same_maximum(start, ended_as_large):
    X, y = sample(share=0.02)
    fit = MKCRegression(start=start, bound=20.0).fit(X, y)
    given = MKCRegression(start=torch.zeros(5).double(), bound=20.0).fit(X, y)
    lts = MKCRegression(bound=20.0).fit(X, y)
    assert difference_in_standard_errors(fit, lts) < 1e-6
    assert difference_in_standard_errors(given, lts) < 1e-6
    assert ended_as_large[-1]


def test_weight_0_equals_removal_and_weight_2_equals_repetition(ended_as_large):
    X, y = sample()
    weight = torch.arange(N).double() % 3
    y[::3] = 1e6  # of no weight
    fit = MKCRegression().fit(X, y, weight)
    rows = torch.cat([torch.arange(N)[weight >= k] for k in (1, 2)])
    repeated = converged_fit(fit, X[rows], y[rows])
    assert ended_as_large[0]
    assert difference_in_standard_errors(fit, repeated) < 1e-6
    torch.testing.assert_close(fit.log_likelihood_, repeated.log_likelihood_, rtol=1e-9, atol=0.0)
    assert float(fit.bound_) < 100.0
    assert difference_in_standard_errors(fit, converged_fit(fit, X, y, weight)) < 1e-6


def test_the_fit_nearly_agrees_for_all_seeds_and_fully_on_a_given_domain():
    X, y = sample()
    fits = [MKCRegression(seed=seed).fit(X, y) for seed in range(4)]
    assert max(difference_in_standard_errors(fit, fits[0]) for fit in fits) < 1e-3
    fits = [MKCRegression(seed=seed, bound=20.0).fit(X, y) for seed in range(4)]
    assert max(difference_in_standard_errors(fit, fits[0]) for fit in fits) < 1e-6


def test_results_are_continuous_where_fits_become_large(monkeypatch, ended_as_large):
    X, y = sample(rows=6000)
    monkeypatch.setattr(_large, "LARGE", 6000)
    large = MKCRegression(bound=20.0).fit(X, y)
    monkeypatch.setattr(_large, "LARGE", 6001)
    small = MKCRegression(bound=20.0, tol=0.0).fit(X, y)
    assert ended_as_large == [True]
    assert difference_in_standard_errors(large, small) < 1e-4
    assert large.n_iter_ < small.n_iter_


def test_float32_data_are_summed_in_float64(monkeypatch):
    X, y = (v.float() for v in rescaled_sample(move_x=100.0))
    fit = MKCRegression(bound=20.0).fit(X, y)
    assert {fit.coef_.dtype, fit.weights_.dtype, fit.covariance_.dtype} == {torch.float32}
    exact = MKCRegression(bound=20.0).fit(X.double(), y.double())
    fit_directly(monkeypatch)
    direct = MKCRegression(bound=20.0).fit(X, y)
    off, direct_off = (((f.coef_ - exact.coef_) / exact.standard_error_).abs().max() for f in (fit, direct))
    assert off < 1e-4
    assert off < 0.1 * direct_off
    assert (fit.d_ - exact.d_).abs().max() < 1e-6


def test_results_have_the_shapes_of_a_direct_fit(monkeypatch):
    X, y = sample()
    Xc, Yc = channels()
    for x, t in ((X, y), (X[None], y[None]), (Xc, Yc), (Xc[None], Yc[None])):
        fit = MKCRegression().fit(x, t)
        with monkeypatch.context() as patch:
            fit_directly(patch)
            direct = MKCRegression().fit(x, t)
        assert set(vars(fit)) == set(vars(direct))
        for name, value in vars(direct).items():
            if isinstance(value, Tensor) and name != "history_":
                mine = getattr(fit, name)
                assert (mine.shape, mine.dtype) == (value.shape, value.dtype), name
        assert fit.history_.shape == (fit.n_iter_ + 1, *direct.history_.shape[1:])
        assert fit.predict(x).shape == t.shape
        torch.testing.assert_close(fit.dof_, direct.dof_)


def test_history_never_rises_and_ends_at_the_likelihood():
    X, y = sample()
    fit = MKCRegression().fit(X, y)
    assert (fit.history_.diff() <= 1e-13).all()
    torch.testing.assert_close(-N * fit.history_[-1], fit.log_likelihood_)


def test_gradients_through_a_large_fit_equal_differences(ended_as_large):
    X, y = sample()
    free = MKCRegression().fit(X, y)
    target = y.clone().requires_grad_()
    fit = MKCRegression(start="lts").fit(X, target)
    assert ended_as_large == [True, True]
    assert bool(fit.differentiable_)
    assert difference_in_standard_errors(free, fit) < 1e-6
    torch.testing.assert_close(fit.bound_.detach(), free.bound_)
    plain = MKCRegression(bound=20.0).fit(X, y)
    fit = MKCRegression(bound=20.0, start=plain.coef_).fit(X, target)
    assert difference_in_standard_errors(plain, fit) < 1e-6
    fit.coef_.sum().backward()
    change = torch.zeros(N).double()
    change[N // 2 :: 7] = 1e-3
    moved = MKCRegression(bound=20.0).fit(X, y + change).coef_.sum() - plain.coef_.sum()
    assert target.grad is not None
    assert float(moved) == pytest.approx(float((target.grad * change).sum()), rel=1e-3)


class LargestTensor(TorchDispatchMode):
    """Number of elements of the largest tensor that an operation creates, except views of ``given``."""

    def __init__(self, *given: Tensor) -> None:
        super().__init__()
        self.known = {t.untyped_storage().data_ptr() for t in given}
        self.most = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for t in result if isinstance(result, (tuple, list)) else (result,):
            if isinstance(t, Tensor) and t.untyped_storage().data_ptr() not in self.known:
                self.most = max(self.most, t.untyped_storage().nbytes() // max(1, t.element_size()))
        return result


def test_the_data_are_read_a_few_times_and_never_copied(monkeypatch):
    rows = 400_000
    X, y = sample(rows=rows)
    read = 0

    def counted(*args, **kwargs):
        nonlocal read
        for block in blocks(*args, **kwargs):
            read += block.y.shape[0]
            yield block

    monkeypatch.setattr(_rows, "blocks", counted)
    with LargestTensor(X, y) as largest:
        MKCRegression().fit(X, y)
    assert read < 12 * rows
    # the weights, and nothing larger at once
    assert largest.most == rows


@pytest.mark.parametrize("kappa", [0.0, 1e-4, 9.9e-3, 1.01e-2, 0.5])
@pytest.mark.parametrize("weighted", [False, True])
def test_sums_of_blocks_equal_those_of_all_rows(kappa, weighted, monkeypatch):
    X, Y = channels()
    weight = torch.arange(2 * N).double().reshape(N, 2) % 3 if weighted else None
    beta = torch.tensor([1.1, 0.9, 1.2]).double()
    density = Density(torch.tensor([kappa, 0.3]).double(), torch.tensor([0.5, 2.0]).double())
    total, curvature_sums, _ = Rows(X, Y, weight).evaluate(beta, density, with_curvature=True)
    assert curvature_sums is not None
    problem = linear_problem(X, Y, weight)
    in_basis = problem.in_basis(beta)
    normalised = None if weight is None else weight / weight.sum(0)
    log_d = torch.log(density.d)
    expected = energy_derivatives(problem.residual(in_basis)[0], normalised, density.kappa, log_d)
    for mine, value in zip(energy_of(total, density.kappa), expected, strict=True):
        torch.testing.assert_close(mine / total.weight, value, rtol=1e-7, atol=1e-9)
    covariance = coefficient_covariance(problem, in_basis, density.kappa[None], density.d[None], "sandwich", None)
    used = 2 * N if weight is None else int((weight > 0).sum())
    torch.testing.assert_close(sandwich_of(curvature_sums, used, used - 3), covariance, rtol=1e-7, atol=0.0)
    monkeypatch.setattr(_block_sums, "_STRIP", 100)
    monkeypatch.setattr(_rows, "blocks", lambda *args, **kwargs: blocks(*args, values=1234, **kwargs))
    again, transformed, _ = Rows(X, Y, weight).evaluate(beta, density, with_curvature=True)
    for reference, other in zip((*total, *curvature_sums), (*again, *(transformed or ())), strict=True):
        torch.testing.assert_close(reference, other, rtol=1e-9, atol=1e-6)


class SumsByTorch(_block_sums.BlockSums):
    """The sums by torch, as on a GPU, on the CPU."""

    def __init__(self, *args, **options) -> None:
        super().__init__(*args, **options)
        self._on_cpu, self._operations, self._number = False, torch, _block_sums._same
        for name, value in vars(self).items():
            if hasattr(value, "__array__") and not isinstance(value, Tensor):
                setattr(self, name, torch.from_numpy(value))


@pytest.mark.parametrize("kappa", [0.0, 1e-3, 0.3])
@pytest.mark.parametrize("weighted", [False, True])
def test_sums_by_torch_equal_sums_by_numpy(kappa, weighted, monkeypatch):
    X, Y = channels()
    rows = Rows(X, Y, (torch.arange(2 * N) % 3).double().reshape(N, 2) if weighted else None)
    density = Density(torch.tensor([kappa, 0.3]).double(), torch.tensor([0.5, 2.0]).double())
    by_numpy, by_torch = torch.empty_like(Y), torch.empty_like(Y)
    options = {"with_curvature": True, "with_range": True}
    expected = rows.evaluate(torch.ones(3).double(), density, weights=by_numpy, **options)
    monkeypatch.setattr(_rows, "BlockSums", SumsByTorch)
    found = rows.evaluate(torch.ones(3).double(), density, weights=by_torch, **options)
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(by_torch, by_numpy)


def test_sums_in_a_frame_are_those_of_transformed_columns():
    X, y = sample()
    frame = torch.linalg.inv(normal(9, 5, 5))
    density = Density(torch.tensor([0.2]).double(), torch.tensor([1.0]).double())
    beta = torch.ones(5).double()
    plain, curvature_sums, _ = Rows(X[:, None], y[:, None], None).evaluate(beta, density, with_curvature=True)
    framed, transformed, _ = Rows(X[:, None], y[:, None], None, frame).evaluate(
        torch.linalg.solve(frame, beta), density, with_curvature=True
    )
    assert curvature_sums is not None
    assert transformed is not None
    torch.testing.assert_close(framed.score, plain.score @ frame)
    torch.testing.assert_close(transformed.curvature, frame.mT @ curvature_sums.curvature @ frame)


def test_the_score_is_the_derivative_of_the_energy():
    X, y = sample(rows=1000)
    density = Density(torch.tensor([0.3]).double(), torch.tensor([1.2]).double())

    def energy_at(beta: Tensor) -> Tensor:
        found = Rows(X[:, None], y[:, None], None).evaluate(beta, density).total
        return torch.cat([energy_of(found, density.kappa).value, found.score.flatten()])

    beta, step = torch.full((5,), 0.9).double(), 1e-5
    for k in range(5):
        move = step * torch.eye(5).double()[k]
        slope = (energy_at(beta + move)[0] - energy_at(beta - move)[0]) / (2 * step)
        assert float(slope) == pytest.approx(-float(energy_at(beta)[1 + k] / density.d.square()), rel=1e-6)


def test_the_pilot_draws_rows_in_use_and_rare_rows_by_leverage():
    X, y = rare_column()
    weight = (torch.arange(N) % 2).double()
    index = drawn_rows(checked_shapes(X, y, weight), 2000, 0)
    assert (weight[index] == 1).all()
    assert (index.diff() > 0).all()
    found = pilot_problem(checked_shapes(X, y), 0)
    assert found is not None
    problem, alike = found
    assert not alike
    assert int((problem.basis[0, :, 0] @ torch.linalg.inv(problem.to_coef[0]))[:, -1].round().sum()) >= 25
    X, y = sample()
    found = pilot_problem(checked_shapes(X, y), 0)
    assert found is not None
    assert found[1]


def test_an_exact_fit_is_found_by_the_alternation(ended_as_large):
    X, y = sample()
    y[N // 10 :] = X[N // 10 :].sum(-1)
    fit = MKCRegression().fit(X, y)
    assert ended_as_large == [False]
    assert bool(fit.exact_fit_)


def test_a_more_likely_gaussian_is_found_by_the_alternation(ended_as_large, monkeypatch):
    X, y = sample(share=0.0)
    X[: N // 5, 1:] = 8.0 + 0.1 * normal(4, N // 5, 4)
    y[: N // 5] = X[: N // 5].sum(-1) - 40.0
    fit = MKCRegression().fit(X, y)
    assert ended_as_large == [False]
    fit_directly(monkeypatch)
    assert torch.equal(MKCRegression().fit(X, y).coef_, fit.coef_)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_values_that_are_not_finite_are_refused_with_their_index(value):
    X, y = sample()
    X[20_001, 2] = value
    with pytest.raises(ValueError, match=r"`X` to be finite but got .* at index \(20001, 2\)"):
        MKCRegression().fit(X, y)


def test_dependent_columns_are_refused():
    X, y = sample()
    with pytest.raises(RankDeficientError, match="linearly dependent"):
        MKCRegression().fit(torch.cat([X, X[:, :1]], 1), y)
    with pytest.raises(RankDeficientError, match="zero on every sample"):
        MKCRegression().fit(torch.cat([X, 0 * X[:, :1]], 1), y)


def test_negative_weights_and_a_narrow_bound_are_refused():
    X, y = sample()
    weight = torch.ones(N).double()
    weight[5] = -1.0
    with pytest.raises(ValueError, match="`sample_weight` to be >= 0"):
        MKCRegression().fit(X, y, weight)
    with pytest.raises(ValueError, match=r"`bound` .*two robust scales"):
        MKCRegression(bound=0.1).fit(X, y)


def test_a_time_series_is_fitted_directly(ended_as_large):
    X, y = sample()
    fit = MKCRegression(covariance="hac", bandwidth=3.0).fit(X, y)
    assert ended_as_large == []
    assert difference_in_standard_errors(fit, converged_fit(fit, X, y)) < 0.05


def test_the_fit_does_not_depend_on_memory_layout(ended_as_large):
    X, y = sample()
    fit = MKCRegression().fit(X, y)
    apart_in_memory = torch.stack([y, y], -1)[:, 0]
    assert not apart_in_memory.is_contiguous()
    for x in (X.mT.contiguous().mT, torch.cat([X, X], 1)[:, :5], X.flip(0).flip(0)):
        assert difference_in_standard_errors(MKCRegression().fit(x, apart_in_memory), fit) < 1e-6
    assert difference_in_standard_errors(MKCRegression().fit(X.numpy(), y.numpy()), fit) < 1e-6
    with torch.inference_mode():
        assert difference_in_standard_errors(MKCRegression().fit(X, y), fit) < 1e-6
    assert ended_as_large == [True] * 6
