"""Streamed MKC-EM: results equal to those in memory for any batches; resuming; refusals."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader, TensorDataset

from mkc_torch.linear import MKCRegression, NotFittedError, RankDeficientError, _rows
from mkc_torch.linear._blocks import Block, Density
from mkc_torch.linear._rows import Rows
from mkc_torch.linear.streaming import StreamChangedError, StreamedMKCRegression, from_memmap
from mkc_torch.linear.streaming._reservoir import Reservoir, merged


def problem(
    seed: int,
    N: int = 400,
    n: int = 3,
    m: int = 1,
    *,
    outliers: float = 0.2,
    leverage: bool = False,
    offset: float = 0.0,
    sort: bool = False,
) -> tuple[Tensor, Tensor]:
    """X with an intercept and Y = X 1 + 0.5 noise, with a share of outliers of up to 20."""
    g = torch.Generator().manual_seed(seed)
    X = torch.randn(N, m, n, generator=g, dtype=torch.float64)
    X[..., 0] = 1.0
    X[..., 1:] += offset
    Y = X.sum(-1) + 0.5 * torch.randn(N, m, generator=g, dtype=torch.float64)
    bad = int(outliers * N)
    Y[:bad] += 20.0 * torch.rand(bad, m, generator=g, dtype=torch.float64)
    if leverage:
        X[:bad, :, 1:] += 10.0
    if not sort:
        order = torch.randperm(N, generator=g)
        X, Y = X[order], Y[order]
    return (X, Y) if m > 1 else (X[:, 0], Y[:, 0])


def split_into_batches(*tensors: Tensor, rows: int = 97) -> list[tuple[Tensor, ...]]:
    return list(zip(*(t.split(rows) for t in tensors), strict=True))


def in_memory(X: Tensor, Y: Tensor, weight: Tensor | None = None, **arguments) -> MKCRegression:
    """The fit in memory, refined by Newton steps like differentiable fits."""
    fit = MKCRegression(**arguments).fit(X.clone().requires_grad_(), Y, weight)
    for name in ("coef_", "sigma_", "d_", "bound_", "log_likelihood_", "covariance_"):
        setattr(fit, name, getattr(fit, name).detach())
    return fit


def assert_same(fit: StreamedMKCRegression, memory: MKCRegression, tol: float = 1e-8) -> None:
    """A partial sample leaves the last pass, which sums the covariance, farther from the maximum than the result."""
    assert fit.converged_
    assert fit.coef_.dtype == torch.float64
    # standard error of one row: d, apart from what the columns have in common
    unit = memory.standard_error_ * memory.dof_.sqrt()
    torch.testing.assert_close(fit.coef_ / unit, memory.coef_ / unit, rtol=0, atol=tol)
    torch.testing.assert_close(fit.d_, memory.d_, rtol=tol, atol=0)
    torch.testing.assert_close(fit.sigma_.pow(-2), memory.sigma_.pow(-2), rtol=0, atol=tol)
    torch.testing.assert_close(fit.bound_, memory.bound_, rtol=tol, atol=0)
    torch.testing.assert_close(fit.log_likelihood_, memory.log_likelihood_, rtol=tol, atol=0)
    size, near = memory.covariance_.abs().max(), tol if fit.n_pilot_ == fit.n_rows_ else 1e-5
    torch.testing.assert_close(fit.covariance_ / size, memory.covariance_ / size, rtol=0, atol=near)
    assert fit.dof_ == memory.dof_


KINDS = {
    "clean": {"outliers": 0.0},
    "few outliers": {"outliers": 0.05, "n": 5},
    "many outliers": {"outliers": 0.4},
    "leverage": {"outliers": 0.1, "leverage": True},
    "sorted": {"sort": True},
    "two channels": {"m": 2},
    "three channels": {"m": 3, "n": 4, "outliers": 0.3},
    "offset": {"offset": 1e3},
    "nearly dependent": {"offset": 1e6},
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", KINDS)
def test_streamed_results_equal_those_in_memory(kind, seed):
    X, Y = problem(seed, **KINDS[kind])
    fit = StreamedMKCRegression().fit(split_into_batches(X, Y))
    assert_same(fit, in_memory(X, Y))
    assert fit.n_rows_ == fit.n_pilot_ == len(X)


@pytest.mark.parametrize("seed", [0, 2, 3])  # at 1 two maxima of the likelihood are in reach
@pytest.mark.parametrize("m", [1, 2])
def test_weighted_results_equal_those_in_memory(m, seed):
    X, Y = problem(seed, m=m)
    weight = torch.rand(Y.shape if seed else Y.shape[:1], generator=torch.Generator().manual_seed(seed)).double()
    weight[::7] = 0.0
    memory = in_memory(X, Y, weight)
    assert_same(StreamedMKCRegression().fit(split_into_batches(X, Y, weight)), memory)


def test_a_weight_of_two_equals_two_rows():
    X, Y = problem(0)
    weight = 1.0 + torch.arange(len(X)).double() % 2
    index = torch.arange(len(X)).repeat_interleave(weight.long())
    bound = 30.0
    reference = StreamedMKCRegression(bound=bound).fit(split_into_batches(X, Y, weight))
    other = StreamedMKCRegression(bound=bound).fit(split_into_batches(X[index], Y[index]))
    torch.testing.assert_close(reference.coef_, other.coef_, rtol=1e-9, atol=0)
    torch.testing.assert_close(reference.log_likelihood_, other.log_likelihood_, rtol=1e-9, atol=0)


@pytest.mark.parametrize("seed", [0, 2, 3])  # at 1 two maxima of the likelihood are in reach
@pytest.mark.parametrize("kind", ["clean", "many outliers", "leverage", "sorted", "two channels"])
def test_results_with_a_partial_sample_equal_those_in_memory_on_the_same_domain(kind, seed):
    X, Y = problem(seed, N=6000, **KINDS[kind])
    fit = StreamedMKCRegression(pilot=500).fit(split_into_batches(X, Y, rows=1000))
    assert fit.n_pilot_ == 500
    assert_same(fit, in_memory(X, Y, bound=fit.bound_))
    # and the domain is that of memory, apart from the error of the sample's rough fit
    torch.testing.assert_close(fit.bound_, MKCRegression().fit(X, Y).bound_, rtol=0.1, atol=0)


def test_the_domain_covers_the_residuals_of_all_rows():
    X, Y = problem(0, N=5000)
    Y[2345] += 1000.0
    fit = StreamedMKCRegression(pilot=200).fit(split_into_batches(X, Y, rows=1000))
    residual = Y - X @ fit.coef_
    assert 2.0 * float(fit.bound_) >= float(residual.max() - residual.min()) * 0.999


@pytest.mark.parametrize(
    "given", [{"sigma": 2.0}, {"sigma": math.inf}, {"d": 0.4}, {"bound": 25.0}, {"start": "s"}, {"start": [1.0] * 3}]
)
def test_given_parameters_give_the_results_in_memory(given):
    X, Y = problem(3)
    tensors = {k: torch.tensor(v).double() if isinstance(v, list) else v for k, v in given.items()}
    assert_same(StreamedMKCRegression(**given).fit(split_into_batches(X, Y)), in_memory(X, Y, **tensors))


def test_float32_rows_are_summed_in_float64():
    X, Y = (t.float() for t in problem(1, N=3000))
    fit = StreamedMKCRegression().fit(split_into_batches(X, Y, rows=500))
    assert_same(fit, in_memory(X.double(), Y.double()))


@pytest.fixture
def float32_passes(monkeypatch) -> list[bool]:
    """For each pass over a batch, whether its products were formed in float32."""
    passes: list[bool] = []
    whole = _rows.BlockSums

    def recorded(beta, density, memory, device, dtype, **options):
        passes.append(dtype == torch.float32)
        return whole(beta, density, memory, device, dtype, **options)

    monkeypatch.setattr(_rows, "BlockSums", recorded)
    return passes


def float32_table(mean: float, scale: float, N: int = 6000) -> tuple[Tensor, Tensor]:
    """Columns of means 0 and ``mean`` and standard deviations 1 and ``scale``, and Y with outliers, in float32."""
    X, _ = problem(1, N=N, n=4)
    X[:, 1] = mean + X[:, 1]
    X[:, 2] *= scale
    coef = torch.tensor([1.0, 1.0, 1.0 / scale, 1.0]).double()
    X, noise = X.float(), 0.5 * torch.randn(N, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    noise[: N // 5] += 20.0
    return X, (X.double() @ coef + noise).float()


@pytest.mark.parametrize(("mean", "scale", "single"), [(0.0, 1e4, True), (100.0, 1e-4, True), (1e4, 1e4, False)])
def test_passes_in_float32_do_not_change_the_result(mean, scale, single, float32_passes):
    """Near the maximum passes are in float64, and everywhere if residuals are too small for float32."""
    X, Y = float32_table(mean, scale)
    fit = StreamedMKCRegression(pilot=500).fit(split_into_batches(X, Y, rows=1000))
    assert any(float32_passes) == single
    assert_same(fit, in_memory(X.double(), Y.double(), bound=fit.bound_))
    assert fit.n_iter_ <= 7


def test_a_pass_in_float32_of_many_rows_loses_no_rank(float32_passes):
    """A million rows whose columns differ by a factor of 1e4 in every other row."""
    rows = np.full((1 << 20, 1, 2), 1e4, np.float32)
    rows[::2, 0, 1] = 1.0
    y = np.ones((1 << 20, 1), np.float32)
    density = Density(torch.tensor([1.0]).double(), torch.tensor([1.0]).double())
    for weight in (None, np.full_like(y, 0.5)):
        exact = Rows(rows, y, weight).evaluate(torch.zeros(2).double(), density, with_range=True)
        found = Rows(rows, y, weight).evaluate(torch.zeros(2).double(), density, with_range=True, rough=True)
        for mine, other in zip((*found.total, *found.extent), (*exact.total, *exact.extent), strict=True):
            torch.testing.assert_close(mine, other, rtol=1e-4, atol=0)
    assert float32_passes == [False, True] * 2


def test_a_pass_in_float32_has_the_exact_range_and_withstands_huge_outliers(float32_passes):
    X, Y = float32_table(0.0, 1.0)
    Y[7] = 1e25
    density = Density(torch.tensor([0.3]).double(), torch.tensor([0.5]).double())
    found, exact = (
        Rows(X[:, None], Y[:, None], None).evaluate(torch.ones(4).double(), density, with_range=True, rough=single)
        for single in (True, False)
    )
    assert float32_passes == [True, False]
    assert found.extent == exact.extent
    torch.testing.assert_close(found.total.score, exact.total.score, rtol=0, atol=1e-2)


def test_an_exact_fit_of_most_rows_is_found():
    X, Y = problem(0, outliers=0.0)
    Y = X @ torch.tensor([1.0, 2.0, 3.0]).double()
    Y[::4] += 5.0
    fit = StreamedMKCRegression().fit(split_into_batches(X, Y))
    assert fit.exact_fit_
    torch.testing.assert_close(fit.coef_, torch.tensor([1.0, 2.0, 3.0]).double(), rtol=1e-10, atol=0)


# --- batches


def test_results_do_not_depend_on_the_sizes_of_batches_and_blocks(monkeypatch):
    X, Y = problem(2, N=3000)
    reference = StreamedMKCRegression(pilot=300).fit(split_into_batches(X, Y, rows=3000))
    monkeypatch.setattr(_rows, "VALUES", 100)
    for rows in (7, 1000):
        other = StreamedMKCRegression(pilot=300).fit(split_into_batches(X, Y, rows=rows))
        torch.testing.assert_close(reference.coef_, other.coef_, rtol=1e-10, atol=0)
        torch.testing.assert_close(reference.covariance_, other.covariance_, rtol=1e-8, atol=1e-15)
        assert torch.allclose(reference.bound_, other.bound_, rtol=1e-12)


def test_a_shuffling_loader_gives_the_results_in_memory():
    X, Y = problem(4, N=2000)
    loader = DataLoader(TensorDataset(X, Y), batch_size=300, shuffle=True, generator=torch.Generator().manual_seed(0))
    fit = StreamedMKCRegression(pilot=300, bound=20.0).fit(loader)
    assert_same(fit, in_memory(X, Y, bound=20.0))


def block_of(values: np.ndarray) -> Block:
    rows = torch.from_numpy(values)
    return Block(rows.reshape(-1, 1, 1), rows.reshape(-1, 1), None)


def test_a_reservoir_samples_rows_uniformly():
    rows = np.arange(40.0)
    counts = np.zeros(40)
    for seed in range(500):
        sample = Reservoir(10, seed)
        for part in np.split(rows, [3, 25]):
            sample.add(block_of(part))
        drawn = sample.drawn()
        assert (np.diff(drawn.numbers) > 0).all()
        assert (drawn.rows[:, 0] == drawn.numbers).all()
        counts[drawn.numbers] += 1
    # 125 of 500 draws each, with a standard deviation of 9.7
    assert abs(counts - 125).max() < 4.5 * 9.7


def test_merged_samples_of_parts_equal_the_sample_of_all_rows():
    rows = np.arange(100.0)
    whole = Reservoir(20, seed=1)
    whole.add(block_of(rows))
    parts = []
    for first in (0, 30):
        part = rows[first : 30 if first == 0 else None]
        sample = Reservoir(20, seed=1, first=first)
        sample.add(block_of(part))
        parts.append(sample.drawn())
    assert (merged(parts, 20).numbers == whole.drawn().numbers).all()


# --- results


@pytest.mark.e2e
def test_predictions_weights_intervals_and_summary_equal_those_in_memory():
    X, Y = problem(0)
    fit, memory = StreamedMKCRegression().fit(split_into_batches(X, Y)), in_memory(X, Y)
    torch.testing.assert_close(fit.predict(X), X @ fit.coef_)
    torch.testing.assert_close(fit.weights(X, Y), memory.weights_.detach(), rtol=0, atol=1e-8)
    torch.testing.assert_close(fit.confidence_interval(), memory.confidence_interval().detach(), rtol=1e-6, atol=1e-9)
    mine, other = fit.summary(), memory.summary()
    assert (mine.num_values, mine.num_light, mine.kind) == (other.num_values, other.num_light, "sandwich")
    assert (fit.history_.diff() <= 1e-12).all()
    with pytest.raises(AttributeError, match=r"weights\(X, Y\)"):
        fit.weights_
    with pytest.raises(ValueError, match="Expected argument `Y` of shape"):
        fit.weights(X, Y[:-1])


def test_weights_of_several_channels_equal_those_in_memory():
    X, Y = problem(3, m=2)
    fit, memory = StreamedMKCRegression().fit(split_into_batches(X, Y)), in_memory(X, Y)
    torch.testing.assert_close(fit.weights(X, Y), memory.weights_.detach(), rtol=0, atol=1e-8)


def test_parameters_are_shown_by_repr_and_can_be_set():
    fit = StreamedMKCRegression(pilot=100)
    assert "pilot=100" in repr(fit)
    assert fit.set_params(pilot=200).get_params()["pilot"] == 200
    with pytest.raises(NotFittedError, match=r"fit\(batches\)"):
        fit.coef_


# --- resuming


class InterruptedBatches(list):
    """Batches that raise KeyboardInterrupt in the middle of a pass."""

    def __init__(self, batches, passes):
        super().__init__(batches)
        self.left = passes

    def __iter__(self):
        self.left -= 1
        for number, batch in enumerate(super().__iter__()):
            if self.left < 0 and number == 2:
                raise KeyboardInterrupt
            yield batch


@pytest.mark.parametrize("passes", range(1, 6))
def test_an_interrupted_fit_resumes(passes, tmp_path):
    X, Y = problem(5, N=2000)
    batches, path = split_into_batches(X, Y), tmp_path / "fit.pt"
    whole = StreamedMKCRegression(pilot=200).fit(batches)
    assert whole.n_iter_ > 5
    broken = StreamedMKCRegression(pilot=200)
    with pytest.raises(KeyboardInterrupt):
        broken.fit(InterruptedBatches(batches, passes), checkpoint=path)
    counted = InterruptedBatches(batches, 1000)
    again = StreamedMKCRegression(pilot=200).fit(counted, checkpoint=path)
    assert 1000 - counted.left == whole.n_iter_ - passes
    taken_over = StreamedMKCRegression(pilot=200)
    taken_over.load_state_dict(broken.state_dict())
    taken_over.fit(batches)
    for other in (again, taken_over):
        for name in ("coef_", "sigma_", "d_", "bound_", "covariance_", "history_"):
            assert torch.equal(getattr(other, name), getattr(whole, name)), name
        assert other.n_iter_ == whole.n_iter_
    assert path.stat().st_size < 20_000


@pytest.mark.parametrize("moved", [1e-14, 1e-2])
def test_recorded_passes_are_repeated_only_at_different_points(moved):
    """Rounding on another processor changes the points of a resumed fit slightly; other steps lead to other points."""
    X, Y = problem(5, N=2000)
    whole, broken = StreamedMKCRegression(pilot=200).fit(split_into_batches(X, Y)), StreamedMKCRegression(pilot=200)
    with pytest.raises(KeyboardInterrupt):
        broken.fit(InterruptedBatches(split_into_batches(X, Y), whole.n_iter_ - 2))
    state = broken.state_dict()
    state["passes"] = tuple((point * (1.0 + moved), sums) for point, sums in state["passes"])
    again, counted = StreamedMKCRegression(pilot=200), InterruptedBatches(split_into_batches(X, Y), 1000)
    again.load_state_dict(state)
    again.fit(counted)
    assert 1000 - counted.left == (2 if moved < 1e-6 else whole.n_iter_ - 1)
    assert again.n_iter_ == whole.n_iter_
    torch.testing.assert_close(again.coef_, whole.coef_, rtol=1e-12, atol=0)


def test_a_state_resumes_only_with_its_data_and_parameters(tmp_path):
    X, Y = problem(5, N=2000)
    path = tmp_path / "fit.pt"
    StreamedMKCRegression(pilot=200).fit(split_into_batches(X, Y), checkpoint=path)
    with pytest.raises(StreamChangedError, match="1999, after 2000"):
        StreamedMKCRegression(pilot=200).fit(split_into_batches(X[1:], Y[1:]), checkpoint=path)
    other = Y.clone()
    other[7] += 1.0
    with pytest.raises(StreamChangedError, match=r"same values.*every pass"):
        StreamedMKCRegression(pilot=200).fit(split_into_batches(X, other), checkpoint=path)
    with pytest.raises(ValueError, match=r"batch.*first, 3 columns without weights"):
        StreamedMKCRegression(pilot=200).fit(split_into_batches(X[:, :2], Y), checkpoint=path)
    with pytest.raises(ValueError, match=r"`pilot` .*200, .*got 300"):
        StreamedMKCRegression(pilot=300).fit(split_into_batches(X, Y), checkpoint=path)
    path.write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"`checkpoint` .*StreamedMKCRegression"):
        StreamedMKCRegression(pilot=200).fit(split_into_batches(X, Y), checkpoint=path)
    with pytest.raises(ValueError, match="Expected a state of StreamedMKCRegression"):
        StreamedMKCRegression().load_state_dict({"format": 0})
    with pytest.raises(NotFittedError):
        StreamedMKCRegression().state_dict()


def test_a_second_fit_starts_over():
    X, Y = problem(5)
    fit = StreamedMKCRegression().fit(split_into_batches(X, Y))
    X, Y = problem(6, m=2)
    assert_same(fit.fit(split_into_batches(X, Y)), in_memory(X, Y))


# --- refusals


class ChangingBatches:
    """Batches that differ from pass to pass."""

    def __init__(self, *passes):
        self.passes = itertools.cycle(passes)

    def __iter__(self):
        return iter(next(self.passes))


def test_a_stream_that_changes_between_passes_is_refused():
    X, Y = problem(0)
    with pytest.raises(StreamChangedError, match="387, after 400 in the first"):
        StreamedMKCRegression(bound=30.0).fit(
            ChangingBatches(split_into_batches(X, Y), split_into_batches(X[:387], Y[:387]))
        )
    for bound in (None, 30.0):
        with pytest.raises(StreamChangedError, match="remove random transforms"):
            StreamedMKCRegression(bound=bound).fit(
                ChangingBatches(split_into_batches(X, Y), split_into_batches(X, Y + 0.01))
            )


def test_single_use_iterables_are_refused():
    X, Y = problem(0)
    with pytest.raises(TypeError, match="can be read once; pass a DataLoader"):
        StreamedMKCRegression().fit(batch for batch in split_into_batches(X, Y))
    with pytest.raises(TypeError, match="from_memmap"):
        StreamedMKCRegression().fit(X)
    with pytest.raises(TypeError, match="an iterable of"):
        StreamedMKCRegression().fit(3)


def test_bad_values_are_refused_naming_batch_and_row():
    X, Y = problem(0)
    for name, where in (("X", X[:, 1]), ("Y", Y)):
        value, where[210] = where[210].clone(), math.nan
        with pytest.raises(ValueError, match=rf"`{name}` .*finite.* got nan in row 16 of batch 2"):
            StreamedMKCRegression().fit(split_into_batches(X, Y))
        where[210] = value
    weight = torch.ones(len(X)).double()
    weight[300] = -1.0
    with pytest.raises(ValueError, match=r"`weight` .*finite.*>= 0.* got -1\.0 in row 9 of batch 3"):
        StreamedMKCRegression().fit(split_into_batches(X, Y, weight))


def test_batches_of_wrong_shape_or_type_are_refused():
    X, Y = problem(0)
    pairs = split_into_batches(X, Y)
    fit = StreamedMKCRegression()
    with pytest.raises(ValueError, match=r"3 columns without weights.* got 2 columns without weights in batch 5"):
        fit.fit([*pairs, (X[:, :2], Y)])
    with pytest.raises(ValueError, match="3 columns with weights in batch 5"):
        fit.fit([*pairs, (X, Y, Y.abs())])
    with pytest.raises(ValueError, match=r"\(400, 3\) and \(399,\) in batch 0"):
        fit.fit([(X, Y[1:])])
    with pytest.raises(ValueError, match=r"one channel is Y.squeeze\(-1\)"):
        fit.fit([(X, Y[:, None])])
    with pytest.raises(ValueError, match="Expected weights of shape"):
        fit.fit([(X, Y, Y[1:])])
    with pytest.raises(TypeError, match="Expected every batch to be"):
        fit.fit([X, Y])
    with pytest.raises(TypeError, match="dict of 2 as batch 0"):
        fit.fit([{"X": X, "Y": Y}])
    with pytest.raises(TypeError, match="to be real"):
        fit.fit([(X.to(torch.complex128), Y)])
    for nothing in ([], [(X[:0], Y[:0])]):
        with pytest.raises(ValueError, match="to have rows but got none"):
            fit.fit(nothing)
    with pytest.raises(ValueError, match=r"at least 3 .*3 coefficients"):
        fit.fit([(X[:2], Y[:2])])
    with pytest.raises(ValueError, match="weights to be positive somewhere"):
        fit.fit([(X, Y, torch.zeros_like(Y))])
    with pytest.raises(ValueError, match="of a magnitude between"):
        fit.fit([(X, 1e90 * Y)])


def test_dependent_columns_are_refused():
    X, Y = problem(0, N=3000)
    with pytest.raises(RankDeficientError, match=r"columns \[1, 3\] are linearly dependent"):
        StreamedMKCRegression().fit(split_into_batches(torch.cat([X, 2.0 * X[:, 1:2]], 1), Y))
    with pytest.raises(RankDeficientError, match="Column 2 of `X` is zero"):
        StreamedMKCRegression().fit(split_into_batches(X * torch.tensor([1.0, 1.0, 0.0]), Y))
    rare = torch.zeros(len(X), 1).double()
    rare[1234] = 1.0
    with pytest.raises(RankDeficientError, match="raise `pilot`"):
        StreamedMKCRegression(pilot=100).fit(split_into_batches(torch.cat([X, rare], 1), Y))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"pilot": 1}, "`pilot` to be a whole number of at least 2"),
        ({"max_passes": 3}, "`max_passes` to be a whole number of at least 4"),
        ({"sigma": 0.01}, "`sigma`"),
        ({"d": -1.0}, "`d`"),
        ({"start": "best"}, "`start`"),
    ],
)
def test_arguments_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        StreamedMKCRegression(**arguments)


def test_too_few_passes_are_reported():
    X, Y = problem(5, N=2000)
    fit = StreamedMKCRegression(pilot=50, max_passes=4).fit(split_into_batches(X, Y))
    assert not fit.converged_
    assert fit.n_iter_ == 4
    assert torch.isfinite(fit.coef_).all()


def test_an_array_in_memory_is_split_into_batches():
    X, Y = problem(1)
    fit = StreamedMKCRegression().fit(from_memmap(X.numpy(), Y.numpy(), rows=33))
    assert_same(fit, in_memory(X, Y))
