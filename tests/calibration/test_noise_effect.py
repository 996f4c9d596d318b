"""Bias and spurious information by noise of the points, compared with closed forms and simulation."""

import torch

from mkc_torch.calibration.coverage import fibonacci_sphere
from mkc_torch.calibration.noise_effect import algebraic_rows, bias_by_noise, distance_rows, moments_of

NOISE = torch.tensor([0.1], dtype=torch.float64)
SPHERE = torch.tensor([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
ROOT = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0]], dtype=torch.float64)


def unit_weights(points):
    return torch.ones(points.shape[:-1], dtype=points.dtype)


def test_information_by_noise_is_half_its_variance_times_the_laplacian():
    points = torch.tensor([[[1.0, 2.0, 3.0]]], dtype=torch.float64)
    moments = moments_of(lambda p: p.square(), points, unit_weights(points), NOISE)
    squares = points[0, 0].square()
    torch.testing.assert_close(moments.found[0], torch.outer(squares, squares))
    # of xᵢ² xⱼ² it is xᵢ² + xⱼ², of xᵢ⁴ six times xᵢ²; differences of step h add h² / 12 of the fourth derivative
    sums = squares.unsqueeze(0) + squares.unsqueeze(1)
    expected = 0.01 * (sums + 4.0 * torch.diag(squares))
    torch.testing.assert_close(moments.lent[0], expected, rtol=1e-3, atol=0)


def test_without_noise_there_is_no_bias_and_no_spurious_information():
    points = fibonacci_sphere(200).unsqueeze(0)
    moments = moments_of(algebraic_rows(SPHERE), points, unit_weights(points), torch.zeros(1).double())
    bias = bias_by_noise(moments)
    assert float(moments.lent.abs().max()) == 0.0
    assert float(bias.offset.abs().max()) == 0.0
    torch.testing.assert_close(bias.growth[0], torch.eye(9).double())


def test_the_bias_of_the_algebraic_fit_equals_that_of_repeated_fits():
    """Least squares of many points on a sphere, each noise of 5 %."""
    generator = torch.Generator().manual_seed(0)
    points = fibonacci_sphere(200_000)
    points = (points + 0.05 * torch.randn(points.shape, generator=generator, dtype=torch.float64)).unsqueeze(0)
    regressors = algebraic_rows(SPHERE)(points)[0, :, :9]
    found = torch.linalg.lstsq(regressors, torch.ones(len(regressors), 1).double()).solution.mT
    moments = moments_of(algebraic_rows(found), points, unit_weights(points), torch.tensor([0.05]).double())
    bias, off = bias_by_noise(moments).offset[0], (found - SPHERE)[0]
    torch.testing.assert_close(bias[:3].mean(), off[:3].mean(), rtol=0.05, atol=0)
    # a coefficient alone has 0.001 of chance
    torch.testing.assert_close(bias, off, rtol=0.05, atol=3e-3)


def test_the_bias_of_distances_equals_that_of_a_mean_distance():
    """Of a sphere of radius 1 it is the variance, by which noise along the surface makes points lie outside."""
    points = fibonacci_sphere(2000).unsqueeze(0)
    bias = bias_by_noise(moments_of(distance_rows(ROOT), points, unit_weights(points), NOISE)).offset[0]
    # the root of a sphere of radius r is the identity over r
    torch.testing.assert_close(bias[[3, 6, 8]], torch.full((3,), -0.01).double(), rtol=0.06, atol=0)
    assert float(bias[[0, 1, 2, 4, 5, 7]].abs().max()) < 1e-4


def test_a_batch_equals_a_loop():
    points = torch.stack([fibonacci_sphere(100), 1.1 * fibonacci_sphere(100)])
    theta, noise = torch.cat([SPHERE, 0.8 * SPHERE]), torch.tensor([0.1, 0.2]).double()
    both = moments_of(algebraic_rows(theta), points, unit_weights(points), noise)
    for i in range(2):
        single = moments_of(
            algebraic_rows(theta[i : i + 1]), points[i : i + 1], unit_weights(points[:1]), noise[i : i + 1]
        )
        torch.testing.assert_close(both.lent[i : i + 1], single.lent)
