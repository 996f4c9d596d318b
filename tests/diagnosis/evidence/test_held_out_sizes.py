"""Residuals of each output on held-out blocks, without the blocks in which a simulation diverges."""

from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.evidence.held_out import Evidence, blocks_of
from mkc_torch.diagnosis.evidence.prediction import kept_blocks, sizes_of
from mkc_torch.diagnosis.result import DivergedBlock
from mkc_torch.diagnosis.settings import ConfirmationSettings

N = 1000
BLOCKS = blocks_of(N, 1, ConfirmationSettings())
COUNT = 25
MEASURED = torch.stack([torch.linspace(-1.0, 1.0, N), 100.0 * torch.linspace(0.0, 1.0, N)], -1).double()
PREPARED = SimpleNamespace(measured=MEASURED, channels=("angle", "speed"))
UNITS = ("rad", "rad/s")


def noise(angle, speed, seed=0):
    drawn = torch.randn(N, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return drawn * torch.tensor([angle, speed], dtype=torch.float64)


def evidence(residual):
    one = residual.new_ones(2)
    return Evidence(residual[:, 0], residual, one, one, residual.new_zeros(5, 1), 0.2)


def with_diverged(residual, block, value, share=1.0):
    """Set the angle's residual to ``value`` in a share of a block."""
    rows = (BLOCKS.block == block).nonzero().squeeze(-1)
    changed = residual.clone()
    changed[rows[: round(share * len(rows))], 0] = value
    return changed


def test_each_output_has_its_sizes_in_its_unit():
    before, after = evidence(noise(0.2, 6.0)), evidence(noise(0.1, 3.0, 1))
    found, diverged = sizes_of(PREPARED, UNITS, before, after, BLOCKS)
    assert diverged == ()
    assert list(found) == ["angle", "speed"]
    assert (found["angle"].before, found["angle"].after, found["angle"].unit) == (
        pytest.approx(0.2, rel=0.1),
        pytest.approx(0.1, rel=0.1),
        "rad",
    )
    assert (found["speed"].before, found["speed"].after, found["speed"].unit) == (
        pytest.approx(6.0, rel=0.1),
        pytest.approx(3.0, rel=0.1),
        "rad/s",
    )


@pytest.mark.parametrize("value", [15671.0, -15671.0, torch.inf, torch.nan])
def test_a_diverged_block_enters_no_mean_and_is_returned(value):
    quiet = noise(0.1, 3.0)
    before, after = evidence(with_diverged(quiet, 7, value)), evidence(quiet)
    found, diverged = sizes_of(PREPARED, UNITS, before, after, BLOCKS)
    assert found["angle"].before == pytest.approx(0.1, rel=0.1)
    # the samples of both are the same
    assert found["angle"].before == found["angle"].after
    assert diverged == (DivergedBlock(8, before=True, after=False),)


def test_a_block_in_which_one_model_diverges_is_excluded_for_all():
    quiet = noise(0.1, 3.0)
    kept, diverged = kept_blocks(
        PREPARED, (evidence(with_diverged(quiet, 3, 9.0)), evidence(with_diverged(quiet, 20, 9.0))), BLOCKS
    )
    assert diverged == [[3], [20]]
    assert torch.equal(kept, (BLOCKS.block != 3) & (BLOCKS.block != 20))


def test_a_block_with_a_fifth_of_outliers_is_not_diverged():
    """The recorded range is 2 rad."""
    quiet = noise(0.1, 3.0)
    assert kept_blocks(PREPARED, (evidence(with_diverged(quiet, 3, 9.0, 0.15)),), BLOCKS)[1] == [[]]
    assert kept_blocks(PREPARED, (evidence(with_diverged(quiet, 3, 9.0, 0.25)),), BLOCKS)[1] == [[3]]


def test_a_block_with_residuals_within_the_recorded_range_is_not_diverged():
    quiet = noise(0.1, 3.0)
    assert kept_blocks(PREPARED, (evidence(with_diverged(quiet, 3, 1.9)),), BLOCKS)[1] == [[]]
    assert kept_blocks(PREPARED, (evidence(with_diverged(quiet, 3, 2.1)),), BLOCKS)[1] == [[3]]


def test_a_constant_output_cannot_diverge():
    still = SimpleNamespace(measured=torch.zeros(N, 2).double(), channels=("angle", "speed"))
    assert kept_blocks(still, (evidence(noise(0.1, 3.0)),), BLOCKS)[1] == [[]]


def test_sizes_are_absent_if_all_blocks_diverge():
    gone = torch.full((N, 2), 1e9).double()
    found, diverged = sizes_of(PREPARED, UNITS, evidence(gone), evidence(noise(0.1, 3.0)), BLOCKS)
    assert found == {}
    assert [block.number for block in diverged] == list(range(1, COUNT + 1))


def test_without_a_measured_column_for_each_output_only_nonfinite_residuals_diverge():
    quiet = noise(0.1, 3.0)
    apart = SimpleNamespace(channels=("angle", "speed"), measured=quiet[:, :1])
    assert kept_blocks(apart, (evidence(with_diverged(quiet, 3, 1e9)),), BLOCKS)[1] == [[]]
    assert kept_blocks(apart, (evidence(with_diverged(quiet, 3, torch.nan)),), BLOCKS)[1] == [[3]]
