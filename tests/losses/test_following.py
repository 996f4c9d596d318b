"""A loss that takes scale and domain from its residuals: units, wrong targets, and what holds while it follows."""

import copy
import math
import socket

import pytest
import torch
import torch.multiprocessing
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from mkc_torch import MKCLoss
from mkc_torch.functional import mkc_nll
from mkc_torch.losses.bandwidth_schedule import BandwidthSchedule
from mkc_torch.losses.residual_scale import ResidualScale

N = 600


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def sampled(seed=0, noise=0.3):
    """Inputs, the truth, and targets with Gaussian noise."""
    g = generator(seed)
    x = torch.rand(N, 3, generator=g)
    truth = torch.sin(4.0 * x[:, :1]) + x[:, 1:2] * x[:, 2:]
    return x, truth, truth + noise * torch.randn(N, 1, generator=g)


def wrong(target, share, kind, seed=1):
    g = generator(seed)
    count = int(share * N)
    rows = torch.randperm(N, generator=g)[:count]
    target = target.clone()
    if kind == "one-sided":
        target[rows] += 3.0 + 7.0 * torch.rand(count, 1, generator=g)
    elif kind == "factor 1000":
        target[rows] *= 1000.0
    else:
        target[rows] = 20.0 * torch.rand(count, 1, generator=g) - 10.0
    return target


class Scaled(nn.Module):
    """A network whose last step is the target's unit, as a model of a physical quantity has it."""

    def __init__(self, scale=1.0, offset=0.0):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(3, 32), nn.SiLU(), nn.Linear(32, 1))
        self.scale, self.offset = scale, offset

    def forward(self, x):
        return self.layers(x) * self.scale + self.offset


def trained(loss, x, y, seed=0, steps=500, scale=1.0, offset=0.0):
    torch.manual_seed(seed)
    model = Scaled(scale, offset)
    groups = [{"params": list(model.parameters())}]
    groups += loss.param_groups(lr=1e-2) if isinstance(loss, MKCLoss) else []
    optimiser = torch.optim.Adam(groups, lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        optimiser.zero_grad()
        loss(model(x), y).backward()
        optimiser.step()
        schedule.step()
    return model


def off(model, x, truth):
    with torch.no_grad():
        return float((model(x) - truth).square().mean().sqrt())


# --- right as it comes


@pytest.mark.parametrize(("scale", "offset"), [(1e-6, 0.0), (1e6, 0.0), (1e-3, 0.1), (200.0, 1000.0)])
def test_a_target_of_any_unit_and_offset_is_learned_as_a_standardised_one(scale, offset):
    x, truth, y = sampled()
    y = wrong(y, 0.2, "uniform")
    plain = off(trained(MKCLoss(1), x, y), x, truth)
    other = trained(MKCLoss(1), x, y * scale + offset, scale=scale, offset=offset)
    assert off(other, x, truth * scale + offset) / scale == pytest.approx(plain, rel=0.05)
    assert plain < 0.1


def test_a_plain_network_gets_to_targets_that_nobody_scaled():
    x, truth, y = sampled()
    truth, y = 1000.0 + 200.0 * truth, wrong(1000.0 + 200.0 * y, 0.2, "factor 1000")
    torch.manual_seed(0)
    errors = []
    for loss in (MKCLoss(1), nn.MSELoss()):
        model = nn.Sequential(nn.Linear(3, 32), nn.SiLU(), nn.Linear(32, 1))
        own = loss.param_groups(lr=1e-2) if isinstance(loss, MKCLoss) else []
        optimiser = torch.optim.Adam([{"params": list(model.parameters())}, *own], lr=0.5)
        for _ in range(600):
            optimiser.zero_grad()
            loss(model(x), y).backward()
            optimiser.step()
        errors.append(off(model, x, truth) / 200.0)
    assert errors[0] < 0.25
    assert errors[1] > 10.0


def test_on_clean_targets_it_is_as_good_as_least_squares():
    errors = []
    for seed in range(3):
        x, truth, y = sampled(seed)
        errors.append([off(trained(loss, x, y, seed), x, truth) for loss in (MKCLoss(1), nn.MSELoss())])
    ours, squares = torch.tensor(errors).mean(0).tolist()
    assert ours < 1.02 * squares


@pytest.mark.parametrize("kind", ["one-sided", "factor 1000", "uniform"])
def test_half_of_the_targets_may_be_wrong(kind):
    x, truth, y = sampled()
    error = off(trained(MKCLoss(1), x, wrong(y, 0.5, kind)), x, truth)
    absolute = off(trained(nn.L1Loss(), x, wrong(y, 0.5, kind)), x, truth)
    assert error < 0.15
    assert error < absolute


def test_half_of_the_targets_may_be_permuted_among_each_other():
    errors = []
    for seed in (3, 4):
        x, truth, y = sampled(seed)
        rows = torch.randperm(N, generator=generator(seed))[: N // 2]
        y[rows] = y[rows.roll(1)]
        losses = MKCLoss(1), nn.L1Loss(), nn.MSELoss()
        errors.append([off(trained(loss, x, y, seed), x, truth) for loss in losses])
    ours, absolute, squares = torch.tensor(errors).mean(0).tolist()
    assert ours < absolute
    assert ours < 0.9 * squares


def test_sigma_and_d_describe_the_noise():
    x, _, y = sampled(noise=0.3)
    clean, heavy = MKCLoss(1), MKCLoss(1)
    trained(clean, x, y)
    trained(heavy, x, wrong(y, 0.3, "uniform"))
    assert clean.d.item() == pytest.approx(0.3, rel=0.15)
    assert heavy.d.item() == pytest.approx(0.3, rel=0.25)
    assert heavy.sigma.item() < clean.sigma.item()
    assert float(heavy.bound) == pytest.approx(10.0, rel=0.2)


# --- what it computes


@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
def test_the_value_is_the_likelihood_of_the_sigma_d_and_bound_that_it_shows(reduction):
    loss = MKCLoss(2, reduction=reduction).double()
    x, y = torch.randn(2, 50, 2, generator=generator(), dtype=torch.float64)
    value = loss(x.requires_grad_(), y)
    expected = mkc_nll(x - y, loss.sigma, loss.d, loss.bound)
    expected = {"none": expected, "mean": expected.mean(), "sum": expected.sum()}[reduction]
    torch.testing.assert_close(value, expected, rtol=1e-6, atol=1e-6)
    assert loss.bound.tolist() >= (10.0 * loss.d).tolist()


@pytest.mark.parametrize("reduction", ["none", "sum"])
def test_elements_and_sums_pull_alike(reduction):
    x, y = torch.randn(2, 40, 2, generator=generator())
    weight = torch.rand(40, 2, generator=generator(1))
    slopes = []
    for kind in (reduction, "mean"):
        leaf = x.clone().requires_grad_()
        value = MKCLoss(2, reduction=kind)(leaf, y, weight)
        (slope,) = torch.autograd.grad(value.sum() * (1.0 if kind != "mean" else weight.sum()), leaf)
        slopes.append(slope)
    torch.testing.assert_close(*slopes)


def test_a_weight_is_judged_by_the_likelihood():
    x, y = torch.randn(2, 40, 1, generator=generator())
    weight, loss = torch.ones(40, 1, requires_grad=True), MKCLoss(1, reduction="sum")
    (slope,) = torch.autograd.grad(loss(x, y, weight), weight)
    torch.testing.assert_close(slope, mkc_nll(x - y, loss.sigma, loss.d, loss.bound).detach(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("reduction", ["none", "mean"])
def test_a_target_is_pulled_as_hard_as_its_prediction_the_other_way(reduction):
    x, y = (t.requires_grad_() for t in torch.randn(2, 40, 1, generator=generator()).unbind(0))
    loss = MKCLoss(1, reduction=reduction)
    by_input, by_target = torch.autograd.grad(loss(x, y).sum(), (x, y))
    torch.testing.assert_close(by_input, -by_target)


@given(exponent=st.floats(-6.0, 6.0), seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_scale_domain_and_pull_have_the_unit_of_the_target(exponent, seed):
    scale = 10.0**exponent
    x, y = torch.randn(2, 30, 1, generator=generator(seed), dtype=torch.float64)
    found = []
    for unit in (1.0, scale):
        loss, leaf = MKCLoss(1).double(), (unit * x).requires_grad_()
        value = loss(leaf, unit * y)
        (pull,) = torch.autograd.grad(value, leaf)
        found.append((value - math.log(unit), loss.d / unit, loss.bound / unit, loss.d_min / unit, pull * unit))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)


def test_the_scale_is_robust_in_each_channel_and_about_nothing():
    loss = MKCLoss(2)
    error = torch.randn(1000, 2, generator=generator()) * torch.tensor([1.0, 50.0])
    error[:450, 0] = 1e4
    loss(error.requires_grad_(), torch.zeros(1000, 2))
    assert 1.0 < loss.d[0].item() < 3.0
    assert loss.d[1].item() == pytest.approx(50.0, rel=0.1)
    offset = MKCLoss(1)
    offset(torch.full((100, 1), 1000.0), torch.zeros(100, 1))
    assert offset.d.item() == pytest.approx(1000.0 / 0.5244, rel=1e-3)


def test_the_least_scale_is_a_thousandth_of_the_spread_about_an_offset():
    error = 1000.0 + 2.0 * torch.randn(500, 1, generator=generator())
    loss = MKCLoss(1)
    loss(error, torch.zeros(500, 1))
    spread = (error - error.mean()).abs().mean()
    assert float(loss.d_min) == pytest.approx(1e-3 * float(spread), rel=1e-3)


def test_the_scale_follows_residuals_that_shrink():
    loss = MKCLoss(1)
    noise = torch.randn(100, 1, generator=generator())
    for step in range(120):
        loss(noise * 100.0 * 0.9 ** min(step, 60), torch.zeros(100, 1))
    assert loss.d.item() == pytest.approx(100.0 * 0.9**60, rel=0.2)


def test_what_does_not_count_has_no_part_in_the_scale():
    error = torch.randn(200, 1, generator=generator())
    spoilt = error.clone()
    spoilt[::2] = math.nan
    mask = torch.ones(200, 1, dtype=torch.bool)
    mask[::2] = False
    one, other = MKCLoss(1), MKCLoss(1)
    one(spoilt, torch.zeros(200, 1), mask)
    other(error[1::2], torch.zeros(100, 1))
    torch.testing.assert_close(one.d, other.d)
    torch.testing.assert_close(one.bound, other.bound)


@pytest.mark.parametrize("batch", [torch.zeros(5, 1), torch.ones(1, 1), torch.full((3, 1), 1e-30)])
def test_batches_of_one_or_without_errors_stay_finite(batch):
    loss = MKCLoss(1)
    for _ in range(3):
        leaf = batch.clone().requires_grad_()
        value = loss(leaf, torch.zeros_like(batch))
        value.backward()
        assert value.isfinite()
        assert leaf.grad.isfinite().all()
        assert all(p.grad.isfinite().all() for p in loss.parameters())


def test_a_batch_that_is_masked_throughout_changes_no_scale():
    loss, x = MKCLoss(1), torch.randn(50, 1, generator=generator())
    loss(x, torch.zeros(50, 1))
    before = loss.d.detach().clone()
    assert loss(x, torch.zeros(50, 1), torch.zeros(50, 1)).item() == 0.0
    torch.testing.assert_close(loss.d.detach(), before)


def test_the_network_begins_with_a_loss_sharper_than_the_absolute_value_and_ends_where_far_errors_pull_at_nothing():
    error = torch.randn(200, 1, generator=generator())
    error[0], error[1] = 20.0, 80.0
    loss, leaf = MKCLoss(1), error.clone().requires_grad_()
    (early,) = torch.autograd.grad(loss(leaf, torch.zeros(200, 1)), leaf)
    assert float(early[0] / early[1]) == pytest.approx(2.0, rel=1e-3)
    loss.schedule.share.fill_(1.0)
    loss.schedule.log_bandwidth.fill_(0.0)
    (late,) = torch.autograd.grad(loss(leaf, torch.zeros(200, 1)), leaf)
    assert float(late[1].abs()) < 1e-6 * float(early[1].abs())


# --- state


def test_evaluation_changes_nothing_and_takes_the_scale_from_its_own_batch_at_first():
    x, y = torch.zeros(50, 1), 1e3 * torch.randn(50, 1, generator=generator())
    fresh, used = MKCLoss(1).eval(), MKCLoss(1)
    before = copy.deepcopy(fresh.state_dict())
    assert fresh(x, y).item() == pytest.approx(used(x, y).item(), rel=1e-5)
    assert all(torch.equal(before[name], value) for name, value in fresh.state_dict().items())
    used.eval()
    value = used(x, 100.0 * y)
    assert used(x, 100.0 * y).item() == value.item()
    with torch.no_grad():
        used.train()(x, 100.0 * y)
    assert used.eval()(x, 100.0 * y).item() == value.item()


def test_a_state_dict_carries_what_was_followed():
    loss, other = MKCLoss(2), MKCLoss(2)
    x, y = torch.randn(2, 50, 2, generator=generator())
    for _ in range(5):
        loss(x, 7.0 * y)
    other.load_state_dict(loss.state_dict())
    assert other(x, y).item() == loss(x, y).item()
    assert repr(other) == repr(loss)


@pytest.mark.parametrize("options", [{}, {"learn_sigma": False, "learn_d": False, "normalize": True}])
def test_what_was_followed_loads_into_a_loss_with_numbers(options):
    loss, other = MKCLoss(2), MKCLoss(2, sigma=1.0, d=1.0, bound=9.0, **options)
    x, y = torch.randn(2, 50, 2, generator=generator())
    loss(x, 7.0 * y)
    other.load_state_dict(loss.state_dict())
    for name in ("sigma", "d", "bound", "d_min"):
        torch.testing.assert_close(getattr(other, name), getattr(loss, name), rtol=1e-5, atol=0.0)
    assert other.eval()(x, y).item() == pytest.approx(loss.eval()(x, y).item(), rel=1e-4)


def test_settled_it_is_a_loss_with_numbers():
    loss = MKCLoss(1)
    x, y = torch.randn(2, 50, 1, generator=generator())
    loss(x, y)
    d, value = loss.d.item(), loss.eval()(x, y).item()
    loss.train().freeze_scale()
    assert loss.d.item() == pytest.approx(d, rel=1e-5)
    assert loss(x, y).item() == pytest.approx(value, rel=1e-4)
    assert loss(x, 100.0 * y).item() > value
    assert loss.d.item() == pytest.approx(d, rel=1e-5)
    loss.d = 2.0
    assert loss.d.item() == pytest.approx(2.0)


def test_d_is_not_set_while_it_is_followed():
    with pytest.raises(ValueError, match="a given `d` to set it but got one that takes d from the residuals"):
        MKCLoss(1).d = 2.0


def test_given_numbers_are_kept():
    loss = MKCLoss(1, bound=50.0, d_min=0.25)
    for size in (1e-3, 1e4):
        loss(size * torch.randn(50, 1, generator=generator()), torch.zeros(50, 1))
        assert (float(loss.bound), float(loss.d_min)) == (50.0, 0.25)
        assert 0.25 <= loss.d.item() <= 25.0
    assert MKCLoss(1, d=2.0).residual_scale is None
    assert MKCLoss(1, d=2.0).bound.item() == 200.0


# --- accumulation, compilation, transforms, processes


def test_gradients_accumulate_over_batches():
    loss, model = MKCLoss(1), nn.Linear(2, 1)
    x, y = torch.randn(64, 2, generator=generator()), torch.randn(64, 1, generator=generator(1))
    sum(loss(model(a), b) for a, b in zip(x.split(16), y.split(16), strict=True)).backward()
    assert model.weight.grad.isfinite().all()
    assert int(loss.schedule.steps) == 4


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_a_compiled_loss_follows_alike():
    torch.compiler.reset()
    eager = MKCLoss(2)
    own = copy.deepcopy(eager)
    compiled = torch.compile(own, fullgraph=True)
    for step in range(3):
        x, y = torch.randn(2, 64, 2, generator=generator(step))
        a, b = x.clone().requires_grad_(), x.clone().requires_grad_()
        one, other = eager(a, y), compiled(b, y)
        one.backward()
        other.backward()
        torch.testing.assert_close(one, other)
        torch.testing.assert_close(a.grad, b.grad)
    torch.testing.assert_close(own.state_dict(), eager.state_dict())


def test_transforms_of_functions_leave_the_state_alone():
    loss = MKCLoss(1)
    x, y = torch.randn(2, 20, 1, generator=generator())
    loss(x, y)
    before = copy.deepcopy(loss.state_dict())
    slopes = torch.func.vmap(torch.func.grad(lambda a, b: loss(a, b)))(x, y)
    assert slopes.isfinite().all()
    assert slopes.abs().sum() > 0
    assert all(torch.equal(before[name], value) for name, value in loss.state_dict().items())


def test_half_precision_is_followed_in_single():
    loss = MKCLoss(1)
    x = torch.randn(100, 1, generator=generator())
    with torch.autocast("cpu", torch.bfloat16):
        value = loss(x.bfloat16(), torch.zeros(100, 1).bfloat16())
    assert value.dtype == torch.float32
    assert {b.dtype for b in loss.half().buffers()} == {torch.float32}


def _process(rank, port, queue):
    torch.distributed.init_process_group("gloo", f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    loss = MKCLoss(1)
    for step in range(3):
        x = torch.randn(50, 1, generator=generator(10 * rank + step))
        loss((1.0 + 3.0 * rank) * x, torch.zeros(50, 1))
    queue.put([loss.d.item(), float(loss.bound), float(loss.d_min), float(loss.schedule.log_bandwidth)])
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()


def test_processes_follow_alike():
    context = torch.multiprocessing.get_context("spawn")
    queue = context.SimpleQueue()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.spawn(_process, (port, queue), nprocs=2)
    one, other = queue.get(), queue.get()
    assert one == other
    assert 1.2 < one[0] < 3.5


def test_what_is_remembered_of_many_channels_stays_small():
    assert Following(1).recent.shape == (1, 1024)
    assert Following(10_000).recent.shape == (10_000, 64)


def test_a_loss_that_settles_on_its_floor_can_be_learned_on():
    loss = MKCLoss(1)
    noise = torch.randn(50, 1, generator=generator())
    for size in [1.0, *[1e-9] * 50]:
        loss((size * noise).requires_grad_(), torch.zeros(50, 1))
    torch.testing.assert_close(loss.d, loss.d_min)
    loss.freeze_scale()
    torch.testing.assert_close(loss.d, loss.d_min)
    slopes = torch.autograd.grad(loss(1e-9 * noise, torch.zeros(50, 1)), list(loss.parameters()))
    assert all(bool(torch.isfinite(one).all()) for one in (*slopes, *loss.parameters()))


def test_a_guide_steers_a_loss_of_given_d_in_training_alone():
    x, y = torch.randn(2, 40, 1, generator=generator())
    plain, loss, guide = MKCLoss(1, d=1.0), MKCLoss(1, d=1.0), Following(1)
    loss.follow_guide(guide)

    def looked_at(one):
        leaf = x.clone().requires_grad_()
        value = one(leaf, y)
        return value.detach(), torch.autograd.grad(value, leaf)[0]

    (value, pull), (own_value, own_pull) = looked_at(loss), looked_at(plain)
    torch.testing.assert_close(value, own_value)
    assert not torch.allclose(pull, own_pull, rtol=0.1)
    assert int(guide.seen) == 1
    torch.testing.assert_close(looked_at(loss.eval()), looked_at(plain.eval()))
    assert int(guide.seen) == 1
    loss.train().follow_guide(None)
    torch.testing.assert_close(looked_at(loss)[1], own_pull)


# --- warnings


def fitted(loss, error, steps=200, moved=True):
    leaf = error.clone().requires_grad_()
    optimiser = torch.optim.SGD([*loss.parameters()] if moved else [leaf], lr=1e-3)
    for _ in range(steps):
        loss(leaf, torch.zeros_like(leaf)).backward()
        optimiser.step()


def test_errors_beyond_a_given_bound_are_warned_of_once():
    error = torch.randn(100, 2, generator=generator())
    error[:5, 1] = 40.0
    with pytest.warns(UserWarning, match=r"channel 1 5 % lie beyond the bound \[20.0\].*`bound` out") as told:
        fitted(MKCLoss(2, d=1.0, bound=torch.tensor([50.0, 20.0])), error)
    assert len(told) == 1
    fitted(MKCLoss(2), error)


def test_sigma_and_d_that_no_optimiser_has_are_warned_of_once():
    error = torch.randn(100, 1, generator=generator())
    with pytest.warns(UserWarning, match=r"sigma and d have had gradients and have not moved .*param_groups") as told:
        fitted(MKCLoss(1), error, moved=False)
    assert len(told) == 1


def test_a_network_that_fits_every_point_is_warned_of():
    target = torch.linspace(-1.0, 1.0, 16).unsqueeze(-1)
    points, loss = target + torch.randn(16, 1, generator=generator()), MKCLoss(1)
    points.requires_grad_()
    optimiser = torch.optim.Adam([points, *loss.parameters()], lr=0.03)

    def interpolate():
        for _ in range(1500):
            optimiser.zero_grad()
            loss(points, target).backward()
            optimiser.step()
            optimiser.param_groups[0]["lr"] *= 0.995

    with pytest.warns(UserWarning, match=r"scale d of channel 0 fell to .* next to its floor"):
        interpolate()
