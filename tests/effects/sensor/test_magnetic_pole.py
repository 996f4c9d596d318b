"""The field of a pole, and the diagnosis of a pole near the path."""

import json
import math
from dataclasses import replace

import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.model.shapes import candidate_terms, reach_of
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects.sensor.field_gradient import FieldGradient
from mkc_torch.effects.sensor.magnetic_pole import MagneticPole
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import Magnetometer
from tests.effects.contexts import make_context

POLE, ENU = MagneticPole(), ("east", "north", "up")
SHAPE = {"place_x": 0.3, "place_y": -0.2, "place_z": 0.5, "radius": 0.0}
ONE = torch.ones(1, dtype=torch.float64)
CENTRE = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
ONE_POINT = make_context(POLE, N=1, channels=ENU)


def field(point):
    return POLE.change(ONE, SHAPE, replace(ONE_POINT, drivers=point.unsqueeze(0)))[0]


def test_field_falls_with_the_square_of_the_distance():
    for far in (1.0, 2.0):
        away = far * torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3.0
        torch.testing.assert_close(field(CENTRE + away), away / far**3)


def test_field_outside_the_pole_has_neither_sources_nor_curl():
    for point in torch.randn(4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64):
        slope = torch.func.jacfwd(field)(point)
        assert float(slope.trace()) == pytest.approx(0.0, abs=1e-9 * float(slope.abs().max()))
        torch.testing.assert_close(slope, slope.mT)


def test_the_field_within_the_radius_of_a_pole_is_finite():
    at = replace(ONE_POINT, drivers=CENTRE.unsqueeze(0))
    assert POLE.change(ONE, {**SHAPE, "radius": 0.1}, at).tolist() == [[0.0, 0.0, 0.0]]


def test_the_change_of_the_field_strength_is_the_field_along_a_fitted_direction():
    context = make_context(POLE, channels=("strength",))
    along = torch.tensor([0.2, 0.5, -0.8], dtype=torch.float64)
    vector = POLE.change(ONE, SHAPE, replace(make_context(POLE, channels=ENU), drivers=context.drivers))
    torch.testing.assert_close(POLE.change(along, SHAPE, context).squeeze(-1), vector @ along)


def columns(seed=0, N=1500):
    """Time, direction and position of a sensor that moves in a room, and its noise of 0.3 µT."""
    generator = torch.Generator().manual_seed(seed)
    time = 0.02 * torch.arange(N, dtype=torch.float64)
    turn = torch.stack([torch.sin(0.9 * time), torch.cos(1.3 * time), torch.sin(1.7 * time + 1.0)], -1)
    direction = turn / torch.linalg.vector_norm(turn, dim=-1, keepdim=True)
    place = torch.stack([1.5 * torch.sin(0.23 * time), torch.cos(0.61 * time), 0.7 * torch.sin(0.41 * time)], -1)
    noise = 0.3 * torch.randn(N, 3, generator=generator, dtype=torch.float64)
    return time, direction, place + torch.tensor([4.0, 0.0, 1.0]), noise


def recording(source, moment):
    """Return a recording of the strength of a field with a pole of this ``moment`` at ``source``."""
    time, direction, place, noise = columns()
    away = place - torch.tensor(source, dtype=torch.float64)
    pole = moment * away / (away.square().sum(-1, keepdim=True) + 0.3**2) ** 1.5
    ambient = torch.tensor([0.0, 20.0, -40.0], dtype=torch.float64)
    length = torch.linalg.vector_norm(ambient + pole, dim=-1, keepdim=True)
    readings = dict(zip(("mag_x", "mag_y", "mag_z"), (length * direction + noise).unbind(-1), strict=True))
    where = dict(zip(("position_x", "position_y", "position_z"), place.unbind(-1), strict=True))
    return Recording({"time": time, **readings, **where}, units=dict.fromkeys(where, "m"))


@pytest.mark.e2e
def test_a_pole_near_the_path_is_located():
    source = (4.9, 0.8, 1.6)
    diagnosis = diagnose(Magnetometer(), recording(source, 4.0))
    finding = diagnosis.findings[0]
    assert finding.effect == "field_gradient"
    assert finding.drivers == ("position_x", "position_y", "position_z")
    known = {parameter.name: parameter for parameter in finding.parameters}
    assert known["pole"].unit == "µT·m²"
    middle = columns()[2].mean(0)
    for axis, there, mean in zip("xyz", source, middle.tolist(), strict=True):
        place = known[f"place_{axis}"]
        assert place.unit == "m"
        assert place.value == pytest.approx(there - mean, abs=0.25)
        assert 0.0 < place.standard_error < 0.25
    assert known["pole"].components == ("q_x", "q_y", "q_z")
    # a chosen number is in the equation and not a parameter
    assert "radius" not in known
    assert f"s = {diagnosis.model.terms[0].shape['radius']:.4g} m, chosen" in finding.equation
    assert [(reference.column, reference.unit) for reference in finding.references] == [
        (name, "m") for name in finding.drivers
    ]
    assert [reference.value for reference in finding.references] == pytest.approx(middle.tolist())
    assert finding.location_specific
    size = math.hypot(*known["pole"].value)
    assert size == pytest.approx(4.0, rel=0.3)
    # the file knows which of the two forms it is
    again = DiagnosedModel.from_json(json.dumps(json.loads(diagnosis.model.to_json())))
    assert isinstance(again.terms[0].effect, MagneticPole)
    assert again.terms[0].shape == diagnosis.model.terms[0].shape


def test_grid_is_around_the_middle_of_the_path():
    seen = recording((9.0, 9.0, 9.0), 0.0)
    prepared = Magnetometer().prepare(seen)
    drivers = find_drivers(prepared.recording, Magnetometer().columns, DriverSettings()).drivers
    terms = candidate_terms(prepared, drivers, (FieldGradient(), POLE))
    away = torch.linalg.vector_norm(drivers[0].values, dim=-1)
    poles = [term for term in terms if term.effect is POLE]
    assert {len(term.shape) for term in poles} == {4}
    assert len({tuple(term.shape.items()) for term in poles}) == len(poles) == len(POLE.shapes(prepared.time))
    assert max(term.shape["place_x"] for term in poles) == pytest.approx(0.8 * float(away.max()))
    low, high = reach_of(poles[0], prepared)["place_z"]
    assert high == -low == pytest.approx(3.0 * float(away.max()))
