"""A fit that follows bad leverage points warns and names their rows; clean fits do not warn."""

import warnings

import numpy as np
import pytest
import torch

from mkc_torch.calibration import EllipsoidFit
from mkc_torch.calibration.coverage import fibonacci_sphere
from mkc_torch.linear import FixedPointLinear, MKCRegression
from tests.shared_data import shared_data


def with_intercept(x, dtype=torch.float64):
    return torch.cat([torch.ones(len(x), 1, dtype=dtype), x], -1)


@pytest.mark.parametrize("estimator", [MKCRegression(), FixedPointLinear(), FixedPointLinear(sigma=2.0, d=0.4)])
def test_the_giants_of_stars_cyg_are_named(estimator):
    table = torch.tensor(np.loadtxt(shared_data("literature/starsCYG.csv"), delimiter=",", skiprows=1))
    with pytest.warns(UserWarning, match="bad leverage points in rows 10, 19, 29, 33: "):
        estimator.fit(with_intercept(table[:, :1]), table[:, 1])


@pytest.mark.parametrize("columns", [1, 3])
def test_leverage_in_a_combination_of_columns_is_found(columns):
    draw = torch.Generator().manual_seed(1)
    x = torch.randn(60, columns, generator=draw, dtype=torch.float64)
    y = x.sum(-1) + 0.3 * torch.randn(60, generator=draw, dtype=torch.float64)
    x[:6, 0] += 40.0
    with pytest.warns(UserWarning, match="rows 0, 1, 2, 3, 4, 5: "):
        FixedPointLinear(sigma=50.0).fit(with_intercept(x), y)


@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.parametrize("estimator", [MKCRegression(), FixedPointLinear()])
def test_clean_fits_and_good_leverage_points_have_no_warning(estimator, heavy):
    draw = torch.Generator().manual_seed(2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(10):
            x = torch.randn(80, 2, generator=draw, dtype=torch.float64)
            x = x.exp() if heavy else x
            y = x.sum(-1) + torch.randn(80, generator=draw, dtype=torch.float64)
            estimator.fit(with_intercept(x), y)


def test_vertical_outliers_and_ellipsoids_have_no_warning():
    draw = torch.Generator().manual_seed(3)
    x = torch.randn(80, 1, generator=draw, dtype=torch.float64)
    y = x[:, 0] + 0.1 * torch.randn(80, generator=draw, dtype=torch.float64)
    y[:20] += 10.0
    points = fibonacci_sphere(400) * torch.tensor([40.0, 50.0, 60.0]) + 5.0
    points[:20] += 25.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        MKCRegression().fit(with_intercept(x), y)
        EllipsoidFit().fit(points)
