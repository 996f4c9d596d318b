"""The field vector in the world frame."""

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


def zero_residual_parameters(view):
    """Return the parameters with zero residual, by SciPy from the view's start."""
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
    return zero_residual_parameters(view)


def test_residual_is_zero_at_the_truth(view, truth):
    assert view.channels == ("along", "across_1", "across_2")
    assert view.residual(truth, {}).shape == (400, 3)
    assert float(view.residual(truth, {}).abs().max()) < 1e-9
    np.testing.assert_allclose(truth[:3], OFFSET, atol=1e-9)
    np.testing.assert_allclose(view.matrix(truth), true_matrix(view.strength), atol=1e-10)
    np.testing.assert_allclose(view.ambient(truth), view.strength * DIRECTION, atol=1e-8)
    assert len(view.parameter_names) == len(truth)


def test_length_and_sign_of_quaternions_are_irrelevant(view, truth):
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
    # the axes are those of the field at the start, which has an error of 1 to 2 degrees
    torch.testing.assert_close(along[:, 0], torch.linspace(-5.0, 5.0, 400).double(), rtol=2e-3, atol=1e-9)
    assert float(along[:, 1:].abs().max()) < 0.2


def truth_of(view, changes):
    """Return the true parameters; the tilt of the field relative to the view's start is fitted."""

    def left(tilt):
        return view.residual(full_truth(view.strength, *tilt), changes).numpy().ravel()

    return full_truth(view.strength, *least_squares(left, np.zeros(2), xtol=1e-15, ftol=1e-15, gtol=1e-15).x)


def test_errors_of_the_attitude_enter_across_the_field_only():
    recording = tumbling(400, attitude=True)
    rotation = turns(recording["time"].numpy())
    small = 0.01 * np.random.default_rng(0).standard_normal((400, 3))
    x, y, z, w = (Rotation.from_rotvec(small) * rotation).as_quat().T
    contaminated = Magnetometer().prepare(changed(recording, q_w=w, q_x=x, q_y=y, q_z=z))
    residual = contaminated.residual(truth_of(contaminated, {}), {})
    # a hundredth of a radian in 47 µT
    assert float(residual[:, 1:].std()) == pytest.approx(0.47, rel=0.15)
    assert float(residual[:, 0].std()) < 0.05
    assert contaminated.independent == (True, False, False)


def test_a_change_at_the_sensor_changes_the_measurement():
    change = torch.randn(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    contaminated = Magnetometer().prepare(tumbling(400, attitude=True, sensor=change))
    theta = truth_of(contaminated, {"sensor": lambda _: change})
    assert float(contaminated.residual(theta, {"sensor": lambda _: change}).abs().max()) < 1e-8
    assert float(contaminated.residual(theta, {}).abs().max()) > 1.0


def test_signals_are_the_simulated_measurement(view, truth):
    torch.testing.assert_close(view.signals(truth, {})["sensor"], view.measured - torch.from_numpy(OFFSET))


def test_start_from_a_part_is_as_good_as_from_all_samples(view):
    rows = torch.arange(400) < 250
    for theta in (view.start(), view.start(rows)):
        residual = view.residual(theta, {})
        # the start takes the identity as matrix, with an error of some per cent
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


def test_the_prior_is_on_the_matrix_only(view):
    precision = view.prior.precision
    assert bool((precision[3:12] > 0).all())
    assert bool((precision[:3] == 0).all())
    assert bool((precision[12:] == 0).all())
    assert torch.equal(view.prior.mean[3:12].reshape(3, 3), torch.eye(3, dtype=torch.float64))


def test_ports_are_the_field_vector_and_the_sensor(view):
    assert view.ports["field"].channels == ("east", "north", "up")
    assert view.ports["sensor"].channels == ("x", "y", "z")
    assert all(port.pointwise for port in view.ports.values())
    assert view.ports["sensor"].allows_drift
    assert view.state == {"view": "attitude", "unit": "µT", "strength": view.strength}


def test_a_turn_about_a_single_axis_is_refused():
    with pytest.raises(NotIdentifiableError, match=r"\+z"):
        Magnetometer().prepare(tumbling(500, noise=0.3, size=(1.0, 0.0, 0.0), attitude=True))


def test_zero_quaternions_are_excluded():
    recording = tumbling(500, noise=0.3, attitude=True)
    waiting = (torch.arange(500) >= 20).double()
    view = Magnetometer().prepare(changed(recording, **{f"q_{a}": waiting * recording[f"q_{a}"] for a in "wxyz"}))
    assert len(view.time) == 480
    assert any("20 of 500 samples whose quaternion is zero" in warning for warning in view.recording.warnings)


def test_a_recording_with_zero_quaternions_only_is_refused():
    recording = changed(tumbling(500, attitude=True), **{f"q_{a}": torch.zeros(500) for a in "wxyz"})
    with pytest.raises(RecordingError, match="tumbling: all quaternions q_w, q_x, q_y, q_z are zero"):
        Magnetometer().prepare(recording)


@pytest.mark.e2e
def test_a_vehicle_that_hardly_tilts_has_a_warning():
    view = Magnetometer().prepare(tumbling(500, noise=0.3, size=(1.0, 0.05, 0.05), attitude=True))
    assert view.view == "attitude"
    (warning,) = view.warnings
    assert warning.startswith("The ellipsoid alone is not identifiable")
    assert "Directions not covered: +z" in warning
    assert Magnetometer().prepare(tumbling(500, noise=0.3, attitude=True)).warnings == ()


def with_inverse_attitude(recording):
    return changed(recording, **{name: -recording[name] for name in ("q_x", "q_y", "q_z")})


def test_an_inverse_attitude_is_refused_with_the_remedy():
    with pytest.raises(RecordingError, match=r"quaternions are the inverse.*give the conjugate"):
        Magnetometer().prepare(with_inverse_attitude(tumbling(500, noise=0.3, attitude=True)))


def test_an_unrelated_attitude_has_a_warning():
    other = tumbling(500, attitude=True, moments=50.0 + 1.7 * np.arange(500) / 50.0)
    recording = changed(
        tumbling(500, noise=0.3, attitude=True), **{name: other[name] for name in ("q_w", "q_x", "q_y", "q_z")}
    )
    view = Magnetometer(use="attitude").prepare(recording)
    assert any("hardly explains the field" in warning for warning in view.warnings)
    view = Magnetometer().prepare(recording)
    assert view.view == "norm"
    assert "The attitude is left out" in view.warnings[0]


def test_a_large_effect_does_not_count_as_a_misfit_of_the_attitude():
    current = 0.5 + 0.5 * np.sin(2.0 * np.arange(500) / 50.0)
    recording = tumbling(500, noise=0.3, attitude=True, sensor=current[:, None] * [15.0, -10.0, 20.0])
    assert not any("hardly explains" in warning for warning in Magnetometer().prepare(recording).warnings)
