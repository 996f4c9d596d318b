"""Which bandwidth residuals speak for: wide ones for Gaussian noise, none that shrinks for targets that are wrong."""

import pytest
import torch

from mkc_torch.losses._bandwidth import choice

N = 1000


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def fitted(share, shrunk, seed=0, noise=0.2):
    """Residuals over their scale, and predictions, of a fit that shrinks so far; a share of targets is permuted."""
    g = generator(seed)
    truth = torch.randn(N, generator=g)
    target = truth + noise * torch.randn(N, generator=g)
    rows = torch.randperm(N, generator=g)[: int(share * N)]
    target[rows] = target[rows[torch.randperm(len(rows), generator=g)]]
    prediction = shrunk * truth
    error = prediction - target
    z = error / (error.abs().quantile(0.4) / 0.5244)
    return z.unsqueeze(0), prediction.unsqueeze(0), torch.ones(1, N)


@pytest.mark.parametrize("seed", range(5))
def test_least_squares_on_permuted_targets_is_given_away_by_its_predictions(seed):
    z, prediction, counts = fitted(0.5, 0.5, seed)
    found = choice(z, prediction, counts)
    assert found.bandwidth <= 1.4 or not found.better
    blind = choice(z, torch.zeros_like(z), counts)
    assert blind.better
    assert blind.bandwidth > 2.0


@pytest.mark.parametrize("seed", range(5))
def test_at_the_truth_permuted_targets_speak_for_a_narrow_bandwidth(seed):
    found = choice(*fitted(0.5, 1.0, seed))
    assert 0.5 <= found.bandwidth <= 2.0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("shrunk", [1.0, 0.98])
def test_right_targets_speak_for_a_wide_one(seed, shrunk):
    found = choice(*fitted(0.0, shrunk, seed))
    assert found.better
    assert found.bandwidth >= 2.8


def test_predictions_in_another_unit_and_with_an_offset_change_nothing():
    z, prediction, counts = (values.double() for values in fitted(0.5, 0.5))
    found = [choice(z, unit * prediction + shift, counts) for unit, shift in ((1.0, 0.0), (1e-6, 1.0), (1e6, -3e6))]
    assert {(float(f.bandwidth), bool(f.better)) for f in found} == {(float(found[0].bandwidth), bool(found[0].better))}


def test_what_does_not_count_has_no_part():
    z, prediction, counts = fitted(0.5, 0.5)
    counts[:, ::2] = 0.0
    expected = choice(z[:, 1::2], prediction[:, 1::2], counts[:, 1::2])
    z[:, ::2], prediction[:, ::2] = 50.0, -3.0
    found = choice(z, prediction, counts)
    assert (found.bandwidth, found.better) == (expected.bandwidth, expected.better)


def test_channels_are_judged_apart():
    parts = [fitted(0.5, 0.5), fitted(0.0, 1.0)]
    both = choice(*(torch.cat(values) for values in zip(*parts, strict=True)))
    assert both.better.tolist() == [False, True]
    assert both.bandwidth.tolist() == [float(choice(*part).bandwidth) for part in parts]


def test_a_prediction_that_is_constant_is_finite():
    z, _, counts = fitted(0.0, 1.0)
    assert choice(z, torch.full_like(z, 7.0), counts).better
