"""Exported corrections, evaluated by the formulas of their files, equal `mkc apply`."""

import json

import numpy as np
import pytest
import torch

from mkc_torch.calibration.exports import EXPORTS, Destination, ExportError
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.io.sensor_correction import sensor_correction
from mkc_torch.diagnosis.model.term import Driver, Term
from mkc_torch.effects.sensor import CurrentField, HardIronStep, MagneticPole, TemperatureOffset
from mkc_torch.recording.recording import Recording
from tests.calibration.exports import formulas

OFFSET = (12.0, -8.0, 21.0)
NORM = (*OFFSET, 0.95, 1.06, 0.99, -0.03, 0.02, -0.016)
TURNED = (*OFFSET, 0.95, -0.05, 0.02, -0.01, 1.06, -0.016, 0.02, 0.03, 0.99)
TOLERANCE = 0.01e-6  # T


def driver(column, reference, unit):
    values = torch.zeros(0, 1, dtype=torch.float64)
    return Driver((column,), "", values, torch.tensor([reference], dtype=torch.float64), (unit,))


def model_of(terms, gammas, theta=NORM, view="norm", unit="µT", simulation="magnetometer"):
    gammas = [torch.tensor(gamma, dtype=torch.float64) for gamma in gammas]
    state = {"view": view, "unit": unit, "strength": 48.0}
    return DiagnosedModel(simulation, state, torch.tensor(theta, dtype=torch.float64), terms, gammas)


CABLE = Term(CurrentField(), driver("current", 3.0, "A"), {})
STEP = Term(HardIronStep(), None, {"onset": 20.0})
TEMPERATURE = Term(TemperatureOffset(), driver("temperature", 25.0, "°C"), {})


def recording(**columns):
    generator = torch.Generator().manual_seed(0)
    points = 45.0 * torch.randn(60, 3, generator=generator, dtype=torch.float64)
    current = 15.0 * torch.rand(60, generator=generator, dtype=torch.float64)
    axes = dict(zip(("mag_x", "mag_y", "mag_z"), points.unbind(-1), strict=True))
    return Recording({"time": torch.arange(60.0)} | axes | {"current": current} | columns)


def field_by_apply(model, of):
    columns, _ = model.correct(of)
    return np.stack([columns[f"field_{axis}"].numpy() for axis in "xyz"], 1) * 1e-6


def fields_by_exported_files(correction, of, current):
    readings = of.magnetometer().numpy() * 1e-6
    texts = {kind: EXPORTS[kind].text(correction, Destination()).text for kind in ("px4", "ardupilot", "json")}
    yield formulas.px4(formulas.qgroundcontrol(texts["px4"]), readings, current)
    yield formulas.ardupilot(formulas.mission_planner(texts["ardupilot"]), readings, current)
    yield formulas.plain_json(json.loads(texts["json"]), readings, current)


@pytest.mark.parametrize("terms", [(), (CABLE,), (STEP,), (CABLE, STEP), (STEP, CABLE)])
def test_exported_files_correct_offset_matrix_current_and_step_as_apply_does(terms):
    """A step depends on the time: apply and the files subtract its final offset from all samples."""
    gammas = [{"current_field": (0.3, -0.2, 0.4), "hard_iron_step": (5.0, -3.0, 2.0)}[t.effect.id] for t in terms]
    model = model_of(terms, gammas)
    of = recording()
    correction = sensor_correction(model, "mast")
    for field in fields_by_exported_files(correction, of, of["current"].numpy()):
        assert np.abs(field - field_by_apply(model, of)).max() < TOLERANCE
    assert (correction.current is not None) == (CABLE in terms)
    text = " ".join(correction.left_out)
    assert ("hard_iron_step depends on the time" in text) == (STEP in terms)


def test_a_current_in_milliamperes_is_exported_in_amperes():
    """4 nT/mA are 4 µT/A, and 3000 mA are 3 A."""
    model = model_of([Term(CurrentField(), driver("battery", 3000.0, "mA"), {})], [(3e-4, -2e-4, 4e-4)])
    found = sensor_correction(model, "mast").current
    assert found.per_ampere == pytest.approx((0.3, -0.2, 0.4))
    assert (found.mean, found.column) == (pytest.approx(3.0), "battery")
    of = recording()
    of = recording(battery=1000.0 * of["current"])
    for field in fields_by_exported_files(sensor_correction(model, "mast"), of, of["current"].numpy()):
        assert np.abs(field - field_by_apply(model, of)).max() < TOLERANCE


def test_other_effects_are_left_out_and_reported():
    """At the mean of the driver, the exported offset equals that of apply."""
    model = model_of([CABLE, TEMPERATURE], [(0.3, -0.2, 0.4), (0.5, 0.1, -0.2)])
    correction = sensor_correction(model, "mast")
    (left_out,) = correction.left_out
    assert left_out.startswith("temperature_offset is left out")
    assert "`temperature` = 25 °C" in left_out
    of = recording(temperature=torch.full((60,), 25.0, dtype=torch.float64))
    for field in fields_by_exported_files(correction, of, of["current"].numpy()):
        assert np.abs(field - field_by_apply(model, of)).max() < TOLERANCE
    assert left_out in EXPORTS["px4"].text(correction, Destination()).text


def test_a_second_current_and_a_current_without_a_unit_are_left_out():
    second = Term(CurrentField(), driver("current_2", 1.0, "A"), {})
    correction = sensor_correction(model_of([CABLE, second], [(0.3, -0.2, 0.4), (0.1, 0.0, 0.0)]), "mast")
    assert correction.current.column == "current"
    assert "holds the field of one current" in correction.left_out[0]
    unknown = Term(CurrentField(), driver("current_2", 1.0, ""), {})
    correction = sensor_correction(model_of([unknown], [(0.3, -0.2, 0.4)]), "mast")
    assert correction.current is None
    assert "no known unit of a current" in correction.left_out[0]


def test_a_location_specific_effect_is_left_out():
    placed = Term(MagneticPole(), driver("position_x", 0.0, "m"), {}, "field_of_the_world")
    correction = sensor_correction(model_of([placed], [(1.0, 1.0, 1.0)]), "mast")
    assert "depends on the location" in correction.left_out[0]
    assert correction.offset == pytest.approx(OFFSET)


def test_a_matrix_with_a_rotation_is_exported_to_json_and_warned_of_elsewhere():
    model = model_of([], [], (*TURNED, 30.0, 0.0, 40.0), "gyro")
    of = recording()
    correction = sensor_correction(model, "mast")
    *_, field = fields_by_exported_files(correction, of, 0.0)
    assert np.abs(field - field_by_apply(model, of)).max() < TOLERANCE
    assert "turns the field by" in EXPORTS["px4"].text(correction, Destination()).warnings[0]


def test_a_model_of_another_simulation_is_refused():
    with pytest.raises(ExportError, match="only magnetometers are exported"):
        sensor_correction(model_of([], [], simulation="Pendulum"), "mast")


def test_a_model_of_another_version_is_refused():
    with pytest.raises(ValueError, match="of another version"):
        sensor_correction(model_of([], [], (*OFFSET, 1.0)), "mast")
