"""The vector in the world's axes."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mkc_torch import NotIdentifiableError
from mkc_torch.recording.recording import RecordingError
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import FIELD, OFFSET, changed, full_truth, true_matrix, tumbling, turns

DIRECTION = FIELD / np.linalg.norm(FIELD)


def exact(view):
    """The parameters that leave nothing, by SciPy from the view's own start."""
    found = least_squares(
        lambda theta: view.residual(torch.from_numpy(theta), {}).numpy().ravel(),
        view.start().numpy(), xtol=1e-15, ftol=1e-15, gtol=1e-15,
    )  # fmt: skip
    return torch.from_numpy(found.x)


@pytest.fixture(scope="module")
def view():
    return Magnetometer().prepare(tumbling(400, attitude=True))


@pytest.fixture(scope="module")
def truth(view):
    return exact(view)


def test_nothing_is_left_at_the_truth(view, truth):
    assert view.channels == ("along", "across_1", "across_2")
    assert view.residual(truth, {}).shape == (400, 3)
    assert float(view.residual(truth, {}).abs().max()) < 1e-9
    np.testing.assert_allclose(truth[:3], OFFSET, atol=1e-9)
    np.testing.assert_allclose(view.matrix(truth), true_matrix(view.strength), atol=1e-10)
    np.testing.assert_allclose(view.ambient(truth), view.strength * DIRECTION, atol=1e-8)
    assert len(view.parameter_names) == len(truth)


def test_the_length_of_a_quaternion_and_its_sign_mean_nothing(view, truth):
    recording = tumbling(400, attitude=True)
    size = torch.linspace(-3.0, 2.0, 400, dtype=torch.float64)
    scaled = changed(recording, **{f"q_{a}": size * recording[f"q_{a}"] for a in "wxyz"})
    torch.testing.assert_close(Magnetometer().prepare(scaled).residual(truth, {}), view.residual(truth, {}))


def test_channels_are_orthonormal_and_the_first_is_along_the_field(view, truth):
    added = torch.randn(400, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    moved = -view.residual(truth, {"field": lambda _: added})
    torch.testing.assert_close(moved.norm(dim=-1), added.norm(dim=-1))
    ahead = torch.from_numpy(np.outer(np.linspace(-5.0, 5.0, 400), DIRECTION))
    along = -view.residual(truth, {"field": lambda _: ahead})
    # the axes are those of the start's field, which is a degree or two off
    torch.testing.assert_close(along[:, 0], torch.linspace(-5.0, 5.0, 400).double(), rtol=2e-3, atol=1e-9)
    assert float(along[:, 1:].abs().max()) < 0.2


def truth_of(view, changes):
    """Offset and response are known; the tilt of the field against the view's own start is fitted."""

    def left(tilt):
        return view.residual(full_truth(view.strength, *tilt), changes).numpy().ravel()

    return full_truth(view.strength, *least_squares(left, np.zeros(2), xtol=1e-15, ftol=1e-15, gtol=1e-15).x)


def test_errors_of_the_attitude_enter_across_the_field_alone():
    recording = tumbling(400, attitude=True)
    rotation = turns(recording["time"].numpy())
    small = 0.01 * np.random.default_rng(0).standard_normal((400, 3))
    x, y, z, w = (Rotation.from_rotvec(small) * rotation).as_quat().T
    spoilt = Magnetometer().prepare(changed(recording, q_w=w, q_x=x, q_y=y, q_z=z))
    residual = spoilt.residual(truth_of(spoilt, {}), {})
    # a hundredth of a radian in 47 µT
    assert float(residual[:, 1:].std()) == pytest.approx(0.47, rel=0.15)
    assert float(residual[:, 0].std()) < 0.05
    assert spoilt.independent == (True, False, False)


def test_a_change_at_the_sensor_is_one_of_the_measurement():
    change = torch.randn(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    spoilt = Magnetometer().prepare(tumbling(400, attitude=True, sensor=change))
    theta = truth_of(spoilt, {"sensor": lambda _: change})
    assert float(spoilt.residual(theta, {"sensor": lambda _: change}).abs().max()) < 1e-8
    assert float(spoilt.residual(theta, {}).abs().max()) > 1.0


def test_signals_are_the_simulated_measurement(view, truth):
    torch.testing.assert_close(view.signals(truth, {})["sensor"], view.measured - torch.from_numpy(OFFSET))


def test_the_start_on_rows_leaves_what_the_start_on_all_leaves(view):
    rows = torch.arange(400) < 250
    for theta in (view.start(), view.start(rows)):
        residual = view.residual(theta, {})
        # the matrix is taken for the identity at the start, which is some per cent off
        assert float(residual.square().mean().sqrt()) < 0.1 * view.strength
    with pytest.raises(ValueError, match="5 samples are too few"):
        view.start(torch.arange(400) < 5)


def test_the_start_finds_the_field_of_a_sensor_without_soft_iron():
    recording = tumbling(400, attitude=True)
    rotation = turns(recording["time"].numpy())
    measured = rotation.inv().apply(FIELD) + OFFSET
    measured[::5] += 40.0
    view = Magnetometer().prepare(changed(recording, **{f"mag_{a}": measured[:, k] for k, a in enumerate("xyz")}))
    for theta in (view.start(), view.start(torch.arange(400) < 200)):
        np.testing.assert_allclose(theta[:3], OFFSET, atol=1e-6)
        np.testing.assert_allclose(view.ambient(theta), FIELD, atol=1e-6)
    assert view.strength == pytest.approx(np.linalg.norm(FIELD))


def test_what_is_known_of_the_matrix_beforehand(view):
    precision = view.prior.precision
    assert bool((precision[3:12] > 0).all())
    assert bool((precision[:3] == 0).all())
    assert bool((precision[12:] == 0).all())
    assert torch.equal(view.prior.mean[3:12].reshape(3, 3), torch.eye(3, dtype=torch.float64))


def test_ports(view):
    assert view.ports["field"].channels == ("east", "north", "up")
    assert view.ports["sensor"].channels == ("x", "y", "z")
    assert all(port.pointwise for port in view.ports.values())
    assert view.ports["sensor"].allows_drift
    assert view.state == {"view": "attitude", "unit": "µT", "strength": view.strength}


def test_a_turn_about_one_axis_determines_no_offset_along_it():
    with pytest.raises(NotIdentifiableError, match=r"\+z"):
        Magnetometer().prepare(tumbling(500, noise=0.3, size=(1.0, 0.0, 0.0), attitude=True))


def test_quaternions_of_length_zero_are_left_out():
    recording = tumbling(500, noise=0.3, attitude=True)
    waiting = (torch.arange(500) >= 20).double()
    view = Magnetometer().prepare(changed(recording, **{f"q_{a}": waiting * recording[f"q_{a}"] for a in "wxyz"}))
    assert len(view.time) == 480
    assert any("20 of 500 samples whose quaternion is zero" in warning for warning in view.recording.warnings)


def test_a_recording_of_nothing_but_zero_quaternions_is_refused_as_such():
    recording = changed(tumbling(500, attitude=True), **{f"q_{a}": torch.zeros(500) for a in "wxyz"})
    with pytest.raises(RecordingError, match="tumbling: all quaternions q_w, q_x, q_y, q_z are zero"):
        Magnetometer().prepare(recording)


@pytest.mark.e2e
def test_a_vehicle_that_hardly_tilts_is_warned_of():
    view = Magnetometer().prepare(tumbling(500, noise=0.3, size=(1.0, 0.05, 0.05), attitude=True))
    assert view.view == "attitude"
    (warning,) = view.warnings
    assert warning.startswith("The ellipsoid alone is not identifiable")
    assert "Directions not covered: +z" in warning
    assert Magnetometer().prepare(tumbling(500, noise=0.3, attitude=True)).warnings == ()


def inverse(recording):
    return changed(recording, **{name: -recording[name] for name in ("q_x", "q_y", "q_z")})


def test_an_inverse_attitude_is_refused_with_what_to_do():
    with pytest.raises(RecordingError, match=r"inverse of what is expected.*give the conjugate"):
        Magnetometer().prepare(inverse(tumbling(500, noise=0.3, attitude=True)))


def test_an_attitude_of_something_else_is_told_of():
    other = tumbling(500, attitude=True, moments=50.0 + 1.7 * np.arange(500) / 50.0)
    recording = changed(
        tumbling(500, noise=0.3, attitude=True), **{name: other[name] for name in ("q_w", "q_x", "q_y", "q_z")}
    )
    view = Magnetometer(use="attitude").prepare(recording)
    assert any("hardly explains the field" in warning for warning in view.warnings)
    view = Magnetometer().prepare(recording)
    assert view.view == "norm"
    assert "The attitude is left out" in view.warnings[0]


def test_a_large_effect_is_no_misfit_of_the_attitude():
    current = 0.5 + 0.5 * np.sin(2.0 * np.arange(500) / 50.0)
    recording = tumbling(500, noise=0.3, attitude=True, sensor=current[:, None] * [15.0, -10.0, 20.0])
    assert not any("hardly explains" in warning for warning in Magnetometer().prepare(recording).warnings)
