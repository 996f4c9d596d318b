"""A calibration finds a step, a drift and a rotation of the sensor's offset, and seldom where there is none."""

import json

import pytest
import torch

from mkc_torch.calibration import Calibration, calibrate
from mkc_torch.calibration.offset_change import offset_change
from mkc_torch.calibration.quality import doubts
from mkc_torch.recording.recording import Recording, write_table
from mkc_torch.report.words.verdict import calibration_verdict
from tests.calibration.changing_offset import NOISES, changing
from tests.shared_data import shared_data


@pytest.mark.parametrize(
    ("change", "kind", "size"),
    [
        ((3.0, "step", 0.5), "step", (2.7, 3.3)),
        ((1.5, "step", 1 / 3), "step", (1.3, 1.7)),  # a magnet taken off after half a minute
        ((2.0, "drift", 0.0), "drift", (1.8, 2.2)),
        ((1.0, "rotation", 0.0), "rotation", (1.5, 3.0)),
    ],
)
def test_a_change_of_the_offset_makes_the_calibration_doubtful(change, kind, size):
    result = calibrate(changing(3, change=change))
    found = result.offset_change
    assert found is not None
    assert found.kind == kind
    assert size[0] < found.size < size[1]
    assert found.p_value <= 0.01
    if kind == "step":
        assert found.at == pytest.approx(90.0 * change[2], abs=2.5)
    assert "offset_changed" in doubts(result)
    assert "the offset" in calibration_verdict(result)
    assert calibration_verdict(result).startswith("Doubtful: ")
    assert Calibration.from_json(result.to_json()).offset_change == found
    assert json.loads(result.to_json())["offset_change"]["kind"] == kind


@pytest.mark.parametrize("noise", [noise for noise in NOISES if noise != "uneven field"])
def test_an_unchanged_offset_is_not_doubted(noise):
    assert [calibrate(changing(seed, 1500, noise)).offset_change for seed in (1, 2)] == [None, None]


def test_sign_flips_keep_their_level():
    """Without the condition on the size, at most three times the level of noise alone is significant."""
    draw = torch.Generator().manual_seed(0)
    eye, centre = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    found = 0
    for _ in range(100):
        points = torch.nn.functional.normalize(torch.randn(600, 3, generator=draw, dtype=torch.float64), dim=-1)
        points = 48.0 * points + 0.3 * torch.randn(600, 3, generator=draw, dtype=torch.float64)
        found += offset_change(points, torch.arange(600.0), centre, eye, 48.0) is not None
    assert found <= 3


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("broad_02_undisturbed", False),
        ("broad_21_undisturbed_fast", False),
        ("broad_28_stationary_magnet", False),
        ("full_sphere", False),
        ("raw_counts", False),
        ("broad_36_attached_magnet_5cm", True),
    ],
)
def test_real_recordings_are_doubted_where_a_magnet_was_attached(name, changed):
    result = calibrate(Recording.read(shared_data(f"magnetometer/{name}.csv")))
    assert (result.offset_change is not None) == changed


def test_a_short_or_exact_recording_is_not_tested():
    eye, centre = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    points = 48.0 * torch.nn.functional.normalize(torch.randn(1000, 3, dtype=torch.float64), dim=-1)
    assert offset_change(points, torch.arange(1000.0), centre, eye, 48.0) is None
    assert offset_change(points[:100] + 1.0, torch.arange(100.0), centre, eye, 48.0) is None


def test_the_command_exits_with_three_and_proposes_a_diagnosis(tmp_path):
    pytest.importorskip("typer")
    from tests.cli.commands import flat, mkc

    path = tmp_path / "step.csv"
    write_table(path, dict(changing(3, change=(3.0, "step", 0.5)).columns))
    result = mkc("calibrate", path, "--output", tmp_path / "out")
    assert result.exit_code == 3
    assert "the offset changed by about" in flat(result.stdout)
    assert f"mkc diagnose {path} --simulation magnetometer" in flat(result.stdout)
