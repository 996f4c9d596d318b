"""Only place and date: calibration by the field's length and inclination, for a vehicle on level ground."""

import math

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.calibration import Calibration, NotIdentifiableError, calibrate
from mkc_torch.calibration.aided import by_place, length_model, select_response
from mkc_torch.calibration.aided.length_model import Circle, LengthModel
from mkc_torch.calibration.aided.place import Field
from mkc_torch.calibration.aided.response import PlaceField
from mkc_torch.report.words.numbers import aided
from tests.calibration.aided.vehicle import example, with_columns

GYRO = ("gyro_x", "gyro_y", "gyro_z")


@pytest.fixture(autouse=True, scope="module")
def few_samples():
    """Fits on a third of the samples, for speed."""
    kept, select_response._MOST = select_response._MOST, 1000
    yield
    select_response._MOST = kept


def field_of(draw, strength=1.0):
    length = float(torch.linalg.vector_norm(draw.field))
    return Field(strength * length, -math.asin(float(draw.field[2]) / length), 0.0)


def swaying_vehicle(tilt=0.0, count=1200, vertical=-42.0):
    """A vehicle that turns on level ground and sways by ``lean`` rad."""
    g = torch.Generator().manual_seed(4)
    yaw = torch.linspace(0.0, 20.0, count, dtype=torch.float64)
    lean = tilt * torch.sin(3.7 * yaw)
    zero, unit = torch.zeros_like(yaw), torch.ones_like(yaw)
    field = torch.stack([20.0 * yaw.sin(), 20.0 * yaw.cos(), vertical * unit], -1)
    turn = torch.stack([unit, zero, zero, zero, lean.cos(), lean.sin(), zero, -lean.sin(), lean.cos()], -1)
    seen = (turn.unflatten(-1, (3, 3)) @ field.unsqueeze(-1)).squeeze(-1)
    seen = seen + torch.tensor([5.0, -8.0, 15.0]).double() + 0.2 * torch.randn(count, 3, generator=g).double()
    names = ("time", "mag_x", "mag_y", "mag_z")
    return Recording(dict(zip(names, (torch.arange(count) / 20.0, *seen.unbind(-1)), strict=True)))


EARTH = Field(math.hypot(20.0, 42.0), math.atan2(42.0, 20.0), 0.0)


@pytest.fixture(scope="module")
def simulated():
    return example().drawn(100_301, 8.0, 15.0, seconds=60.0)


@pytest.fixture(scope="module")
def calibrated(simulated):
    return calibrate(with_columns(simulated.recording, drop=GYRO), earth=field_of(simulated, 1.005))


@pytest.mark.e2e
def test_place_and_date_determine_offsets_and_headings_up_to_a_constant(simulated, calibrated):
    off = (torch.tensor(calibrated.center).double() - simulated.offset) / torch.tensor(calibrated.center_se).double()
    assert float(off.abs().max()) < 4.0
    error = torch.deg2rad(
        example().heading_errors(
            simulated, torch.tensor(calibrated.center).double(), torch.tensor(calibrated.matrix).double()
        )
    )
    constant = torch.atan2(error.sin().mean(), error.cos().mean())
    assert math.degrees(float((error - constant).sin().square().mean().sqrt())) < 3.0
    with pytest.raises(NotIdentifiableError):
        calibrate(with_columns(simulated.recording, drop=GYRO))


def test_warnings_state_the_aid_and_its_assumptions(calibrated):
    assert calibrated.aid.by == "place"
    assert any("field of the place replaces the missing turns" in note for note in calibrated.notes)
    assert any("level ground" in warning and "known heading" in warning for warning in calibrated.warnings)
    assert "By the place" in " ".join(aided(calibrated))
    assert "constant heading offset cannot be observed" in " ".join(aided(calibrated))
    matrix = torch.tensor(calibrated.matrix)
    assert torch.allclose(matrix, matrix.mT, atol=1e-6)
    assert Calibration.from_json(calibrated.to_json()) == calibrated


def test_without_tilts_the_vertical_offset_is_undetermined():
    c = calibrate(swaying_vehicle(), earth=EARTH)
    assert "offset_z" in c.aid.undetermined
    assert math.isinf(c.center_se[2])
    assert any(w.startswith("Not determined: the offset of z") and w.endswith("Tilt it more.") for w in c.warnings)
    assert abs(c.center[0] - 5.0) < 4.0 * c.center_se[0] < 16.0
    assert abs(c.center[1] + 8.0) < 4.0 * c.center_se[1] < 16.0


@pytest.mark.e2e
@pytest.mark.parametrize("vertical", [-42.0, 42.0])
def test_tilts_determine_the_vertical_offset(vertical):
    c = calibrate(swaying_vehicle(0.15, vertical=vertical), earth=EARTH)
    assert "offset_z" not in c.aid.undetermined
    assert abs(c.center[2] - 15.0) < 4.0 * c.center_se[2] < 24.0


def test_the_field_of_another_place_is_refused_with_both_radii():
    with pytest.raises(NotIdentifiableError, match=r"circle of radius 20.*of the place is 40"):
        calibrate(swaying_vehicle(0.15), earth=Field(math.hypot(40.0, 20.0), math.atan2(20.0, 40.0), 0.0))


def test_a_vehicle_that_hardly_turned_is_refused():
    part = swaying_vehicle(0.15, count=4000)
    part = Recording({name: values[:100] for name, values in part.columns.items()})
    with pytest.raises(NotIdentifiableError, match=r"vertical axis, at least once round"):
        calibrate(part, earth=EARTH)


def make_model(rises=0.6):
    axis = torch.tensor([0.0, 0.6, 0.8]).double()
    drawn = Circle(axis, torch.tensor([4.0, -2.0, 9.0]).double(), 35.0)
    return LengthModel("full matrix", 50.0, biased=False, circle=drawn, rises=rises, rises_error=0.02)


def test_residuals_are_distances_from_the_ellipsoid_and_along_it_from_the_circle():
    fitted_model, g = make_model(), torch.Generator().manual_seed(0)
    response = 50.0 * torch.tensor([[1.1, 0.05, 0.0], [0.05, 0.9, 0.1], [0.0, 0.1, 1.2]]).double()
    theta = fitted_model.start(torch.tensor([3.0, 4.0, 5.0]).double(), response)
    assert torch.allclose(fitted_model.response(theta), response)
    axis = torch.nn.functional.normalize(response.mT @ fitted_model.circle.axis, dim=0)
    first = torch.nn.functional.normalize(torch.linalg.cross(axis, torch.tensor([1.0, 0.0, 0.0]).double()), dim=0)
    second = torch.linalg.cross(axis, first)
    angle = torch.linspace(0.0, 6.0, 50).double()[:, None]
    level = angle.cos() * first + angle.sin() * second
    off, tilt = torch.randn(2, 50, 1, generator=g).double()
    tilt = 0.02 * tilt
    on, drawn = (torch.cos(a) * level + torch.sin(a) * axis for a in (0.6 + tilt, torch.tensor(0.6).double()))
    outwards = torch.nn.functional.normalize(torch.linalg.solve(response, on.mT).mT, dim=-1)
    found = fitted_model.residual(theta, on @ response.mT + theta[:3] + off * outwards)
    assert torch.allclose(found[:, :1], off, atol=0.03 * float(off.square().max()))
    moved = torch.linalg.vector_norm((on - drawn) @ response.mT, dim=-1, keepdim=True)
    plain = fitted_model.residual(theta, on @ response.mT + theta[:3])
    assert torch.allclose(plain[:, 1:].abs(), moved, rtol=0.03)
    assert torch.equal(plain[:, 1:].sign(), tilt.sign())


@pytest.mark.parametrize("rises", [0.6, -0.6])
def test_a_turn_without_tilts_is_equally_likely_on_either_side(rises):
    """Mirroring everything at the plane of the circle changes nothing: noise of lengths favours neither side."""
    recording = swaying_vehicle()
    points, place = recording.magnetometer(), PlaceField(EARTH.strength, EARTH.inclination, 0.5, 0.01)
    first = by_place._judged(*_mirrored(points, rises, place))
    other = by_place._judged(*_mirrored(points, -rises, place))
    assert float(first.fit.log_likelihood) == pytest.approx(float(other.fit.log_likelihood), abs=2.0 / len(points))


def _mirrored(points, rises, place):
    fitted_model = by_place._model(length_model.circle(points), place, math.copysign(1.0, rises))
    offset = fitted_model.circle.center - math.sin(fitted_model.rises) * fitted_model.scale * fitted_model.circle.axis
    return fitted_model, fitted_model.start(offset, fitted_model.scale * torch.eye(3).double()), points, place
