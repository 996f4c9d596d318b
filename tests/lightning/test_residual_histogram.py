import math
import os
import socket

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import distributed as dist
from torch import multiprocessing

from mkc_torch import MKCDistribution, fit_density
from mkc_torch.lightning.residual_histogram import BINS, ResidualHistogram

INF, NAN = math.inf, math.nan


def drawn(*shape, sigma=2.0, d=0.5, bound=20.0, seed=0):
    """Residuals of a heavy-tailed density."""
    torch.manual_seed(seed)
    return MKCDistribution(torch.tensor(sigma).double(), torch.tensor(d).double(), bound).sample(shape)


def filled(*batches, bound=20.0, channel_dim=-1):
    m = (batches[0][0] if isinstance(batches[0], tuple) else batches[0]).shape[channel_dim]
    histogram = ResidualHistogram(torch.full((m,), bound))
    for batch in batches:
        histogram.add(*(batch if isinstance(batch, tuple) else (batch, None)), channel_dim)
    return histogram


def fitted(histogram, bound=20.0):
    error, weight = histogram.residuals()
    return fit_density(error, weight=weight, bound=bound, d_min=1e-4)


# --- the density fitted to it


@pytest.mark.parametrize(("sigma", "d"), [(1.5, 2.0), (2.0, 0.5), (3.0, 0.01), (INF, 1.5)])
@pytest.mark.parametrize("weighted", [False, True])
def test_density_fitted_to_the_histogram_is_that_of_the_residuals(sigma, d, weighted):
    error = drawn(4000, 2, sigma=sigma, d=d)
    weight = torch.rand(4000, 2, dtype=torch.float64) if weighted else None
    raw = fit_density(error, weight=weight, bound=20.0, d_min=1e-4)
    found = fitted(filled((error, weight)))
    torch.testing.assert_close(found.d, raw.d, rtol=1e-4, atol=0)
    torch.testing.assert_close(found.sigma.pow(-2), raw.sigma.pow(-2), rtol=1e-3, atol=5e-5)
    torch.testing.assert_close(found.log_likelihood, raw.log_likelihood, rtol=0, atol=5e-5)


def test_residuals_beyond_the_bound_count_as_the_flat_tail():
    error = torch.cat([drawn(1000, 1), torch.tensor([[25.0], [-80.0], [1e30], [20.0], [-20.0]])])
    histogram = filled(error)
    assert histogram.share_beyond().item() == pytest.approx(3 / 1005)
    torch.testing.assert_close(fitted(histogram).d, fit_density(error, bound=20.0).d, rtol=2e-4, atol=0)


def test_zeros_and_denormal_residuals_fit_into_the_first_bin():
    histogram = filled(torch.tensor([[0.0], [1e-300], [1e-12]]).double())
    error, weight = histogram.residuals()
    assert weight.item() == 3
    assert 0 <= error.item() < 1e-11


def test_second_moment_is_exact():
    error = drawn(5000, 3)
    found, weight = filled(error).residuals()
    torch.testing.assert_close((weight * found**2).sum(0), (error**2).sum(0), rtol=1e-6, atol=0)


def test_bins_are_about_a_hundredth_wide():
    size = torch.logspace(-7, 0, 20_000, dtype=torch.float64).unsqueeze(-1) * 20
    error, weight = filled(size).residuals()
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


# --- what it is filled with


@pytest.mark.parametrize(("shape", "channel_dim"), [((3,), 0), ((5, 3), -1), ((5, 3, 4), 1), ((3, 2, 4), 0)])
@pytest.mark.parametrize("weighted", [False, True])
def test_channels_may_lie_in_any_dimension(shape, channel_dim, weighted):
    error = drawn(*shape)
    weight = torch.rand(shape) if weighted else None
    found = filled((error, weight), channel_dim=channel_dim)
    moved = None if weight is None else weight.movedim(channel_dim, -1).reshape(-1, 3)
    expected = filled((error.movedim(channel_dim, -1).reshape(-1, 3), moved))
    torch.testing.assert_close(found.sums, expected.sums, rtol=1e-12, atol=0)
    torch.testing.assert_close(found.count, expected.count)


def test_a_mask_is_a_weight_and_hides_what_has_no_value():
    error = drawn(100, 2).float()
    mask = torch.rand(100, 2) < 0.5
    holed = torch.where(mask, error, NAN)
    torch.testing.assert_close(filled((holed, mask)).sums, filled((error, mask.float())).sums)
    assert torch.equal(filled((holed, mask)).count, mask.sum(0).double())


def test_weight_is_repetition():
    error, times = drawn(200, 1), torch.randint(0, 4, (200, 1))
    repeated = error.squeeze(-1).repeat_interleave(times.squeeze(-1)).unsqueeze(-1)
    torch.testing.assert_close(filled((error, times)).sums, filled(repeated).sums)


def test_autocast_does_not_reach_it():
    error = drawn(500, 2).float()
    with torch.autocast("cpu", torch.bfloat16):
        found = filled(error)
    assert torch.equal(found.sums, filled(error).sums)
    assert found.sums.dtype == torch.float64


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
def test_residuals_that_are_not_finite_are_refused_by_channel(bad):
    histogram, error = ResidualHistogram(torch.ones(3)), torch.rand(4, 3)
    error[2, 1] = bad
    with pytest.raises(ValueError, match=r"finite residuals but got .*channel 1; .*isfinite"):
        histogram.add(error)
    assert histogram.batches == 0


@pytest.mark.parametrize("bad", [-1.0, NAN, INF])
def test_weights_that_are_negative_or_not_finite_are_refused(bad):
    histogram, weight = ResidualHistogram(torch.ones(2)), torch.ones(4, 2)
    weight[1, 0] = bad
    with pytest.raises(ValueError, match=r"weights >= 0 but got .*channel 0"):
        histogram.add(torch.rand(4, 2), weight)


# --- sums


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.floats(-1e3, 1e3, width=32), min_size=1, max_size=40),
    cut=st.integers(0, 40),
    weighted=st.booleans(),
)
def test_merged_histograms_are_the_histogram_of_all(values, cut, weighted):
    error = torch.tensor(values).unsqueeze(-1)
    weight = torch.arange(len(values)).remainder(3).unsqueeze(-1) if weighted else None
    parts = [slice(0, cut), slice(cut, None)]
    pieces = [filled((error[p], None if weight is None else weight[p])) for p in parts if len(error[p])]
    whole = filled((error, weight))
    torch.testing.assert_close(sum(p.sums for p in pieces), whole.sums, rtol=1e-12, atol=0)
    assert torch.equal(sum(p.count for p in pieces), whole.count)
    assert torch.equal(sum(p.weight() for p in pieces), whole.weight())


def test_saved_histogram_goes_on_to_the_last_bit():
    first, second = drawn(50, 2).split(25)
    whole, restored = filled(first, second), ResidualHistogram(torch.full((2,), 20.0))
    restored.load_state_dict(filled(first).state_dict())
    restored.add(second)
    assert torch.equal(restored.sums, whole.sums)
    assert restored.batches == 2
    assert ResidualHistogram(torch.ones(2)).state_dict()["sums"] is None


def test_histogram_of_other_channels_is_refused():
    with pytest.raises(ValueError, match="another number of channels"):
        ResidualHistogram(torch.ones(2)).load_state_dict(filled(drawn(5, 3)).state_dict())


def test_cleared_histogram_is_empty():
    histogram = filled(drawn(5, 2))
    histogram.clear()
    assert not histogram.sums.any()
    assert histogram.batches == 0
    assert histogram.share_beyond().tolist() == [0, 0]


# --- processes


def _reduced(rank, port, folder):
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    dist.init_process_group("gloo", rank=rank, world_size=2)
    histogram = filled(drawn(600, 2)[rank::2])
    histogram.all_reduce()
    fit = fitted(histogram)
    torch.save((histogram.sums, histogram.count, histogram.batches, fit.sigma, fit.d), f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def test_processes_add_up_to_the_histogram_of_all_residuals(tmp_path):
    multiprocessing.spawn(_reduced, (free_port(), str(tmp_path)), nprocs=2)
    one, other = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
    whole = filled(drawn(600, 2))
    sums, count, batches, sigma, d = one
    torch.testing.assert_close(sums, whole.sums, rtol=1e-12, atol=0)
    assert torch.equal(count, whole.count)
    assert batches == 2
    torch.testing.assert_close(d, fitted(whole).d, rtol=1e-9, atol=0)
    torch.testing.assert_close(sigma, fitted(whole).sigma, rtol=1e-8, atol=0)


def test_alone_there_is_nothing_to_reduce():
    histogram = filled(drawn(5, 2))
    before = histogram.sums.clone()
    histogram.all_reduce()
    assert torch.equal(histogram.sums, before)
