"""The summed energy against the plain formula: value, first and second gradients, forward mode, vmap, any layout."""

import math

import pytest
import torch

from mkc_torch.density.energy import energy
from mkc_torch.losses._energy_sums import _LARGE, energy_sums

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")


def randn(*size, seed=0, dtype=torch.float64):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


KAPPA = torch.tensor([0.0, 1e-6, 0.1, 4.0], dtype=torch.float64)
D = torch.tensor([1.0, 0.5, 2.0, 3.0], dtype=torch.float64)


def plain(error, kappa, d, weight=None, axis=-1):
    axis = axis % error.dim()
    shape = [-1 if i == axis else 1 for i in range(error.dim())]
    values = energy(error / d.view(shape), kappa.view(shape))
    values = values if weight is None else weight * values
    return values.sum([i for i in range(error.dim()) if i != axis]) if error.dim() > 1 else values


def leaves(*values):
    return [v.clone().requires_grad_() for v in values]


def first_gradients(function, error, kappa, d, weight, axis):
    error, kappa, d = leaves(error, kappa, d)
    out = function(error, kappa, d, weight, axis)
    mixed = out @ torch.tensor([1.0, -2.0, 0.5, 3.0]).to(out)
    return out.detach(), *torch.autograd.grad(mixed, (error, kappa, d))


@pytest.mark.parametrize("shape", [(4,), (7, 4), (4, 7), (3, 5, 4), (2, 4, 6)])
@pytest.mark.parametrize("weighted", [False, True])
def test_value_and_gradients_are_those_of_the_formula(shape, weighted):
    axis = shape.index(4)
    error = 3.0 * randn(*shape)
    weight = randn(*shape, seed=1).abs() if weighted else None
    for found, expected in zip(
        first_gradients(energy_sums, error, KAPPA, D, weight, axis),
        first_gradients(plain, error, KAPPA, D, weight, axis),
        strict=True,
    ):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("rows", [16_383, 16_384, 16_385, 50_001])
def test_parts_of_a_large_batch_add_up(rows):
    error = 2.0 * randn(rows, 4)
    weight = randn(rows, 4, seed=1).abs()
    for found, expected in zip(
        first_gradients(energy_sums, error, KAPPA, D, weight, -1),
        first_gradients(plain, error, KAPPA, D, weight, -1),
        strict=True,
    ):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("sigma", [1.0, 10.0, 100.0, 1e3, 1e4])
def test_single_precision_keeps_the_gradient_of_large_bandwidths(sigma):
    """A difference of exponentials would lose it: of 1 - exp(-x) (1 + x) nothing is left at x = 1e-7."""
    error, kappa, d = 1.5 * randn(20_000, 1), torch.tensor([sigma**-2.0]).double(), torch.ones(1).double()
    single = leaves(error.float(), kappa.float(), d.float())
    found = torch.autograd.grad(energy_sums(*single).sum(), single)
    double = leaves(error, kappa, d)
    expected = torch.autograd.grad(plain(*double).sum(), double)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.double(), other, rtol=2e-5, atol=1e-6)


def test_a_gaussian_channel_is_half_the_squared_error_to_the_bit():
    error = randn(1000, 1, dtype=torch.float32).requires_grad_()
    out = energy_sums(error, torch.zeros(1), torch.ones(1))
    (slope,) = torch.autograd.grad(out.sum(), error)
    assert torch.equal(slope, error.detach())
    torch.testing.assert_close(out, (0.5 * error.detach().square()).sum(0), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("size", [1e8, 1e14, 1.8e19])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("rows", [1, _LARGE // 2 + 1])
def test_a_gaussian_channel_is_so_as_far_as_single_precision_holds_the_square(size, weighted, rows):
    error = torch.zeros(rows, 2)
    error[0] = torch.tensor([size, 3.0])
    weight = torch.ones_like(error) if weighted else None
    leaf = error.requires_grad_()
    sums = energy_sums(leaf, torch.tensor([0.0, 1.0]), torch.ones(2), weight)
    (pull,) = torch.autograd.grad(sums.sum(), leaf)
    assert sums[0].item() == pytest.approx(0.5 * size**2, rel=1e-6)
    assert sums[1].item() == pytest.approx(1.0 - math.exp(-4.5), rel=1e-6)
    assert pull[0, 0].item() == pytest.approx(size, rel=1e-6)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("by_kappa", [False, True])
def test_beyond_that_it_is_infinite_and_pulls_as_it_should(weighted, by_kappa):
    leaf = torch.tensor([[1e30], [2.0]], requires_grad=True)
    weight = torch.ones(2, 1) if weighted else None
    sums = energy_sums(leaf, torch.zeros(1, requires_grad=by_kappa), torch.ones(1), weight)
    (pull,) = torch.autograd.grad(sums, leaf)
    assert sums.item() == math.inf
    torch.testing.assert_close(pull, leaf.detach())


@pytest.mark.parametrize("size", [1e10, 1e19, 1e30])
def test_an_error_whose_square_overflows_pulls_at_nothing(size):
    error = torch.tensor([[0.5], [size]], requires_grad=True)
    kappa, d = leaves(torch.tensor([0.1]), torch.tensor([1.0]))
    out = energy_sums(error, kappa, d)
    slopes = torch.autograd.grad(out.sum(), (error, kappa, d))
    assert out.item() == pytest.approx(10.0 * (1.0 - torch.exp(torch.tensor(-0.0125)).item()) + 10.0, rel=1e-5)
    assert slopes[0][1].item() == 0.0
    assert all(bool(torch.isfinite(s).all()) for s in slopes)


def test_derivatives_of_every_kind():
    error, kappa, d = leaves(randn(5, 2), torch.tensor([0.3, 2.0]).double(), torch.tensor([1.0, 0.7]).double())
    weight = randn(5, 2, seed=1).abs().requires_grad_()
    assert torch.autograd.gradcheck(energy_sums, (error, kappa, d, weight), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(energy_sums, (error, kappa, d, weight))


def test_derivatives_by_prediction_and_target():
    input, target, kappa, d = leaves(
        randn(5, 2), randn(5, 2, seed=3), torch.tensor([0.3, 2.0]).double(), torch.tensor([1.0, 0.7]).double()
    )
    weight = randn(5, 2, seed=1).abs().requires_grad_()

    def sums(i, t, k, s, w):
        return energy_sums(i, k, s, w, target=t)

    inputs = (input, target, kappa, d, weight)
    torch.testing.assert_close(sums(*inputs), plain(input - target, kappa, d, weight))
    assert torch.autograd.gradcheck(sums, inputs, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(sums, inputs)
    by_input, by_target = torch.autograd.grad(energy_sums(input, kappa, d, target=target).sum(), (input, target))
    torch.testing.assert_close(by_target, -by_input)


def test_hessians_by_forward_over_reverse_and_reverse_over_reverse():
    error = randn(6, 1)

    def value(parameters):
        return energy_sums(error - parameters[0], parameters[1:2], parameters[2:3]).sum()

    at = torch.tensor([0.2, 0.5, 1.3]).double()
    forward = torch.func.jacfwd(torch.func.grad(value))(at)
    torch.testing.assert_close(forward, torch.autograd.functional.hessian(value, at))
    torch.testing.assert_close(forward, forward.mT)


def test_an_ensemble_under_vmap_is_each_one_alone():
    error, kappa, d = randn(3, 8, 2), randn(3, 2, seed=1).abs(), randn(3, 2, seed=2).abs() + 0.5

    def slope(e, k, s):
        return torch.func.grad(lambda *a: energy_sums(*a).sum(), argnums=(0, 1, 2))(e, k, s)

    together = torch.func.vmap(slope)(error, kappa, d)
    for i in range(3):
        for one, all_of in zip(slope(error[i], kappa[i], d[i]), together, strict=True):
            torch.testing.assert_close(one, all_of[i])


def test_one_bandwidth_per_member_over_shared_errors():
    error = randn(8, 2)
    kappas = randn(4, 2, seed=1).abs()
    together = torch.func.vmap(lambda k: energy_sums(error, k, torch.ones(2).double()))(kappas)
    torch.testing.assert_close(together, torch.stack([plain(error, k, torch.ones(2).double()) for k in kappas]))


def test_without_a_gradient_the_value_is_the_same():
    error = randn(100, 4)
    with torch.no_grad():
        quiet = energy_sums(error, KAPPA, D)
    torch.testing.assert_close(quiet, energy_sums(error.requires_grad_(), KAPPA, D).detach())


@pytest.mark.parametrize("channels", [1, 3, 4, 700])
@pytest.mark.parametrize("learned", [True, False])
def test_large_batches_in_pieces_are_those_in_one(channels, learned, monkeypatch):
    # not a whole number of pieces, nor, but for the first, of long rows
    rows = _LARGE // channels + (256 if channels == 1 else 5)
    generator = torch.Generator().manual_seed(0)
    error = 3.0 * torch.randn(rows, channels, generator=generator, dtype=torch.float64)
    kappa = torch.linspace(0.02, 2.0, channels, dtype=torch.float64)
    d = torch.linspace(0.5, 1.5, channels, dtype=torch.float64)

    def found():
        inputs = [error.clone().requires_grad_(), *(one.clone().requires_grad_(learned) for one in (kappa, d))]
        sums = energy_sums(*inputs)
        wanted = [one for one in inputs if one.requires_grad]
        return [sums.detach(), *torch.autograd.grad(sums.square().sum(), wanted)]

    def found_of_a_target():
        shift = randn(*error.shape, seed=2)
        input, target = leaves(error + shift, shift)
        sums = energy_sums(input, kappa, d, target=target)
        return [sums.detach(), *torch.autograd.grad(sums.square().sum(), (input, target))]

    pieces = found()
    total, slope, *_ = pieces
    for one, other in zip(found_of_a_target(), (total, slope, -slope), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-8)
    monkeypatch.setattr("mkc_torch.losses._energy_sums._LARGE", math.inf)
    for one, other in zip(pieces, found(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-8)


def test_a_gaussian_in_pieces_is_half_the_squares():
    error = torch.randn(_LARGE // 2 + 1, 2, generator=torch.Generator().manual_seed(1)).requires_grad_()
    sums = energy_sums(error, torch.zeros(2), torch.ones(2))
    torch.testing.assert_close(sums, 0.5 * error.detach().square().sum(0), rtol=1e-5, atol=0.0)
    (gradient,) = torch.autograd.grad(sums.sum(), error)
    torch.testing.assert_close(gradient, error.detach())
