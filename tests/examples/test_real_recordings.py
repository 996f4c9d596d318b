"""The example of real magnetometers, on one of its recordings."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.shared_data import shared_data

FILE = Path(__file__).resolve().parents[2] / "examples" / "concealed_physics" / "magnetometer" / "real_recordings.py"


@pytest.fixture
def example(monkeypatch):
    spec = importlib.util.spec_from_file_location("real_recordings", FILE)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "real_recordings", module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("number", "step"), [(0, (1.3, -0.5, -13.4)), (1, (-0.7, -0.1, 5.7))])
def test_the_true_attitude_shows_the_published_step(example, number, step):
    case = example.CASES[number]
    folder = shared_data(f"magnetometer/{case.name}.csv").parent
    assert np.abs(example.step_by_attitude(folder, case) - step).max() < 0.6


@pytest.mark.manual
def test_findings_are_printed_and_drawn(example, monkeypatch, tmp_path, capsys):
    case = example.CASES[0]
    folder = shared_data(f"magnetometer/{case.name}.csv").parent
    monkeypatch.setattr(example, "CASES", (case,))
    monkeypatch.setattr(sys, "argv", ["real_recordings.py", "--data", str(folder), "--output", str(tmp_path / "a.png")])
    example.main()
    printed = capsys.readouterr().out
    assert "broad_34_attached_magnet_3cm, norm: " in printed
    assert "  hard_iron_step at 51." in printed
    assert "  by the true attitude: [1.64, -0.4, -13.86] µT" in printed
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_the_recording_of_a_case_has_the_magnetometer_only(example):
    case = example.CASES[0]
    folder = shared_data(f"magnetometer/{case.name}.csv").parent
    assert set(case.recording(folder).columns) == {"time", "mag_x", "mag_y", "mag_z"}
