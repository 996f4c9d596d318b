"""Student's t against scipy, and against closed forms where scipy's quantiles lose digits: near the centre."""

import math

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import stats

from mkc_torch._support.student_t import student_quantile, student_tails

FREEDOM = torch.logspace(math.log10(0.5), 7.0, 300, dtype=torch.float64)
IN_EACH_TAIL = [1e-12, 1e-9, 1e-6, 1e-3, 0.025, 0.1, 0.25, 0.3, 0.4]
LEVELS = [1e-12, 1e-6, 0.01, 0.3, 0.499, 0.501, 0.9, 0.999, 1.0 - 1e-9]


def f64(value: float | list[float]) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


@pytest.mark.parametrize("tail", IN_EACH_TAIL)
def test_quantiles_have_ten_digits_from_half_a_degree_of_freedom_to_ten_million(tail):
    level = 1.0 - 2.0 * tail
    expected = torch.from_numpy(stats.t.isf(0.5 * (1.0 - level), FREEDOM.numpy()))
    torch.testing.assert_close(student_quantile(level, FREEDOM), expected, rtol=1e-10, atol=0.0)


@pytest.mark.parametrize("t", [0.0, 1e-9, 0.01, 0.5, 1.0, 2.0, 5.0, 30.0])
def test_tails_have_ten_digits_from_half_a_degree_of_freedom_to_ten_million(t):
    expected = torch.from_numpy(2.0 * stats.t.sf(t, FREEDOM.numpy()))
    torch.testing.assert_close(student_tails(f64(t), FREEDOM), expected, rtol=1e-10, atol=0.0)


@pytest.mark.parametrize("level", LEVELS)
def test_quantiles_equal_closed_forms(level):
    cauchy = math.tan(0.5 * math.pi * level) if level < 0.5 else 1.0 / math.tan(0.5 * math.pi * (1.0 - level))
    of_two = level * math.sqrt(2.0 / ((1.0 - level) * (1.0 + level)))
    found = student_quantile(level, f64([1.0, 2.0]))
    torch.testing.assert_close(found, f64([cauchy, of_two]), rtol=1e-13, atol=0.0)


@pytest.mark.parametrize("t", [1e-6, 0.4, 3.0, 1e3, 1e8])
def test_tails_equal_closed_forms(t):
    of_two = 2.0 / (math.sqrt(2.0 + t * t) * (math.sqrt(2.0 + t * t) + t))
    found = student_tails(f64(-t), f64([1.0, 2.0]))
    torch.testing.assert_close(found, f64([2.0 / math.pi * math.atan2(1.0, t), of_two]), rtol=1e-13, atol=0.0)


@settings(deadline=None)  # the first call of a process is slow
@given(st.floats(0.5, 1e9), st.floats(1e-9, 1.0, exclude_max=True))
@example(freedom=0.5, level=0.99609375)
def test_tails_invert_quantiles(freedom, level):
    inside = 1.0 - float(student_tails(student_quantile(level, f64(freedom)), f64(freedom)))
    assert inside == pytest.approx(level, rel=1e-11, abs=1e-14)


def test_limits():
    assert float(student_tails(f64(torch.inf), f64(5.0))) == 0.0
    assert float(student_tails(f64(0.0), f64(5.0))) == pytest.approx(1.0, rel=1e-14)
    assert math.isnan(float(student_tails(f64(math.nan), f64(5.0))))


def test_shapes_are_kept_and_broadcast():
    freedom = f64([[1.0, 7.0, 1.0]])
    found = student_quantile(0.9, freedom)
    assert found.shape == (1, 3)
    assert found[0, 0] == found[0, 2] != found[0, 1]
    t = torch.randn(20_000, 1, generator=torch.Generator().manual_seed(0))
    tails = student_tails(t, freedom)
    assert tails.shape == (20_000, 3)
    torch.testing.assert_close(tails[-1, 1], student_tails(t[-1, 0], f64(7.0)), rtol=1e-14, atol=0.0)
