"""The recordings and the table of the comparison with a fit of numbers alone."""

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")

from matplotlib import pyplot as plt
from matplotlib.colors import to_rgb

from examples.numbers_alone.compare import as_recording, draw, table, without_findings
from examples.numbers_alone.recordings import ARM, HIDDEN, NOISE, NUMBERS, recorded
from mkc_torch.diagnosis.validation.predict import predict
from mkc_torch.simulation import load_mjcf


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    return load_mjcf(tmp_path / "arm.xml")


def errors(arm, hidden, numbers=NUMBERS):
    """Error of each joint of the model without findings."""
    return (
        predict(without_findings(arm, numbers), as_recording(recorded(hidden, 150, 3))).residual.square().mean(0).sqrt()
    )


def test_without_missing_physics_the_model_predicts_the_recording(arm):
    assert float(errors(arm, HIDDEN[0]).max()) < 6 * NOISE  # its step is five times that of the recording


@pytest.mark.parametrize("hidden", HIDDEN[1:], ids=lambda hidden: hidden.name)
def test_missing_physics_is_far_above_the_noise(arm, hidden):
    assert float(errors(arm, hidden).max()) > 15 * NOISE


def test_a_fit_of_numbers_alone_finds_them_where_nothing_is_missing_and_bends_them_elsewhere():
    pytest.importorskip("absl")
    from examples.numbers_alone.least_squares import fitted_numbers

    right, bent = (fitted_numbers(recorded(hidden, 100, 1)) for hidden in HIDDEN[:2])
    assert right == pytest.approx(NUMBERS, rel=0.05)
    assert bent["elbow_damping"] > 1.2 * NUMBERS["elbow_damping"]


def test_the_picture_has_a_line_for_each_model(arm, tmp_path):
    second = as_recording(recorded(HIDDEN[1], 60, 2))
    right = predict(without_findings(arm, NUMBERS), second).residual.detach()
    draw(tmp_path / "picture.png", HIDDEN[1], second, {"file": right, "sysid": 0.5 * right, "mkc": 0.1 * right})
    height, width, _ = plt.imread(tmp_path / "picture.png").shape
    assert (width, height) == (880, 495)
    shown = plt.imread(tmp_path / "picture.png")[height // 2 :, :, :3]
    for color in ("tab:gray", "tab:orange", "tab:blue"):
        assert (np.abs(shown - to_rgb(color)).max(-1) < 0.02).sum() > 100, color


def test_the_table_has_a_row_for_each_recording():
    row = {
        "hidden": "nothing",
        "numbers": {"sysid": {"a": 0.3, "b": 0.21}, "mkc": {"a": 0.302, "b": 0.2}},
        "findings": ["coulomb_friction at elbow_force: friction 0.12 N m"],
        "error": {"file": np.float64(0.05), "sysid": 0.04, "mkc": 0.001},
    }
    lines = table([row, row]).splitlines()
    assert len(lines) == 4
    assert lines[2].count("|") == lines[0].count("|")
    assert "0.300, 0.210" in lines[2]
    assert "friction 0.12 N m | 0.0500 | 0.0400 | 0.0010" in lines[2]
