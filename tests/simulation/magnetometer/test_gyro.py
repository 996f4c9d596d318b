"""The field vector, rotated by the gyroscope."""

import numpy as np
import pytest
import torch

from mkc_torch import NotIdentifiableError, diagnose
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import (
    FIELD,
    OFFSET,
    body_rate,
    changed,
    true_matrix,
    tumbling,
    turns,
)


def prepared(N=500, **further):
    return Magnetometer(use="gyro").prepare(tumbling(N, gyro=True, **further))


@pytest.fixture(scope="module")
def view():
    return prepared()


def truth(view):
    matrix = torch.from_numpy(true_matrix(view.strength)).flatten()
    return torch.cat([torch.from_numpy(OFFSET), matrix, matrix.new_zeros(3)])


def test_residual_is_small_at_the_truth(view):
    residual = view.residual(truth(view), {})
    assert view.channels == ("along", "across_1", "across_2")
    assert residual.shape == (500, 3)
    # along the field there is no error; across it that of the trapezoidal rule at 50 Hz
    assert float(residual[:, 0].abs().max()) < 1e-4
    assert 1e-4 < float(residual[:, 1:].abs().max()) < 0.03


def test_the_error_of_the_turns_falls_with_the_square_of_the_rate():
    sizes = []
    for rate in (50.0, 200.0):
        view = prepared(round(20 * rate), rate=rate)
        sizes.append(float(view.residual(truth(view), {}).square().mean().sqrt()))
    assert sizes[1] < sizes[0] / 12.0


def test_the_start_is_the_truth_without_noise(view):
    torch.testing.assert_close(view.start(), truth(view), rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(view.start(torch.arange(500) > 20), truth(view), rtol=1e-8, atol=1e-8)
    assert len(view.parameter_names) == len(view.start())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_channels_are_orthonormal_and_the_first_is_along_the_field(view, axis):
    """A change of a sample changes its residual by as much, rotated, and hardly affects its window."""
    theta, k = truth(view), 230
    ambient = turns(view.time.numpy()[k]).inv().apply(FIELD)
    axes = np.linalg.qr(np.stack([ambient, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], -1))[0].T
    axes[0] *= np.sign(axes[0] @ ambient)
    change = torch.zeros(500, 3, dtype=torch.float64)
    change[k] = -torch.from_numpy(np.linalg.solve(true_matrix(view.strength), 5.0 * axes[axis]))
    moved = (view.residual(theta, {"sensor": lambda _: change}) - view.residual(theta, {}))[k]
    assert float(moved.norm()) == pytest.approx(5.0, rel=0.01)
    if axis == 0:
        assert float(moved[0]) == pytest.approx(5.0, rel=0.01)
    else:
        assert abs(float(moved[0])) < 0.05


def test_axes_across_are_orthogonal(view):
    generator = torch.Generator().manual_seed(0)
    change = torch.zeros(500, 3, dtype=torch.float64)
    picked = torch.arange(10, 500, 50)
    change[picked] = torch.randn(len(picked), 3, generator=generator, dtype=torch.float64)
    moved = (view.residual(truth(view), {"sensor": lambda _: change}) - view.residual(truth(view), {}))[picked]
    expected = (change[picked] @ torch.from_numpy(true_matrix(view.strength))).norm(dim=-1)
    torch.testing.assert_close(moved.norm(dim=-1), expected, rtol=0.02, atol=0.02)


def test_a_change_at_the_sensor_changes_the_measurement():
    change = torch.randn(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    view = prepared(sensor=change)
    assert float(view.residual(truth(view), {}).abs().max()) > 1.0
    assert float(view.residual(truth(view), {"sensor": lambda _: change}).abs().max()) < 0.03


def test_a_change_of_the_field_changes_its_strength(view):
    stronger = torch.linspace(-1.0, 1.0, 500, dtype=torch.float64).unsqueeze(-1)
    moved = view.residual(truth(view), {"field": lambda _: stronger}) - view.residual(truth(view), {})
    torch.testing.assert_close(moved[:, :1], -stronger)
    assert float(moved[:, 1:].abs().max()) < 1e-12


def test_windows_last_two_seconds_and_end_at_gaps():
    time = np.concatenate([np.arange(300), 1000 + np.arange(200)]) / 50.0
    rate = body_rate(time)
    measured = turns(time).inv().apply(FIELD)
    table = tumbling(500, gyro=True)
    new = {"time": time} | {f"gyro_{a}": rate[:, k] for k, a in enumerate("xyz")}
    new |= {f"mag_{a}": measured[:, k] for k, a in enumerate("xyz")}
    view = Magnetometer(use="gyro").prepare(changed(table, **new))
    counts = torch.bincount(view.window)
    assert counts.tolist() == [100, 100, 100, 100, 100]
    identity = torch.zeros(15, dtype=torch.float64)
    identity[3:12] = torch.eye(3, dtype=torch.float64).flatten() * view.strength / np.linalg.norm(FIELD)
    assert float(view.residual(identity, {}).abs().max()) < 0.03


def test_outliers_do_not_move_their_window():
    sensor = np.zeros((500, 3))
    sensor[5::7] += (60.0, -40.0, 50.0)
    view = prepared(noise=0.1, sensor=sensor)
    residual = view.residual(truth(view), {})
    clean = torch.ones(500, dtype=torch.bool)
    clean[5::7] = False
    assert float(residual[clean].abs().max()) < 1.0
    assert float(residual[~clean].norm(dim=-1).min()) > 50.0


def test_signals_are_the_simulated_measurement(view):
    found = view.signals(truth(view), {})["sensor"]
    torch.testing.assert_close(found, view.measured - torch.from_numpy(OFFSET), atol=0.03, rtol=0.0)


def test_a_bias_of_the_gyroscope_is_a_parameter():
    bias = np.array([0.02, -0.01, 0.015])
    recording = tumbling(500, gyro=True)
    biased = changed(recording, **{f"gyro_{a}": recording[f"gyro_{a}"] + bias[k] for k, a in enumerate("xyz")})
    view = Magnetometer(use="gyro").prepare(biased)
    theta = truth(view)
    without = float(view.residual(theta, {}).square().mean().sqrt())
    theta[12:] = torch.from_numpy(bias)
    assert float(view.residual(theta, {}).square().mean().sqrt()) < 0.1 * without


def test_the_prior_of_the_bias_is_at_zero(view):
    assert bool((view.prior.precision[12:] > 0).all())
    assert view.prior.mean[12:].tolist() == [0.0] * 3


def test_ports_are_the_field_strength_and_the_sensor(view):
    assert view.ports["field"].channels == ("strength",)
    assert not any(port.pointwise for port in view.ports.values())
    assert view.state == {"view": "gyro", "unit": "µT", "strength": view.strength}


@pytest.mark.e2e
def test_the_gyroscope_is_used_where_turns_are_insufficient_for_the_length():
    recording = tumbling(500, noise=0.2, size=(1.0, 0.3, 0.3), gyro=True)
    with pytest.raises(NotIdentifiableError, match="Directions not covered"):
        Magnetometer(use="norm").prepare(recording)
    view = Magnetometer().prepare(recording)
    assert view.view == "gyro"
    np.testing.assert_allclose(view.start()[:3], OFFSET, atol=5.0)


def test_a_turn_about_a_single_axis_is_refused():
    with pytest.raises(NotIdentifiableError, match="Directions not covered"):
        Magnetometer().prepare(tumbling(500, noise=0.2, size=(1.0, 0.0, 0.0), gyro=True))


SMALL_TILTS = (1.0, 0.12, 0.12)


@pytest.mark.e2e
@pytest.mark.parametrize("seed", range(3))
def test_noise_of_small_tilts_does_not_shrink_the_matrix(seed):
    """The noise is in the units of the sensor; with noise of the field, a small matrix and a far offset would win."""
    recording = tumbling(1500, noise=0.3, size=SMALL_TILTS, gyro=True, seed=seed)
    found = diagnose(Magnetometer(use="gyro"), recording, surrogates=19, effects=())
    offset, matrix = found.model.theta[:3], found.model.theta[3:12].unflatten(0, (3, 3))
    assert found.corrected.rmse == pytest.approx(0.3, rel=0.05)
    np.testing.assert_allclose(offset, OFFSET, atol=6.0)
    assert float(torch.linalg.det(matrix)) == pytest.approx(1.0, abs=0.25)


@pytest.mark.e2e
def test_misaligned_axes_are_fitted_by_the_matrix():
    angle = np.radians(4.0)
    turned = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    recording = tumbling(1500, noise=0.3, gyro=True)
    measured = (recording.magnetometer().numpy() - OFFSET) @ turned.T + OFFSET
    recording = changed(recording, **{f"mag_{a}": measured[:, k] for k, a in enumerate("xyz")})
    found = diagnose(Magnetometer(use="gyro"), recording, surrogates=19, effects=())
    assert found.corrected.rmse == pytest.approx(0.3, rel=0.05)
    matrix = found.model.theta[3:12].unflatten(0, (3, 3)).numpy()
    skew = 0.5 * (matrix[0, 1] - matrix[1, 0])
    assert skew == pytest.approx(np.sin(angle), abs=0.01)
