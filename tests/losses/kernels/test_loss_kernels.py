"""The kernels of MKCLoss against the formulas in float64, and the running state against torch's."""

import copy
import math

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from mkc_torch import MKCLoss

INF, NAN = math.inf, math.nan
FIXED = {"d": 1.0, "sigma": 2.0, "learn_sigma": False, "learn_d": False}
MODES = {
    "fixed": FIXED,
    "learned": {"d": 1.0},
    "wide": {"d": 0.3, "sigma": 20.0},
    "gaussian": {"d": 1.0, "sigma": INF, "learn_sigma": False},
    "default": {},
    "automatic likelihood": {"objective": "likelihood"},
    "robust, given d": {"d": 1.0, "objective": "robust"},
    "given bound": {"bound": 9.0, "d_min": 0.01, "learn_sigma": False, "learn_d": False, "normalize": True},
}
TOLERANCE = {torch.float64: 1e-10, torch.float32: 2e-5, torch.bfloat16: 2e-2, torch.float16: 3e-3}
"""Difference over the greatest number; float32 loses digits of a small kappa, half precision rounds twice."""
compiler = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own


def data(shape, dtype=torch.float64, seed=0):
    """Predictions and targets three times as large."""
    generator = torch.Generator().manual_seed(seed)
    x, y = torch.randn(2, *shape, generator=generator, dtype=torch.float64)
    return x.to(dtype), (3.0 * y).to(dtype)


def weights(shape, seed=5):
    weight = torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.where(weight < 0.2, 0.0, weight)


def step(loss, x, y, weight=None, upstream=1.0):
    """Value and all gradients of one training step."""
    x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
    for parameter in loss.parameters():
        parameter.grad = None
    value = loss(x, y, weight)
    value.backward(torch.full_like(value, upstream))
    grads = [x.grad, y.grad, *(p.grad for p in loss.parameters())]
    return [grad.detach().cpu().double() for grad in (value, *grads)]


def assert_agrees(
    device, shape, mode, dtype=torch.float64, weighted=False, batches=2, upstream=1.7, axis=-1, **options
):
    """A few training steps by kernels against the same by torch's operations in float64."""
    own = {"channel_dim": axis, **MODES[mode], **options}
    kernel, eager = MKCLoss(shape[axis], impl="triton", **own), MKCLoss(shape[axis], impl="eager", **own).double()
    kernel = (kernel.double() if dtype == torch.float64 else kernel).to(device)
    weight = weights(shape) if weighted else None
    for seed in range(batches):
        x, y = data(shape, dtype, seed)
        own_weight = None if weight is None else weight.to(device, dtype)
        found = step(kernel, x.to(device), y.to(device), own_weight, upstream)
        expected = step(eager, x.double(), y.double(), None if weight is None else weight.to(dtype).double(), upstream)
        for entry, other in zip(found, expected, strict=True):
            largest = max(float(other.abs().max()), 1e-2)
            torch.testing.assert_close(entry, other, rtol=0.0, atol=TOLERANCE[dtype] * largest)
    if dtype in (torch.float32, torch.float64):
        for name, value in eager.state_dict().items():
            other = kernel.state_dict()[name].cpu().double()
            torch.testing.assert_close(other, value.double(), rtol=1e-4, atol=1e-5, msg=name)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_value_gradients_and_state_equal_torch(device, mode, dtype):
    assert_agrees(device, (37, 3), mode, dtype, weighted=dtype == torch.float64)


@pytest.mark.e2e
@pytest.mark.parametrize("mode", ["fixed", "learned", "default"])
@pytest.mark.parametrize(
    ("shape", "axis"), [((33, 1), -1), ((64, 4), -1), ((3, 4, 6, 5), 1), ((300, 5), -1), ((2, 20), -1), ((9000, 2), -1)]
)
def test_kernels_equal_torch_for_all_layouts_and_sizes(device, mode, shape, axis):
    assert_agrees(device, shape, mode, torch.float32, batches=1, axis=axis)


@pytest.mark.parametrize("mode", ["fixed", "default"])
@pytest.mark.parametrize("reduction", ["sum", "none"])
def test_kernels_equal_torch_for_reductions_sum_and_none(device, mode, reduction):
    assert_agrees(device, (20, 3), mode, weighted=True, reduction=reduction)


@pytest.mark.parametrize("mode", ["fixed", "learned", "default"])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_computed_in_float32(device, mode, dtype):
    assert_agrees(device, (40, 2), mode, dtype, batches=1, upstream=100.0)


@pytest.mark.parametrize("make", [lambda t: t.mT.contiguous().mT, lambda t: t.repeat(1, 2)[:, :3], lambda t: t.flip(0)])
def test_kernels_equal_torch_for_strided_predictions_and_targets(device, make):
    x, y = data((16, 3))
    losses = [MKCLoss(3, impl=impl, **FIXED).double() for impl in ("triton", "eager")]
    found = [step(loss.to(device), make(x.to(device)), y.to(device)) for loss in losses]
    torch.testing.assert_close(*found)


@pytest.mark.e2e
def test_the_schedule_equals_that_of_torch(device):
    kernel, eager = (MKCLoss(1, impl=impl).double().to(device) for impl in ("triton", "eager"))
    for loss in (kernel, eager):
        loss.schedule.warmup_steps, loss.schedule.anneal_step = 4, 0.1
    for seed in range(18):
        x, y = data((64, 1), seed=seed)
        y[::4] += 20.0
        found, expected = (step(loss, x.to(device), y.to(device)) for loss in (kernel, eager))
        for value, other in zip(found, expected, strict=True):
            torch.testing.assert_close(value, other, rtol=1e-6, atol=1e-8)
    assert 0.0 < kernel.schedule.share.item() <= 1.0
    assert torch.equal(kernel.schedule.share, eager.schedule.share)


@pytest.mark.parametrize("mode", ["learned", "default"])
def test_repeated_backward_passes_are_bitwise_equal(device, mode):
    loss = MKCLoss(2, impl="triton", **MODES[mode]).to(device)
    x, y = (entry.to(device) for entry in data((30, 2), torch.float32))
    leaves = [x.requires_grad_(), *loss.parameters()]
    value = loss(x, y)
    first = torch.autograd.grad(value, leaves, torch.tensor(3.0, device=device), retain_graph=True)
    second = torch.autograd.grad(value, leaves, torch.tensor(3.0, device=device))
    assert all(torch.equal(*pair) for pair in zip(first, second, strict=True))


@pytest.mark.parametrize("mode", ["learned", "default"])
def test_second_derivatives_equal_torch(device, mode):
    curves = []
    x, y = data((12, 2))
    for impl in ("triton", "eager"):
        loss = MKCLoss(2, impl=impl, **MODES[mode]).double().to(device)
        leaf = x.to(device).requires_grad_()
        (slope,) = torch.autograd.grad(loss(leaf, y.to(device)), leaf, create_graph=True)
        curves.append(torch.autograd.grad(slope.square().sum(), leaf)[0])
    torch.testing.assert_close(*curves)


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")  # the interpreter computes by NumPy
@pytest.mark.parametrize("value", [NAN, INF])
@pytest.mark.parametrize("mode", ["learned", "default"])
def test_non_finite_values_reach_the_gradient_but_not_the_state(device, mode, value):
    loss = MKCLoss(1, impl="triton", **MODES[mode]).to(device)
    x, y = (entry.to(device) for entry in data((30, 1), torch.float32))
    y[3] = value
    assert not step(loss, x, y)[1].isfinite().all()
    assert all(buffer.isfinite().all() for buffer in loss.buffers())


def test_masked_elements_affect_neither_value_nor_gradient_nor_state(device):
    x, y = (value.to(device) for value in data((30, 2), torch.float32))
    mask = torch.rand(30, 2, generator=torch.Generator().manual_seed(1)).to(device) < 0.7
    clean, dirty = (MKCLoss(2, impl="triton").to(device) for _ in range(2))
    found = step(clean, x, y, mask)
    other = step(dirty, torch.where(mask, x, NAN), torch.where(mask, y, INF), mask)
    for value, contaminated in zip(found, other, strict=True):
        torch.testing.assert_close(value, contaminated)
    assert all(torch.equal(a, b) for a, b in zip(clean.buffers(), dirty.buffers(), strict=True))


def test_a_fresh_loss_takes_its_scale_from_the_evaluated_batch(device):
    x, y = (value.to(device) for value in data((60, 2), torch.float32))
    kernel, eager = (MKCLoss(2, impl=impl).to(device).eval() for impl in ("triton", "eager"))
    torch.testing.assert_close(kernel(x, 100.0 * y), eager(x, 100.0 * y))
    assert int(kernel.residual_scale.batches.sum()) == 0


@pytest.mark.e2e
@pytest.mark.parametrize("mode", ["fixed", "learned", "default"])
@pytest.mark.parametrize("reduction", ["mean", "none"])
@compiler
def test_compiled_training_equals_eager_for_any_batch_size(device, mode, reduction):
    torch.compiler.reset()
    eager = MKCLoss(3, impl="triton", reduction=reduction, **MODES[mode]).to(device)
    own = copy.deepcopy(eager)
    compiled = torch.compile(own, fullgraph=True, backend="aot_eager")
    for count in (20, 20, 31):
        x, y = (value.to(device) for value in data((count, 3), torch.float32, seed=count))
        for value, other in zip(step(eager, x, y), step(_CallWithParameters(compiled, own), x, y), strict=True):
            torch.testing.assert_close(value, other)
    assert all(torch.equal(a, b) for a, b in zip(eager.buffers(), own.buffers(), strict=True))


class _CallWithParameters:
    """A compiled loss with the parameters of the uncompiled loss."""

    def __init__(self, call, loss):
        self.call, self.parameters = call, loss.parameters

    def __call__(self, *given):
        return self.call(*given)


@pytest.mark.e2e
@pytest.mark.parametrize("mode", ["fixed", "default"])
def test_operators_pass_opcheck(device, mode):
    from mkc_torch.losses.kernels import operators
    from mkc_torch.losses.kernels.channels import TABLE
    from mkc_torch.losses.kernels.loss import options_of, request_of

    loss = MKCLoss(3, impl="triton", **MODES[mode]).to(device)
    x, y = (value.to(device) for value in data((20, 3), torch.float32))
    request, options = request_of(loss, x.device), list(options_of(loss))
    copies = [None if value is None else value.detach().clone() for value in (*request[:4], *request.running)]
    table = torch.zeros(len(TABLE), 3, device=device)
    given = (table, x, y, None, 1, *copies, options, request.updates, *request[-2:])
    torch.library.opcheck(operators.channel_table, given)
    operators.channel_table(*given)
    own = (loss.raw_kappa, loss.raw_d, table, options)
    torch.library.opcheck(operators.reduced_loss, (x.requires_grad_(), y, None, 1, *own))
    torch.library.opcheck(operators.each_loss, (x, y, torch.rand(20, 3, device=device), 1, *own))


def test_fake_cuda_tensors_use_the_operators(device):
    loss = MKCLoss(3, impl="triton")
    with FakeTensorMode(allow_non_fake_inputs=True), torch.no_grad():
        own = {name: torch.empty_like(value, device="cuda") for name, value in loss.state_dict().items()}
        x, y = (torch.empty(20, 3, device="cuda") for _ in range(2))
        value = torch.func.functional_call(loss, own, (x, y))
    assert value.shape == ()
    assert value.device.type == "cuda"


@pytest.mark.filterwarnings("ignore:(overflow|invalid value) encountered:RuntimeWarning")  # of Triton's interpreter
@pytest.mark.parametrize("size", [1e20, 3e38])
def test_predictions_that_overflow_leave_the_state_of_eager_code(size):
    kernel, eager = MKCLoss(2, impl="triton"), MKCLoss(2, impl="eager")
    generator = torch.Generator().manual_seed(0)
    for scale in (size, 1.0, 1.0, 1.0, size, 1.0):
        x = torch.randn(40, 2, generator=generator).clamp(-1.0, 1.0)
        for loss in (kernel, eager):
            loss(scale * x, torch.zeros(40, 2))
    for name, value in eager.state_dict().items():
        assert value.isfinite().all()
        torch.testing.assert_close(kernel.state_dict()[name], value, rtol=1e-4, atol=1e-6, msg=name)
