"""Residuals on unseen blocks, each output by itself, without blocks in which a run is lost."""

from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.evidence.held_out import Evidence, blocks_of
from mkc_torch.diagnosis.evidence.held_out_sizes import kept_blocks, left_in_words, sizes_of
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


def with_lost(residual, block, value, share=1.0):
    """The residual of a run that is so far off in a share of a block."""
    rows = (BLOCKS.block == block).nonzero().squeeze(-1)
    changed = residual.clone()
    changed[rows[: round(share * len(rows))], 0] = value
    return changed


def test_each_output_has_its_sizes_in_its_unit():
    before, after = evidence(noise(0.2, 6.0)), evidence(noise(0.1, 3.0, 1))
    found, told = sizes_of(PREPARED, UNITS, before, after, BLOCKS)
    assert told == ""
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
def test_a_block_in_which_the_run_is_lost_enters_no_mean_and_is_told(value):
    quiet = noise(0.1, 3.0)
    before, after = evidence(with_lost(quiet, 7, value)), evidence(quiet)
    found, told = sizes_of(PREPARED, UNITS, before, after, BLOCKS)
    assert found["angle"].before == pytest.approx(0.1, rel=0.1)
    # the samples of both are the same
    assert found["angle"].before == found["angle"].after
    assert told == left_in_words([1, 0], COUNT)
    assert "1 of 25 blocks the simulation alone" in told


def test_blocks_that_any_of_the_models_loses_are_left_out_of_all():
    quiet = noise(0.1, 3.0)
    kept, lost = kept_blocks(
        PREPARED, (evidence(with_lost(quiet, 3, 9.0)), evidence(with_lost(quiet, 20, 9.0))), BLOCKS
    )
    assert lost == [1, 1]
    assert torch.equal(kept, (BLOCKS.block != 3) & (BLOCKS.block != 20))


def test_some_outliers_do_not_make_a_block_a_lost_one():
    """Up to a fifth of its samples, beyond the range of the recording, 2 rad."""
    quiet = noise(0.1, 3.0)
    assert kept_blocks(PREPARED, (evidence(with_lost(quiet, 3, 9.0, 0.15)),), BLOCKS)[1] == [0]
    assert kept_blocks(PREPARED, (evidence(with_lost(quiet, 3, 9.0, 0.25)),), BLOCKS)[1] == [1]


def test_a_residual_within_the_range_of_the_recording_is_not_lost():
    quiet = noise(0.1, 3.0)
    assert kept_blocks(PREPARED, (evidence(with_lost(quiet, 3, 1.9)),), BLOCKS)[1] == [0]
    assert kept_blocks(PREPARED, (evidence(with_lost(quiet, 3, 2.1)),), BLOCKS)[1] == [1]


def test_an_output_that_never_moves_has_no_range_to_leave():
    still = SimpleNamespace(measured=torch.zeros(N, 2).double(), channels=("angle", "speed"))
    assert kept_blocks(still, (evidence(noise(0.1, 3.0)),), BLOCKS)[1] == [0]


def test_where_all_blocks_are_lost_there_are_no_sizes_and_it_is_told():
    gone = torch.full((N, 2), 1e9).double()
    found, told = sizes_of(PREPARED, UNITS, evidence(gone), evidence(noise(0.1, 3.0)), BLOCKS)
    assert found == {}
    assert "25 of 25" in told


def test_without_a_recording_to_leave_only_what_is_not_finite_is_lost():
    apart = SimpleNamespace(channels=("angle", "speed"))
    quiet = noise(0.1, 3.0)
    assert kept_blocks(apart, (evidence(with_lost(quiet, 3, 1e9)),), BLOCKS)[1] == [0]
    assert kept_blocks(apart, (evidence(with_lost(quiet, 3, torch.nan)),), BLOCKS)[1] == [1]


@pytest.mark.parametrize(
    ("lost", "words"),
    [
        ([0, 0], ""),
        ([3, 0], "In 3 of 25 blocks the simulation alone leaves the range of the recording; they enter no mean."),
        ([0, 2], "In 2 of 25 blocks the corrected simulation leaves the range of the recording; they enter no mean."),
        (
            [3, 2],
            "In 3 of 25 blocks the simulation alone leaves the range of the recording, in 2 the corrected one; they "
            "enter no mean.",
        ),
    ],
)
def test_which_simulation_leaves_the_recording_is_said(lost, words):
    assert left_in_words(lost, COUNT) == words
