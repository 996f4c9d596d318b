"""The table of the head equals the quadrature."""

import math

import pytest
import torch

from mkc_torch.density.head_table import look_up, reaches_beyond_head
from mkc_torch.density.normalizer import log_partition


def uniform(low, high, *shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize(("shortest", "longest", "rounding"), [(1.0, 15.0, 5e-6), (15.0, 1e7, 5e-7)])
def test_many_normalisers_in_single_precision_equal_double_precision(shortest, longest, rounding):
    """Short domains mostly use the quadrature, where the tail cancels in the derivative; long domains the table."""
    n = 5000
    kappa = torch.cat(
        [uniform(0.0, 1.0, n), uniform(0.0, 400.0, n), torch.exp(uniform(-14.0, 5.99, n)), torch.zeros(9)]
    )
    kappa = kappa.float()
    length = torch.exp(uniform(math.log(shortest), math.log(longest), len(kappa), seed=1)).float()
    found, expected = [], []
    for results, dtype in ((found, torch.float32), (expected, torch.float64)):
        k, reach = (entry.to(dtype).requires_grad_() for entry in (kappa, length))
        value = log_partition(k, reach)
        by_kappa, by_length = torch.autograd.grad(value.sum(), (k, reach))
        results += [value.detach().double(), by_kappa.double(), (by_length * length).double()]
    torch.testing.assert_close(found[0], expected[0], rtol=1e-7, atol=3e-7)
    # exp(-1 / kappa) has the rounding error of kappa, times 1 / kappa
    amplified = rounding + 2e-7 / kappa.double().clamp(min=0.03)
    assert ((found[1] - expected[1]).abs() <= amplified * expected[1].abs()).all()
    torch.testing.assert_close(found[2], expected[2], rtol=1e-6, atol=1e-6)


def test_the_table_is_more_accurate_than_single_precision():
    kappa = torch.cat([uniform(0.0, 0.5, 500), uniform(0.0, 400.0, 500)]).requires_grad_()
    length = torch.full_like(kappa, 24.0)
    assert reaches_beyond_head(kappa, length).all()
    value = log_partition(kappa, length)
    (by_kappa,) = torch.autograd.grad(value.sum(), kappa)
    found, slope, _ = look_up(kappa.detach(), length)
    torch.testing.assert_close(found, value.detach(), rtol=0.0, atol=5e-8)
    torch.testing.assert_close(slope, by_kappa, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("reach", [9.0, 50.0])
def test_nan_zero_and_empty_tensors_are_accepted(reach):
    kappa = torch.full((10, 10), 0.1)
    kappa[2, 3], kappa[4, 5] = math.nan, 0.0
    length = torch.full_like(kappa, reach)
    value = log_partition(kappa, length)
    assert value.isnan().sum() == 1
    assert value[2, 3].isnan()
    assert value[4, 5].item() == pytest.approx(0.5 * math.log(2.0 * math.pi), abs=1e-6)
    assert log_partition(kappa[:0], length[:0]).shape == (0, 10)


def test_second_derivatives_of_transposed_elements_equal_double_precision():
    kappa = uniform(0.05, 2.0, 9, 20).float().mT.requires_grad_()
    length = uniform(1.0, 60.0, 9, 20, seed=1).float().mT
    found, expected = [], []
    for results, dtype in ((found, torch.float32), (expected, torch.float64)):
        k = kappa.detach().to(dtype).requires_grad_()
        (slope,) = torch.autograd.grad(log_partition(k, length.to(dtype)).sum(), k, create_graph=True)
        (curvature,) = torch.autograd.grad(slope.sum(), k)
        results += [slope.detach().double(), curvature.double()]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
