import contextlib
import math
import os
import socket
from unittest import mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import distributed as dist
from torch import multiprocessing
from torch.utils._python_dispatch import TorchDispatchMode

from mkc_torch import MKCDistribution, fit_density
from mkc_torch.lightning import residual_histogram
from mkc_torch.lightning.residual_histogram import BINS, ResidualHistogram

INF, NAN = math.inf, math.nan
WEIGHTS = {
    "none": lambda *_: None,
    "mask": lambda *shape: torch.rand(shape) < 0.6,
    "counts": lambda *shape: torch.randint(0, 3, shape),
    "weights": lambda *shape: torch.rand(shape) * (torch.rand(shape) < 0.8),
}


def residual_draws(*shape, sigma=2.0, d=0.5, bound=20.0, seed=0):
    """Residuals of a heavy-tailed density."""
    torch.manual_seed(seed)
    return MKCDistribution(torch.tensor(sigma).double(), torch.tensor(d).double(), bound).sample(shape)


def histogram_of(*batches, bound=20.0, channel_dim=-1, on_accelerator=False):
    m = (batches[0][0] if isinstance(batches[0], tuple) else batches[0]).shape[channel_dim]
    histogram = ResidualHistogram(None if bound is None else torch.full((m,), bound), num_channels=m)
    for batch in batches:
        with simulated_accelerator() if on_accelerator else contextlib.nullcontext():
            histogram.add(*(batch if isinstance(batch, tuple) else (batch, None)), channel_dim)
    return histogram


def simulated_accelerator():
    """Treat tensors of the CPU like those of an accelerator."""
    return mock.patch.object(residual_histogram, "_can_read", return_value=False)


class RefuseReads(TorchDispatchMode):
    """Fails if Python reads a value or a shape depends on a value: on an accelerator the host would wait."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = str(func)
        assert not any(part in name for part in ("_local_scalar_dense", "nonzero", "masked_select")), name
        indices = args[1] if name.startswith("aten.index.") else ()
        assert not any(i is not None and i.dtype == torch.bool for i in indices), "an index by a boolean mask"
        return func(*args, **(kwargs or {}))


def second_moment(histogram):
    error, weight = histogram.residuals()
    return (weight * error**2).sum(0)


def fitted(histogram, bound=20.0):
    error, weight = histogram.residuals()
    return fit_density(error, weight=weight, bound=bound, d_min=1e-4)


# --- the density fitted to it


@pytest.mark.parametrize(("sigma", "d"), [(1.5, 2.0), (2.0, 0.5), (3.0, 0.01), (INF, 1.5)])
@pytest.mark.parametrize("weighted", [False, True])
def test_a_density_fitted_to_the_histogram_equals_that_of_the_residuals(sigma, d, weighted):
    error = residual_draws(4000, 2, sigma=sigma, d=d)
    weight = torch.rand(4000, 2, dtype=torch.float64) if weighted else None
    raw = fit_density(error, weight=weight, bound=20.0, d_min=1e-4)
    found = fitted(histogram_of((error, weight)))
    torch.testing.assert_close(found.d, raw.d, rtol=1e-4, atol=0)
    torch.testing.assert_close(found.sigma.pow(-2), raw.sigma.pow(-2), rtol=1e-3, atol=5e-5)
    torch.testing.assert_close(found.log_likelihood, raw.log_likelihood, rtol=0, atol=5e-5)


def test_residuals_beyond_the_bound_have_the_density_of_the_flat_tail():
    error = torch.cat([residual_draws(1000, 1), torch.tensor([[25.0], [-80.0], [1e30], [20.0], [-20.0]])])
    histogram = histogram_of(error)
    assert histogram.share_beyond().item() == pytest.approx(3 / 1005)
    torch.testing.assert_close(fitted(histogram).d, fit_density(error, bound=20.0).d, rtol=2e-4, atol=0)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-1e-5, 1e-5), min_size=1, max_size=20))
def test_share_beyond_a_bound_given_at_the_start_is_the_last_bin(offsets):
    error = 20.0 * (1.0 + torch.tensor(offsets, dtype=torch.float64).unsqueeze(-1))
    histogram = histogram_of(error, (torch.zeros(3, 1), torch.rand(3, 1)))
    assert torch.equal(histogram.share_beyond(), histogram.sums[0, :, -1] / histogram.weight())
    assert histogram.sums[0, 0, -1] == ((error / (20.0 * (1.0 + 1e-6))).float() >= 1).sum()


def test_zeros_and_denormal_residuals_fit_into_the_first_bin():
    histogram = histogram_of(torch.tensor([[0.0], [1e-300], [1e-12]]).double())
    error, weight = histogram.residuals()
    assert weight.item() == 3
    assert 0 <= error.item() < 1e-11


def test_second_moment_is_exact():
    error = residual_draws(5000, 3)
    found, weight = histogram_of(error).residuals()
    torch.testing.assert_close((weight * found**2).sum(0), (error**2).sum(0), rtol=1e-6, atol=0)


def test_bins_are_about_a_hundredth_wide():
    size = torch.logspace(-7, 0, 20_000, dtype=torch.float64).unsqueeze(-1) * 20
    error, weight = histogram_of(size).residuals()
    assert (error[1:] / error[:-1]).max() < 1.02
    assert weight.sum() == 20_000


def test_memory_does_not_grow():
    histogram = ResidualHistogram(torch.ones(2))
    before = histogram.sums.numel()
    for _ in range(3):
        histogram.add(torch.rand(1000, 2))
    assert before == histogram.sums.numel() == 2 * 2 * BINS
    assert histogram.count.tolist() == [3000, 3000]
    assert histogram.batches == 3


# --- added batches


@pytest.mark.parametrize(("shape", "channel_dim"), [((3,), 0), ((5, 3), -1), ((5, 3, 4), 1), ((3, 2, 4), 0)])
@pytest.mark.parametrize("weighted", [False, True])
def test_channels_may_lie_in_any_dimension(shape, channel_dim, weighted):
    error = residual_draws(*shape)
    weight = torch.rand(shape) if weighted else None
    found = histogram_of((error, weight), channel_dim=channel_dim)
    moved = None if weight is None else weight.movedim(channel_dim, -1).reshape(-1, 3)
    expected = histogram_of((error.movedim(channel_dim, -1).reshape(-1, 3), moved))
    torch.testing.assert_close(found.sums, expected.sums, rtol=1e-12, atol=0)
    torch.testing.assert_close(found.count, expected.count)


def test_a_mask_is_a_weight_and_hides_nan():
    error = residual_draws(100, 2).float()
    mask = torch.rand(100, 2) < 0.5
    holed = torch.where(mask, error, NAN)
    torch.testing.assert_close(histogram_of((holed, mask)).sums, histogram_of((error, mask.float())).sums)
    assert torch.equal(histogram_of((holed, mask)).count, mask.sum(0).double())


def test_weight_is_repetition():
    error, times = residual_draws(200, 1), torch.randint(0, 4, (200, 1))
    repeated = error.squeeze(-1).repeat_interleave(times.squeeze(-1)).unsqueeze(-1)
    torch.testing.assert_close(histogram_of((error, times)).sums, histogram_of(repeated).sums)


def test_autocast_does_not_affect_the_histogram():
    error = residual_draws(500, 2).float()
    with torch.autocast("cpu", torch.bfloat16):
        found = histogram_of(error)
    assert torch.equal(found.sums, histogram_of(error).sums)
    assert found.sums.dtype == torch.float64


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
def test_residuals_that_are_not_finite_are_refused_by_channel(bad):
    histogram, error = ResidualHistogram(torch.ones(3)), torch.rand(4, 3)
    error[2, 1] = bad
    with pytest.raises(ValueError, match=r"finite residuals.*channel 1;.*isfinite"):
        histogram.add(error)
    assert histogram.batches == 0


@pytest.mark.parametrize("bad", [-1.0, NAN, INF])
def test_weights_that_are_negative_or_not_finite_are_refused(bad):
    histogram, weight = ResidualHistogram(torch.ones(2)), torch.ones(4, 2)
    weight[1, 0] = bad
    with pytest.raises(ValueError, match=r"weights >= 0.*channel 0"):
        histogram.add(torch.rand(4, 2), weight)


@pytest.mark.parametrize("on_accelerator", [False, True])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("kind", ["none", "mask", "weights"])
def test_residuals_that_overflowed_in_half_precision_are_left_out(dtype, kind, on_accelerator):
    error = residual_draws(60, 2).to(dtype)
    weight = WEIGHTS[kind](60, 2)
    overflowed = error.clone()
    overflowed[::3, 0] = 2 * torch.tensor(torch.finfo(dtype).max, dtype=dtype)
    overflowed[1, 1] = NAN
    kept = torch.isfinite(overflowed)
    found = histogram_of((overflowed, weight), on_accelerator=on_accelerator)
    expected = histogram_of((error.float(), kept if weight is None else weight * kept))
    found.check()
    torch.testing.assert_close(found.sums, expected.sums, rtol=1e-12, atol=0)
    assert torch.equal(found.count, expected.count)


# --- accelerators


@pytest.mark.parametrize("kind", WEIGHTS)
@pytest.mark.parametrize("bound", [20.0, None])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize(("shape", "channel_dim"), [((3,), 0), ((5, 3), -1), ((2, 3, 4), 1)])
def test_no_value_is_read_on_an_accelerator(kind, bound, dtype, shape, channel_dim):
    histogram = ResidualHistogram(None if bound is None else torch.full((3,), bound), num_channels=3)
    error, weight = torch.empty(shape, dtype=dtype, device="meta"), WEIGHTS[kind](*shape)
    with RefuseReads():
        for _ in range(2):
            histogram.add(error, None if weight is None else weight.to("meta"), channel_dim)
        histogram.clear()
    assert histogram.sums.device.type == histogram.refused.device.type == "meta"


def test_the_guard_detects_reads_on_the_cpu():
    with pytest.raises(AssertionError, match="_local_scalar_dense"), RefuseReads():
        ResidualHistogram(torch.ones(2)).add(torch.rand(3, 2))


@pytest.mark.parametrize("kind", WEIGHTS)
@pytest.mark.parametrize("bound", [20.0, None])
@pytest.mark.parametrize(("shape", "channel_dim"), [((3,), 0), ((50, 3), -1), ((5, 3, 4), 1)])
def test_sums_on_an_accelerator_equal_the_cpu(kind, bound, shape, channel_dim):
    batches = [(residual_draws(*shape, seed=seed).float(), WEIGHTS[kind](*shape)) for seed in (0, 1)]
    found = histogram_of(*batches, bound=bound, channel_dim=channel_dim, on_accelerator=True)
    expected = histogram_of(*batches, bound=bound, channel_dim=channel_dim)
    torch.testing.assert_close(found.sums, expected.sums, rtol=1e-12, atol=0)
    for name in ("count", "batches", "reach", "refused"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    found.check()


@settings(max_examples=60, deadline=None)
@given(data=st.data(), weighted=st.booleans(), bound=st.sampled_from([20.0, None]))
def test_elements_that_are_not_finite_are_left_out_and_reported_by_channel(data, weighted, bound):
    n = data.draw(st.integers(1, 8))
    error = residual_draws(n, 3, seed=n).float()
    weight = torch.rand(n, 3) if weighted else None
    bad_error = torch.tensor(data.draw(st.lists(st.booleans(), min_size=3 * n, max_size=3 * n))).view(n, 3)
    holed = torch.where(bad_error, data.draw(st.sampled_from([NAN, INF, -INF])), error)
    refused, given_weight = bad_error, weight
    if weighted:
        bad_weight = torch.tensor(data.draw(st.lists(st.booleans(), min_size=3 * n, max_size=3 * n))).view(n, 3)
        given_weight = torch.where(bad_weight, data.draw(st.sampled_from([NAN, INF, -INF, -1.0])), weight)
        refused = bad_error | bad_weight
    found = histogram_of((holed, given_weight), bound=bound, on_accelerator=True)
    kept = ~refused if weight is None else torch.where(refused, 0.0, weight)
    expected = histogram_of((torch.where(refused, 0.0, error), kept), bound=bound)
    torch.testing.assert_close(found.sums, expected.sums, rtol=1e-12, atol=0)
    assert torch.equal(found.reach, expected.reach)
    assert torch.equal(found.refused, refused.sum(0).double())
    channels = refused.any(0).nonzero().flatten().tolist()
    if channels:
        with pytest.raises(ValueError, match=rf"got {refused.sum()} others in channels? {str(channels)[1:-1]}; .*isf"):
            found.check()
    found.clear()
    found.check()


def test_non_finite_elements_of_weight_0_are_accepted_on_an_accelerator():
    error = torch.tensor([[NAN, 1.0], [INF, 2.0], [1.0, 3.0]])
    for weight in (torch.isfinite(error), torch.isfinite(error).float(), torch.isfinite(error).int()):
        histogram = histogram_of((error, weight), on_accelerator=True)
        histogram.check()
        assert histogram.count.tolist() == histogram.weight().tolist() == [1, 3]


def test_refused_elements_survive_a_saved_state():
    histogram = histogram_of(torch.full((2, 3), NAN), on_accelerator=True)
    restored = ResidualHistogram(torch.ones(3))
    restored.load_state_dict(histogram.state_dict())
    with pytest.raises(ValueError, match="6 others in channels 0, 1, 2;"):
        restored.check()


# --- a bound unknown at the start


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=20),
    unit=st.sampled_from([1e-30, 1e-6, 1.0, 1e6, 1e30]),
    on_accelerator=st.booleans(),
)
def test_bins_reach_64_to_128_times_as_far_as_the_first_batch(values, unit, on_accelerator):
    error = unit * torch.tensor(values).unsqueeze(-1)
    histogram = histogram_of(error, 3 * error, bound=None, on_accelerator=on_accelerator)
    largest = error.abs().max().double().item()
    if largest == 0:
        assert histogram.reach == 0
    elif largest > 1e-37:
        assert 64 * largest <= histogram.reach.item() <= 128 * largest
    assert histogram.weight().item() == 2 * len(values)


@pytest.mark.parametrize("on_accelerator", [False, True])
def test_zeros_and_masked_residuals_do_not_set_the_reach(on_accelerator):
    first = torch.tensor([[0.0, 5.0], [0.0, -0.0]]), torch.tensor([[True, False], [True, True]])
    second = torch.tensor([[0.0, 3.0]]), None
    histogram = histogram_of(first, second, bound=None, on_accelerator=on_accelerator)
    histogram.check()
    assert histogram.reach.tolist() == [0, 256]
    histogram.add(torch.tensor([[1.0, 1e6]]))
    assert histogram.reach.tolist() == [128, 256]
    assert histogram.weight().tolist() == [4, 3]
    torch.testing.assert_close(second_moment(histogram), torch.tensor([1.0, 1e12 + 9]).double(), rtol=1e-6, atol=0)


def test_residuals_beyond_the_reach_keep_their_sum_of_squares():
    late = torch.tensor([[1e3], [-1e5], [1e9]])
    histogram = histogram_of(torch.ones(1, 1), late, bound=None)
    assert histogram.sums[0, 0, -1] == 3
    torch.testing.assert_close(second_moment(histogram), late.double().square().sum(0) + 1, rtol=1e-6, atol=0)


@pytest.mark.parametrize("on_accelerator", [False, True])
def test_largest_and_smallest_numbers_of_float32_give_a_usable_reach(on_accelerator):
    error = torch.tensor([[3e38, 1e-42]])
    histogram = histogram_of(error, torch.ones(1, 2), bound=None, on_accelerator=on_accelerator)
    assert histogram.reach.tolist() == [2.0**126, 128.0]
    torch.testing.assert_close(
        second_moment(histogram), torch.tensor([9e76, 1.0], dtype=torch.float64), rtol=1e-6, atol=0
    )


@pytest.mark.parametrize(("sigma", "d"), [(1.5, 2.0), (2.0, 0.5), (INF, 1.5)])
def test_a_density_fitted_with_an_unknown_bound_equals_that_of_the_residuals(sigma, d):
    error = residual_draws(4000, 2, sigma=sigma, d=d)
    raw = fit_density(error, bound=20.0, d_min=1e-4)
    found = fitted(histogram_of(*error.split(100), bound=None))
    torch.testing.assert_close(found.d, raw.d, rtol=1e-4, atol=0)
    torch.testing.assert_close(found.sigma.pow(-2), raw.sigma.pow(-2), rtol=1e-3, atol=5e-5)


@settings(max_examples=100, deadline=None)
@given(
    values=st.lists(st.floats(2**-10, 1e3, width=32), min_size=1, max_size=40),
    first=st.floats(20.0, 1e3, width=32),
    bound=st.sampled_from([1e3, 2e3, None]),
)
def test_a_bin_is_within_a_64th_of_its_residuals(values, first, bound):
    size = torch.tensor([first, *values]).sort().values
    histogram = histogram_of(torch.tensor([[first]]), torch.tensor(values).unsqueeze(-1), bound=bound)
    error, weight = histogram.residuals()
    found = error.squeeze(-1).repeat_interleave(weight.squeeze(-1).long())
    torch.testing.assert_close(found, size.double(), rtol=1 / 64, atol=0)


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=40),
    first=st.floats(20.0, 1e3, width=32),
    bound=st.floats(1e-2, 1e3),
)
def test_share_beyond_a_bound_set_later_is_accurate_to_a_bin(values, first, bound):
    histogram = histogram_of(torch.tensor([[first]]), torch.tensor(values).unsqueeze(-1), bound=None)
    sums, reach = histogram.sums.clone(), histogram.reach.clone()
    assert math.isnan(histogram.share_beyond().item())
    histogram.set_bound(torch.tensor([bound]))
    size = torch.tensor([first, *values]).abs().double()
    low, high = ((size > bound * factor).double().mean().item() for factor in (65 / 64, 63 / 64))
    assert low - 1e-12 <= histogram.share_beyond().item() <= high + 1e-12
    assert torch.equal(histogram.sums, sums)
    assert torch.equal(histogram.reach, reach)


def test_a_bound_set_before_the_first_batch_equals_a_bound_given_at_the_start():
    error = torch.cat([residual_draws(100, 2), torch.tensor([[30.0, 20.0]])])
    late = ResidualHistogram(num_channels=2)
    late.set_bound(torch.full((2,), 20.0))
    late.add(error)
    expected = histogram_of(error)
    assert torch.equal(late.sums, expected.sums)
    assert torch.equal(late.share_beyond(), expected.share_beyond())
    assert late.share_beyond().tolist() == [1 / 101, 0]


@pytest.mark.parametrize("unknown", [NAN, INF])
def test_a_bound_may_be_unknown_in_single_channels(unknown):
    histogram = ResidualHistogram(torch.tensor([20.0, unknown]))
    histogram.add(torch.tensor([[30.0, 1.0], [1.0, 1.0]]))
    assert histogram.reach.tolist() == pytest.approx([20, 128])
    torch.testing.assert_close(histogram.share_beyond()[0].item(), 0.5)


@pytest.mark.parametrize(
    ("bound", "m", "message"),
    [(None, None, "`bound` or `num_channels`.*neither"), (torch.ones(2), 3, "`num_channels` to be 2.*got 3")],
)
def test_a_histogram_without_a_number_of_channels_or_with_two_is_refused(bound, m, message):
    with pytest.raises(ValueError, match=message):
        ResidualHistogram(bound, num_channels=m)


# --- sums


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=10), min_size=2, max_size=5),
    bound=st.sampled_from([20.0, None]),
    on_accelerator=st.booleans(),
    order=st.randoms(use_true_random=False),
)
def test_the_sums_do_not_depend_on_the_order_of_batches(values, bound, on_accelerator, order):
    first = torch.tensor([[50.0]])
    batches = [torch.tensor(v).unsqueeze(-1) for v in values]
    shuffled = order.sample(batches, len(batches))
    found, expected = (histogram_of(first, *b, bound=bound, on_accelerator=on_accelerator) for b in (shuffled, batches))
    torch.testing.assert_close(found.sums, expected.sums, rtol=1e-12, atol=0)
    assert torch.equal(found.count, expected.count)


@settings(max_examples=60, deadline=None)
@given(
    # sizes within 1e18 of each other: a square of a larger ratio would overflow, and is cut off there
    values=st.lists(
        st.lists(st.floats(-1e3, 1e3, width=32).filter(lambda v: v == 0.0 or abs(v) > 1e-12), min_size=1, max_size=10),
        min_size=1,
        max_size=5,
    ),
    order=st.randoms(use_true_random=False),
)
def test_weights_and_squares_do_not_depend_on_the_batch_that_sets_the_reach(values, order):
    batches = [torch.tensor(v).unsqueeze(-1) for v in values]
    histogram = histogram_of(*order.sample(batches, len(batches)), bound=None)
    error = torch.cat(batches)
    assert histogram.weight().item() == len(error)
    torch.testing.assert_close(second_moment(histogram), error.double().square().sum(0), rtol=1e-6, atol=1e-30)


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=40),
    cut=st.integers(0, 40),
    weighted=st.booleans(),
)
def test_merged_histograms_equal_the_histogram_of_all(values, cut, weighted):
    error = torch.tensor(values).unsqueeze(-1)
    weight = torch.arange(len(values)).remainder(3).unsqueeze(-1) if weighted else None
    parts = [slice(0, cut), slice(cut, None)]
    pieces = [histogram_of((error[p], None if weight is None else weight[p])) for p in parts if len(error[p])]
    whole = histogram_of((error, weight))
    torch.testing.assert_close(sum(p.sums for p in pieces), whole.sums, rtol=1e-12, atol=0)
    assert torch.equal(sum(p.count for p in pieces), whole.count)
    assert torch.equal(sum(p.weight() for p in pieces), whole.weight())


def test_a_resumed_histogram_is_bitwise_equal():
    first, second = residual_draws(50, 2).split(25)
    whole, restored = histogram_of(first, second), ResidualHistogram(torch.full((2,), 20.0))
    restored.load_state_dict(histogram_of(first).state_dict())
    restored.add(second)
    assert torch.equal(restored.sums, whole.sums)
    assert restored.batches == 2
    assert ResidualHistogram(torch.ones(2)).state_dict()["sums"] is None


@pytest.mark.parametrize("on_accelerator", [False, True])
@pytest.mark.parametrize("kind", WEIGHTS)
@pytest.mark.parametrize("saved_after", range(4))
def test_a_resumed_collection_is_bitwise_equal(saved_after, kind, on_accelerator, tmp_path):
    batches = [(residual_draws(25, 2, seed=seed).float() * (seed > 0), WEIGHTS[kind](25, 2)) for seed in range(4)]
    whole = histogram_of(*batches, bound=None, on_accelerator=on_accelerator)
    resumed = ResidualHistogram(num_channels=2)
    with simulated_accelerator() if on_accelerator else contextlib.nullcontext():
        for i, batch in enumerate(batches):
            if i == saved_after:
                torch.save(resumed.state_dict(), tmp_path / "state.pt")
                resumed = ResidualHistogram(torch.ones(2))
                resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
            resumed.add(*batch)
    for histogram in (resumed, whole):
        histogram.check()
        histogram.set_bound(torch.full((2,), 3.0))
    for name in ("sums", "count", "refused", "batches", "reach", "bound"):
        assert torch.equal(getattr(resumed, name), getattr(whole, name)), name
    for name in ("share_beyond", "weight"):
        assert torch.equal(getattr(resumed, name)(), getattr(whole, name)()), name
    assert all(map(torch.equal, resumed.residuals(), whole.residuals()))


def test_loading_an_empty_state_empties_a_histogram():
    histogram = histogram_of(residual_draws(50, 2))
    histogram.load_state_dict(ResidualHistogram(torch.ones(2)).state_dict())
    assert not histogram.sums.any()
    assert histogram.bound.tolist() == [1, 1]


def test_setting_a_bound_does_not_change_loaded_bins():
    histogram = histogram_of(residual_draws(50, 2), bound=None)
    restored = ResidualHistogram(num_channels=2)
    restored.load_state_dict(histogram.state_dict())
    restored.set_bound(torch.ones(2))
    assert torch.equal(restored.reach, histogram.reach)


def test_a_bound_set_late_is_saved():
    histogram = histogram_of(residual_draws(50, 2), bound=None)
    histogram.set_bound(torch.full((2,), 1.0))
    restored = ResidualHistogram(num_channels=2)
    restored.load_state_dict(histogram.state_dict())
    assert torch.equal(restored.share_beyond(), histogram.share_beyond())
    assert (restored.share_beyond() > 0).all()


@pytest.mark.parametrize("batches", [[], [residual_draws(5, 3)]])
def test_histogram_of_other_channels_is_refused(batches):
    histogram = ResidualHistogram(torch.ones(3))
    for batch in batches:
        histogram.add(batch)
    with pytest.raises(ValueError, match="another number of channels"):
        ResidualHistogram(torch.ones(2)).load_state_dict(histogram.state_dict())


def test_cleared_histogram_is_empty():
    histogram = histogram_of(residual_draws(5, 2))
    histogram.clear()
    assert not histogram.sums.any()
    assert histogram.batches == 0
    assert histogram.share_beyond().tolist() == [0, 0]


def test_cleared_histogram_keeps_its_reach():
    first, second = 0.1 * residual_draws(50, 2), residual_draws(50, 2)
    histogram = histogram_of(first, bound=None)
    reach = histogram.reach.clone()
    histogram.clear()
    histogram.set_bound(torch.ones(2))
    histogram.add(second)
    assert torch.equal(histogram.reach, reach)
    expected = histogram_of(first, second, bound=None).sums - histogram_of(first, bound=None).sums
    torch.testing.assert_close(histogram.sums, expected, rtol=1e-9, atol=1e-12)


# --- processes


def _reduce_on_rank(rank, port, folder):
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    dist.init_process_group("gloo", rank=rank, world_size=2)
    histogram = histogram_of(residual_draws(600, 2)[rank::2])
    histogram.all_reduce()
    fit = fitted(histogram)
    torch.save((histogram.sums, histogram.count, histogram.batches, fit.sigma, fit.d), f"{folder}/{rank}.pt")
    torch.save(_reduced_without_a_bound(rank), f"{folder}/unknown-{rank}.pt")
    dist.destroy_process_group()


def batches_of(rank):
    """The reaches of the two processes are far apart; channel 1 grows beyond that of one of them; channel 2 is late."""
    error = residual_draws(300, 3, seed=rank) * torch.tensor([(0.1, 3.0)[rank], (0.003, 5.0)[rank], 1.0])
    error[200:, 1] = residual_draws(100, seed=7)
    error[:100, 2] = 0.0
    return error.float().split(100)


def _reduced_without_a_bound(rank):
    histogram = histogram_of(*batches_of(rank), bound=None, on_accelerator=True)
    histogram.all_reduce()
    histogram.check()
    collected = histogram.sums.clone()
    histogram.clear()
    with simulated_accelerator():
        if rank == 1:
            histogram.add(torch.tensor([[1.0, NAN, 1.0]]))
    histogram.set_bound(torch.ones(3))
    histogram.all_reduce()
    with pytest.raises(ValueError, match="1 others in channel 1;"):
        histogram.check()
    late = ResidualHistogram(num_channels=3)
    if rank == 1:
        late.add(batches_of(1)[0])
    late.all_reduce()
    late.set_bound(torch.ones(3))
    return collected, histogram.reach, histogram.sums, late.reach, late.share_beyond()


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@pytest.mark.process
def test_processes_add_up_to_the_histogram_of_all_residuals(tmp_path):
    multiprocessing.spawn(_reduce_on_rank, (free_port(), str(tmp_path)), nprocs=2)
    left, other = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    assert all(torch.equal(a, b) for a, b in zip(left, other, strict=True))
    whole = histogram_of(residual_draws(600, 2))
    sums, count, batches, sigma, d = left
    torch.testing.assert_close(sums, whole.sums, rtol=1e-12, atol=0)
    assert torch.equal(count, whole.count)
    assert batches == 2
    torch.testing.assert_close(d, fitted(whole).d, rtol=1e-9, atol=0)
    torch.testing.assert_close(sigma, fitted(whole).sigma, rtol=1e-8, atol=0)

    left, other = (torch.load(tmp_path / f"unknown-{rank}.pt") for rank in (0, 1))
    assert all(torch.equal(a, b) for a, b in zip(left, other, strict=True))
    collected, reach, last, reach_of_one, share = left
    assert torch.equal(reach_of_one, histogram_of(batches_of(1)[0], bound=None).reach)
    assert ((share > 0) & (share < 1))[:2].all()
    reaches = torch.stack([histogram_of(*batches_of(rank), bound=None).reach for rank in (0, 1)])
    assert torch.equal(reach, reaches.amax(0))
    assert (reaches[1] > 2 * reaches[0])[:2].all()
    whole = ResidualHistogram(num_channels=3)
    whole.reach.copy_(reach)
    for rank in (0, 1):
        for batch in batches_of(rank):
            whole.add(batch)
    torch.testing.assert_close(collected[:, ::2], whole.sums[:, ::2], rtol=1e-12, atol=0)
    torch.testing.assert_close(collected.sum(-1), whole.sums.sum(-1), rtol=1e-6, atol=0)
    assert last[0].sum(-1).tolist() == [1, 0, 1]


def test_without_processes_all_reduce_changes_nothing():
    histogram = histogram_of(residual_draws(5, 2))
    before = histogram.sums.clone()
    histogram.all_reduce()
    assert torch.equal(histogram.sums, before)
