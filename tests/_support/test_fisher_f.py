"""Fisher's F and the incomplete beta function against scipy."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import special, stats

from mkc_torch._support.fisher_f import fisher_tail, incomplete_beta


def f64(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


@given(st.floats(0.05, 1e5), st.floats(0.05, 1e3), st.floats(0.0, 1.0))
def test_the_incomplete_beta_function_agrees_with_scipy(a, b, x):
    expected = special.betainc(a, b, x)
    assert float(incomplete_beta(f64(a), f64(b), f64(x))) == pytest.approx(expected, rel=1e-8, abs=1e-12)


@pytest.mark.parametrize("f", [0.0, 0.3, 2.0, 40.0])
@pytest.mark.parametrize("under", [3.0, 90.0, 1e9])
def test_fisher_tails_agree_with_scipy(f, under):
    expected = stats.f.sf(f, 4, under)
    assert float(fisher_tail(f64(f), torch.tensor(4), f64(under))) == pytest.approx(expected, rel=1e-4, abs=1e-12)
