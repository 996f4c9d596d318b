"""Fields of sensor_msgs/MagneticField: tesla, and a covariance that holds for disturbed samples too."""

import dataclasses
import math

import pytest
import torch

from mkc_torch.calibration import Calibration, calibrate, magnetic_field_messages
from mkc_torch.calibration.field_covariance import field_covariance, field_noise
from mkc_torch.recording import Recording
from mkc_torch.recording.demonstration import NOISE, simulated_recording


@pytest.fixture(scope="module")
def recording():
    return simulated_recording()[0]


@pytest.fixture(scope="module")
def calibration(recording):
    return calibrate(recording)


def test_the_field_equals_that_of_apply_in_tesla(recording, calibration):
    field = torch.stack(list(calibration.apply(recording).values())[1:], -1)
    found = magnetic_field_messages(calibration, recording.magnetometer())
    assert torch.allclose(found.magnetic_field, 1e-6 * field, rtol=1e-12)
    assert list(found.columns())[:4] == [f"magnetic_field.{a}" for a in "xyz"] + ["magnetic_field_covariance[0]"]
    assert len(found.columns()) == 12


def test_an_undisturbed_sample_has_the_noise_of_the_sensor(calibration):
    assert field_noise(calibration) == pytest.approx(NOISE, rel=0.1)  # µT
    on_the_sphere = torch.linalg.inv(torch.tensor(calibration.matrix, dtype=torch.float64)) @ torch.tensor(
        [calibration.field_strength, 0.0, 0.0], dtype=torch.float64
    ) + torch.tensor(calibration.center, dtype=torch.float64)
    covariance = magnetic_field_messages(calibration, on_the_sphere[None]).magnetic_field_covariance.reshape(3, 3)
    assert torch.allclose(covariance, 1e-12 * torch.tensor(field_covariance(calibration), dtype=torch.float64))
    assert torch.equal(covariance, covariance.mT)


def test_the_error_of_every_sample_is_covered_and_bounded(recording, calibration):
    """The length of the field deviates by at most its standard deviation or four times the noise."""
    found = magnetic_field_messages(calibration, recording.magnetometer())
    covariance = found.magnetic_field_covariance.reshape(-1, 3, 3)
    assert (torch.linalg.eigvalsh(covariance) > 0).all()
    deviation = covariance.diagonal(dim1=-2, dim2=-1).amin(-1).sqrt()
    off = (found.magnetic_field.norm(dim=-1) - 1e-6 * calibration.field_strength).abs()
    bound = 1e-6 * calibration.field_strength
    assert (off.clamp(max=bound) <= deviation).logical_or(off < 4e-6 * NOISE).all()
    assert deviation.max() <= 1.01 * bound
    disturbed = calibration.weight(recording.magnetometer()) < 0.01
    assert disturbed.sum() > 100
    assert (deviation[disturbed] > 3e-6 * NOISE).all()


def test_a_lower_weight_never_has_a_lower_covariance(recording, calibration):
    weight = calibration.weight(recording.magnetometer())
    found = magnetic_field_messages(calibration, recording.magnetometer()).magnetic_field_covariance[:, 0]
    longer = calibration.algebraic_residual(recording.magnetometer()) > 0
    ordered = found[longer][weight[longer].argsort(descending=True)]
    assert (ordered.diff() >= 0).all()


def test_a_given_bound_limits_the_covariance_and_missing_values_stay_nan(calibration):
    readings = torch.tensor([[500.0, 0.0, 0.0], [math.nan, 0.0, 0.0]])
    found = magnetic_field_messages(calibration, readings, largest_error=5e-6)
    assert found.magnetic_field_covariance[:, 0].sqrt().tolist() == pytest.approx([5e-6, 5e-6], rel=1e-2)
    assert found.magnetic_field[1].isnan().any()


def test_gaussian_noise_is_bounded_by_the_misfit_alone(calibration):
    gaussian = dataclasses.replace(calibration, sigma=math.inf)
    found = magnetic_field_messages(gaussian, torch.tensor([[100.0, 0.0, 0.0]]))
    off = found.magnetic_field.norm() - 1e-6 * calibration.field_strength
    assert found.magnetic_field_covariance[0, 0].sqrt() == pytest.approx(float(off), rel=1e-3)


def test_an_undetermined_offset_has_an_error_of_the_radius(calibration):
    unknown = dataclasses.replace(calibration, center_se=(0.1, 0.1, math.nan))
    assert math.sqrt(field_covariance(unknown)[2][2]) == pytest.approx(calibration.radius, rel=0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sensor": "accel"}, "accelerometer"),
        ({"field_unit": "counts"}, "in counts"),
    ],
)
def test_other_sensors_and_units_are_refused(calibration, change, message):
    with pytest.raises(ValueError, match=message):
        magnetic_field_messages(dataclasses.replace(calibration, **change), torch.zeros(1, 3))


@pytest.mark.parametrize("bound", [1e-9, math.inf, math.nan])
def test_a_bound_below_the_noise_or_infinite_is_refused(calibration, bound):
    with pytest.raises(ValueError, match="largest_error"):
        magnetic_field_messages(calibration, torch.zeros(1, 3), largest_error=bound)


def test_messages_do_not_depend_on_the_unit_of_the_calibration(calibration):
    def scaled(vector):
        return tuple(0.01 * v for v in vector)

    gauss = dataclasses.replace(
        calibration,
        unit="gauss",
        field_unit="gauss",
        center=scaled(calibration.center),
        center_se=scaled(calibration.center_se),
        radius=0.01 * calibration.radius,
        field_strength=0.01 * calibration.field_strength,
    )
    assert isinstance(gauss, Calibration)
    reading = torch.tensor([[44.55, -7.35, -17.1]], dtype=torch.float64)
    for a, b in zip(
        magnetic_field_messages(calibration, reading), magnetic_field_messages(gauss, 0.01 * reading), strict=True
    ):
        assert torch.allclose(a, b, rtol=1e-9, atol=0.0)


def test_the_true_field_is_within_the_stated_error():
    """The figures of docs/ros.md: random disturbances of 15 µT of two samples in five."""
    draw = torch.Generator().manual_seed(1)
    time = torch.arange(1500, dtype=torch.float64) / 50.0
    about, tilt = 1.1 * time, 0.6 * (0.31 * time).sin() + 0.4 * time
    truth = 48.0 * torch.stack([about.cos() * tilt.cos(), about.sin() * tilt.cos(), tilt.sin()], -1)
    disturbed = torch.rand(1500, generator=draw) < 0.4
    error = torch.where(disturbed, 15.0, 0.4)[:, None] * torch.randn(1500, 3, generator=draw, dtype=torch.float64)
    measured = truth + torch.tensor([5.0, -3.0, 9.0]) + error
    columns = dict(zip(("mag_x", "mag_y", "mag_z"), measured.unbind(-1), strict=True))
    found = magnetic_field_messages(calibrate(Recording({"time": time, **columns})), measured)
    deviation = found.magnetic_field_covariance[:, [0, 4, 8]].sqrt()
    within = ((found.magnetic_field - 1e-6 * truth).abs() < 2.0 * deviation).double()
    assert within[~disturbed].mean() > 0.94
    assert 0.8 < within[disturbed].mean() < 0.95  # a disturbance across the field is not seen
