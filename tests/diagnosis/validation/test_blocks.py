"""Ratios of residuals over blocks, compared with SciPy."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from mkc_torch.diagnosis.io.training import BlockSquares
from mkc_torch.diagnosis.validation.blocks import block_numbers, block_squares, independent_ratio, paired_ratio


def squares(values, samples=20):
    return BlockSquares(tuple(map(float, values)), (samples,) * len(values))


def test_blocks_are_consecutive_samples_of_one_run_and_leave_out_the_first_part():
    run = torch.tensor([0] * 40 + [1] * 50)
    predicted = torch.cat([torch.arange(40) >= 4, torch.arange(50) >= 5])
    block = block_numbers(run, predicted)
    assert (block[~predicted] == -1).all()
    assert block.max() == 8
    assert (block[predicted].diff() >= 0).all()
    assert block[:40].max() < block[45:].min()
    assert torch.bincount(block[predicted]).min() >= 9


def test_each_of_many_runs_has_a_block():
    run = torch.arange(20).repeat_interleave(6)
    block = block_numbers(run, torch.ones(120, dtype=torch.bool))
    assert torch.equal(block, run)


def test_mean_squares_leave_out_missing_outputs():
    residual = torch.tensor([1.0, torch.nan, 3.0, torch.nan, torch.nan, 2.0])
    found = block_squares(residual, torch.tensor([0, 0, 0, 1, 1, 2]))
    assert (found.squares, found.samples) == ((5.0, 4.0), (2, 1))
    assert found.rmse == pytest.approx(math.sqrt(14.0 / 3.0))


def test_the_interval_of_equal_blocks_is_students_of_the_linearised_ratio():
    """The delta method for a ratio of means, by SciPy."""
    random = np.random.default_rng(0)
    under = random.chisquare(10, 9)
    over = 0.3 * under * random.uniform(0.9, 1.1, 9)
    found = paired_ratio(squares(over), squares(under))
    influence = over / over.mean() - under / under.mean()
    reach = stats.t.ppf(0.975, 8) * stats.sem(influence) / 2.0
    assert found.value == pytest.approx(math.sqrt(over.mean() / under.mean()))
    assert math.log(found.low / found.value) == pytest.approx(-reach)
    assert math.log(found.high / found.value) == pytest.approx(reach)


def test_the_interval_of_two_recordings_is_welchs():
    random = np.random.default_rng(1)
    over, under = random.chisquare(10, 9), random.chisquare(10, 6)
    found = independent_ratio(squares(over), squares(under))
    reference = stats.ttest_ind(over / over.mean(), under / under.mean(), equal_var=False).confidence_interval()
    assert 2.0 * math.log(found.high / found.value) == pytest.approx((reference.high - reference.low) / 2.0)


def test_the_interval_contains_the_ratio_at_its_rate():
    """Correlated residuals of two models, whose mean squares are the same: 95 % of the intervals contain 1."""
    random, inside = np.random.default_rng(2), 0
    run, predicted = torch.zeros(400, dtype=torch.long), torch.arange(400) >= 40
    block = block_numbers(run, predicted)
    for _ in range(400):
        white = random.standard_normal((2, 500))
        first, second = (np.convolve(row, 0.8 ** np.arange(30), "same")[:400] for row in white)
        found = paired_ratio(*(block_squares(torch.tensor(values), block) for values in (first, second)))
        inside += found.low <= 1.0 <= found.high
    assert stats.binomtest(inside, 400, 0.95).pvalue > 0.001


def test_few_blocks_and_perfect_fits_have_no_interval():
    assert math.isnan(paired_ratio(squares([1.0, 2.0]), squares([1.0, 2.0])).low)
    assert paired_ratio(squares([1.0] * 5), squares([0.0] * 5)).value == math.inf
    assert math.isnan(paired_ratio(squares([0.0] * 5), squares([0.0] * 5)).value)
    assert paired_ratio(squares([0.0] * 5), squares([1.0] * 5)).value == 0.0
