"""Intervals of MKC-EM contain the truth under one-sided outliers that hide within the noise."""

import pytest
import torch

from mkc_torch.linear import MKCRegression
from tests.linear.interval_coverage import CASES, coverage, draws


@pytest.mark.parametrize("rows", [40, 100])
@pytest.mark.parametrize("case", CASES)
def test_intervals_contain_the_truth(case, rows):
    """0.92 to 0.97 in 5000 draws; five standard errors of 500 draws are 0.05."""
    shares = coverage(MKCRegression(), case, rows, 500, seed=1)
    assert bool((shares > 0.90).all()), shares
    assert bool((shares < 0.99).all()), shares


def test_the_bound_is_for_the_coefficients_that_the_outliers_move():
    X, Y = draws("+3", 200, 100)
    fit = MKCRegression().fit(X, Y)
    bias = (fit.coef_ - torch.tensor([1.0, 2.0], dtype=torch.float64)).mean(0).abs()
    bound = fit.one_sided_bias_.median(0).values
    assert bias[0] > 3.0 * bias[1]
    assert 0.5 * bias[0] < bound[0] < 3.0 * bias[0]
    assert bound[1] < bound[0]


def test_the_bound_has_the_unit_of_the_coefficients_and_is_0_for_an_exact_fit():
    X, Y = draws("+3", 4, 60)
    one, other = MKCRegression().fit(X, Y), MKCRegression().fit(X, 1000.0 * Y)
    torch.testing.assert_close(1000.0 * one.one_sided_bias_, other.one_sided_bias_, rtol=1e-4, atol=1e-3)
    exact = MKCRegression().fit(X[0], X[0] @ torch.tensor([1.0, 2.0], dtype=torch.float64))
    assert exact.one_sided_bias_.tolist() == [0.0, 0.0]
    assert exact.confidence_interval().isfinite().all()


def test_several_channels_have_no_bound():
    X, Y = draws("+3", 3, 60)
    fit = MKCRegression().fit(X.unsqueeze(-2).expand(3, 60, 2, 2), torch.stack([Y, 2.0 * Y], -1))
    assert fit.one_sided_bias_.shape == fit.coef_.shape
    assert not bool(fit.one_sided_bias_.any())
