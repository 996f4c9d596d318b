"""Recordings of MuJoCo's own elements, and how the findings of their diagnoses are judged."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from tests.gate.each_joint_effect import HIDDEN, NOISE_RAD, SAMPLES, judged, recorded


@pytest.mark.parametrize("kind", HIDDEN)
def test_each_element_moves_the_arm_by_more_than_the_noise(kind, monkeypatch):
    size, columns = recorded(kind, 0, 3)
    smallest, largest = HIDDEN[kind].sizes
    assert smallest <= size <= largest
    monkeypatch.setitem(
        HIDDEN, kind, HIDDEN[kind].__class__(**{**vars(HIDDEN[kind]), "write": lambda spec, size: None})
    )
    again, plain = recorded(kind, 0, 3)
    assert again == size
    away = (columns["elbow"] - plain["elbow"]).abs().median() + (columns["shoulder"] - plain["shoulder"]).abs().median()
    assert float(away) > 5.0 * NOISE_RAD
    assert len(columns["time"]) == SAMPLES


def test_the_same_seed_gives_the_same_recording():
    first, other, third = (recorded("load", index, seed)[1] for index, seed in ((1, 3), (1, 3), (2, 3)))
    assert all(np.array_equal(first[name], other[name]) for name in first)
    assert not np.array_equal(first["elbow"], third["elbow"])


def finding(effect, channel, name, value):
    parameter = {"name": name, "value": value, "standard_error": 0.01}
    return {"findings": [{"effect": effect, "channels": [channel], "parameters": [parameter]}], "verdict": "explained"}


def test_a_finding_is_right_with_its_effect_at_its_place():
    load = HIDDEN["load"]
    right, text = judged(finding("constant_change", "constant fore_mass", "change", 0.12), load, 0.1)
    assert right
    assert "off by 2.0 errors" in text
    assert not judged(finding("constant_change", "constant elbow_ref", "change", 0.1), load, 0.1)[0]
    assert not judged(finding("coulomb_friction", "input elbow_force", "friction", 0.1), load, 0.1)[0]
    assert judged({"findings": [], "verdict": "adequate"}, load, 0.1) == (False, "adequate: no name")
