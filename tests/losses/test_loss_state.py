"""The running state of a loss: batches, resumed training, ensembles and processes."""

import copy
import io
import math
import socket

import pytest
import torch
import torch.multiprocessing
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.func import functional_call, grad, stack_module_state, vmap
from torch.nn.parallel import DistributedDataParallel
from torch.utils.checkpoint import checkpoint

from mkc_torch import MKCLoss
from mkc_torch.losses.residual_scale import MOST_RECENT, ResidualScale

FIXED = {"learn_sigma": False, "learn_d": False}
ROBUST = {"default": {}, "given d": {"d": 1.5, "objective": "robust"}}
each_robust = pytest.mark.parametrize("options", ROBUST.values(), ids=ROBUST)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def data(count, m=2, seed=0):
    return torch.randn(2, count, m, generator=generator(seed)).unbind(0)


def state(loss):
    return copy.deepcopy(loss.state_dict())


def assert_same(left, other):
    assert list(left) == list(other)
    torch.testing.assert_close(left, other, rtol=0.0, atol=0.0)


def loss_after(*sizes, **options):
    """A loss after batches."""
    loss = MKCLoss(2, **options)
    for n, size in enumerate(sizes):
        x, y = data(50, seed=n)
        loss(x, size * y)
    return loss


# --- content


def test_the_state_dict_is_small():
    entries = MKCLoss(2).state_dict()
    assert len(entries) <= 12
    assert entries["residual_scale.recent"].shape == (3, 2, MOST_RECENT)
    assert MOST_RECENT == 512
    others = [value.numel() for name, value in entries.items() if name != "residual_scale.recent"]
    assert max(others) == 2
    assert len(MKCLoss(2, d=1.0).state_dict()) == 4


def test_half_precision_keeps_the_state_in_float32_and_its_counters_integer():
    loss = loss_after(1.0, 2.0)
    before = state(loss)
    for half in (loss.half(), loss.bfloat16(), loss.float()):
        assert_same(state(half), before)
    with torch.autocast("cpu", torch.bfloat16):
        value = loss(torch.ones(100, 2).bfloat16(), torch.zeros(100, 2).bfloat16())
    assert value.dtype == torch.float32


@given(exponent=st.floats(-6.0, 6.0), seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_scale_bound_and_gradient_have_the_unit_of_the_target(exponent, seed):
    scale = 10.0**exponent
    x, y = torch.randn(2, 30, 1, generator=generator(seed), dtype=torch.float64)
    found = []
    for unit in (1.0, scale):
        loss, leaf = MKCLoss(1).double(), (unit * x).requires_grad_()
        value = loss(leaf, unit * y)
        (gradient,) = torch.autograd.grad(value, leaf)
        found.append((value - math.log(unit), loss.d / unit, loss.bound / unit, loss.d_min / unit, gradient * unit))
    for entry, other in zip(*found, strict=True):
        torch.testing.assert_close(entry, other, rtol=1e-6, atol=1e-9)


def test_a_given_bound_and_lower_limit_of_d_are_kept():
    loss = MKCLoss(1, bound=50.0, d_min=0.25)
    for size in (1e-3, 1e4):
        loss(size * torch.randn(50, 1, generator=generator()), torch.zeros(50, 1))
        assert (float(loss.bound), float(loss.d_min)) == (50.0, 0.25)
        assert 0.25 <= loss.d.item() <= 25.0
    robust = MKCLoss(1, d=2.0, objective="robust")
    robust(*data(50, 1))
    assert (robust.d.item(), robust.bound.item(), robust.d_min.item()) == pytest.approx((2.0, 200.0, 2e-3))
    assert MKCLoss(1, d=2.0).residual_scale is None
    assert MKCLoss(1, d=2.0).bound.item() == 200.0


def test_d_follows_the_residuals_and_learns_a_factor_on_them():
    loss = loss_after(1.0, 1.0)
    torch.testing.assert_close(loss.d.detach(), loss.residual_scale.scale)
    with torch.no_grad():
        loss.raw_d.fill_(2.0 * math.atanh(0.5 * math.log(1.5)))
    torch.testing.assert_close(loss.d, 1.5 * loss.residual_scale.scale)
    for extreme in (-1e3, 1e3):
        with torch.no_grad():
            loss.raw_d.fill_(extreme)
        expected = math.exp(math.copysign(2.0, extreme)) * loss.residual_scale.scale
        torch.testing.assert_close(loss.d.detach(), expected.clamp(max=0.5 * loss.bound))


@pytest.mark.parametrize("batch", [torch.zeros(5, 1), torch.ones(1, 1), torch.full((3, 1), 1e-30)])
@pytest.mark.parametrize("options", [{}, {"d": 1.5, "objective": "robust"}, {"objective": "likelihood"}])
def test_single_element_and_zero_error_batches_stay_finite(batch, options):
    loss = MKCLoss(1, **options)
    for _ in range(3):
        leaf = batch.clone().requires_grad_()
        value = loss(leaf, torch.zeros_like(batch))
        value.backward()
        assert value.isfinite()
        assert leaf.grad.isfinite().all()
        assert all(p.grad.isfinite().all() for p in loss.parameters())


# --- updates by batches


def test_each_forward_pass_in_training_is_a_batch():
    loss, model = MKCLoss(1), nn.Linear(2, 1)
    x, y = torch.randn(64, 2, generator=generator()), torch.randn(64, 1, generator=generator(1))
    sum(loss(model(a), b) for a, b in zip(x.split(16), y.split(16), strict=True)).backward()
    assert model.weight.grad.isfinite().all()
    assert loss.schedule.steps.unique().tolist() == [4]
    assert loss.residual_scale.batches.tolist() == [4]
    assert loss.residual_scale.position.unique().tolist() == [64]


def test_evaluation_changes_nothing_and_a_fresh_loss_takes_its_scale_from_the_batch():
    x, y = torch.zeros(50, 2), 1e3 * data(50)[1]
    fresh, used = MKCLoss(2).eval(), MKCLoss(2)
    before = state(fresh)
    used(x, y)
    assert fresh(x, y).item() == pytest.approx(used.eval()(x, y).item(), rel=1e-5)
    assert_same(state(fresh), before)
    before, value = state(used), used(x, 100.0 * y)
    used.terms(x, y)
    used.train().terms(x, y)
    assert_same(state(used), before)
    with torch.no_grad():
        used(x, 100.0 * y)
    assert used.eval()(x, 100.0 * y).item() != value.item()


def test_training_without_a_gradient_is_a_batch():
    loss = MKCLoss(2)
    with torch.no_grad():
        loss(*data(50))
    assert loss.residual_scale.batches.tolist() == [1, 1]
    with torch.inference_mode():
        loss(*data(50))
    assert loss.residual_scale.batches.tolist() == [2, 2]
    x, y = data(50)
    loss(x.requires_grad_(), y).backward()


def test_a_fully_masked_batch_changes_no_scale():
    loss = loss_after(1.0, 3.0)
    before = loss.d.detach(), loss.bound, loss.d_min, loss.residual_scale.batches.clone()
    assert loss(*data(50), torch.zeros(50, 2)).item() == 0.0
    for value, other in zip(
        before, (loss.d.detach(), loss.bound, loss.d_min, loss.residual_scale.batches), strict=True
    ):
        assert torch.equal(value, other)


@each_robust
@pytest.mark.parametrize("use_reentrant", [False, True])
def test_activation_checkpointing_counts_a_batch_once(options, use_reentrant):
    model, twin = nn.Linear(3, 2), nn.Linear(3, 2)
    twin.load_state_dict(model.state_dict())
    left, other = MKCLoss(2, **options), MKCLoss(2, **options)
    for seed in range(5):
        x, y = torch.randn(50, 3, generator=generator(seed)), data(50, seed=seed)[1]
        x.requires_grad_()
        value = checkpoint(lambda a, b: left(model(a), b), x, y, use_reentrant=use_reentrant)
        assert left.schedule.steps.unique().tolist() == [seed + 1]
        value.backward()
        plain = other(twin(x.detach()), y)
        plain.backward()
        assert value.item() == plain.item()
        assert_same(state(left), state(other))
        for a, b in zip(
            (*model.parameters(), *left.parameters()), (*twin.parameters(), *other.parameters()), strict=True
        ):
            torch.testing.assert_close(a.grad, b.grad, rtol=1e-6, atol=1e-8)


@each_robust
def test_function_transforms_do_not_change_the_state(options):
    loss = loss_after(1.0, 3.0, **options)
    x, y = data(20, seed=9)
    before = state(loss)
    slopes = vmap(grad(lambda a, b: loss(a, b)))(x, y)
    whole = grad(lambda a: loss(a, y))(x)
    tangent = torch.func.jvp(lambda a: loss(a, y), (x,), (torch.ones_like(x),))[1]
    assert_same(state(loss), before)
    leaf = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad(loss.terms(leaf, y).network, leaf)
    torch.testing.assert_close(whole, expected, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(slopes / 20, expected, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(tangent, expected.sum(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize("options", [{}, FIXED, {"objective": "likelihood"}], ids=str)
def test_a_fresh_loss_under_a_transform_takes_its_scale_from_the_data(unit, options):
    x, y = data(40)
    loss, used = MKCLoss(2, **options), MKCLoss(2, **options)
    before = state(loss)
    found = grad(lambda a: loss(a, unit * y))(unit * x)
    leaf = (unit * x).requires_grad_()
    used(leaf, unit * y).backward()
    torch.testing.assert_close(found * unit, leaf.grad * unit, rtol=1e-5, atol=1e-7)
    each = vmap(grad(lambda a, b: loss(a, b)))(unit * x, unit * y)
    first = MKCLoss(2, **options)
    leaf = (unit * x[:1]).requires_grad_()
    first(leaf, unit * y[:1]).backward()
    torch.testing.assert_close(each[:1] * unit, leaf.grad * unit, rtol=1e-5, atol=1e-7)
    assert_same(state(loss), before)


# --- ensembles


@each_robust
def test_a_functional_call_uses_and_updates_the_given_state(options):
    loss, other = loss_after(1.0, 3.0, **options), MKCLoss(2, **options)
    given = state(loss)
    untouched = state(other)
    x, y = data(20, seed=9)
    value = functional_call(other, given, (x, y))
    assert value.item() == loss(x, y).item()
    assert_same(given, state(loss))
    assert_same(state(other), untouched)


@each_robust
@pytest.mark.parametrize("fresh", [False, True])
def test_an_ensemble_under_vmap_equals_a_loop(options, fresh):
    losses = [MKCLoss(2, **options) if fresh else loss_after(size, 2.0 * size, **options) for size in (0.5, 1.0, 30.0)]
    parameters, buffers = stack_module_state(losses)
    kept = copy.deepcopy(buffers)
    x, y = torch.randn(2, 3, 20, 2, generator=generator(7))

    def value(parameters, buffers, x, y):
        return functional_call(losses[0], (parameters, buffers), (x, y))

    found = vmap(value)(parameters, buffers, x, y)
    slopes = vmap(grad(value))(parameters, buffers, x, y)
    assert_same(buffers, kept)
    for n, loss in enumerate(losses):
        if fresh:
            loss(x[n], y[n])  # takes its scale from the batch, as the ensemble did
            loss.schedule.load_state_dict({name: torch.zeros_like(v) for name, v in loss.schedule.state_dict().items()})
        alone = sum(loss.terms(x[n], y[n]))
        torch.testing.assert_close(found[n], alone, rtol=1e-5, atol=1e-6)
        expected = torch.autograd.grad(alone, list(loss.parameters()))
        for name, slope in zip(("raw_kappa", "raw_d"), expected, strict=True):
            torch.testing.assert_close(slopes[name][n], slope, rtol=1e-4, atol=1e-6)


# --- saved and loaded


def saved_and_loaded(*parts):
    buffer = io.BytesIO()
    torch.save([part.state_dict() for part in parts], buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


def trained(model, loss, optimiser, steps, found):
    for step in steps:
        x, y = torch.randn(40, 3, generator=generator(step)), 2.0 * data(40, seed=step)[1]
        y[: step % 20] += 10.0
        optimiser.zero_grad()
        value = loss(model(x), y)
        value.backward()
        found.append([value.detach(), *(p.grad.clone() for p in (*model.parameters(), *loss.parameters()))])
        optimiser.step()


@pytest.mark.e2e
@pytest.mark.parametrize("at", [1, 121, 122, 123, 124])
@pytest.mark.parametrize("options", [*ROBUST.values(), {"objective": "likelihood"}], ids=[*ROBUST, "likelihood"])
def test_resumed_training_is_bitwise_equal(options, at):
    runs = []
    for resumed in (False, True):
        torch.manual_seed(0)
        model, loss, found = nn.Linear(3, 2), MKCLoss(2, **options), []
        optimiser = torch.optim.Adam([*model.parameters(), *loss.parameters()], lr=0.01)
        trained(model, loss, optimiser, range(at), found)
        if resumed:
            parts = saved_and_loaded(model, loss, optimiser)
            torch.manual_seed(1)
            model, loss = nn.Linear(3, 2), MKCLoss(2, **options)
            optimiser = torch.optim.Adam([*model.parameters(), *loss.parameters()], lr=0.01)
            for part, value in zip((model, loss, optimiser), parts, strict=True):
                part.load_state_dict(value)
        trained(model, loss, optimiser, range(at, at + 6), found)
        runs.append((found, state(model), state(loss)))
    torch.testing.assert_close(*runs, rtol=0.0, atol=0.0)
    if at > 100 and loss.schedule is not None:
        assert 0.0 < float(loss.schedule.share.max()) < 1.0


@pytest.mark.parametrize("options", [{}, FIXED, {"learn_sigma": False}, {"learn_d": False}], ids=str)
@pytest.mark.parametrize("kind", [*ROBUST.values(), {"objective": "likelihood"}], ids=[*ROBUST, "likelihood"])
def test_a_state_dict_restores_everything_in_an_equal_loss(options, kind):
    loss, other = loss_after(1.0, 7.0, 3.0, **options, **kind), MKCLoss(2, **options, **kind)
    (stored,) = saved_and_loaded(loss)
    other.load_state_dict(stored)
    assert_same(state(other), state(loss))
    assert repr(other) == repr(loss)
    x, y = data(50, seed=9)
    assert other(x, y).item() == loss(x, y).item()
    assert_same(state(other), state(loss))


@pytest.mark.parametrize("options", [{}, {**FIXED, "normalize": True}, {"learn_d": False}], ids=str)
@pytest.mark.parametrize(
    ("kind", "objective"),
    [({}, "likelihood"), ({"objective": "likelihood"}, "likelihood"), ({"bound": 60.0}, "likelihood"), ({}, "robust")],
    ids=str,
)
def test_a_loss_with_auto_d_loads_into_a_loss_with_given_d(options, kind, objective):
    loss = loss_after(1.0, 7.0, **kind)
    other = MKCLoss(2, sigma=1.0, d=1.0, bound=9.0, objective=objective, **options)
    other.load_state_dict(state(loss))
    for name in ("sigma", "d", "bound", "d_min"):
        torch.testing.assert_close(getattr(other, name), getattr(loss, name), rtol=1e-5, atol=0.0)
    x, y = data(50)
    assert other.eval()(x, y).item() == pytest.approx(loss.eval()(x, y).item(), rel=1e-4)


@pytest.mark.parametrize("options", [{}, FIXED, {"learn_d": False}], ids=str)
@pytest.mark.parametrize("kind", [{}, {"objective": "likelihood"}], ids=str)
def test_a_frozen_loss_loads_into_a_loss_with_auto_d_and_freezes_it(options, kind):
    loss = loss_after(1.0, 7.0, **options, **kind)
    loss.freeze_scale()
    other = MKCLoss(2, **options, **kind)
    other.load_state_dict(saved_and_loaded(loss)[0])
    assert other.objective == "likelihood"
    assert_same(state(other), state(loss))
    x, y = data(50)
    assert other(x, y).item() == loss(x, y).item()


@pytest.mark.parametrize("options", [{}, FIXED, {"learn_d": False}], ids=str)
def test_a_robust_loss_with_given_d_loads_into_a_likelihood_loss(options):
    given = {"d": torch.tensor([0.7, 1.5]), "bound": 60.0, **options}
    loss = loss_after(1.0, 7.0, **given, objective="robust")
    other = MKCLoss(2, d=1.0, **options)
    other.load_state_dict(state(loss))
    for name in ("sigma", "d", "bound", "d_min"):
        assert torch.equal(getattr(other, name), getattr(loss, name))
    x, y = data(50)
    assert other.eval()(x, y).item() == loss.eval()(x, y).item()


def test_a_copy_is_equal_and_independent():
    loss = loss_after(1.0, 7.0)
    twin = copy.deepcopy(loss)
    x, y = data(50, seed=9)
    assert twin(x, y).item() == loss(x, y).item()
    before = state(loss)
    twin(x, 5.0 * y)
    assert_same(state(loss), before)


# --- processes


class NetworkWithLoss(nn.Module):
    """A network and its loss in a single module, so that a wrapper averages sigma and d too."""

    def __init__(self, loss):
        super().__init__()
        self.net, self.loss = nn.Linear(3, 2), loss

    def forward(self, x, y):
        return self.loss(self.net(x), y)


def _train_on_rank(rank, call, parameters, steps=25):
    """Train on data of another unit in each process."""
    optimiser = torch.optim.SGD(list(parameters), lr=0.05)
    for step in range(steps):
        g = generator(100 * rank + step)
        x, y = torch.randn(50, 3, generator=g), (1.0 + 3.0 * rank) * torch.randn(50, 2, generator=g)
        optimiser.zero_grad()
        call(x, y).backward()
        optimiser.step()


def _process(rank, port, queue):
    torch.distributed.init_process_group("gloo", f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    found = {}
    scale = ResidualScale(3).double()
    residual = (1.0 + 3.0 * rank) * torch.linspace(-1.0, 1.0, 101, dtype=torch.float64).unsqueeze(-1).expand(101, 3)
    scale.update(residual, torch.zeros_like(residual), torch.tensor([True, rank == 1, False]).expand(101, 3))
    found["scale"] = scale.state_dict()
    for name, options in ROBUST.items():
        torch.manual_seed(0)
        inside = NetworkWithLoss(MKCLoss(2, **options))
        inside.loss.schedule.warmup_steps = 8
        _train_on_rank(rank, DistributedDataParallel(inside), inside.parameters())
        found[f"{name}, inside"] = inside.loss.state_dict()
        found[f"{name}, network"] = inside.net.state_dict()
        torch.manual_seed(0)
        network, loss = nn.Linear(3, 2), MKCLoss(2, **options)
        loss.schedule.warmup_steps = 8
        wrapped = DistributedDataParallel(network)
        _train_on_rank(
            rank, lambda x, y, net=wrapped, own=loss: own(net(x), y), [*network.parameters(), *loss.parameters()]
        )
        found[f"{name}, outside"] = loss.state_dict()
        found[f"{name}, network outside"] = network.state_dict()
    queue.put(
        {
            name: {key: value.tolist() for key, value in part.items() if "recent" not in key}
            for name, part in found.items()
        }
    )
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()


@pytest.fixture(scope="module")
def processes():
    """Final states of two processes that train together."""
    context = torch.multiprocessing.get_context("spawn")
    queue = context.SimpleQueue()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.spawn(_process, (port, queue), nprocs=2)
    return queue.get(), queue.get()


@pytest.mark.process
def test_processes_share_the_geometric_mean_scale_and_the_widest_range(
    processes,
):
    """Of three channels: with residuals in both processes, in the second alone, in none."""
    left, other = (found["scale"] for found in processes)
    assert left == other
    scale = 0.4 / 0.5244005
    assert torch.tensor(left["log_scale"]).exp().tolist() == pytest.approx([2.0 * scale, 4.0 * scale, 1.0], rel=1e-2)
    assert left["half_range"] == pytest.approx([4.0, 4.0, 1.0])
    assert left["batches"] == [1, 1, 0]


@pytest.mark.process
@pytest.mark.parametrize("place", ["inside", "outside"])
@pytest.mark.parametrize("kind", ROBUST)
def test_processes_have_the_same_scale_and_schedule(processes, kind, place):
    left, other = (found[f"{kind}, {place}"] for found in processes)
    running = [name for name in left if name.startswith(("residual_scale", "schedule"))]
    assert len(running) == 7
    assert {name: left[name] for name in running} == {name: other[name] for name in running}
    assert left["schedule.steps"] == [25, 25]
    scales = torch.tensor(left["residual_scale.log_scale"]).exp()
    assert bool(((scales > 1.2) & (scales < 3.5)).all())  # between 1 and 4
    assert min(left["schedule.share"]) > 0.0


@pytest.mark.parametrize("kind", ROBUST)
def test_sigma_and_d_are_averaged_only_if_the_loss_is_inside_the_wrapped_module(processes, kind):
    for name in ("raw_kappa", "raw_d"):
        inside, outside = ([found[f"{kind}, {place}"][name] for found in processes] for place in ("inside", "outside"))
        assert inside[0] == inside[1]
        assert outside[0] != outside[1]
    for place in ("network", "network outside"):
        assert processes[0][f"{kind}, {place}"] == processes[1][f"{kind}, {place}"]


# --- the ends of the range of numbers

HUGE = {torch.float32: (1e20, 3e38, 1e-42), torch.float64: (1e160, 1e308, 1e-310)}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("options", [*ROBUST.values(), {"objective": "likelihood"}, {"d": 1.0}, {"d": 1.0, **FIXED}])
@pytest.mark.parametrize(("dtype", "size"), [(dtype, size) for dtype, sizes in HUGE.items() for size in sizes])
def test_predictions_at_the_ends_of_the_range_warn_of_nothing_and_leave_a_finite_state(dtype, size, options):
    loss, target = MKCLoss(1, **options).to(dtype), torch.zeros(50, 1, dtype=dtype)
    signs = torch.ones(50, 1, dtype=dtype)
    signs[::3] = -1.0
    for step, scale in enumerate([size, 1.0, 1.0, 1.0, size, 1.0]):
        loss((scale * (signs if step % 2 else signs.abs())).requires_grad_(), target).backward()
    for value in (*loss.state_dict().values(), loss.sigma, loss.d, loss.bound):
        assert value.isfinite().all()
    leaf = signs.clone().requires_grad_()
    loss(leaf, target).backward()
    assert leaf.grad.isfinite().all()


def test_a_vector_of_m_numbers_is_a_sample_of_m_channels():
    loss, other = MKCLoss(3), MKCLoss(3)
    x, y = data(1, 3)
    assert loss(x[0], y[0]).item() == pytest.approx(other(x, y).item())
    assert_same(state(loss), state(other))
    with pytest.raises(ValueError, match=r"Expected 1 channel.*unsqueeze\(-1\)"):
        MKCLoss(1)(x[0], y[0])
