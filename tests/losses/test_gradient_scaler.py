"""Training in half precision: gradients of a mean over many elements, and predictions that overflow."""

import copy
import math

import pytest
import torch
from torch import nn

from mkc_torch import MKCLoss
from mkc_torch.losses._terms import loss_value

FIXED = {"learn_sigma": False, "learn_d": False}
MODES = {
    "default": {},
    "given d, robust": {"d": 50.0, "objective": "robust"},
    "likelihood, auto d": {"objective": "likelihood"},
    "learned": {"d": 50.0},
    "fixed": {"d": 50.0, **FIXED},
}
each_mode = pytest.mark.parametrize("options", MODES.values(), ids=MODES)

UPSTREAM = 65536.0
"""Initial factor of a gradient scaler."""

LEAST_HALF = 2.0**-24
"""The smallest number of float16."""


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def half_precision_batch(count, channels, size, dtype=torch.float16):
    """Predictions and targets in half precision, whose residuals have that size."""
    g = generator()
    x = torch.randn(count, channels, generator=g).mul_(size).to(dtype)
    y = torch.randn(count, channels, generator=g).mul_(size).to(dtype)
    return x, y


def exact_gradient(loss, x, y, rows):
    """The gradient by some rows in float64, the mean being over all rows, at the state of the loss."""
    own = copy.deepcopy(loss).double()
    own.reduction = "sum"
    x = x[rows].double().requires_grad_()
    batch = own._batch(x, y[rows].double(), None)
    settings = own._settings(batch, robust=own.schedule is not None, updated=True)
    value = loss_value(batch, own.raw_kappa, own.raw_d, settings)
    return torch.autograd.grad(value, x)[0]


def assert_rounded(found, expected):
    """Equal up to a rounding to float16 after a rounding to float32."""
    spacing = torch.clamp(2.0 ** (expected.abs().log2().floor() - 10), min=LEAST_HALF)
    assert bool(((found.double() - expected).abs() <= 0.51 * spacing + 2e-6 * expected.abs()).all())


@each_mode
@pytest.mark.parametrize("channel_dim", [-1, 1])
def test_a_mean_over_a_million_elements_has_the_gradients_of_float32_rounded_once(options, channel_dim):
    """1 / (N d) is 1e-8, below the smallest number of float16, until the scaler's factor is in."""
    loss = MKCLoss(2, channel_dim=channel_dim, **options)
    x, y = half_precision_batch(500_000, 2, 50.0)
    if channel_dim == 1:
        x, y = (values.view(50, 2, 10_000) for values in (x, y))
    assert torch.tensor(1.0 / (x.numel() * 50.0)).half() == 0.0
    leaf = x.requires_grad_()
    value = loss(leaf, y)
    assert value.dtype == torch.float32
    (found,) = torch.autograd.grad(UPSTREAM * value, leaf)
    assert found.dtype == torch.float16
    expected = UPSTREAM / x.numel() * exact_gradient(loss, x.detach(), y, slice(0, 10_000 if channel_dim == -1 else 1))
    assert_rounded(found[: len(expected)], expected)
    assert bool((found != 0).float().mean() > 0.9)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"d": 1.0}], ids=["default", "learned"])
def test_a_mean_over_a_hundred_million_elements_has_the_gradients_of_float32_rounded_once(options):
    loss = MKCLoss(4, **options)
    x, y = half_precision_batch(25_000_000, 4, 1.0)
    leaf = x.requires_grad_()
    (found,) = torch.autograd.grad(UPSTREAM * loss(leaf, y), leaf)
    for rows in (slice(0, 10_000), slice(24_990_000, None)):
        assert_rounded(found[rows], UPSTREAM / x.numel() * exact_gradient(loss, x.detach(), y, rows))


@each_mode
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
def test_half_precision_is_computed_in_float32(options, dtype, reduction):
    losses = [MKCLoss(2, reduction=reduction, **options) for _ in range(2)]
    for seed in range(3):
        x, y = (values.to(dtype) for values in torch.randn(2, 40, 2, generator=generator(seed)))
        found = []
        for loss, kind in zip(losses, (dtype, torch.float32), strict=True):
            leaf = x.to(kind).requires_grad_()
            value = loss(leaf, y.to(kind))
            (slope,) = torch.autograd.grad(value.sum(), leaf)
            assert slope.dtype == kind
            found.append((value, slope.to(dtype)))
        torch.testing.assert_close(*found, rtol=0.0, atol=0.0)
    torch.testing.assert_close(losses[0].state_dict(), losses[1].state_dict(), rtol=0.0, atol=0.0)


# --- predictions that overflow


@each_mode
@pytest.mark.parametrize("reduction", ["none", "mean"])
@pytest.mark.parametrize("bad", [math.inf, -math.inf, math.nan])
def test_an_overflowing_prediction_reaches_the_gradients_but_not_the_running_state(options, reduction, bad):
    loss = MKCLoss(2, reduction=reduction, **options)
    for seed in range(3):
        loss(*(values.half() for values in torch.randn(2, 40, 2, generator=generator(seed))))
    twin = copy.deepcopy(loss)
    x, y = (values.half() for values in torch.randn(2, 40, 2, generator=generator(9)))
    mask = torch.ones(40, 2, dtype=torch.bool)
    mask[3, 1] = mask[7, 0] = False
    twin(x, y, mask)
    x[~mask] = bad
    leaf = x.requires_grad_()
    value = loss(leaf, y)
    if options == {}:
        assert not value.isfinite().all()
    value.sum().backward()
    assert leaf.grad.isfinite().logical_not().nonzero().tolist() == [[3, 1], [7, 0]]
    assert all(entry.isfinite().all() for entry in loss.state_dict().values())
    torch.testing.assert_close(loss.state_dict(), twin.state_dict(), rtol=0.0, atol=0.0)


@pytest.mark.parametrize("options", [{}, {"d": 1.0, "objective": "robust"}, {"objective": "likelihood"}], ids=str)
def test_a_batch_that_overflows_throughout_does_not_change_the_running_scale(options):
    loss = MKCLoss(2, **options)
    for seed in range(3):
        loss(*(values.half() for values in (1.0 + seed) * torch.randn(2, 40, 2, generator=generator(seed))))
    numbers = ("batches", "log_scale", "half_range")
    before = [getattr(loss.residual_scale, name).clone() for name in numbers]
    loss(torch.full((40, 2), math.inf, dtype=torch.float16), torch.zeros(40, 2))
    for name, value in zip(numbers, before, strict=True):
        assert torch.equal(getattr(loss.residual_scale, name), value)
    assert loss(*torch.randn(2, 40, 2, generator=generator())).isfinite()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_an_infinite_prediction_of_another_dtype_is_refused(dtype):
    with pytest.raises(ValueError, match=r"`input`.*finite"):
        MKCLoss(1)(torch.full((3, 1), math.inf, dtype=dtype), torch.zeros(3, 1))
    with pytest.raises(ValueError, match=r"`target`.*finite"):
        MKCLoss(1)(torch.zeros(3, 1, dtype=torch.float16), torch.full((3, 1), math.inf))


@each_mode
def test_a_gradient_scaler_skips_the_step_of_an_overflowing_batch_and_continues(options):
    torch.manual_seed(0)
    model, loss = nn.Linear(3, 2), MKCLoss(2, **options)
    optimiser = torch.optim.SGD([*model.parameters(), *loss.parameters()], lr=1e-3)
    scaler = torch.amp.GradScaler("cpu", init_scale=1024.0)

    def step(factor):
        x, y = torch.randn(40, 3, generator=generator()), torch.randn(40, 2, generator=generator(1))
        before = [p.detach().clone() for p in (*model.parameters(), *loss.parameters())]
        optimiser.zero_grad()
        prediction = (factor * model(x)).half()
        scaler.scale(loss(prediction, y)).backward()
        scaler.step(optimiser)
        scaler.update()
        after = (*model.parameters(), *loss.parameters())
        return any(not torch.equal(value, other) for value, other in zip(before, after, strict=True)), prediction

    assert step(1.0)[0]
    moved, prediction = step(1e6)
    assert not prediction.isfinite().all()
    assert not moved
    assert scaler.get_scale() == 512.0
    assert step(1.0)[0]
    assert scaler.get_scale() == 512.0
