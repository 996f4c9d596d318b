"""Student's t and Fisher's F against scipy."""

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import special, stats

from mkc_torch._support.student_t import fisher_tail, incomplete_beta, student_quantile, student_tails


def f64(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


@given(st.floats(0.05, 1e5), st.floats(0.05, 1e3), st.floats(0.0, 1.0))
def test_the_incomplete_beta_function_agrees_with_scipy(a, b, x):
    expected = special.betainc(a, b, x)
    assert float(incomplete_beta(f64(a), f64(b), f64(x))) == pytest.approx(expected, rel=1e-8, abs=1e-12)


@settings(deadline=None, max_examples=25)  # the first call of a process is slow
@given(st.floats(0.5, 1e5), st.floats(0.01, 0.999))
@example(freedom=0.5, level=0.99609375)
def test_quantile_and_tails_are_inverse_and_agree_with_scipy(freedom, level):
    t = student_quantile(level, f64(freedom))
    assert float(t) == pytest.approx(stats.t.ppf(0.5 + 0.5 * level, freedom), rel=1e-8)
    assert float(student_tails(t, f64(freedom))) == pytest.approx(1 - level, rel=1e-8)


@pytest.mark.parametrize("f", [0.0, 0.3, 2.0, 40.0])
@pytest.mark.parametrize("under", [3.0, 90.0, 1e9])
def test_fisher_tails_agree_with_scipy(f, under):
    expected = stats.f.sf(f, 4, under)
    assert float(fisher_tail(f64(f), torch.tensor(4), f64(under))) == pytest.approx(expected, rel=1e-4, abs=1e-12)


def test_far_tails_are_accurate():
    assert float(student_tails(f64(30.0), f64(50.0))) == pytest.approx(2 * stats.t.sf(30.0, 50), rel=1e-9)
    assert float(student_tails(f64(torch.inf), f64(5.0))) == 0.0
