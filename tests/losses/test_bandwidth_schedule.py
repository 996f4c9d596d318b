"""The schedule from the sharp initial loss to Welsch's at the selected bandwidth: arithmetic on a counter."""

import copy
import math

import pytest
import torch

from mkc_torch.density.energy import energy
from mkc_torch.losses import bandwidth_schedule as module
from mkc_torch.losses._bandwidth_selection import BandwidthSelection
from mkc_torch.losses._initial_loss import initial_loss
from mkc_torch.losses.bandwidth_schedule import ANNEAL_STEP, SELECTION_INTERVAL, WARMUP_STEPS, BandwidthSchedule
from mkc_torch.losses.residual_scale import RATE, ResidualScale


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def randn(*size, seed=0):
    return torch.randn(*size, generator=generator(seed), dtype=torch.float64)


def scale_after(residual, prediction=None):
    """A running scale after one batch."""
    scale = ResidualScale(residual.shape[-1]).double()
    prediction = torch.zeros_like(residual) if prediction is None else prediction
    scale.update(prediction, prediction - residual)
    return scale


def fix_selection(monkeypatch, bandwidth, better):
    """Replace the selection by a constant; ``better`` may be changed in place."""
    bandwidth, better = torch.tensor(bandwidth, dtype=torch.float64), torch.tensor(better)

    def selected(xp, *_):
        given = (bandwidth, better) if xp is torch else (bandwidth.numpy(), better.numpy())
        return BandwidthSelection(*given)

    monkeypatch.setattr(module, "select_bandwidth", selected)
    return better


@pytest.fixture(params=["NumPy", "torch"])
def array_library(request, monkeypatch):
    if request.param == "torch":
        monkeypatch.setattr(module, "SMALL_STATE", 0)
    return request.param


# --- the share


@pytest.mark.usefixtures("array_library")
def test_the_share_is_0_in_the_warm_up_and_then_grows_at_every_fourth_batch(monkeypatch):
    fix_selection(monkeypatch, [2.0], [True])
    scale, schedule = scale_after(randn(20, 1)), BandwidthSchedule(1).double()
    for batch in range(3 * WARMUP_STEPS):
        schedule.update(scale)
        assert schedule.steps.tolist() == [batch + 1]
        selections = max(0, batch - WARMUP_STEPS) // SELECTION_INTERVAL + 1 if batch >= WARMUP_STEPS else 0
        assert float(schedule.share) == pytest.approx(min(selections * SELECTION_INTERVAL * ANNEAL_STEP, 1.0))
    assert WARMUP_STEPS % SELECTION_INTERVAL == 0
    assert (WARMUP_STEPS, ANNEAL_STEP, SELECTION_INTERVAL) == (100, 0.005, 4)


@pytest.mark.usefixtures("array_library")
def test_the_share_falls_if_the_initial_loss_has_the_smaller_risk_and_stays_in_0_and_1(monkeypatch):
    better = fix_selection(monkeypatch, [2.0, 2.0], [True, False])
    scale, schedule = scale_after(randn(20, 2)), BandwidthSchedule(2, warmup_steps=0, anneal_step=0.1).double()
    shares = []
    for batch in range(32):
        if batch == 16:
            better.logical_not_()
        schedule.update(scale)
        if batch % SELECTION_INTERVAL == 0:
            shares.append(schedule.share.tolist())
    rise, fall = [0.4, 0.8, 1.0, 1.0], [0.6, 0.2, 0.0, 0.0]
    assert [first for first, _ in shares] == pytest.approx(rise + fall)
    assert [second for _, second in shares] == pytest.approx([0.0] * 4 + rise)


@pytest.mark.parametrize("warmup_steps", [0, 1, 2, 7, 8])
def test_the_length_of_the_warm_up_is_an_argument(warmup_steps, monkeypatch):
    fix_selection(monkeypatch, [2.0], [True])
    scale, schedule = scale_after(randn(20, 1)), BandwidthSchedule(1, warmup_steps=warmup_steps)
    batches = 0
    while float(schedule.share) == 0.0:
        schedule.update(scale)
        batches += 1
    assert batches == -(-warmup_steps // SELECTION_INTERVAL) * SELECTION_INTERVAL + 1


@pytest.mark.usefixtures("array_library")
def test_a_channel_without_residuals_is_not_annealed(monkeypatch):
    fix_selection(monkeypatch, [2.0, 2.0], [True, True])
    scale, schedule = ResidualScale(2).double(), BandwidthSchedule(2, warmup_steps=0).double()
    scale.update(randn(20, 2), torch.zeros(20, 2), torch.tensor([True, False]).expand(20, 2))
    schedule.update(scale)
    assert schedule.share.tolist() == pytest.approx([SELECTION_INTERVAL * ANNEAL_STEP, 0.0])


# --- the bandwidth


@pytest.mark.usefixtures("array_library")
def test_the_log_bandwidth_is_a_running_mean_over_every_fourth_batch(monkeypatch):
    scale, schedule, mean = scale_after(randn(20, 1)), BandwidthSchedule(1).double(), 0.0
    widths = [64.0, 2.0, 2.0, 8.0, 0.5, 1.0] * 3
    for batch in range(SELECTION_INTERVAL * len(widths)):
        width = widths[batch // SELECTION_INTERVAL]
        fix_selection(monkeypatch, [width if batch % SELECTION_INTERVAL == 0 else math.nan], [True])
        schedule.update(scale)
        if batch % SELECTION_INTERVAL == 0:
            # the same number of single updates of a tenth
            rate = min(max(SELECTION_INTERVAL / (batch + 1), 1.0 - (1.0 - RATE) ** SELECTION_INTERVAL), 1.0)
            mean += rate * (math.log(width) - mean)
        assert float(schedule.log_bandwidth) == pytest.approx(mean, abs=1e-12)
        assert float(schedule.bandwidth) == pytest.approx(math.exp(mean))


def test_clean_residuals_lead_to_a_wide_bandwidth_and_permuted_targets_of_a_shrunk_fit_to_a_narrow_one():
    truth = randn(512)
    noise, permuted = 0.2 * randn(512, seed=1), truth.clone()
    permuted[::2] = truth[::2].roll(7)
    prediction = torch.stack([truth, 0.5 * truth], -1)
    scale = scale_after(prediction - torch.stack([truth + noise, permuted + noise], -1), prediction)
    schedule = BandwidthSchedule(2, warmup_steps=20, anneal_step=0.05).double()
    for _ in range(60):
        schedule.update(scale)
    assert schedule.share.tolist() == pytest.approx([1.0, 1.0])
    assert float(schedule.bandwidth[0]) > 2.8
    assert float(schedule.bandwidth[1]) < 2.0


# --- the loss


def test_the_energy_is_the_mixture_of_both_losses():
    schedule = BandwidthSchedule(3).double()
    schedule.share.copy_(torch.tensor([0.0, 0.25, 1.0]))
    schedule.log_bandwidth.copy_(torch.tensor([0.5, 2.0, 3.0], dtype=torch.float64).log())
    z = 3.0 * randn(50, 3)
    initial, welsch = initial_loss(torch, z), energy(z, torch.tensor([4.0, 0.25, 1.0 / 9.0], dtype=torch.float64))
    expected = torch.stack([initial[:, 0], 0.25 * welsch[:, 1] + 0.75 * initial[:, 1], welsch[:, 2]], -1)
    torch.testing.assert_close(schedule.energy(z), expected, rtol=1e-10, atol=1e-12)


def test_influence_of_far_residuals_follows_a_root_at_first_and_is_0_when_annealed():
    schedule, z = BandwidthSchedule(1), torch.tensor([[20.0], [80.0]], requires_grad=True)
    (early,) = torch.autograd.grad(schedule.energy(z).sum(), z)
    assert float(early[0] / early[1]) == pytest.approx(2.0, rel=1e-3)
    schedule.share.fill_(1.0)
    (late,) = torch.autograd.grad(schedule.energy(z).sum(), z)
    assert late.tolist() == [[0.0], [0.0]]


# --- state


@pytest.mark.parametrize("channels", [1, 3, module.SMALL_STATE + 1])
def test_numpy_and_torch_follow_the_same_schedule(channels, monkeypatch):
    scale, schedules = ResidualScale(channels).double(), [BandwidthSchedule(channels, warmup_steps=8) for _ in range(2)]
    for batch in range(40):
        prediction = randn(60, channels, seed=batch) * 1.05**batch
        noise = randn(60, channels, seed=batch + 100)
        noise[::5] *= torch.linspace(1.0, 30.0, channels, dtype=torch.float64)
        scale.update(prediction, prediction - noise, (noise < 40.0).double())
        for schedule, small in zip(schedules, (64, 0), strict=True):
            monkeypatch.setattr(module, "SMALL_STATE", small)
            schedule.double().update(scale)
        torch.testing.assert_close(schedules[0].state_dict(), schedules[1].state_dict(), rtol=1e-12, atol=1e-12)
    assert float(schedules[0].share.max()) > 0.0


def test_channels_are_independent():
    residual = randn(100, 3) ** 3 * torch.tensor([1.0, 10.0, 1e-3])
    schedules = [BandwidthSchedule(m, warmup_steps=0).double() for m in (3, 1)]
    for _ in range(9):
        schedules[0].update(scale_after(residual))
        schedules[1].update(scale_after(residual[:, 1:2]))
    for name, value in schedules[1].state_dict().items():
        assert value.item() == pytest.approx(schedules[0].state_dict()[name][1].item(), rel=1e-12)


def test_an_update_does_not_change_the_scale_and_has_no_gradient():
    scale, schedule = scale_after(randn(100, 2)), BandwidthSchedule(2, warmup_steps=0).double()
    before = copy.deepcopy(scale.state_dict())
    schedule.update(scale)
    torch.testing.assert_close(scale.state_dict(), before, rtol=0.0, atol=0.0)
    assert not list(schedule.parameters())
    assert not any(value.requires_grad for value in schedule.state_dict().values())


@pytest.mark.parametrize("at", [1, 2, 3, 4, 121])
def test_a_schedule_resumed_from_a_state_dict_is_bitwise_equal(at):
    scales = [scale_after(randn(100, 1, seed=seed) ** 3) for seed in range(6)]
    schedule, resumed = (BandwidthSchedule(1, warmup_steps=3) for _ in range(2))
    for batch in range(at):
        schedule.update(scales[batch % 6])
    resumed.load_state_dict(copy.deepcopy(schedule.state_dict()))
    for scale in scales:
        schedule.update(scale)
        resumed.update(scale)
    torch.testing.assert_close(schedule.state_dict(), resumed.state_dict(), rtol=0.0, atol=0.0)
