"""The same algorithm in NumPy, in torch, in torch's compiler, and on tensors without values."""

import copy
import math

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mkc_torch import MKCLoss
from mkc_torch.losses import _fused, bandwidth_schedule, mkc, residual_scale
from mkc_torch.losses._bandwidth_selection import BandwidthSelection

# gradients are compared, without an optimizer
pytestmark = pytest.mark.filterwarnings("ignore:In 100 training steps")

FIXED = {"learn_sigma": False, "learn_d": False}
MODES = {
    "default": {},
    "given d, robust": {"d": 1.0, "objective": "robust"},
    "likelihood, auto d": {"objective": "likelihood"},
    "learned": {"d": 1.0},
    "fixed": {"d": 1.0, **FIXED},
    "fixed, normalised": {"d": 1.0, "normalize": True, **FIXED},
    "auto d, nothing learned": FIXED,
}
each_mode = pytest.mark.parametrize("options", MODES.values(), ids=MODES)
compiler = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own


def batch(step, *shape):
    """Predictions and targets without ties, of changing noise, up to half of them wrong for a time."""
    g = torch.Generator().manual_seed(step)
    x, y = torch.randn(2, *shape, generator=g, dtype=torch.float64)
    y *= 1.0 + 0.5 * math.sin(0.1 * step)
    if step % 100 < 50:
        y[::2] += 0.1 * step * torch.rand(y[::2].shape, generator=g, dtype=torch.float64)
    return x, y


def make_loss(options, warmup_steps=20):
    loss = MKCLoss(2, **options).double()
    if loss.schedule is not None:
        loss.schedule.warmup_steps = warmup_steps
    return loss


def value_and_gradients(loss, call, x, y, *weight):
    """Value and gradients of one batch."""
    x = x.clone().requires_grad_()
    value = call(x, y, *weight)
    return [value.detach(), *torch.autograd.grad(value.sum(), [x, *loss.parameters()])]


def assert_same_steps(reference, other, call, steps, *, rtol, shape=(64, 2), prepare=lambda _: None):
    """Values, gradients and states of two losses agree batch after batch; counters and shares to the bit."""
    shares = []
    for step in range(steps):
        x, y = batch(step, *shape)
        prepare(0)
        expected = value_and_gradients(reference, reference, x, y)
        prepare(1)
        found = value_and_gradients(other, call, x, y)
        for a, b in zip(found, expected, strict=True):
            torch.testing.assert_close(a, b, rtol=rtol, atol=rtol * float(b.abs().max()))
        for name, value in reference.state_dict().items():
            exact = name.endswith(("share", "steps", "batches", "position"))
            tolerance = 0.0 if exact else rtol
            torch.testing.assert_close(other.state_dict()[name], value, rtol=tolerance, atol=tolerance)
        if reference.schedule is not None:
            shares.append(reference.schedule.share.clone())
    if shares and steps >= 300:  # up and down, in between and at the end
        change = torch.stack(shares).diff(dim=0)
        assert bool((change > 0).any())
        assert bool((change < 0).any())
        assert bool((shares[-1] == 1.0).any())


# --- the compiler


def loss_and_compiled_copy(options, backend):
    """A loss, an equal copy, and the compiled copy."""
    torch.compiler.reset()
    loss = make_loss(options)
    own = copy.deepcopy(loss)
    return loss, own, torch.compile(own, fullgraph=True, backend=backend)


@pytest.mark.e2e
@compiler
def test_a_traced_loss_equals_eager_over_300_batches():
    """The graph that the compiler receives, executed without compilation."""
    assert_same_steps(*loss_and_compiled_copy({}, "aot_eager"), 300, rtol=1e-10)


@compiler
@pytest.mark.slow
@each_mode
def test_a_compiled_loss_equals_eager_over_300_batches(options):
    loss, own, call = loss_and_compiled_copy(options, "inductor")
    assert_same_steps(loss, own, call, 300, rtol=1e-10)
    # eight forward passes, each of which changes the state, before a backward pass
    batches = [batch(step, 64, 2) for step in range(8)]
    found = []
    for entry in (loss, call):
        inputs = [x.clone().requires_grad_() for x, _ in batches]
        values = [entry(x, y) for x, (_, y) in zip(inputs, batches, strict=True)]
        found.append([torch.autograd.grad(value, x)[0] for value, x in zip(values, inputs, strict=True)])
    torch.testing.assert_close(*found, rtol=1e-10, atol=1e-12)


@pytest.mark.e2e
@compiler
def test_a_compiled_backward_pass_uses_the_state_of_its_forward_pass(monkeypatch):
    """On a loss small enough to be compiled in seconds: the share and the bandwidth alone change.

    torch's compiler would compute them again from buffers that have changed since (pytorch#197039).
    """

    def selected(xp, z, *_):
        return BandwidthSelection(xp.clip(z.sum(-1), 2.0, 2.0), z.sum(-1) < math.inf)

    monkeypatch.setattr(bandwidth_schedule, "select_bandwidth", selected)
    monkeypatch.setattr(residual_scale.ResidualScale, "update", lambda *_: None)
    loss, own, call = loss_and_compiled_copy({"d": 1.0, "objective": "robust", **FIXED}, "inductor")
    for value in (loss, own):
        value.schedule.warmup_steps = 0
        value.residual_scale.recent.fill_(1.0)
    assert_same_steps(loss, own, call, 12, rtol=1e-12)
    assert float(loss.schedule.share[0]) == pytest.approx(0.06)


@compiler
@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"channel_dim": 1}, {"reduction": "none"}], ids=str)
@pytest.mark.parametrize("weighted", [False, True])
def test_a_compiled_loss_takes_weights_and_batches_of_any_size(options, weighted):
    torch.compiler.reset()
    loss = make_loss(options, warmup_steps=0)
    own = copy.deepcopy(loss)
    compiled = torch.compile(own, fullgraph=True)
    for step, rows in enumerate([64, 64, 40, 700, 3, 1, 20_000, 64]):
        x, y = batch(step, rows, *((2, 5) if options.get("channel_dim") else (2,)))
        weight = [torch.rand(x.shape, generator=torch.Generator().manual_seed(step)).double()] if weighted else []
        torch.testing.assert_close(
            value_and_gradients(own, compiled, x, y, *weight),
            value_and_gradients(loss, loss, x, y, *weight),
            rtol=1e-9,
            atol=1e-11,
        )
    torch.testing.assert_close(own.state_dict(), loss.state_dict(), rtol=1e-10, atol=1e-10)


@pytest.mark.e2e
@compiler
def test_impl_compile_equals_impl_eager(monkeypatch):
    torch.compiler.reset()
    compiled = torch.compile(mkc.MKCLoss._computed, backend="aot_eager")
    calls = []
    monkeypatch.setattr(mkc, "_compiled", lambda: lambda *args: calls.append(1) or compiled(*args))
    reference, other = make_loss({"impl": "eager"}, 0), make_loss({"impl": "compile"}, 0)
    assert_same_steps(reference, other, other, 12, rtol=1e-10)
    assert len(calls) == 12


def test_an_unknown_implementation_is_refused():
    with pytest.raises(ValueError, match=r"`impl`.*'auto', 'eager', 'compile', 'triton'.*got 'cuda'"):
        MKCLoss(1, impl="cuda")


# --- NumPy and torch


@pytest.mark.e2e
@each_mode
def test_torch_equals_numpy_over_300_batches(options, monkeypatch):
    def choose(which):
        for module in (residual_scale, bandwidth_schedule, _fused):
            monkeypatch.setattr(module, "SMALL_STATE", 0 if which else 64)

    loss = make_loss(options)
    other = copy.deepcopy(loss)
    assert_same_steps(loss, other, other, 300, rtol=1e-10, prepare=choose)


@pytest.mark.filterwarnings("ignore:In 100 training steps")  # nothing is optimised
def test_torch_equals_numpy_in_single_precision(monkeypatch):
    loss = make_loss({}).float()
    other = copy.deepcopy(loss)
    for step in range(120):
        x, y = (values.float() for values in batch(step, 64, 2))
        found = []
        for which, own in enumerate((loss, other)):
            for module in (residual_scale, bandwidth_schedule, _fused):
                monkeypatch.setattr(module, "SMALL_STATE", 0 if which else 64)
            found.append(value_and_gradients(own, own, x, y))
        torch.testing.assert_close(*found, rtol=1e-4, atol=1e-6)
        assert torch.equal(loss.schedule.share, other.schedule.share)
        torch.testing.assert_close(loss.residual_scale.scale, other.residual_scale.scale, rtol=1e-5, atol=0.0)
        torch.testing.assert_close(loss.schedule.bandwidth, other.schedule.bandwidth, rtol=1e-5, atol=0.0)


# --- no values


class OneDevice(TorchDispatchMode):
    """Fails if an operation reads a value, or has a tensor of the CPU among its arguments or results."""

    looks = frozenset(
        getattr(torch.ops.aten, name)
        for name in ("_local_scalar_dense", "nonzero", "equal", "is_nonzero", "masked_select")
    )

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        assert func.overloadpacket not in self.looks, f"{func} reads a value"
        result = func(*args, **(kwargs or {}))
        tensors = [value for value in tree_leaves((args, kwargs, result)) if isinstance(value, torch.Tensor)]
        assert {tensor.device.type for tensor in tensors} <= {"meta"}, f"{func} mixes devices"
        return result


class NoHostCopy(TorchFunctionMode):
    """Fails if a tensor is made of Python's or NumPy's numbers, or read into them: a hidden copy of torch."""

    made_from_numbers = (torch.tensor, torch.as_tensor, torch.asarray, torch.from_numpy, torch.Tensor.new_tensor)
    reads = (torch.Tensor.item, torch.Tensor.tolist, torch.Tensor.numpy, torch.Tensor.cpu, torch.Tensor.__bool__)

    def __torch_function__(self, func, types, args=(), kwargs=None):
        assert func not in self.reads, f"{func} reads a value"
        source = args[0] if func is not torch.Tensor.new_tensor else args[1]
        assert func not in self.made_from_numbers or isinstance(source, torch.Tensor), f"{func} copies from the host"
        return func(*args, **(kwargs or {}))


def meta_step(loss, shape, dtype, weight):
    x = torch.empty(shape, device="meta", dtype=dtype, requires_grad=True)
    y = torch.empty(shape, device="meta", dtype=dtype)
    value = loss(x, y, weight)
    (value if value.dim() == 0 else value.sum()).backward()
    return x, value


@each_mode
@pytest.mark.parametrize(
    ("reduction", "weighted", "channel_dim", "dtype"),
    [  # each pair of choices once
        ("none", None, None, torch.float32),
        ("none", torch.float32, 1, torch.float16),
        ("none", torch.bool, -1, torch.float64),
        ("mean", None, 1, torch.float16),
        ("mean", torch.float32, -1, torch.float64),
        ("mean", torch.bool, None, torch.float32),
        ("sum", None, -1, torch.float64),
        ("sum", torch.float32, None, torch.float32),
        ("sum", torch.bool, 1, torch.float16),
    ],
    ids=str,
)
def test_a_training_step_reads_no_value_and_copies_nothing_from_the_host(
    options, reduction, weighted, channel_dim, dtype
):
    loss = MKCLoss(3, reduction=reduction, channel_dim=channel_dim, **options).to("meta")
    shape = {None: (5, 3), 1: (5, 3, 7), -1: (2, 2, 7, 3)}[channel_dim]
    weight = None if weighted is None else torch.ones(shape, device="meta", dtype=weighted)
    meta_step(loss, shape, dtype, weight)  # constants are copied to a device once
    with NoHostCopy(), OneDevice():
        x, value = meta_step(loss, shape, dtype, weight)
    assert x.grad.shape == shape
    assert x.grad.dtype == dtype
    assert value.shape == (shape if reduction == "none" else ())
    assert value.device.type == "meta"
    assert all(parameter.grad.device.type == "meta" for parameter in loss.parameters())


@each_mode
def test_evaluation_and_a_second_derivative_read_no_value(options):
    loss = MKCLoss(3, **options).to("meta")

    def steps():
        x, y = (torch.empty(5, 3, device="meta", requires_grad=True) for _ in range(2))
        value = loss.train()(x, y)
        wanted = [x, y, *loss.parameters()]
        slopes = torch.autograd.grad(value, wanted, create_graph=True)
        torch.autograd.grad(sum(slope.sum() for slope in slopes), wanted, allow_unused=True)
        loss.eval()(x, y).backward()
        loss.terms(x, y)

    steps()
    with NoHostCopy(), OneDevice():
        steps()


def test_the_checking_modes_detect_reads_and_copies():
    reference = torch.ones(3, device="meta")
    for bad in (
        lambda: reference.new_tensor([1.0, 2.0]),
        lambda: torch.tensor([1.0], device="meta"),
        lambda: torch.ones(3).to("meta"),
        lambda: reference + torch.ones(()),
        lambda: torch.ones(3).sum().item(),
    ):
        with pytest.raises(AssertionError), NoHostCopy(), OneDevice():
            bad()
