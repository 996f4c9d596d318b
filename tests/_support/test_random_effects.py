"""Mean, spread, departures and trends of a quantity of several units, compared with statsmodels and by properties."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from statsmodels.stats.meta_analysis import combine_effects

from mkc_torch._support.random_effects import departures, random_effects, trend


def draws(units, spread, seed, slope=0.0):
    """Values of units of mean 2 with errors of different sizes, and a condition on which they may depend."""
    rng = np.random.default_rng(seed)
    errors = rng.uniform(0.1, 0.4, units)
    condition = rng.uniform(10.0, 40.0, units)
    values = 2.0 + slope * (condition - 25.0) + spread * rng.normal(size=units) + errors * rng.normal(size=units)
    return values, errors, condition


# the iteration of statsmodels ends at 0 in some other draws
@pytest.mark.parametrize("seed", [0, 2, 3, 4, 5, 6, 7, 9])
def test_mean_and_spread_are_those_of_statsmodels(seed):
    values, errors, _ = draws(8, 0.6, seed)
    found = random_effects(values, errors)
    expected = combine_effects(values, errors**2, method_re="iterated", use_t=True, atol=1e-13, maxiter=1000)
    assert found.spread**2 == pytest.approx(expected.tau2, rel=1e-5)
    assert found.mean == pytest.approx(expected.mean_effect_re, rel=1e-6)
    # statsmodels' factor of Hartung & Knapp may be below 1 by rounding
    assert found.error == pytest.approx(expected.sd_eff_w_re * math.sqrt(max(expected.scale_hksj_re, 1.0)), rel=1e-4)


@given(st.lists(st.tuples(st.floats(-5.0, 5.0), st.floats(0.05, 3.0)), min_size=2, max_size=9))
def test_the_spread_is_the_smallest_that_explains_the_differences(pairs):
    values, errors = (np.array(each) for each in zip(*pairs, strict=True))
    found = random_effects(values, errors)

    def dispersion(spread):
        weight = 1.0 / (errors**2 + spread**2)
        return (weight * (values - np.average(values, weights=weight)) ** 2).sum()

    assert dispersion(found.spread) <= (len(values) - 1) * (1.0 + 1e-9)
    assert found.spread == 0.0 or dispersion(found.spread) == pytest.approx(len(values) - 1)
    assert found.spread_low <= found.spread + 1e-12
    assert found.spread <= found.spread_high + 1e-12


@given(st.integers(0, 1000), st.floats(0.01, 100.0), st.floats(-50.0, 50.0))
def test_units_of_measurement_do_not_matter(seed, factor, shift):
    values, errors, _ = draws(6, 0.5, seed)
    found, moved = random_effects(values, errors), random_effects(factor * values + shift, factor * errors)
    assert moved.mean == pytest.approx(factor * found.mean + shift, rel=1e-6, abs=1e-6 * factor)
    for name in ("error", "spread", "spread_low", "spread_high"):
        assert getattr(moved, name) == pytest.approx(factor * getattr(found, name), rel=1e-5, abs=1e-7 * factor)
    for first, second in zip(departures(values, errors), departures(factor * values, factor * errors), strict=True):
        assert first.score == pytest.approx(second.score, rel=1e-5, abs=1e-7)


def test_intervals_contain_mean_and_spread_as_often_as_they_state():
    found = [random_effects(*draws(8, 0.5, seed)[:2]) for seed in range(200)]
    mean = np.mean([each.low <= 2.0 <= each.high for each in found])
    spread = np.mean([each.spread_low <= 0.5 <= each.spread_high for each in found])
    assert 0.92 <= mean <= 0.98
    assert 0.92 <= spread <= 0.98


def test_units_that_differ_by_their_errors_only_agree():
    found = [random_effects(*draws(10, 0.0, seed)[:2]) for seed in range(100)]
    assert 0.93 <= np.mean([each.agree for each in found]) <= 1.0
    assert not any(random_effects(*draws(10, 3.0, seed)[:2]).agree for seed in range(50))


def test_a_unit_that_departs_is_found_and_others_are_not():
    alarms = sum(min(e.p_value for e in departures(*draws(10, 0.5, seed)[:2])) < 0.05 for seed in range(150))
    assert alarms <= 0.08 * 150
    values, errors, _ = draws(10, 0.2, 1)
    values[7] += 4.0
    assert [each.unit for each in departures(values, errors) if each.p_value < 0.05] == [7]
    assert departures([1.0, 2.0, 9.0], [0.1, 0.1, 0.1]) == []


def test_a_trend_is_found_with_its_slope_and_its_rate_of_false_alarms():
    found = trend(*draws(20, 0.1, 3, slope=0.05))
    assert found is not None
    assert abs(found.slope - 0.05) < 3.0 * found.error < 0.03
    assert found.p_value < 1e-3
    alarms = sum(trend(*draws(12, 0.5, seed)).p_value < 0.05 for seed in range(200))
    assert 0.01 * 200 <= alarms <= 0.09 * 200
    values, errors, _ = draws(8, 0.1, 0)
    assert trend(values, errors, np.full(8, 20.0)) is None
    assert trend(values[:4], errors[:4], np.arange(4.0)) is None


@pytest.mark.parametrize(
    ("values", "errors", "match"),
    [
        ([1.0], [0.1], "at least 2 values"),
        ([1.0, 2.0], [0.1, 0.0], "positive errors"),
        ([1.0, math.nan], [1.0, 1.0], "finite values"),
    ],
)
def test_bad_values_are_refused(values, errors, match):
    with pytest.raises(ValueError, match=match):
        random_effects(values, errors)
