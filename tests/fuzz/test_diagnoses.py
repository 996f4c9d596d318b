"""The recordings of the fuzzer of diagnoses, and one of its diagnoses."""

import pytest
import torch

from tests.fuzz.diagnoses import HIDDEN, HeatExchanger, crash_of, recording_of


@pytest.mark.parametrize("seed", range(len(HIDDEN)))
def test_recordings_have_missing_values_and_the_simulation_accepts_them(seed):
    hidden, recording = recording_of(seed, 400)
    assert hidden == list(HIDDEN)[seed]
    missing = recording["temperature"].isnan()
    assert 0 < int(missing.sum()) < 100
    prepared = HeatExchanger().prepare(recording)
    assert len(prepared.time) == 400 - int(missing.sum())


def test_a_seed_draws_the_same_recording_again():
    first, again = (recording_of(3, 200)[1]["temperature"] for _ in range(2))
    torch.testing.assert_close(first, again, rtol=0.0, atol=0.0, equal_nan=True)


@pytest.mark.slow
def test_a_long_recording_with_a_hidden_store_is_diagnosed_without_an_internal_error():
    # the shape of the finding has faster tangents than the simulation's parameters
    assert crash_of(4, limit=180.0) == ("second store", "")
