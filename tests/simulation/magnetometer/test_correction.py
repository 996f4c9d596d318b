"""The correction of another recording by a fitted magnetometer."""

import json

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis.io.model import correction_of
from mkc_torch.recording.recording import MissingColumnError, RecordingError
from mkc_torch.simulation import Magnetometer
from mkc_torch.simulation.magnetometer import MagnetometerCorrection
from tests.simulation.tumbling import FIELD, OFFSET, changed, full_truth, symmetric_truth, true_matrix, tumbling, turns

STRENGTH = float(np.linalg.norm(FIELD))


def stacked(columns):
    return torch.stack([columns[f"field_{axis}"] for axis in "xyz"], -1)


@pytest.mark.parametrize("view", ["norm", "gyro", "attitude"])
def test_the_corrected_field_is_the_ambient_field(view):
    theta = full_truth(STRENGTH, 0.0, 0.0) if view == "attitude" else symmetric_truth(STRENGTH)
    if view == "gyro":
        theta = torch.cat([theta[:3], torch.from_numpy(true_matrix(STRENGTH)).flatten(), theta.new_zeros(3)])
    recording = tumbling(50)
    columns = MagnetometerCorrection({"view": view}, recording).corrected(theta, {})
    assert list(columns) == ["time", "field_x", "field_y", "field_z"]
    assert torch.equal(columns["time"], recording["time"])
    np.testing.assert_allclose(stacked(columns), turns(recording["time"].numpy()).inv().apply(FIELD), atol=1e-10)


def test_parameters_of_another_view_are_refused():
    with pytest.raises(ValueError, match="has 9 parameters of its sensor and not 15"):
        MagnetometerCorrection({"view": "gyro"}, tumbling(50)).corrected(symmetric_truth(STRENGTH), {})


def test_changes_are_removed_from_the_measurement():
    change = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    theta = symmetric_truth(STRENGTH)
    clean = MagnetometerCorrection({"view": "norm"}, tumbling(50)).corrected(theta, {})
    contaminated = MagnetometerCorrection({"view": "norm"}, tumbling(50, sensor=change))
    torch.testing.assert_close(stacked(contaminated.corrected(theta, {"sensor": lambda _: change})), stacked(clean))


def test_changes_depend_on_the_measurement_without_offset():
    theta, seen = symmetric_truth(STRENGTH), []
    correction = MagnetometerCorrection({"view": "norm"}, tumbling(50))
    correction.corrected(theta, {"sensor": lambda signal: seen.append(signal) or torch.zeros_like(signal)})
    torch.testing.assert_close(seen[0], correction.measured - torch.from_numpy(OFFSET))


def test_only_the_sensor_is_corrected():
    correction = MagnetometerCorrection({"view": "attitude"}, tumbling(50))
    assert list(correction.ports) == ["sensor"]
    assert correction.ports["sensor"].channels == ("x", "y", "z")
    assert correction.ports["sensor"].unit == "µT"


def test_missing_samples_stay_missing():
    recording = tumbling(50)
    mag_x = recording["mag_x"].clone()
    mag_x[3] = torch.nan
    columns = MagnetometerCorrection({"view": "norm"}, changed(recording, mag_x=mag_x)).corrected(
        symmetric_truth(STRENGTH), {}
    )
    assert bool(stacked(columns)[3].isnan().all())
    assert int(stacked(columns).isnan().any(-1).sum()) == 1


def test_without_times_the_correction_has_no_times():
    correction = MagnetometerCorrection({"view": "norm"}, changed(tumbling(50), time=None))
    assert list(correction.corrected(symmetric_truth(STRENGTH), {})) == ["field_x", "field_y", "field_z"]
    assert torch.equal(correction.time, torch.arange(50, dtype=torch.float64))


@pytest.mark.parametrize("state", [{}, {"view": "compass"}])
def test_unknown_views_are_refused(state):
    with pytest.raises(ValueError, match="not one of norm, gyro, attitude"):
        MagnetometerCorrection(state, tumbling(50))


def test_corrections_are_looked_up_by_name():
    with pytest.raises(ValueError, match='the model is of the simulation "pendulum"'):
        correction_of("pendulum", {}, tumbling(50))
    with pytest.raises(MissingColumnError, match="mag_z"):
        correction_of("magnetometer", {"view": "norm"}, changed(tumbling(50), mag_z=None))


@pytest.mark.parametrize("use", ["norm", "gyro", "attitude"])
def test_state_of_a_view_suffices_for_the_correction(use):
    recording = tumbling(600, gyro=True, attitude=True)
    view = Magnetometer(use=use).prepare(recording)
    state = json.loads(json.dumps(view.state))
    theta = view.start()
    columns = correction_of(view.name, state, recording).corrected(theta, {})
    torch.testing.assert_close(stacked(columns), view.corrected(theta, {}))


def test_an_empty_measurement_is_refused():
    nothing = torch.full((50,), torch.nan, dtype=torch.float64)
    with pytest.raises(RecordingError):
        Magnetometer().prepare(changed(tumbling(50), mag_x=nothing))
