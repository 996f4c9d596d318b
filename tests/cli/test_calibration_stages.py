"""Stages that `mkc calibrate` reports for each sensor; a file is read once."""

import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("matplotlib")

from mkc_torch.cli import calibration_files
from mkc_torch.cli.calibration_files import CalibrationRequest, calibrations_of
from mkc_torch.recording.formats import read_topics
from mkc_torch.recording.recording import write_table
from tests.calibration.test_calibrate import noisy_ellipsoid


@pytest.fixture
def files_read(monkeypatch):
    """Return a list to which the name of each file is added when it is read."""
    found = []

    def counted(path):
        found.append(path.name)
        return read_topics(path)

    for module in ("cli.calibration_files", "cli.recorded", "recording.load"):
        monkeypatch.setattr(f"mkc_torch.{module}.read_topics", counted)
    return found


def request(**given):
    return CalibrationRequest(**({"columns": {}, "units": {}, "sensor": None, "field_strength": None} | given))


def test_stages_name_each_sensor_and_a_file_is_read_once(tmp_path, files_read):
    points, stages = noisy_ellipsoid(300), []
    columns = {f"mag{n}_{axis}": points[:, k] + n for n in range(2) for k, axis in enumerate("xyz")}
    write_table(tmp_path / "two.csv", {"time": torch.arange(300) / 50.0} | columns)
    outcomes = list(calibrations_of(tmp_path / "two.csv", tmp_path / "o", request(), force=False, step=stages.append))
    assert [isinstance(outcome, calibration_files.CalibrationOutcome) for _, outcome in outcomes] == [True, True]
    assert stages == [
        "reading two.csv",
        "calibrating two.csv, sensor mag0 (1 of 2)",
        "drawing the report on two.csv, sensor mag0 (1 of 2)",
        "calibrating two.csv, sensor mag1 (2 of 2)",
        "drawing the report on two.csv, sensor mag1 (2 of 2)",
    ]
    assert files_read == ["two.csv"]


def test_an_absent_file_is_a_single_failed_outcome(tmp_path):
    stages = []
    ((subject, error),) = calibrations_of(
        tmp_path / "a.csv", tmp_path / "o", request(), force=False, step=stages.append
    )
    assert (subject, type(error)) == (str(tmp_path / "a.csv"), FileNotFoundError)
    assert stages == ["reading a.csv"]
