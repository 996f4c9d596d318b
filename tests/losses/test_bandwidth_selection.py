"""The selected bandwidth: wide for Gaussian noise, narrow for wrong targets if a wide one shrinks predictions."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.losses._bandwidth_selection import BANDWIDTHS, select_bandwidth
from mkc_torch.losses._initial_loss import initial_influence, initial_loss

N = 1000


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def selection(z, prediction, weight):
    """The selection by torch, checked against NumPy."""
    found = select_bandwidth(torch, z, prediction, weight)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        other = select_bandwidth(np, z.numpy(), prediction.numpy(), weight.numpy())
    assert found.bandwidth.dtype == z.dtype
    assert other.bandwidth.dtype == z.numpy().dtype
    assert found.bandwidth.tolist() == other.bandwidth.tolist()
    assert found.better.tolist() == other.better.tolist()
    return found


def simulated_fit(share, shrunk, seed=0, noise=0.2):
    """Standardised residuals and predictions of a fit with the given shrinkage; a share of targets is permuted."""
    g = generator(seed)
    truth = torch.randn(N, generator=g)
    target = truth + noise * torch.randn(N, generator=g)
    rows = torch.randperm(N, generator=g)[: int(share * N)]
    target[rows] = target[rows[torch.randperm(len(rows), generator=g)]]
    prediction = shrunk * truth
    error = prediction - target
    z = error / (error.abs().quantile(0.4) / 0.5244)
    return z.unsqueeze(0), prediction.unsqueeze(0), torch.ones(1, N)


@pytest.mark.parametrize("seed", range(5))
def test_least_squares_on_permuted_targets_is_detected_by_its_shrunk_predictions(seed):
    z, prediction, weight = simulated_fit(0.5, 0.5, seed)
    found = selection(z, prediction, weight)
    assert found.bandwidth <= 1.4 or not found.better
    blind = selection(z, torch.zeros_like(z), weight)
    assert blind.better
    assert blind.bandwidth > 2.0


@pytest.mark.parametrize("seed", range(5))
def test_at_the_truth_permuted_targets_support_a_narrow_bandwidth(seed):
    found = selection(*simulated_fit(0.5, 1.0, seed))
    assert 0.5 <= found.bandwidth <= 2.0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("shrunk", [1.0, 0.98])
def test_right_targets_support_a_wide_bandwidth(seed, shrunk):
    found = selection(*simulated_fit(0.0, shrunk, seed))
    assert found.better
    assert found.bandwidth >= 2.8


def test_without_shrinkage_the_widest_bandwidth_of_nearly_the_smallest_variance_is_selected():
    """The variance of an M-estimate, written out for each candidate."""
    z = torch.randn(3, N, generator=generator(), dtype=torch.float64)
    z[1, ::4] *= 6.0
    z[2, ::2] *= 30.0
    weight = torch.rand(3, N, generator=generator(1), dtype=torch.float64)
    found = selection(z, torch.zeros_like(z), weight)
    for channel in range(3):
        own, share = z[channel], weight[channel] / weight[channel].sum()

        def variance(influence, slope, share=share):
            return float((share * influence**2).sum() / (share * slope).sum().clamp(min=1e-3) ** 2)

        risks = []
        for width in BANDWIDTHS:
            inlier = torch.exp(-0.5 * (own / width) ** 2)
            risks.append(variance(own * inlier, (1.0 - (own / width) ** 2) * inlier))
        nearly = [width for width, risk in zip(BANDWIDTHS, risks, strict=True) if risk <= 1.1 * min(risks)]
        assert float(found.bandwidth[channel]) == max(nearly)
        assert bool(found.better[channel]) == (1.1 * min(risks) < variance(*initial_influence(torch, own)))
    assert found.bandwidth[0] >= 8.0 > 4.0 >= found.bandwidth[1:].max()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_selection_does_not_depend_on_unit_and_offset_of_predictions(dtype):
    z, prediction, weight = (values.to(dtype) for values in simulated_fit(0.5, 0.5))
    units = [(1.0, 0.0), (1e-6, 1e-6), (1e6, -3e6)]
    found = [selection(z, unit * prediction + shift, weight) for unit, shift in units]
    assert {(float(f.bandwidth), bool(f.better)) for f in found} == {(float(found[0].bandwidth), bool(found[0].better))}


def test_residuals_of_weight_0_are_ignored():
    z, prediction, weight = simulated_fit(0.5, 0.5)
    weight[:, ::2] = 0.0
    expected = selection(z[:, 1::2], prediction[:, 1::2], weight[:, 1::2])
    z[:, ::2], prediction[:, ::2] = 50.0, -3.0
    found = selection(z, prediction, weight)
    assert (found.bandwidth, found.better) == (expected.bandwidth, expected.better)


def test_a_weight_equals_repetition_except_for_chance():
    z, _, weight = (values.double() for values in simulated_fit(0.5, 1.0))
    times = torch.randint(1, 4, (N,), generator=generator(2))
    repeated = [values.repeat_interleave(times, 1) for values in (z, torch.zeros_like(z), weight)]
    found, expected = selection(z, torch.zeros_like(z), weight * times), selection(*repeated)
    assert (found.bandwidth, found.better) == (expected.bandwidth, expected.better)


def test_channels_are_selected_independently():
    parts = [simulated_fit(0.5, 0.5), simulated_fit(0.0, 1.0)]
    both = selection(*(torch.cat(values) for values in zip(*parts, strict=True)))
    assert both.better.tolist() == [False, True]
    assert both.bandwidth.tolist() == [float(selection(*part).bandwidth) for part in parts]


def test_a_constant_prediction_gives_a_finite_selection():
    z, _, weight = simulated_fit(0.0, 1.0)
    assert selection(z, torch.full_like(z, 7.0), weight).better


@given(
    seed=st.integers(0, 9999),
    channels=st.integers(1, 4),
    length=st.integers(2, 64),
    share=st.floats(0.0, 1.0),
    far=st.floats(0.0, 30.0),
)
@settings(max_examples=60, deadline=None)
def test_numpy_and_torch_select_the_same_candidate(seed, channels, length, share, far):
    g = generator(seed)
    z, prediction = torch.randn(2, channels, length, generator=g, dtype=torch.float64)
    z[:, ::3] *= 10.0**far
    weight = torch.rand(channels, length, generator=g, dtype=torch.float64)
    weight *= torch.rand(channels, length, generator=g) < share
    found = selection(z, prediction, weight)
    assert set(found.bandwidth.tolist()) <= set(BANDWIDTHS)


@pytest.mark.parametrize("at", [0.0, 1e-3, 0.2, 1.0, 40.0, 1e5])
def test_the_influence_of_the_initial_loss_is_its_derivative(at):
    z = torch.tensor(at, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(initial_loss(torch, z), z, create_graph=True)
    (curvature,) = torch.autograd.grad(slope, z)
    found = initial_influence(torch, z.detach())
    torch.testing.assert_close(found[0], slope.detach(), rtol=1e-12, atol=0.0)
    torch.testing.assert_close(found[1], curvature, rtol=1e-10, atol=1e-20)
    assert [float(value) for value in initial_influence(np, np.float64(at))] == pytest.approx([float(f) for f in found])


def test_the_initial_loss_is_half_the_square_near_0_and_a_root_far_away():
    z = torch.tensor([1e-4, 1e4, 4e4], dtype=torch.float64)
    near, far, farther = initial_loss(torch, z).tolist()
    assert near == pytest.approx(0.5e-8, rel=1e-4)
    assert farther / far == pytest.approx(2.0, rel=1e-2)
