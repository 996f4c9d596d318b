import math

import pytest
from scipy import stats

from examples.blind_proof.binomial import share, uniformity
from examples.blind_proof.draws import generator


@pytest.mark.parametrize(("count", "total"), [(0, 10), (10, 10), (3, 10), (20, 400), (28, 400), (400, 400), (1, 5000)])
def test_the_binomial_interval_agrees_with_scipy(count, total):
    expected = stats.binomtest(count, total).proportion_ci(0.95, "exact")
    found = share(count, total)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_a_share_of_zero_trials_is_nan():
    found = share(0, 0)
    assert math.isnan(found.value)
    assert (found.low, found.high) == (0.0, 1.0)


def test_a_count_above_the_total_is_refused():
    with pytest.raises(ValueError, match=r"0 <= count <= total.*got 3 of 2"):
        share(3, 2)


@pytest.mark.parametrize("power", [1.0, 1.15, 1.4])
def test_the_uniformity_test_agrees_with_scipy(power):
    import torch

    values = torch.rand(400, generator=generator(0)).double().pow(power).tolist()
    expected = stats.kstest(values, "uniform")
    distance, p = uniformity(values)
    assert distance == pytest.approx(expected.statistic)
    assert p == pytest.approx(expected.pvalue, abs=0.01)
