"""The loss with gradients made in the forward pass against the formulas: all modes, layouts, sizes and derivatives."""

import math

import pytest
import torch

from mkc_torch.losses import _fixed_pieces
from mkc_torch.losses import _fused as module
from mkc_torch.losses._fixed_pieces import fixed_sums
from mkc_torch.losses._fused import LARGE_BATCH, SMALL_BATCH, fused_loss
from mkc_torch.losses._parameters import ChannelState
from mkc_torch.losses._terms import Batch, LossSettings, loss_value

KAPPA = torch.tensor([0.0, 1e-6, 0.1, 4.0], dtype=torch.float64)
RAW_KAPPA = torch.tensor([-19.0, -8.0, -3.0, 1.0], dtype=torch.float64)
D = torch.tensor([1.0, 0.5, 2.0, 3.0], dtype=torch.float64)
RAW_D = torch.tensor([-1.0, 0.3, 0.0, 2.0], dtype=torch.float64)
MODES = ["fixed", "normalised", "learned", "sigma", "d", "auto d", "scale", "robust", "robust of given d"]
each_mode = pytest.mark.parametrize("mode", MODES)


def randn(*size, seed=0, dtype=torch.float64):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def parameters_and_settings(mode, m=4, dtype=torch.float64, reduction="mean"):
    """Raw parameters and settings of a loss of that mode."""
    kappa, raw_kappa, d, raw_d = (value.to(dtype).repeat(-(-m // 4))[:m] for value in (KAPPA, RAW_KAPPA, D, RAW_D))
    ramp = torch.linspace(0.0, 1.0, m, dtype=dtype)
    state = ChannelState(
        bound=30.0 - 20.0 * ramp, floor=0.6 - 0.59 * ramp
    )  # of the first and the last d if it is automatic
    auto_d = mode in ("auto d", "scale", "robust")
    if auto_d or mode.startswith("robust"):
        state = state._replace(scale=0.7 + ramp)
    if mode.startswith("robust"):
        state = state._replace(log_bandwidth=4.0 * ramp, share=(1.5 * ramp.flip(0)).clamp(max=1.0))
    learns_kappa, learns_d = (
        mode not in ("fixed", "normalised", "d"),
        mode not in ("fixed", "normalised", "sigma", "scale"),
    )
    settings = LossSettings(
        fixed_kappa=None if learns_kappa else kappa,
        fixed_d=None if learns_d or auto_d else d,
        state=state,
        follows=auto_d,
        normalize=mode != "fixed",
        reduction=reduction,
    )
    return raw_kappa if learns_kappa else None, raw_d if learns_d else None, settings


def batch_of(input, target, weight=None, axis=-1):
    counts = None if weight is None else weight != 0
    return Batch(input, target, weight, counts, axis % input.dim())


def leaves(*values):
    return [None if v is None else v.clone().requires_grad_() for v in values]


def value_and_gradients(function, input, target, raw_kappa, raw_d, settings, weight=None, axis=-1, upstream=1.0):
    """Value, and gradients by input, target and the raw parameters."""
    given = leaves(input, target, raw_kappa, raw_d)
    value = function(batch_of(*given[:2], weight, axis), *given[2:], settings)
    wanted = [entry for entry in given if entry is not None]
    return [value.detach(), *torch.autograd.grad(value, wanted, torch.tensor(upstream, dtype=value.dtype))]


def assert_equals_formulas(*args, **options):
    """Equal but for the derivative by kappa, whose series has an error of 1e-11."""
    found = value_and_gradients(fused_loss, *args, **options)
    expected = value_and_gradients(loss_value, *args, **options)
    torch.testing.assert_close(found[:3], expected[:3], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(found[3:], expected[3:], rtol=1e-9, atol=1e-10)


@pytest.fixture(params=["NumPy", "torch", "torch table", "pieces"])
def implementation(request, monkeypatch):
    """Every implementation, for batches of any size."""
    if request.param == "torch":
        monkeypatch.setattr(module, "SMALL_BATCH", 0)
    elif request.param != "NumPy":
        monkeypatch.setattr(module, "SMALL_STATE", 0)
    if request.param == "pieces":
        monkeypatch.setattr(module, "LARGE_BATCH", 1)
        monkeypatch.setattr(_fixed_pieces, "PIECE", 24)
        monkeypatch.setattr(_fixed_pieces, "ROW", 8)
    return request.param


# --- against the formulas


@pytest.mark.usefixtures("implementation")
@each_mode
@pytest.mark.parametrize("shape", [(4,), (7, 4), (4, 7), (3, 5, 4), (2, 4, 6)])
@pytest.mark.parametrize(("weighted", "reduction"), [(False, "mean"), (True, "mean"), (True, "sum")])
def test_value_and_gradients_equal_the_formulas(mode, shape, weighted, reduction):
    raw_kappa, raw_d, settings = parameters_and_settings(mode, reduction=reduction)
    weight = None
    if weighted:
        weight = randn(*shape, seed=1).abs() * (randn(*shape, seed=2) > -1.0)
    assert_equals_formulas(
        3.0 * randn(*shape), randn(*shape, seed=3), raw_kappa, raw_d, settings, weight, shape.index(4), upstream=-2.5
    )


@pytest.mark.usefixtures("implementation")
@each_mode
def test_masked_elements_affect_neither_value_nor_gradient(mode):
    raw_kappa, raw_d, settings = parameters_and_settings(mode)
    input, target, weight = randn(9, 4), randn(9, 4, seed=1), torch.ones(9, 4, dtype=torch.float64)
    weight[::2, 1] = weight[3] = 0.0
    found = value_and_gradients(fused_loss, input, target, raw_kappa, raw_d, settings, weight)
    input[::2, 1], target[3] = math.nan, math.inf
    contaminated = value_and_gradients(fused_loss, input, target, raw_kappa, raw_d, settings, weight)
    torch.testing.assert_close(found, contaminated, rtol=0.0, atol=0.0)
    assert (contaminated[1][weight == 0] == 0).all()
    nothing = value_and_gradients(fused_loss, input, target, raw_kappa, raw_d, settings, torch.zeros_like(weight))
    assert all((value == 0).all() for value in nothing)


@each_mode
def test_strided_and_expanded_batches_equal_their_copies(mode):
    raw_kappa, raw_d, settings = parameters_and_settings(mode)
    for input in (randn(4, 9).mT, randn(18, 8)[::2, ::2], randn(4).expand(9, 4), randn(9, 1).expand(9, 4)):
        target = randn(4, 9, seed=1).mT
        found = value_and_gradients(fused_loss, input, target, raw_kappa, raw_d, settings)
        copied = value_and_gradients(fused_loss, input.contiguous(), target.contiguous(), raw_kappa, raw_d, settings)
        torch.testing.assert_close(found, copied, rtol=1e-13, atol=1e-14)


@each_mode
@pytest.mark.parametrize("rows", [SMALL_BATCH // 4, SMALL_BATCH // 4 + 1])
def test_torch_on_large_batches_equals_the_formulas(mode, rows):
    raw_kappa, raw_d, settings = parameters_and_settings(mode)
    assert_equals_formulas(2.0 * randn(rows, 4), randn(rows, 4, seed=1), raw_kappa, raw_d, settings)


@pytest.mark.parametrize("channels", [1, 3, 4, 700])
@pytest.mark.parametrize("mode", ["fixed", "learned", "robust", "robust of given d"])
@pytest.mark.parametrize("weighted", [False, True])
def test_large_batches_in_pieces_equal_whole_batches(channels, mode, weighted, monkeypatch):
    # not a whole number of pieces, nor, but for the first, of long rows
    rows = LARGE_BATCH // channels + (256 if channels == 1 else 5)
    raw_kappa, raw_d, settings = parameters_and_settings(mode, channels)
    input, target = 3.0 * randn(rows, channels), randn(rows, channels, seed=1)
    weight = randn(rows, channels, seed=2).clamp(min=0.0) if weighted else None
    calls, in_pieces = [], module._in_pieces
    monkeypatch.setattr(module, "_in_pieces", lambda *a, **k: calls.append(1) or in_pieces(*a, **k))
    found = value_and_gradients(fused_loss, input, target, raw_kappa, raw_d, settings, weight)
    assert calls
    monkeypatch.setattr(module, "LARGE_BATCH", math.inf)
    expected = value_and_gradients(fused_loss, input, target, raw_kappa, raw_d, settings, weight)
    assert len(calls) == 1
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-14)


def test_without_a_gradient_the_value_is_the_same():
    raw_kappa, raw_d, settings = parameters_and_settings("robust")
    batch = batch_of(randn(100, 4), randn(100, 4, seed=1))
    with torch.no_grad():
        quiet = fused_loss(batch, raw_kappa, raw_d, settings)
    assert not quiet.requires_grad
    given = leaves(*batch[:2])
    assert torch.equal(quiet, fused_loss(batch_of(*given), raw_kappa, raw_d, settings).detach())


# --- single precision


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("sigma", [1.0, 10.0, 100.0, 1e3, 1e4])
def test_single_precision_keeps_the_gradient_of_large_bandwidths(sigma):
    """A difference of exponentials would lose it: 1 - exp(-x) (1 + x) cancels to 0 at x = 1e-7."""
    rows = 20_000 if module.SMALL_STATE else 2000
    raw = torch.logit(torch.tensor([sigma**-2.0 / 400.0], dtype=torch.float64)).float()
    state = ChannelState(bound=torch.tensor([100.0]), floor=torch.tensor([0.001]))
    error, settings = 1.5 * randn(rows, 1).float(), LossSettings(None, torch.ones(1), state, False, False, "mean")
    double = LossSettings(
        None, torch.ones(1).double(), ChannelState(*(s and s.double() for s in state)), False, False, "mean"
    )
    zeros = torch.zeros_like(error)
    found = value_and_gradients(fused_loss, error, zeros, raw, None, settings)
    expected = value_and_gradients(loss_value, error.double(), zeros.double(), raw.double(), None, double)
    for value, other in zip(found, expected, strict=True):
        torch.testing.assert_close(value.double(), other, rtol=2e-5, atol=1e-10)


def gaussian(m=1, reduction="sum", d=1.0):
    """The settings of channels that are Gaussian, in single precision."""
    ones = torch.ones(m)
    return LossSettings(0.0 * ones, d * ones, ChannelState(100.0 * ones, 1e-3 * ones), False, False, reduction)


@pytest.mark.usefixtures("implementation")
def test_a_gaussian_channel_is_bitwise_half_the_squared_error():
    error = randn(1000, 1, dtype=torch.float32)
    found = value_and_gradients(fused_loss, error, torch.zeros_like(error), None, None, gaussian())
    assert torch.equal(found[1], error)
    torch.testing.assert_close(found[0], 0.5 * error.square().sum(), rtol=1e-6, atol=0.0)


def test_a_gaussian_in_pieces_is_half_the_squares():
    error = randn(LARGE_BATCH // 2 + 1, 2, dtype=torch.float32)
    found = value_and_gradients(fused_loss, error, torch.zeros_like(error), None, None, gaussian(2))
    torch.testing.assert_close(found[0], 0.5 * error.square().sum(), rtol=1e-5, atol=0.0)
    assert torch.equal(found[1], error)


@pytest.mark.parametrize("size", [1e8, 1e14, 1.8e19])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("rows", [1, SMALL_BATCH, LARGE_BATCH // 2 + 1])
def test_a_gaussian_channel_is_exact_up_to_the_overflow_of_the_square(size, weighted, rows):
    error = torch.zeros(rows, 2)
    error[0] = torch.tensor([size, 3.0])
    weight = torch.ones_like(error) if weighted else None
    settings = gaussian(2)
    settings.fixed_kappa[1] = 1.0
    for kept in (0, 1):
        errors = error.clone()
        errors[0, 1 - kept] = 0.0
        value, slope, _ = value_and_gradients(
            fused_loss, errors, torch.zeros_like(errors), None, None, settings, weight
        )
        assert value.item() == pytest.approx((0.5 * size**2, 1.0 - math.exp(-4.5))[kept], rel=1e-6)
        assert slope[0, kept].item() == pytest.approx((size, 3.0 * math.exp(-4.5))[kept], rel=1e-6)


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("learned", [False, True])
def test_a_square_that_overflows_has_infinite_value_and_the_right_gradient(weighted, learned):
    settings = gaussian()
    raw_d = torch.zeros(1) if learned else None
    settings = LossSettings(
        settings.fixed_kappa, None if learned else torch.ones(1), settings.state, False, False, "sum"
    )
    error = torch.tensor([[1e30], [2.0]])
    weight = torch.ones(2, 1) if weighted else None
    value, slope, *_ = value_and_gradients(fused_loss, error, torch.zeros(2, 1), None, raw_d, settings, weight)
    assert value.item() == math.inf
    d = 50.0005 if learned else 1.0
    torch.testing.assert_close(slope, error / d**2)


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("size", [1e10, 1e19, 1e30])
def test_an_error_whose_square_overflows_has_zero_influence_and_finite_gradients(size):
    error = torch.tensor([[0.5], [size]])
    state = ChannelState(torch.tensor([2.0]), torch.tensor([0.0]))
    settings = LossSettings(None, None, state, False, False, "sum")
    raw_kappa, raw_d = torch.logit(torch.tensor([0.1 / 400.0])), torch.zeros(1)
    found = value_and_gradients(fused_loss, error, torch.zeros(2, 1), raw_kappa, raw_d, settings)
    assert found[0].item() == pytest.approx(10.0 * (1.0 - math.exp(-0.0125)) + 10.0, rel=1e-5)
    assert found[1][1].item() == 0.0
    assert all(value.isfinite().all() for value in found)


@pytest.mark.parametrize("rows", [100, LARGE_BATCH + 256])
def test_sums_of_single_precision_are_accurate_to_a_rounding_per_element(rows):
    raw_kappa, raw_d, settings = parameters_and_settings("robust", 1, torch.float32)
    wide = parameters_and_settings("robust", 1)
    input, target = randn(rows, 1, dtype=torch.float32), randn(rows, 1, seed=1, dtype=torch.float32)
    found = value_and_gradients(fused_loss, input, target, raw_kappa, raw_d, settings)
    expected = value_and_gradients(loss_value, input.double(), target.double(), *wide)
    for value, other in zip(found, expected, strict=True):
        torch.testing.assert_close(value.double(), other, rtol=3e-6, atol=1e-9 if value.dim() else 0.0)


# --- backward


@pytest.mark.usefixtures("implementation")
@each_mode
def test_two_backward_passes_give_bitwise_equal_gradients(mode):
    raw_kappa, raw_d, settings = parameters_and_settings(mode)
    given = leaves(randn(9, 4), randn(9, 4, seed=1), raw_kappa, raw_d)
    value = fused_loss(batch_of(*given[:2]), *given[2:], settings)
    wanted = [entry for entry in given if entry is not None]
    for upstream in (1.0, 1.0, 3.0, 1.0):
        grad = torch.tensor(upstream, dtype=torch.float64)
        found = torch.autograd.grad(value, wanted, grad, retain_graph=True)
        if upstream == 1.0:
            expected = [entry.clone() for entry in found]
            for entry in found:
                entry.mul_(7.0)  # changing returned gradients must not affect a later pass
            found = torch.autograd.grad(value, wanted, grad, retain_graph=True)
            torch.testing.assert_close(list(found), expected, rtol=0.0, atol=0.0)
        else:
            torch.testing.assert_close(list(found), [3.0 * entry for entry in expected], rtol=1e-14, atol=0.0)


def test_gradients_accumulate_in_leaves_as_twice_the_gradient():
    raw_kappa, raw_d, settings = parameters_and_settings("robust")
    given = leaves(randn(9, 4), randn(9, 4, seed=1), raw_kappa, raw_d)
    value = fused_loss(batch_of(*given[:2]), *given[2:], settings)
    value.backward(retain_graph=True)
    once = [entry.grad.clone() for entry in given]
    value.backward()
    torch.testing.assert_close([entry.grad for entry in given], [2.0 * entry for entry in once], rtol=1e-15, atol=0.0)


@each_mode
def test_the_gradient_by_the_target_is_the_negative_gradient_by_the_input(mode):
    _, by_input, by_target, *_ = value_and_gradients(
        fused_loss, randn(9, 4), randn(9, 4, seed=1), *parameters_and_settings(mode)
    )
    assert torch.equal(by_target, -by_input)
    given = leaves(randn(9, 4, seed=1))
    raw_kappa, raw_d, settings = parameters_and_settings(mode)
    value = fused_loss(batch_of(randn(9, 4), given[0]), raw_kappa, raw_d, settings)
    assert torch.equal(torch.autograd.grad(value, given)[0], by_target)


@each_mode
def test_only_required_gradients_are_computed(mode, monkeypatch):
    raw_kappa, raw_d, settings = parameters_and_settings(mode)
    input, target = randn(9, 4), randn(9, 4, seed=1)
    made, reduced = [], module.reduced_loss
    monkeypatch.setattr(module, "reduced_loss", lambda *a, **k: made.append(reduced(*a, **k)) or made[-1])
    given = leaves(raw_kappa, raw_d)
    wanted = [entry for entry in given if entry is not None]
    value = fused_loss(batch_of(input, target), *given, settings)
    assert made[0].by_input is None
    assert value.requires_grad == bool(wanted)
    if wanted:
        found = torch.autograd.grad(value, wanted)
        expected = value_and_gradients(fused_loss, input, target, raw_kappa, raw_d, settings)[3:]
        torch.testing.assert_close(list(found), expected, rtol=0.0, atol=0.0)


@pytest.mark.e2e
@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("mode", [mode for mode in MODES if not mode.startswith("robust")])
@pytest.mark.parametrize("weighted", [False, True])
def test_first_and_second_derivatives_equal_finite_differences(mode, weighted):
    """Of the likelihood; the gradient of a robust loss is that of a sum of two terms with constants in each."""
    raw_kappa, raw_d, settings = parameters_and_settings(mode)
    given = leaves(randn(3, 4), randn(3, 4, seed=1), raw_kappa, raw_d)
    wanted = [entry for entry in given if entry is not None]
    weight = randn(3, 4, seed=2).abs() if weighted else None

    def value(*now):
        now = iter(now)
        all_of = [None if entry is None else next(now) for entry in given]
        return fused_loss(batch_of(*all_of[:2], weight), *all_of[2:], settings)

    assert torch.autograd.gradcheck(value, wanted)
    assert torch.autograd.gradgradcheck(value, wanted)


@each_mode
def test_second_derivatives_equal_the_formulas(mode):
    raw_kappa, raw_d, settings = parameters_and_settings(mode)
    found = []
    for function in (fused_loss, loss_value):
        given = leaves(randn(9, 4), randn(9, 4, seed=1), raw_kappa, raw_d)
        wanted = [entry for entry in given if entry is not None]
        value = function(batch_of(*given[:2]), *given[2:], settings)
        slopes = torch.autograd.grad(value, wanted, create_graph=True)
        mixed = sum((slope * (1.0 + slope)).sum() for slope in slopes)
        found.append([value, *slopes, *torch.autograd.grad(mixed, wanted)])
    torch.testing.assert_close(*found, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", [1e-4, 0.1, 1.0, 30.0, 1e15])
@pytest.mark.parametrize("unit", [1.0, 1e-15, 1e20])
@pytest.mark.parametrize("equal", [False, True])
def test_sums_of_a_large_batch_of_given_numbers_keep_single_precision(size, equal, unit, monkeypatch):
    """Also where all energies are small, where they are at their limit, and where all rounding errors are equal."""
    monkeypatch.setattr(_fixed_pieces, "PIECE", 1 << 12)
    kappa, d = torch.tensor([0.01, 0.1, 1.0, 4.0]), unit * torch.tensor([0.5, 1.0, 2.0, 0.1])
    error = unit * size * (torch.ones(9_999, 4) if equal else randn(9_999, 4, dtype=torch.float32))
    energy, slope = fixed_sums(error, torch.zeros_like(error), kappa, d, 4e4, wants_input=True)
    without = fixed_sums(error, torch.zeros_like(error), kappa, d, 4e4, wants_input=False)
    minus_x = -0.5 * kappa.double() * (error.double() / d.double()).square()
    torch.testing.assert_close(energy, (-torch.expm1(minus_x) / kappa.double()).sum(0), rtol=2e-6, atol=0.0)
    expected = error.double() / d.double().square() * minus_x.exp() / 4e4
    torch.testing.assert_close(slope.double() * unit, expected * unit, rtol=2e-5, atol=1e-17)
    assert without[1] is None
    torch.testing.assert_close(without[0], energy, rtol=0.0, atol=0.0)
