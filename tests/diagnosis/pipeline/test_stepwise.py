"""When a candidate counts: surrogates test the first finding, held-out blocks have to confirm further findings."""

import importlib
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.evidence.held_out import blocks_of
from mkc_torch.diagnosis.noise.spectrum import innovation_gain
from mkc_torch.diagnosis.settings import ConfirmationSettings

holds = importlib.import_module("mkc_torch.diagnosis.pipeline.stepwise")._holds
N = 2000
BLOCKS = blocks_of(N, 1, ConfirmationSettings())


def evidence(mean, spread):
    noise = torch.randn(N, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return SimpleNamespace(log_likelihood=mean + spread * (noise - noise.mean()), residual=RESIDUAL)


RESIDUAL = torch.randn(N, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
NOTHING = SimpleNamespace(log_likelihood=torch.zeros(N, dtype=torch.float64), residual=RESIDUAL)


def located(beyond):
    return SimpleNamespace(beyond=beyond, fit=SimpleNamespace(model=SimpleNamespace(sizes=(3,)), recorded=None))


@pytest.mark.parametrize(
    ("first", "mean", "spread", "beyond", "counts"),
    [
        (True, 0.01, 1.0, 0.0, True),  # positive gain
        (True, -0.01, 1.0, 0.0, False),
        (True, -0.01, 1.0, 100.0, True),  # clearly beyond all surrogates
        (True, -0.5, 1.0, 100.0, False),  # clearly beyond, but clearly worse on held-out blocks
        (False, 0.01, 1.0, 10.0, False),  # positive gain, not confirmed
        (False, 0.01, 1.0, 100.0, True),  # positive gain, clearly beyond
        (False, 0.5, 1.0, 0.0, True),
        (False, -0.5, 1.0, 100.0, False),
    ],
)
def test_a_candidate_counts_by_its_held_out_gain_or_if_far_beyond_all_surrogates(first, mean, spread, beyond, counts):
    assert (
        holds(located(beyond), NOTHING, evidence(mean, spread), BLOCKS, 0, ConfirmationSettings(), first=first)
        is counts
    )


def drifting_evidence(step):
    """Evidence with a small loss, and residuals with a random walk, with and without a fast course."""
    draws = torch.randn(N, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    drift = draws[:, 0].cumsum(0) + 0.1 * draws[:, 1]
    course = step * torch.sin(torch.arange(N, dtype=torch.float64))
    below = torch.full((N,), -0.01, dtype=torch.float64)
    before = SimpleNamespace(log_likelihood=torch.zeros_like(below), residual=(drift + course).unsqueeze(-1))
    return before, SimpleNamespace(log_likelihood=below, residual=drift.unsqueeze(-1))


def test_a_clear_gain_of_innovations_counts_under_drift():
    before, after = drifting_evidence(0.5)
    assert innovation_gain(before.residual, after.residual) > 50.0
    assert holds(located(0.0), before, after, BLOCKS, 0, ConfirmationSettings(), first=True)
    assert not holds(located(0.0), before, after, BLOCKS, 0, ConfirmationSettings(), first=False)


def test_a_gain_below_the_penalty_does_not_count():
    before, after = drifting_evidence(0.05)
    assert innovation_gain(before.residual, after.residual) < 10.0
    assert not holds(located(0.0), before, after, BLOCKS, 0, ConfirmationSettings(), first=True)


def test_the_innovation_gain_in_white_noise_equals_least_squares():
    draws = torch.randn(N, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    course = 0.2 * torch.sin(torch.arange(N, dtype=torch.float64)).unsqueeze(-1)
    before, after = SimpleNamespace(residual=draws + course), SimpleNamespace(residual=draws)
    expected = 0.5 * float(((draws + course).square() - draws.square()).sum())
    assert innovation_gain(before.residual, after.residual) == pytest.approx(expected, rel=0.15)
