"""Evidence on held-out blocks."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from mkc_torch.diagnosis.evidence.held_out import blocks_of, gain_interval, held_out, scored
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.settings import ConfirmationSettings
from tests.diagnosis.line import Line


@pytest.mark.parametrize("N", [100, 777, 4500])
def test_every_sample_is_held_out_once(N):
    blocks = blocks_of(N, 3, ConfirmationSettings())
    assert blocks.block.tolist() == sorted(blocks.block.tolist())
    counts = torch.bincount(blocks.block)
    assert len(counts) == 25
    assert int(counts.max() - counts.min()) <= 1
    assert torch.equal(blocks.fold, blocks.block % 5)
    assert len(blocks.train) == 5
    for k in range(5):
        assert not bool((blocks.train[k] & (blocks.fold == k)).any())
        assert float(blocks.train[k].double().mean()) > 0.5


@pytest.mark.parametrize("N", [100, 777, 4500])
@pytest.mark.parametrize("correlation", [1, 5])
def test_a_gap_separates_held_out_from_training_samples(N, correlation):
    blocks = blocks_of(N, correlation, ConfirmationSettings())
    index = torch.arange(N)
    for k in range(5):
        held, train = index[blocks.fold == k], index[blocks.train[k]]
        distance = (held.unsqueeze(-1) - train).abs().amin(-1)
        assert int(distance.min()) > 1
        assert int(distance.min()) > N // 100


def test_the_gap_is_at_least_a_correlation_time():
    blocks = blocks_of(4500, 80, ConfirmationSettings())
    index = torch.arange(4500)
    for k in range(5):
        held, train = index[blocks.fold == k], index[blocks.train[k]]
        assert int((held.unsqueeze(-1) - train).abs().min()) >= 80


@pytest.fixture(scope="module")
def fit():
    line = Line(300)
    return fitted(JointModel(line), line.start())


def test_held_out_residuals_are_those_of_the_fit_to_the_rest(fit):
    blocks = blocks_of(300, 1, ConfirmationSettings())
    found = held_out(fit, blocks)
    line = fit.model.prepared
    assert found.residual.shape == (300, 2)
    for k in range(5):
        train, seen = blocks.train[k].numpy(), (blocks.fold == k).numpy()
        design = np.stack([np.ones(600), np.repeat(line.time.numpy(), 2)], -1)
        rows = np.repeat(train, 2)
        theta = np.linalg.lstsq(design[rows], line.measured.numpy().ravel()[rows], rcond=None)[0]
        expected = line.measured.numpy() - (theta[0] + theta[1] * line.time.numpy())[:, None]
        np.testing.assert_allclose(found.residual.numpy()[seen], expected[seen], atol=0.005)
    # Gaussian noise of 0.1, not the one of the fit to itself
    level = stats.norm(0.0, 0.1).logpdf(found.residual.numpy()).sum(-1).mean()
    assert float(found.log_likelihood.mean()) == pytest.approx(level, abs=0.05)
    np.testing.assert_allclose(found.d, 0.1, atol=0.015)


def test_held_out_samples_do_not_influence_their_prediction(fit):
    blocks = blocks_of(300, 1, ConfirmationSettings())
    corrupted = Line(300)
    hidden = ~blocks.train[2]
    corrupted.measured[hidden] += 0.7
    other = fitted(JointModel(corrupted), corrupted.start(), fit.bound)
    before, after = held_out(fit, blocks), held_out(other, blocks)
    seen = blocks.fold == 2
    torch.testing.assert_close(
        after.residual[seen] - before.residual[seen], torch.full_like(before.residual[seen], 0.7), rtol=0.0, atol=1e-3
    )


def test_scores_are_log_densities():
    residual = torch.linspace(-3.0, 3.0, 7, dtype=torch.float64).reshape(-1, 1).expand(7, 2)
    sigma, d, bound = (torch.tensor([v, v]).double() for v in (math.inf, 0.5, 1000.0))
    expected = 2.0 * stats.norm(0.0, 0.5).logpdf(residual[:, 0].numpy())
    np.testing.assert_allclose(scored(residual, sigma, d, bound), expected, rtol=1e-9)


def test_the_interval_is_that_of_block_means():
    """The differences are constant within a block: the bootstrap resamples blocks."""
    generator = torch.Generator().manual_seed(0)
    levels = torch.randn(25, generator=generator, dtype=torch.float64)
    block = torch.arange(2500) // 100
    mean, (low, high) = gain_interval(levels[block], block, generator)
    assert mean == pytest.approx(float(levels.mean()))
    drawn = np.random.default_rng(0).choice(levels.numpy(), (20_000, 25)).mean(-1)
    np.testing.assert_allclose((low, high), np.quantile(drawn, [0.025, 0.975]), atol=0.03)


def test_the_interval_is_far_narrower_for_independent_samples():
    difference = torch.randn(2500, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mean, (low, high) = gain_interval(difference, torch.arange(2500) // 100, torch.Generator().manual_seed(0))
    assert low < mean < high
    assert high - low == pytest.approx(2.0 * 1.96 / 50.0, rel=0.35)


def test_blocks_of_unequal_length_count_by_their_samples():
    difference = torch.tensor([1.0] * 90 + [2.0] * 10, dtype=torch.float64).repeat(50)
    block = torch.tensor([0] * 90 + [1] * 10).repeat(50) + 2 * torch.arange(50).repeat_interleave(100)
    mean, (low, high) = gain_interval(difference, block, torch.Generator().manual_seed(0))
    assert mean == pytest.approx(1.1)
    assert 1.05 < low < 1.1 < high < 1.15


def test_equal_models_have_a_gain_of_zero():
    assert gain_interval(torch.zeros(100), torch.arange(100) // 4, torch.Generator()) == (0.0, (0.0, 0.0))


def test_the_interval_depends_on_its_generator_only():
    difference = torch.randn(100, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    block = torch.arange(100) // 4
    first, second = (gain_interval(difference, block, torch.Generator().manual_seed(5)) for _ in range(2))
    assert first == second
