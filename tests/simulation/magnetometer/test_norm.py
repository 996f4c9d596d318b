"""The field strength."""

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from mkc_torch import EllipsoidFit, NotIdentifiableError
from mkc_torch.linear import LeastTrimmedSquares
from mkc_torch.recording.recording import MissingColumnError
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import FIELD, OFFSET, changed, symmetric_truth, true_matrix, tumbling


@pytest.fixture(scope="module")
def view():
    return Magnetometer().prepare(tumbling(600))


def orthogonal_distance(point, semi_axes):
    """Signed distance to an ellipsoid about the origin along the axes, by the root of its equation."""
    p, a = np.abs(point), np.asarray(semi_axes)

    def equation(t):
        return (a**2 * p**2 / (a**2 + t) ** 2).sum() - 1.0

    t = brentq(equation, -0.5 * a.min() ** 2, 20.0 * a.max() ** 2, xtol=1e-14, rtol=1e-14)
    nearest = a**2 * p / (a**2 + t)
    return np.sign(t) * np.linalg.norm(p - nearest)


def test_residual_is_zero_at_the_truth(view):
    theta = symmetric_truth(view.strength)
    assert view.channels == ("norm",)
    assert view.unit == "µT"
    residual = view.residual(theta, {})
    assert residual.shape == (600, 1)
    assert float(residual.abs().max()) < 1e-10


def test_the_start_is_the_truth_without_noise(view):
    torch.testing.assert_close(view.start(), symmetric_truth(view.strength), rtol=1e-8, atol=1e-8)
    rows = torch.arange(600) < 400
    torch.testing.assert_close(view.start(rows), symmetric_truth(view.strength), rtol=1e-8, atol=1e-8)
    assert len(view.parameter_names) == len(view.start())


def test_the_start_is_robust_to_outliers():
    sensor = np.zeros((600, 3))
    sensor[::4] += (30.0, -50.0, 20.0)
    view = Magnetometer().prepare(tumbling(600, noise=0.1, sensor=sensor))
    np.testing.assert_allclose(view.start()[:3], OFFSET, atol=0.2)


@pytest.mark.parametrize("size", [0.01, 0.1, 1.0])
def test_the_residual_is_the_orthogonal_distance_to_first_order(size):
    error = size * np.random.default_rng(0).standard_normal((600, 3))
    contaminated = Magnetometer().prepare(tumbling(600, sensor=error))
    theta = symmetric_truth(contaminated.strength)
    found = contaminated.residual(theta, {}).squeeze(-1).numpy()
    values, vectors = np.linalg.eigh(true_matrix(1.0) @ true_matrix(1.0))
    points = (contaminated.measured.numpy() - OFFSET) @ vectors
    expected = np.array([orthogonal_distance(p, values**-0.5) for p in points])
    assert np.abs(expected).max() > size
    # the remainder is of second order in the error over the radius
    assert np.abs(found - expected).max() < 3.0 * size**2 / np.linalg.norm(FIELD)


def test_a_change_at_the_sensor_changes_the_measurement():
    change = torch.randn(600, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    view = Magnetometer().prepare(tumbling(600, sensor=change))
    theta = symmetric_truth(view.strength)
    assert float(view.residual(theta, {}).abs().max()) > 1.0
    assert float(view.residual(theta, {"sensor": lambda _: change}).abs().max()) < 1e-10


def test_a_change_of_the_field_changes_its_strength():
    course = 1.0 + 0.005 * np.sin(np.arange(600) / 30.0)
    still = tumbling(600)
    measured = (still.magnetometer().numpy() - OFFSET) * course[:, None] + OFFSET
    view = Magnetometer().prepare(changed(still, **{f"mag_{a}": measured[:, k] for k, a in enumerate("xyz")}))
    theta = symmetric_truth(view.strength)
    stronger = torch.from_numpy(view.strength * (course - 1.0)).unsqueeze(-1)
    assert float(view.residual(theta, {}).abs().max()) > 0.2
    assert float(view.residual(theta, {"field": lambda _: stronger}).abs().max()) < 1e-10


def test_the_signal_is_the_simulated_measurement(view):
    noisy = Magnetometer().prepare(tumbling(600, noise=0.3))
    signal = noisy.signals(symmetric_truth(noisy.strength), {})["sensor"]
    true = view.measured - torch.from_numpy(OFFSET)
    normal = (true @ torch.from_numpy(true_matrix(1.0) @ true_matrix(1.0))).numpy()
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # noise along the surface stays, because the length does not contain it; noise across it is removed
    assert np.abs(((signal - true).numpy() * normal).sum(-1)).max() < 0.05
    across = ((noisy.measured - view.measured).numpy() * normal).sum(-1)
    assert np.abs(across).max() > 0.5


def test_ports_are_the_field_strength_and_the_sensor(view):
    assert {name: port.channels for name, port in view.ports.items()} == {
        "sensor": ("x", "y", "z"), "field": ("strength",),
    }  # fmt: skip
    assert all(port.unit == "µT" and port.pointwise for port in view.ports.values())
    assert view.ports["sensor"].allows_drift
    assert view.prior is None
    assert view.state == {"view": "norm", "unit": "µT", "strength": view.strength}


def test_the_time_of_a_recording_without_times_is_the_sample_number():
    view = Magnetometer().prepare(changed(tumbling(600), time=None))
    assert torch.equal(view.time, torch.arange(600, dtype=torch.float64))


def test_samples_are_sorted_and_finite():
    recording = tumbling(600)
    mag_x = recording["mag_x"].clone()
    mag_x[7] = torch.nan
    order = torch.randperm(600, generator=torch.Generator().manual_seed(0))
    shuffled = changed(
        recording, **{name: values[order] for name, values in changed(recording, mag_x=mag_x).columns.items()}
    )
    view = Magnetometer().prepare(shuffled)
    assert len(view.time) == 599
    assert bool((view.time.diff() > 0).all())
    assert "Dropped 1 of 600 samples" in " ".join(view.recording.notes)


def test_a_turn_about_a_single_axis_is_refused_with_the_missing_directions():
    with pytest.raises(NotIdentifiableError, match=r"Directions not covered: \+z .*; -z"):
        Magnetometer().prepare(tumbling(500, noise=0.3, size=(1.0, 0.0, 0.0)))


def test_too_few_rows_for_a_start_are_refused(view):
    with pytest.raises(ValueError, match="least 9 points"):
        view.start(torch.arange(600) < 5)


def test_missing_columns_are_named():
    with pytest.raises(MissingColumnError, match="mag_y"):
        Magnetometer().prepare(changed(tumbling(100), mag_y=None))
    with pytest.raises(MissingColumnError, match="gyro_x"):
        Magnetometer(use="gyro").prepare(tumbling(100))
    with pytest.raises(MissingColumnError, match="q_w"):
        Magnetometer(use="attitude").prepare(tumbling(100))
    with pytest.raises(MissingColumnError, match="time"):
        Magnetometer(use="gyro").prepare(changed(tumbling(100, gyro=True), time=None))


def test_the_view_can_be_requested():
    recording = tumbling(600, gyro=True, attitude=True)
    views = {use: Magnetometer(use=use).prepare(recording).view for use in (None, "norm", "gyro", "attitude")}
    assert views == {None: "attitude", "norm": "norm", "gyro": "gyro", "attitude": "attitude"}
    assert Magnetometer().prepare(tumbling(600, gyro=True)).view == "norm"
    with pytest.raises(ValueError, match=r"'attitude', 'gyro', 'norm' or None.*got 'compass'"):
        Magnetometer(use="compass").prepare(recording)


def test_own_columns_do_not_drive_effects():
    assert Magnetometer().columns == {
        "time", "mag_x", "mag_y", "mag_z", "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z",
        "q_w", "q_x", "q_y", "q_z",
    }  # fmt: skip


def test_samples_without_a_surface_give_a_start():
    """An effect may scatter the samples as widely as the noise here."""
    recording = tumbling(3000, noise=14.0)
    with pytest.raises(NotIdentifiableError, match="Not identifiable"):
        EllipsoidFit(LeastTrimmedSquares()).fit(recording.magnetometer())
    start = Magnetometer("norm").prepare(recording).start()
    assert np.abs(start[:3].numpy() - OFFSET).max() < 5.0
