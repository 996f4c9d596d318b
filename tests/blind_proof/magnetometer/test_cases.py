import json
from collections import Counter

import pytest
import torch

from examples.blind_proof.key import canonical
from examples.blind_proof.magnetometer import motion
from examples.blind_proof.magnetometer.cases import KINDS, MOST_Z, draw
from examples.blind_proof.magnetometer.families import POSITION
from examples.blind_proof.magnetometer.hidden import CATALOGUE, OUTSIDE

DURATION = 12.0
COUNT = 40


@pytest.fixture(scope="module")
def cases():
    return [draw(DURATION, 5, k) for k in range(COUNT)]


def same_recording(first, second):
    return first.names == second.names and all(first[name].equal(second[name]) for name in first.names)


def test_the_same_address_gives_the_same_case(cases):
    again = draw(DURATION, 5, 3)
    assert same_recording(again.recording, cases[3].recording)
    assert same_recording(again.second, cases[3].second)
    assert again.key == cases[3].key


def test_other_addresses_give_other_cases(cases):
    assert not same_recording(draw(DURATION, 6, 3).recording, cases[3].recording)


def test_empty_cases_have_the_same_columns_and_no_effect(cases):
    for k in range(6):
        empty = draw(DURATION, 5, k, hidden=False)
        assert empty.recording.names == cases[k].recording.names
        assert empty.key.kind == "empty"
        assert empty.key.effects == ()
        assert empty.second is None


def test_hidden_and_empty_cases_differ_by_the_effect_only(cases):
    case = next(case for case in cases if case.key.effects[0].effect == "hard_iron_step" and case.key.kind == "single")
    empty = draw(DURATION, 5, int(case.key.name[-5:]), hidden=False)
    change = case.recording.magnetometer() - empty.recording.magnetometer()
    effect = case.key.effects[0]
    before = case.recording["time"] < effect.onset - 0.2
    assert float(change[before].abs().max()) < 1e-3
    assert float(change[-1].norm()) == pytest.approx(effect.size, rel=0.1)


def test_keys_are_consistent(cases):
    for case in cases:
        key = case.key
        assert key.kind in KINDS
        assert len(key.effects) == (2 if key.kind == "double" else 1)
        assert json.loads(canonical([key])) == [key.numbers()]
        assert len(key.outliers) == round(key.outlier_kind["share"] * len(case.recording))
        assert 0 < key.oracle_rms < 10
        for effect in key.effects:
            assert effect.effect in {**CATALOGUE, **OUTSIDE}
            assert effect.z_sep <= effect.z <= MOST_Z * (1 + 1e-9)
            assert all(driver in case.recording for driver in effect.drivers)
            assert not (effect.withheld and effect.withheld in case.recording)
            assert all(rival.z_sep < 6 for rival in effect.inseparable)


def test_names_of_columns_do_not_reveal_the_driver(cases):
    known = {"time", "temperature", "current", "voltage", *POSITION, "q_w", "q_x", "q_y", "q_z"}
    known |= {f"{name}_{axis}" for name in ("mag", "gyro", "accel") for axis in "xyz"}
    for case in cases:
        others = set(case.recording.names) - known
        assert others == {f"aux_{k}" for k in range(1, len(others) + 1)} == set(case.key.decoys)


def test_modes_have_their_declared_shares(cases):
    modes = Counter(case.key.mode for case in cases)
    assert modes["norm"] > modes["attitude"] > 0
    for case in cases:
        assert ("q_w" in case.recording) == (case.key.mode == "attitude")
        assert ("gyro_x" in case.recording) == (case.key.mode == "gyro")


def test_fields_and_offsets_are_in_range(cases):
    for case in cases:
        assert 25 <= case.key.field_strength <= 65
        assert torch.tensor(case.key.sensor["hard"]).norm() <= 40.0 + 1e-4
        assert (torch.tensor(case.key.sensor["soft"]) - torch.eye(3)).abs().max() <= 0.1 + 1e-6


def test_a_full_length_case_is_90_s_at_50_hz():
    case = draw(motion.DURATION, 5, 0)
    assert len(case.recording) == len(case.second) == 4500
    assert float(case.second["time"][0]) == pytest.approx(99.98)
