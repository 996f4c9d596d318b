"""The running scale of residuals: robust, in the unit of the target, per channel, equal in NumPy and torch."""

import copy
import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.losses import residual_scale as module
from mkc_torch.losses.residual_scale import (
    FEWEST_RECENT,
    MOST_RECENT,
    NORMAL_QUANTILE,
    QUANTILE,
    RANGE_DECAY,
    RANGE_ROWS,
    RATE,
    RECENT_IN_ALL,
    ResidualScale,
    spaced_rows,
    weighted_quantile,
)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def randn(*size, seed=0):
    return torch.randn(*size, generator=generator(seed), dtype=torch.float64)


def scale_after(*batches, channels=None, dtype=torch.float64):
    """A scale after batches of residuals; a batch may be a pair of residuals and weights."""
    pairs = [batch if isinstance(batch, tuple) else (batch, None) for batch in batches]
    scale = ResidualScale(channels or pairs[0][0].shape[-1]).to(dtype)
    for residual, weight in pairs:
        scale.update(residual, torch.zeros_like(residual), weight)
    return scale


def state_of(scale):
    return {name: value for name, value in scale.state_dict().items() if name not in ("recent", "position")}


def assert_same_numbers(left, other, **tolerance):
    torch.testing.assert_close(state_of(left), state_of(other), **(tolerance or {"rtol": 0.0, "atol": 0.0}))


def quantile(residual):
    """The empirical quantile of the absolute residuals, without interpolation."""
    ordered = sorted(abs(float(r)) for r in residual)
    return ordered[math.ceil(QUANTILE * len(ordered)) - 1]


# --- definition


def test_the_scale_is_the_quantile_of_absolute_residuals_over_that_of_a_normal_variable():
    residual = randn(237, 2) * torch.tensor([1.0, 50.0])
    scale = scale_after(residual)
    expected = [quantile(column) / NORMAL_QUANTILE for column in residual.T]
    torch.testing.assert_close(scale.scale, torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=0.0)
    torch.testing.assert_close(scale.half_range, 0.5 * (residual.amax(0) - residual.amin(0)))
    torch.testing.assert_close(scale.bound, torch.maximum(scale.half_range, 10.0 * scale.scale))
    assert scale.batches.tolist() == [1, 1]


def test_the_scale_of_normal_residuals_is_their_standard_deviation():
    large = torch.linspace(-1.0, 1.0, 20_001, dtype=torch.float64)[1:-1].erfinv() * 2.0**0.5
    assert float(scale_after(7.0 * large.unsqueeze(-1)).scale) == pytest.approx(7.0, rel=1e-2)


def test_the_scale_is_robust_in_each_channel_and_about_0():
    residual = randn(1000, 2) * torch.tensor([1.0, 50.0])
    residual[:450, 0] = 1e4
    scale = scale_after(residual)
    assert 1.0 < float(scale.scale[0]) < 3.0
    assert float(scale.scale[1]) == pytest.approx(50.0, rel=0.1)
    offset = scale_after(torch.full((100, 1), 1000.0))
    assert float(offset.scale) == pytest.approx(1000.0 / NORMAL_QUANTILE, rel=1e-6)


@given(exponent=st.floats(-6.0, 6.0), seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_all_numbers_have_the_unit_of_the_target(exponent, seed):
    unit, batches = 10.0**exponent, [randn(30, 2, seed=seed), randn(50, 2, seed=seed + 1)]
    left, other = scale_after(*batches), scale_after(*(unit * batch for batch in batches))
    for name in ("scale", "half_range", "floor", "bound"):
        torch.testing.assert_close(unit * getattr(left, name), getattr(other, name), rtol=1e-9, atol=0.0)


def test_the_floor_is_a_thousandth_of_the_scale():
    for scale in (scale_after(randn(500, 1)), scale_after(randn(500, 1), *[1e-6 * randn(500, 1)] * 200)):
        assert float(scale.floor) == pytest.approx(1e-3 * float(scale.scale), rel=1e-6)
    assert float(scale.floor) < 1e-8


def test_a_state_that_holds_a_floor_is_loaded():
    scale, other = scale_after(randn(500, 1)), ResidualScale(1)
    other.load_state_dict({**scale.state_dict(), "floor": torch.ones(1)})
    assert float(other.floor) == pytest.approx(float(scale.floor))


def test_if_most_residuals_are_0_their_mean_size_gives_the_scale():
    residual = torch.zeros(100, 1, dtype=torch.float64)
    residual[:5] = torch.tensor([1.0, -2.0, 3.0, -4.0, 5.0]).unsqueeze(-1)
    assert float(scale_after(residual).scale) == pytest.approx(0.15, rel=1e-12)


def test_the_log_scale_is_the_mean_of_the_first_batches_and_later_updated_by_a_tenth():
    sizes = torch.tensor([1.0, 4.0, 16.0, 2.0] * 5).tolist()
    scale, mean = ResidualScale(1).double(), 0.0
    for n, size in enumerate(sizes):
        # each batch replaces all recent residuals
        scale.update(torch.full((MOST_RECENT, 1), size, dtype=torch.float64), torch.zeros(MOST_RECENT, 1))
        mean += max(1.0 / (n + 1), RATE) * (math.log(size / NORMAL_QUANTILE) - mean)
        assert float(scale.log_scale) == pytest.approx(mean, rel=1e-9)
        assert int(scale.batches) == n + 1
    assert len(sizes) > 1.0 / RATE


def test_the_scale_follows_residuals_that_shrink():
    noise = randn(100, 1)
    scale = scale_after(*(noise * 100.0 * 0.9 ** min(step, 60) for step in range(120)))
    assert float(scale.scale) == pytest.approx(100.0 * 0.9**60 * float(scale_after(noise).scale), rel=0.05)


def test_the_half_range_widens_at_once_and_shrinks_slowly():
    scale = scale_after(*(size * torch.tensor([[-1.0], [0.1], [0.2], [3.0]]) for size in (1.0, 10.0, 1.0, 1.0)))
    assert float(scale.half_range) == pytest.approx(20.0 * RANGE_DECAY**2)


# --- masks and weights


def test_residuals_that_are_not_finite_or_of_weight_0_are_ignored():
    residual = randn(200, 1)
    contaminated = residual.clone()
    contaminated[::4], contaminated[2::4], contaminated[4] = math.nan, math.inf, -math.inf
    mask = torch.ones(200, 1, dtype=torch.bool)
    mask[::2] = False
    expected = scale_after(residual[1::2])
    for weight in (mask, mask.double(), None):
        assert_same_numbers(scale_after((contaminated, weight)), expected, rtol=1e-12, atol=0.0)
        scale = ResidualScale(1).double()
        scale.update(torch.zeros_like(residual), contaminated, weight)
        assert_same_numbers(scale, expected, rtol=1e-12, atol=0.0)


@given(
    seed=st.integers(0, 9999),
    count=st.integers(1, 60),
    offset=st.sampled_from([-100.0, 0.0, 3.0]),
    weighted=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_masked_residuals_equal_missing_residuals(seed, count, offset, weighted):
    residual = offset + randn(count, 1, seed=seed)
    weight = torch.rand(count, 1, generator=generator(seed), dtype=torch.float64) if weighted else torch.ones(count, 1)
    mask = torch.rand(count, 1, generator=generator(seed + 1)) < 0.6
    kept = mask.flatten()
    first = randn(40, 1, seed=seed + 2)
    found = scale_after(first, (torch.where(mask, residual, 1e3), weight * mask))
    expected = scale_after(first, *([(residual[kept], weight[kept])] if kept.any() else []))
    assert_same_numbers(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["masked", "weight 0", "not finite"])
@pytest.mark.parametrize("rows", [16, 600])
def test_a_batch_without_usable_residuals_changes_no_number(kind, rows):
    scale = scale_after(randn(50, 2), 3.0 * randn(50, 2, seed=1))
    before = copy.deepcopy(state_of(scale))
    residual = torch.full((rows, 2), math.inf if kind == "not finite" else 1e3, dtype=torch.float64)
    weight = {"masked": torch.zeros(rows, 2, dtype=torch.bool), "weight 0": torch.zeros(rows, 2)}.get(kind)
    for _ in range(3):
        scale.update(residual, torch.zeros_like(residual), weight)
    torch.testing.assert_close(state_of(scale), before, rtol=0.0, atol=0.0)


def test_a_fully_masked_channel_keeps_its_state_while_others_update():
    mask = torch.tensor([True, False]).expand(50, 2)
    scale = scale_after((randn(50, 2), mask), (randn(50, 2, seed=1), mask))
    assert scale.batches.tolist() == [2, 0]
    assert scale.log_scale.tolist()[1] == 0.0
    scale.update(1e3 * randn(50, 2, seed=2), torch.zeros(50, 2))
    assert scale.batches.tolist() == [3, 1]
    expected = scale_after((1e3 * randn(50, 2, seed=2))[:, 1:])
    assert float(scale.log_scale[1]) == pytest.approx(float(expected.log_scale), rel=1e-12)
    assert float(scale.half_range[1]) == float(expected.half_range)


def test_a_weight_equals_repetition():
    residual, times = randn(40, 1), torch.randint(1, 4, (40, 1), generator=generator())
    repeated = residual.repeat_interleave(times.flatten(), 0)
    assert_same_numbers(scale_after((residual, times)), scale_after(repeated), rtol=1e-12, atol=1e-12)


def test_channels_are_independent():
    residual = randn(70, 3) * torch.tensor([1.0, 10.0, 1e-3])
    together = state_of(scale_after(residual, 2.0 * residual))
    for channel in range(3):
        alone = state_of(scale_after(residual[:, [channel]], 2.0 * residual[:, [channel]]))
        for name, value in alone.items():
            assert float(value) == float(together[name][channel])


@given(values=st.lists(st.tuples(st.integers(0, 20), st.integers(0, 3)), min_size=1, max_size=12))
@settings(max_examples=200, deadline=None)
def test_a_weighted_quantile_is_the_smallest_value_with_the_share_of_the_weight(values):
    residuals, weights = (torch.tensor([value], dtype=torch.float64) for value in zip(*values, strict=True))
    total = sum(weight for _, weight in values)
    reached = [
        number
        for number, _ in values
        if sum(weight for other, weight in values if other <= number) >= Fraction(2, 5) * total and total > 0
    ]
    # with weights of 0 alone, any finite number is accepted
    expected = min((n for n in reached if any(w > 0 for m, w in values if m <= n)), default=None)
    for found in (
        float(weighted_quantile(torch, residuals, weights, 0.4)[0]),
        float(weighted_quantile(np, residuals.numpy(), weights.numpy(), 0.4)[0]),
    ):
        assert math.isfinite(found)
        if expected is not None:
            assert found == expected


# --- the most recent residuals


def test_the_most_recent_residuals_are_kept_with_predictions_and_weights():
    scale = ResidualScale(2).double()
    prediction, target = randn(1300, 2), randn(1300, 2, seed=1)
    weight = torch.rand(1300, 2, generator=generator(), dtype=torch.float64)
    for rows in torch.arange(1300).split(100):
        scale.update(prediction[rows], target[rows], weight[rows])
        seen = int(rows[-1]) + 1
        assert scale.position.unique().tolist() == [seen % MOST_RECENT]
        latest = slice(max(seen - MOST_RECENT, 0), seen)
        kept = torch.stack([(prediction - target)[latest].mT, prediction[latest].mT, weight[latest].mT])
        start = seen % MOST_RECENT if seen >= MOST_RECENT else 0
        found = scale.recent.roll(-start, -1)[..., : kept.shape[-1]]
        assert torch.equal(found, kept)


@pytest.mark.parametrize("rows", [MOST_RECENT - 1, MOST_RECENT, MOST_RECENT + 1, 1000, 5000])
def test_evenly_spaced_residuals_of_a_large_batch_are_kept(rows):
    scale = scale_after(torch.arange(1.0, rows + 1.0, dtype=torch.float64).unsqueeze(-1))
    kept = scale.recent[0, 0].sort().values
    kept = kept[kept > 0]
    assert len(kept) == min(rows, MOST_RECENT)
    gaps = kept.diff()
    assert gaps.min() >= rows // MOST_RECENT
    assert gaps.max() <= max(1, -(-rows // MOST_RECENT))
    assert float(scale.scale) * NORMAL_QUANTILE == pytest.approx(QUANTILE * rows, rel=0.01)


@pytest.mark.parametrize("channels", [1, 128, 129, 500, 1024, 5000])
def test_the_buffer_of_many_channels_stays_small(channels):
    kept = ResidualScale(channels).recent.shape
    assert kept == (3, channels, min(MOST_RECENT, max(FEWEST_RECENT, RECENT_IN_ALL // channels)))
    assert kept[-1] == {1: 512, 128: 512, 129: 508, 500: 131, 1024: 64, 5000: 64}[channels]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_most_extreme_of_evenly_spaced_residuals_give_the_half_range_of_a_large_batch(dtype):
    residual = torch.linspace(-3.0, 5.0, 5 * RANGE_ROWS + 7, dtype=dtype).unsqueeze(-1)
    assert float(scale_after(residual, dtype=dtype).half_range) == pytest.approx(4.0, rel=2.0 / RANGE_ROWS)


@given(
    shape=st.lists(st.integers(1, 6), min_size=1, max_size=4),
    axis=st.integers(0, 3),
    most=st.integers(1, 40),
    permuted=st.permutations(range(4)),
)
@settings(max_examples=100, deadline=None)
def test_spaced_rows_are_rows_of_the_batch_whatever_its_layout(shape, axis, most, permuted):
    axis %= len(shape)
    places = [place for place in permuted if place < len(shape)]
    values = torch.arange(float(math.prod(shape))).reshape(shape)
    strided = values.permute(places).contiguous().permute([places.index(i) for i in range(len(shape))])
    assert torch.equal(strided, values)
    rows = values.movedim(axis, -1).reshape(-1, shape[axis])
    kept = min(len(rows), most)
    expected = rows[[place * len(rows) // kept for place in range(kept)]]
    assert torch.equal(spaced_rows(strided, axis, most), expected)


@pytest.mark.parametrize("shape", [(40, 3, 5), (40, 3, 30, 20), (40, 3)])
def test_channels_in_the_second_dimension_equal_channels_last(shape):
    prediction, target = randn(*shape), randn(*shape, seed=1)
    weight = torch.rand(shape, generator=generator(), dtype=torch.float64)
    left, other = ResidualScale(3).double(), ResidualScale(3).double()
    left.update(prediction, target, weight, channel_dim=1)
    other.update(*(values.movedim(1, -1).contiguous() for values in (prediction, target, weight)))
    torch.testing.assert_close(left.state_dict(), other.state_dict(), rtol=0.0, atol=0.0)


# --- NumPy and torch


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("weighted", [None, "weights", "mask"])
def test_numpy_and_torch_compute_the_same_state(dtype, weighted, monkeypatch):
    """Batches of one row, of fewer and of more than are kept, with residuals that are not finite and residuals of 0."""
    scales = [ResidualScale(3).to(dtype), ResidualScale(3).to(dtype)]
    for n, rows in enumerate([1, 7, 200, 511, 512, 513, 3000, 40, 40, 40, 700, 1]):
        prediction, target = randn(rows, 3, seed=n).to(dtype), randn(rows, 3, seed=100 + n).to(dtype)
        prediction[:, 1] *= 100.0
        if n % 3 == 1:
            prediction[0, 0], prediction[-1, 2], target[:3, 1] = math.nan, math.inf, prediction[:3, 1]
        weight = None
        if weighted:
            weight = torch.rand(rows, 3, generator=generator(n), dtype=torch.float64).to(dtype)
            weight = weight > 0.5 if weighted == "mask" else weight * (weight > 0.2)
        for scale, small in zip(scales, (64, 0), strict=True):
            monkeypatch.setattr(module, "SMALL_STATE", small)
            scale.update(prediction, target, weight)
        rtol = 2e-6 if dtype == torch.float32 else 1e-12
        torch.testing.assert_close(scales[0].state_dict(), scales[1].state_dict(), rtol=rtol, atol=rtol)


def test_many_channels_in_torch_equal_single_channels():
    channels = module.SMALL_STATE + 1
    residual = randn(300, channels)
    many = state_of(scale_after(residual, residual**3))
    few = state_of(scale_after(residual[:, :5], residual[:, :5] ** 3))
    for name, value in few.items():
        torch.testing.assert_close(many[name][:5], value, rtol=1e-12, atol=1e-12)


# --- state


def test_the_state_has_no_gradient_and_keeps_no_graph():
    scale = ResidualScale(1)
    prediction = randn(20, 1).float().requires_grad_()
    scale.update(2.0 * prediction, torch.zeros(20, 1))
    assert not list(scale.parameters())
    assert not any(value.requires_grad for value in scale.state_dict().values())


def test_update_is_the_only_method_that_changes_the_state():
    scale = scale_after(randn(30, 2))
    before = copy.deepcopy(scale.state_dict())
    x, y = randn(40, 2, seed=5), randn(40, 2, seed=6)
    scale.with_batch(x, y, None, -1)
    _ = scale.scale, scale.bound
    scale.eval().train()
    torch.testing.assert_close(scale.state_dict(), before, rtol=0.0, atol=0.0)


def test_with_batch_equals_an_update_for_channels_without_a_batch():
    scale = scale_after((randn(30, 2), torch.tensor([True, False]).expand(30, 2)))
    x, y, weight = 5.0 * randn(40, 2, seed=5), randn(40, 2, seed=6), torch.rand(40, 2, generator=generator())
    seen = scale.with_batch(x, y, weight, -1)
    for name in ("log_scale", "half_range"):
        assert float(getattr(seen, name)[0]) == float(getattr(scale, name)[0])
    scale.update(x, y, weight)
    for name in ("log_scale", "half_range"):
        assert float(getattr(seen, name)[1]) == pytest.approx(float(getattr(scale, name)[1]), rel=1e-12)


def test_a_scale_resumed_from_a_state_dict_is_bitwise_equal():
    batches = [randn(90, 2, seed=n) * 1.1**n for n in range(20)]
    scale, resumed = scale_after(*batches[:13]), ResidualScale(2).double()
    resumed.load_state_dict(copy.deepcopy(scale.state_dict()))
    for batch in batches[13:]:
        for value in (scale, resumed):
            value.update(batch, torch.zeros_like(batch))
    torch.testing.assert_close(scale.state_dict(), resumed.state_dict(), rtol=0.0, atol=0.0)
