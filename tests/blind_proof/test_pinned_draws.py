"""Draws of a seed do not change: stored figures are compared across versions."""

import pytest

from examples.blind_proof.equations.cases import equations
from examples.blind_proof.equations.scenarios import equations_scenarios
from examples.blind_proof.magnetometer.cases import magnetometer
from examples.blind_proof.magnetometer.scenarios import magnetometer_scenarios
from examples.blind_proof.mujoco.cases import mujoco_steps

PROOFS = {
    proof.name: proof
    for proof in (magnetometer(), equations(), mujoco_steps(), magnetometer_scenarios(30.0), equations_scenarios())
}

PINNED = (
    ("magnetometer", "magnetometer", 1, 0, False, 0, {"mag_x": 18405.7247, "mag_y": 20188.3593},
     "", 0.0),
    ("magnetometer", "magnetometer", 1, 1, True, 1, {"mag_x": -15038.7332, "mag_y": -18120.964},
     "cubic_nonlinearity", 76.298681),
    ("magnetometer", "magnetometer", 7, 2, True, 2, {"mag_x": -6544.0288, "mag_y": -85370.6364},
     "hysteresis", 10.037318),
    ("equations", "equations", 1, 0, False, 0, {"torque": -129.575878, "angle": -7.906998},
     "", 0.0),
    ("equations", "equations", 1, 2, True, 2, {"pump_1": 1419.140762, "pump_2": 1729.749744},
     "input_lag", 117.630297),
    ("equations", "equations", 7, 1, True, 1, {"command": 66.8283, "angle": 88.472789},
     "gravity_sag", 65.986509),
    ("mujoco", "mujoco", 7, 0, False, 0, {"first": 74.08063, "elbow": -97.862972},
     "", 0.0),
    ("mujoco", "mujoco", 7, 1, True, 1, {"motor": -14.98779, "hinge": 0.839453},
     "input_lag", 525.443859),
    ("magnetometer_scenarios", "white", 7, 0, False, 10, {"mag_x": 11441.0341, "mag_y": 44393.4303},
     "", 0.0),
    ("magnetometer_scenarios", "bursts", 7, 1, True, 11, {"mag_x": -6184.0041, "mag_y": 23632.564},
     "cubic_nonlinearity", 60.803622),
    ("magnetometer_scenarios", "useless", 7, 1, False, 11, {"mag_x": -7301.9571, "mag_y": 7682.4712},
     "", 0.0),
    ("equations_scenarios", "coloured", 7, 0, False, 10, {"voltage": -15.087633, "angle": 2215.26741},
     "", 0.0),
    ("equations_scenarios", "gusts", 7, 0, True, 10, {"distance": 2459.89199, "height": 739.867137},
     "linear_drag", 113.930591),
    ("equations_scenarios", "far_starts", 7, 1, False, 11, {"pump_1": 1536.046269, "pump_2": 1562.465245},
     "", 0.0),
    ("equations_scenarios", "slow_sensor", 7, 0, False, 10, {"voltage": 1094.29322, "angle": 13439.1603},
     "", 0.0),
    ("equations_scenarios", "lasting_push_runs", 7, 0, False, 10, {"heater_1": 16131.87162, "heater_2": 14660.13419},
     "", 0.0),
    ("equations_scenarios", "useless", 7, 0, False, 10, {"heater_1": 17388.46577, "heater_2": 16317.0295},
     "", 0.0),
)  # fmt: skip
"""Proof, scenario, seed, index, hidden, number; sums of two columns, and the hidden effect with its z."""


@pytest.mark.parametrize("pinned", PINNED, ids=lambda pinned: " ".join(map(str, pinned[1:5])))
def test_pinned_seeds_draw_the_stored_recording_and_hidden_effect(pinned):
    proof, scenario, seed, index, hidden, number, sums, effect, z = pinned
    (drawn,) = PROOFS[proof].only([scenario]).scenarios
    case = drawn.draw(seed, index, hidden, number)
    found = {name: float(case.recording[name].sum()) for name in sums}
    assert found == pytest.approx(sums, rel=1e-6, abs=1e-3)
    assert [e.effect for e in case.key.effects[:1]] == ([effect] if effect else [])
    if effect:
        assert case.key.effects[0].z == pytest.approx(z, rel=1e-4)
