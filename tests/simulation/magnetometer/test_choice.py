"""Selection of the view: wrong turns have a far larger residual than the length."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mkc_torch import diagnose
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.simulation import Magnetometer
from mkc_torch.simulation.magnetometer.parts import ellipsoid_of_a_part, sphere_of_all
from tests.simulation.tumbling import RATE, body_rate, changed, full_truth, tumbling, turns

N = 3000
TIME = np.arange(N) / RATE
SLOW = 0.1 * TIME
"""Moments of a motion so slow that the length determines the sensor without a step but not with a step."""

STEP = np.outer(TIME > 30.0, [8.0, -5.0, 3.0])


def quaternions(rotation):
    x, y, z, w = rotation.as_quat().T
    return {"q_w": w, "q_x": x, "q_y": y, "q_z": z}


def rates(rate):
    return {f"gyro_{axis}": np.ascontiguousarray(column) for axis, column in zip("xyz", rate.T, strict=True)}


def view_of(attitude, **further):
    return Magnetometer().prepare(changed(tumbling(N, noise=0.5, **further), **attitude))


def drifting_rotation(degrees, tau=10.0):
    """Return a rotation error with the correlation time of a filter."""
    random, decay = np.random.default_rng(0), np.exp(-1.0 / (RATE * tau))
    error = np.zeros((N, 3))
    for k in range(1, N):
        error[k] = decay * error[k - 1] + np.sqrt(1.0 - decay**2) * random.standard_normal(3)
    return Rotation.from_rotvec(np.deg2rad(degrees) * error)


@pytest.mark.parametrize(
    "attitude",
    [
        quaternions(turns(TIME)),
        quaternions(drifting_rotation(2.0) * turns(TIME)),
        quaternions(drifting_rotation(4.0) * turns(TIME)),
        quaternions(turns(TIME - 0.01)),
        quaternions(turns(TIME) * Rotation.from_euler("Z", 40, degrees=True)),
    ],
    ids=["exact", "2 degrees", "4 degrees", "10 ms late", "other axes"],
)
def test_a_noisy_attitude_is_used(attitude):
    assert view_of(attitude).view == "attitude"


@pytest.mark.e2e
@pytest.mark.parametrize("size", [10.0, 40.0])
def test_a_change_of_the_sensor_does_not_exclude_the_attitude(size):
    right = quaternions(turns(TIME))
    assert view_of(right, sensor=np.outer(TIME > 30.0, [0.8, -0.5, 0.3]) * size).view == "attitude"
    assert view_of(right, sensor=np.outer(TIME / 60.0, [0.8, -0.5, 0.3]) * size).view == "attitude"
    assert view_of(right, sensor=np.outer(np.sin(TIME) ** 2, [0.8, -0.5, 0.3]) * size).view == "attitude"


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("attitude", "words"),
    [
        (quaternions(turns(TIME - 0.1)), "seems to be late by 0.1 s"),
        (quaternions(turns(TIME + 0.5)), "seems to be early by 0.5 s"),
        (dict(zip(("q_w", "q_x", "q_y", "q_z"), turns(TIME).as_quat().T, strict=True)), "in the order x, y, z, w"),
        (quaternions(turns(0.77 * TIME + 31.0)), "check that it belongs to this recording and this sensor"),
        (quaternions(drifting_rotation(20.0) * turns(TIME)), "check that it belongs to this recording and this sensor"),
        (quaternions(turns(0.0 * TIME)), "does not turn as the field does"),
    ],
    ids=["late", "early", "order", "another's", "poor", "still"],
)
def test_a_wrong_attitude_is_excluded_with_the_reason(attitude, words):
    view = view_of(attitude)
    assert view.view == "norm"
    (sentence,) = (warning for warning in view.warnings if "attitude is left out" in warning)
    assert words in sentence
    assert float(1.4826 * view.residual(view.start(), {}).abs().median()) < 0.6


def test_the_warning_has_residuals_in_the_measurements_unit():
    (sentence,) = view_of(quaternions(turns(TIME - 0.1))).warnings
    assert "of the field of 47 µT, with the length 0.5 µT" in sentence
    assert "Without this fault the residual would be 0.5" in sentence


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("rate", "words"),
    [
        (lambda rate: np.rad2deg(rate), "in degrees per second, not in rad/s. Without"),
        (lambda rate: -np.rad2deg(rate), "in degrees per second, not in rad/s, and of the other sign"),
        (lambda rate: np.rad2deg(rate[:, [1, 0, 2]]) * [1.0, 1.0, -1.0], "its x is y as recorded"),
    ],
    ids=["degrees", "degrees and sign", "exchanged"],
)
def test_a_wrong_gyroscope_is_excluded_where_length_and_step_determine_the_sensor(rate, words):
    recording = tumbling(N, noise=0.5, moments=SLOW, sensor=STEP)
    right = 0.1 * body_rate(SLOW)
    assert Magnetometer().prepare(changed(recording, **rates(right))).view == "gyro"
    view = Magnetometer().prepare(changed(recording, **rates(rate(right))))
    assert view.view == "norm"
    assert "The gyroscope is left out" in view.warnings[0]
    assert words in view.warnings[0]
    assert "All samples together do not determine an ellipsoid" in view.warnings[1]
    assert view.prior is not None


@pytest.mark.e2e
def test_wrong_turns_have_a_warning_where_the_length_is_insufficient():
    little = tumbling(N, noise=0.5, size=(1.0, 0.1, 0.1), moments=0.3 * TIME)
    rate = 0.3 * body_rate(0.3 * TIME, (1.0, 0.1, 0.1))
    right = Magnetometer().prepare(changed(little, **rates(rate)))
    wrong = Magnetometer().prepare(changed(little, **rates(np.rad2deg(rate))))
    assert (right.view, wrong.view) == ("gyro", "gyro")
    assert not any("hardly explains" in warning for warning in right.warnings)
    assert "The gyroscope hardly explains the field" in wrong.warnings[0]
    assert "degrees per second" in wrong.warnings[0]


@pytest.mark.e2e
def test_a_requested_view_is_used_and_has_the_fault_of_its_turns():
    table = changed(tumbling(N, noise=0.5), **quaternions(turns(TIME - 0.5)), **rates(-body_rate(TIME)))
    views = [Magnetometer(use=use).prepare(table) for use in ("attitude", "gyro", "norm")]
    assert [view.view for view in views] == ["attitude", "gyro", "norm"]
    late, turned_round, none = ("".join(view.faults) for view in views)
    assert late.startswith("With the attitude")
    assert "seems to be late by 0.5 s" in late
    assert "with the length 0.5 µT" in turned_round
    assert "The rates seem to have the other sign" in turned_round
    assert none == ""


def test_correct_turns_are_not_reported_as_wrong():
    table = changed(tumbling(N, noise=0.5, sensor=STEP), **quaternions(turns(TIME)), **rates(body_rate(TIME)))
    assert [Magnetometer(use=use).prepare(table).faults for use in ("attitude", "gyro")] == [(), ()]


@pytest.mark.e2e
def test_a_simulation_with_wrong_turns_is_unfit_with_the_reason():
    table = changed(tumbling(N, noise=0.5, sensor=STEP), **rates(-body_rate(TIME)))
    found = diagnose(Magnetometer(use="gyro"), table, surrogates=19)
    assert (found.verdict, found.findings) == ("unfit", ())
    assert "The rates seem to have the other sign" in found.environment.reasons[0]


@pytest.mark.e2e
def test_a_part_determines_the_ellipsoid_where_all_samples_do_not():
    half = tumbling(N, noise=0.3, moments=np.where(TIME < 30.0, TIME, 30.0 + 0.02 * (TIME - 30.0)))
    points = half.magnetometer() + torch.as_tensor(np.outer(TIME > 30.0, [300.0, 0.0, 0.0]))
    surface = ellipsoid_of_a_part(points, torch.arange(N))
    assert surface.last <= N // 2 + 1
    assert surface.center == pytest.approx(full_truth(47.0)[:3].tolist(), abs=0.1)
    assert sphere_of_all(tumbling(N, noise=0.3, sensor=STEP).magnetometer(), torch.arange(N)).radius == pytest.approx(
        46.7, rel=0.1
    )


def test_samples_with_little_coverage_are_refused():
    little = tumbling(N, noise=0.5, size=(1.0, 0.05, 0.05))
    with pytest.raises(NotIdentifiableError):
        Magnetometer().prepare(little)
    assert sphere_of_all(little.magnetometer(), torch.arange(N)) is None


@pytest.mark.e2e
def test_a_step_is_found_by_the_length_with_a_gyroscope_in_degrees():
    recording = changed(
        tumbling(N, noise=0.5, seed=1, moments=SLOW, sensor=STEP), **rates(np.rad2deg(0.1 * body_rate(SLOW)))
    )
    found = diagnose(Magnetometer(), recording, surrogates=19)
    (finding,) = found.findings
    assert finding.effect == "hard_iron_step"
    assert finding.onset == pytest.approx(30.0, abs=0.2)
    (change,) = (parameter for parameter in finding.parameters if parameter.name == "offset_change")
    assert change.value == pytest.approx((8.0, -5.0, 3.0), abs=1.0)
    assert any("The gyroscope is left out" in warning for warning in found.warnings)
