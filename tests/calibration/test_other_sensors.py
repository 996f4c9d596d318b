"""Calibration of an accelerometer by gravity, and a gyroscope's bias from rest."""

import json

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.calibration import Calibration, calibrate
from mkc_torch.calibration.coverage import fibonacci_sphere
from mkc_torch.calibration.other_sensors import ACCEL, GYRO, rest_bias
from mkc_torch.recording import MissingColumnError
from mkc_torch.report import calibration_report

OFFSET = torch.tensor([0.3, -0.2, 0.5])
GAINS = torch.tensor([1.02, 0.97, 1.01])


def laid_down(places=16, rest=60, move=20, jolt=3.0):
    """An accelerometer that is laid down on its sides and accelerated by hand in between."""
    draw = torch.Generator().manual_seed(0)
    up = fibonacci_sphere(places)
    parts = []
    for k in range(places):
        share = torch.linspace(0.0, 1.0, move)[:, None]
        turned = torch.nn.functional.normalize((1 - share) * up[k] + share * up[(k + 1) % places] + 1e-3, dim=-1)
        parts += [up[k].expand(rest, 3), turned * (1 + jolt * torch.rand(move, 1, generator=draw))]
    force = 9.80665 * torch.cat(parts)
    return force * GAINS + OFFSET + 0.02 * torch.randn(len(force), 3, generator=draw)


def recorded(points, names=ACCEL, **columns):
    time = torch.arange(len(points)) / 50.0
    return Recording({"time": time, **dict(zip(names, points.unbind(-1), strict=True)), **columns}, name="sides")


@pytest.mark.e2e
def test_an_accelerometer_is_calibrated_by_its_rests():
    recording = recorded(laid_down())
    c = calibrate(recording, sensor="accel")
    assert c.center == pytest.approx(OFFSET.tolist(), abs=0.02)
    assert sorted(c.semi_axes) == pytest.approx(sorted((9.80665 * GAINS).tolist()), abs=0.03)
    assert (c.sensor, c.unit, c.field_unit, c.field_strength) == ("accel", "m/s²", "m/s²", 9.80665)
    assert any("samples between rests" in w for w in c.warnings)
    assert Calibration.from_json(c.to_json()) == c
    assert json.loads(c.to_json())["sensor"] == "accel"
    assert "samples between rests" in calibration_report(c, recording)
    length = torch.stack(list(c.apply(recording).values())[1:]).norm(dim=0)
    assert float(length.median()) == pytest.approx(9.80665, abs=0.01)


def test_without_rests_all_samples_count_and_gravity_can_be_given():
    points = 9.7803 * fibonacci_sphere(400) * GAINS + OFFSET
    c = calibrate(recorded(points), sensor="accel", field_strength=9.7803)
    assert c.center == pytest.approx(OFFSET.tolist(), abs=1e-3)
    assert c.field_strength == 9.7803
    assert c.samples == 400


def test_an_acceleration_in_g_has_a_warning():
    c = calibrate(recorded(fibonacci_sphere(400) * GAINS), sensor="accel")
    assert "not gravity; the columns may be in g" in c.warnings[0]


def test_an_unknown_or_missing_sensor_is_rejected():
    with pytest.raises(ValueError, match="'mag' or 'accel'"):
        calibrate(recorded(fibonacci_sphere(40)), sensor="gyro")
    with pytest.raises(MissingColumnError, match="accel_x"):
        calibrate(recorded(fibonacci_sphere(40), ("mag_x", "mag_y", "mag_z")), sensor="accel")


def gyroscope(count=2000, turns=slice(500, 1500)):
    draw = torch.Generator().manual_seed(1)
    rate = 0.005 * torch.randn(count, 3, generator=draw) + torch.tensor([0.02, -0.01, 0.005])
    time = torch.arange(count) / 50.0
    rate[turns] += torch.stack([torch.sin(time), torch.cos(0.7 * time), torch.sin(1.3 * time)], -1)[turns]
    return rate


def test_a_gyroscopes_bias_comes_from_its_rest():
    found = rest_bias(recorded(gyroscope(), GYRO))
    off = (torch.tensor(found.value) - torch.tensor([0.02, -0.01, 0.005])).abs()
    assert bool((off < 4.0 * torch.tensor(found.standard_error)).all())
    assert max(found.standard_error) < 5e-4
    assert 15.0 < found.seconds < 20.1


def test_a_gyroscope_that_never_rests_has_no_bias():
    assert rest_bias(recorded(gyroscope(turns=slice(0, 2000)), GYRO)) is None
    rates = torch.zeros(100, 3)
    assert rest_bias(Recording(dict(zip(GYRO, rates.unbind(-1), strict=True)))) is None
    assert rest_bias(recorded(torch.full((200, 3), float("nan")), GYRO)) is None


@pytest.mark.e2e
def test_the_calibration_of_a_magnetometer_includes_the_gyroscope_bias():
    points = torch.cat([torch.tensor([[30.0, 20.0, 10.0]]).expand(500, 3), 45.0 * fibonacci_sphere(1500)])
    points = points + 0.3 * torch.randn(2000, 3, generator=torch.Generator().manual_seed(2))
    rates = gyroscope(turns=slice(500, 2000))
    recording = recorded(points, ("mag_x", "mag_y", "mag_z"), **dict(zip(GYRO, rates.unbind(-1), strict=True)))
    c = calibrate(recording)
    assert json.loads(c.to_json())["gyroscope"]["bias"]["value"] == pytest.approx((0.02, -0.01, 0.005), abs=2e-3)
    assert Calibration.from_json(c.to_json()) == c
    assert "s of rest" in calibration_report(c, recording)
