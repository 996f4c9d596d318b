"""Parts of a fit of many rows: a step within limits, the Gaussian fit from sums, the triangular factor of the rows."""

import math
from dataclasses import replace

import pytest
import torch

from mkc_torch.linear._blocks import Block, triangle
from mkc_torch.linear._descent import Descent, EvaluatedPoint, PassDerivatives, _newton_move
from mkc_torch.linear._implicit.stationary import FitState, Unknowns
from mkc_torch.linear._many_rows import more_likely_gaussian
from mkc_torch.linear._rows import Rows

GRADIENTS = {
    "inside": [1.0, 0.1, -0.3],
    "κ to 0": [1.0, 5.0, -0.3],
    "log d to its least": [1.0, -0.1, 3.0],
    "both": [0.5, 4.0, 5.0],
    "log d to the bound": [0.0, 0.0, -3.0],
    "held at once, as the coefficient moves": [-9.0, 0.4, 0.1],
}


def double(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


@pytest.mark.parametrize("gradient", GRADIENTS.values(), ids=GRADIENTS)
def test_a_step_is_newtons_in_the_unknowns_within_their_limits(gradient):
    """κ = 0.5 may fall to 0, log d = 0 may fall to -1 and rise to 2."""
    point = Unknowns(double(3.0), double(0.5), double(0.0))
    fit_state = FitState(
        point.beta,
        point.kappa,
        point.log_d,
        torch.tensor([True]),
        double(2.0),
        double(-1.0),
        free_kappa=True,
        free_d=True,
    )
    slope = double(*gradient)
    hessian = torch.tensor([[[2.0, 0.5, 0.3], [0.5, 1.0, 0.2], [0.3, 0.2, 1.0]]], dtype=torch.float64)
    move = _newton_move(fit_state, EvaluatedPoint(point, 0.0, torch.tensor(0.0), slope, hessian, None, None))
    low, high = double(-torch.inf, -0.5, -1.0), double(torch.inf, 399.5, 2.0)
    assert bool(((move >= low) & (move <= high)).all())
    stopped = (move == low) | (move == high)
    left = slope + torch.matmul(hessian, move.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(left[~stopped], torch.zeros_like(left[~stopped]), rtol=0, atol=1e-12)
    newton = -torch.linalg.solve(hessian, slope.unsqueeze(-1)).squeeze(-1)
    assert bool(stopped.any()) == bool(((newton < low) | (newton > high)).any())


@pytest.mark.parametrize("channels", [1, 2])
def test_the_more_likely_gaussian_equals_weighted_least_squares_of_all_channels(channels):
    generator = torch.Generator().manual_seed(0)
    X = torch.randn(300, channels, 3, generator=generator, dtype=torch.float64)
    scales = torch.tensor([0.5, 3.0]).double()[:channels]
    Y = X.sum(-1) + scales * torch.randn(300, channels, generator=generator, dtype=torch.float64)
    weight = torch.rand(300, channels, generator=generator, dtype=torch.float64)
    kappa, log_d = (torch.full((1, channels), value, dtype=torch.float64) for value in (0.3, 0.0))
    fit_state = FitState(
        double(0.9, 1.2, 1.0),
        kappa,
        log_d,
        torch.tensor([False]),
        log_d + 5.0,
        log_d - 9.0,
        free_kappa=True,
        free_d=True,
    )
    grams = torch.einsum("kc,kci,kcj->cij", weight, X, X) / weight.sum()
    begin = Descent.begin(fit_state, PassDerivatives(grams[0], grams[:, 0], grams), near=0.0, stop=1.0)
    result = Rows(X, Y, weight).evaluate(begin.point.beta[0], begin.density(), with_curvature=True)
    best = EvaluatedPoint(begin.point, 0.0, 0.0, double(0.0), double(0.0), None, result)
    end = replace(begin, best=best, curvature_sums=result.curvature, history=(math.inf,))
    gaussian = more_likely_gaussian(end, grams)
    precision = torch.ones(channels).double()
    for _ in range(3):
        root = (weight * precision).sqrt()
        beta = torch.linalg.lstsq((root.unsqueeze(-1) * X).flatten(0, 1), (root * Y).flatten()).solution
        mean_square = (weight * (Y - X @ beta).square()).sum(0) / weight.sum(0)
        precision = 1.0 / mean_square if channels > 1 else precision
    torch.testing.assert_close(gaussian.beta[0], beta, rtol=1e-10, atol=0)
    torch.testing.assert_close(torch.exp(gaussian.log_d[0]), mean_square.sqrt(), rtol=1e-10, atol=0)
    assert not gaussian.kappa.any()
    assert more_likely_gaussian(replace(end, history=(-1e9,)), grams) is None
    assert more_likely_gaussian(replace(end, point=replace(end.point, kappa=0.0 * kappa)), grams) is None


@pytest.mark.parametrize("channels", [1, 2])
def test_the_triangular_factor_is_that_of_the_rows_with_weight(channels):
    rows = torch.randn(40, channels, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weight = 0.5 * torch.ones(40, channels, dtype=torch.float64)
    weight[::3, -1] = 0.0
    upper = None
    for part in (slice(25), slice(25, None)):
        upper = triangle(Block(rows[part], rows[part, :, 0], weight[part]), upper)
    used = rows[weight > 0]
    torch.testing.assert_close(upper.mT @ upper, used.mT @ used)
    assert bool((upper.tril(-1) == 0).all())
