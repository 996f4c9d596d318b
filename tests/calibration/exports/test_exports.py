import dataclasses
import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.calibration.exports import EXPORTS, CurrentCoefficients, Destination, ExportError, SensorCorrection
from mkc_torch.calibration.exports.numbers import single
from mkc_torch.cli.export_options import KINDS
from mkc_torch.recording.recording import Recording
from tests.calibration.exports import formulas
from tests.calibration.test_calibrate import noisy_ellipsoid, recorded

TOLERANCE_T = 0.01e-6  # T
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
CABLE = CurrentCoefficients((0.3, -0.2, 0.4), 3.0, "current")

size = st.floats(-1.0, 1.0)


@pytest.fixture(scope="module")
def fitted():
    return calibrate(recorded(noisy_ellipsoid(200)))


@st.composite
def calibrations(draw, fitted):
    """Calibrations in any unit of the field: ellipsoids of any direction, near and far, with and without a strength."""
    unit = draw(st.sampled_from(["µT", "uT", "gauss", "G", "mG", "nT", "T", "mT"]))
    in_unit = 1e-6 / formulas.TESLA[unit]
    rotation = np.linalg.qr(np.array(draw(st.lists(size, min_size=9, max_size=9))).reshape(3, 3) + 2 * np.eye(3))[0]
    gains = np.exp(np.array(draw(st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3))))
    matrix = (rotation * (gains / gains.prod() ** (1 / 3))) @ rotation.T
    center = 400.0 * in_unit * np.array(draw(st.lists(size, min_size=3, max_size=3)))
    radius = draw(st.floats(20.0, 70.0)) * in_unit
    strength, field_unit = radius, unit
    if draw(st.booleans()):
        strength, field_unit = draw(st.floats(22.0, 67.0)), "µT"
    matrix = 0.5 * (matrix + matrix.T) * (strength / radius)
    return dataclasses.replace(
        fitted,
        unit=unit,
        center=tuple(center.tolist()),
        matrix=tuple(map(tuple, matrix.tolist())),
        radius=radius,
        field_strength=strength,
        field_unit=field_unit,
    )


def readings_of(calibration, seed):
    """Readings (N, 3) in the calibration's unit, of fields of its strength in all directions."""
    directions = np.random.default_rng(seed).normal(size=(50, 3))
    directions *= calibration.field_strength / np.linalg.norm(directions, axis=1, keepdims=True)
    return directions @ np.linalg.inv(np.array(calibration.matrix)).T + np.array(calibration.center)


def applied(calibration, readings):
    """What `mkc apply` writes, in tesla."""
    columns = {f"mag_{a}": torch.from_numpy(v.copy()) for a, v in zip("xyz", readings.T, strict=True)}
    field = calibration.apply(Recording(columns))
    return np.stack([field[f"field_{a}"].numpy() for a in "xyz"], 1) * formulas.TESLA[calibration.field_unit]


def exported(kind, correction, **place):
    return EXPORTS[kind].text(correction, Destination(**place))


def test_the_command_line_knows_every_kind():
    assert tuple(EXPORTS) == KINDS


@given(data=st.data())
def test_each_documented_formula_equals_what_apply_writes(fitted, data):
    calibration = data.draw(calibrations(fitted))
    readings = readings_of(calibration, data.draw(st.integers(0, 99)))
    expected, in_tesla = applied(calibration, readings), readings * formulas.TESLA[calibration.unit]
    correction = SensorCorrection.of(calibration)
    px4 = formulas.qgroundcontrol(exported("px4", correction, instance=2).text)
    assert np.abs(formulas.px4(px4, in_tesla, instance=2) - expected).max() < TOLERANCE_T
    assert not any("COMP" in name for name in px4)
    ardupilot = formulas.mission_planner(exported("ardupilot", correction, instance=3).text)
    assert np.abs(formulas.ardupilot(ardupilot, in_tesla, instance="3") - expected).max() < TOLERANCE_T
    assert not any("MOT" in name for name in ardupilot)
    numbers = json.loads(exported("json", correction).text)
    assert np.abs(formulas.plain_json(numbers, in_tesla) - expected).max() < 1e-3 * TOLERANCE_T
    header = exported("c-header", correction).text
    field = formulas.c_header(header, in_tesla, calibration.unit, calibration.field_unit)
    assert np.abs(field - expected).max() < TOLERANCE_T


@given(data=st.data())
def test_ros_parameters_give_the_field_that_apply_writes(fitted, data):
    yaml = pytest.importorskip("yaml")
    calibration = data.draw(calibrations(fitted))
    readings = readings_of(calibration, 0)
    parameters = yaml.safe_load(exported("ros-yaml", SensorCorrection.of(calibration)).text)
    field = formulas.magnetometer_pipeline(parameters, readings * formulas.TESLA[calibration.unit])
    assert np.abs(field - applied(calibration, readings)).max() < TOLERANCE_T


def test_the_ros_file_has_the_messages_covariance_in_tesla_squared(fitted):
    """Nine numbers, row by row, as sensor_msgs/MagneticField takes them: those of an undisturbed sample's message."""
    yaml = pytest.importorskip("yaml")
    values = yaml.safe_load(exported("ros-yaml", SensorCorrection.of(fitted)).text)["/**"]["ros__parameters"]
    assert all(isinstance(v, float) for v in values["magnetic_field_covariance"])
    found = np.array(values["magnetic_field_covariance"]).reshape(3, 3)
    noise = 1e-6 * 0.5 * fitted.field_strength * fitted.d  # T, of a calibration in µT
    offset = 1e-12 * np.array(fitted.matrix) @ np.diag(np.square(fitted.center_se)) @ np.array(fitted.matrix).T
    assert found == pytest.approx(noise**2 * np.eye(3) + offset, rel=1e-9)
    numbers = json.loads(exported("json", SensorCorrection.of(fitted)).text)
    assert 1e-12 * numbers["covariance_xx"] == pytest.approx(found[0, 0], rel=1e-9)


def test_a_correction_without_noise_has_no_covariance():
    correction = SensorCorrection("a", "µT", (1.0, 2.0, 3.0), EYE, "µT")
    assert "magnetic_field_covariance:" not in exported("ros-yaml", correction).text.partition("ros__parameters:")[2]
    assert json.loads(exported("json", correction).text)["covariance_xy"] is None


def test_imu_calib_corrects_an_accelerometer_as_apply_does(fitted):
    """`corrected = SM raw - bias`, of accel_calib.cpp."""
    yaml = pytest.importorskip("yaml")
    matrix = ((1.1, 0.02, 0.0), (0.02, 0.9, 0.01), (0.0, 0.01, 1.0))
    correction = SensorCorrection("imu", "m/s²", (0.01, -0.02, 0.03), matrix, "m/s²")
    found = yaml.safe_load(exported("imu-calib", correction).text)
    raw = np.random.default_rng(0).normal(size=(20, 3))
    corrected = raw @ np.array(found["SM"]).reshape(3, 3).T - np.array(found["bias"])
    assert corrected == pytest.approx((raw - correction.offset) @ np.array(correction.matrix).T, rel=1e-6, abs=1e-9)
    with pytest.raises(ExportError, match="--quantity accel"):
        exported("imu-calib", SensorCorrection.of(fitted))


def test_pymavlink_reads_the_parameters_of_ardupilot(fitted, tmp_path, capsys):
    mavparm = pytest.importorskip("pymavlink.mavparm")
    text = exported("ardupilot", SensorCorrection.of(fitted)).text
    path = tmp_path / "a.param"
    path.write_text(text, encoding="utf-8")
    values = mavparm.MAVParmDict()
    values.load(str(path), check=False)
    assert "Invalid" not in capsys.readouterr().out
    assert dict(values) == pytest.approx({name: float(v) for name, v in formulas.mission_planner(text).items()})
    assert len(values) == 10


@given(
    k=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    mean=st.floats(0.0, 40.0),
    most=st.floats(0.0, 80.0),
    unit=st.sampled_from(["µT", "gauss", "nT"]),
)
def test_the_field_of_a_current_goes_into_each_autopilot(fitted, k, mean, most, unit):
    """Against the model's own equation, field = M (m − c − k (I − Ī))."""
    in_unit = 1e-6 / formulas.TESLA[unit]
    center, k = np.array([30.0, -12.0, 55.0]) * in_unit, np.array(k) * in_unit
    matrix, current = np.array(fitted.matrix), np.linspace(0.0, most, 50)
    correction = SensorCorrection(
        "cable",
        unit,
        tuple(center.tolist()),
        fitted.matrix,
        unit,
        None,
        CurrentCoefficients(tuple(k.tolist()), mean, "amps"),
    )
    readings = 50.0 * in_unit * np.random.default_rng(0).normal(size=(50, 3))
    expected = (readings - center - (current - mean)[:, None] * k) @ matrix.T * formulas.TESLA[unit]
    in_tesla = readings * formulas.TESLA[unit]
    px4 = formulas.qgroundcontrol(exported("px4", correction).text)
    assert px4["CAL_MAG_COMP_TYP"] == 2
    assert np.abs(formulas.px4(px4, in_tesla, current) - expected).max() < TOLERANCE_T
    ardupilot = formulas.mission_planner(exported("ardupilot", correction).text)
    assert np.abs(formulas.ardupilot(ardupilot, in_tesla, current) - expected).max() < TOLERANCE_T
    numbers = json.loads(exported("json", correction).text)
    assert np.abs(formulas.plain_json(numbers, in_tesla, current) - expected).max() < TOLERANCE_T


def test_a_current_is_left_out_of_a_ros_file_with_a_warning():
    yaml = pytest.importorskip("yaml")
    correction = SensorCorrection("cable", "µT", (1.0, 2.0, 3.0), EYE, "µT", None, CABLE)
    text, warnings = exported("ros-yaml", correction)
    assert "3 A of the column current" in warnings[0]
    assert warnings[0] in text
    # at the mean current the offset is whole
    parameters = yaml.safe_load(text)
    field = formulas.magnetometer_pipeline(parameters, np.array([[1e-6, 2e-6, 3e-6]]))
    assert np.abs(field).max() < 1e-15


@pytest.mark.parametrize("unit", ["counts", "recorded units", "", "V"])
@pytest.mark.parametrize("kind", ["px4", "ardupilot", "ros-yaml"])
def test_a_calibration_in_unknown_units_is_refused_with_a_remedy(kind, unit):
    """Where the field's strength was given too: the readings' unit is what an autopilot needs."""
    for field_unit in (unit, "µT"):
        with pytest.raises(ExportError, match="--convert mag=gauss"):
            exported(kind, SensorCorrection("a", unit, (1.0, 2.0, 3.0), EYE, field_unit))


@pytest.mark.parametrize("kind", ["c-header", "json"])
def test_exports_for_own_programs_accept_any_unit(kind):
    assert "counts" in exported(kind, SensorCorrection("a", "counts", (1.0, 2.0, 3.0), EYE, "counts")).text


@pytest.mark.parametrize(
    ("unit", "same"), [("Gauss", "gauss"), ("mGauss", "mG"), ("\N{GREEK SMALL LETTER MU}T", "µT"), (" uT ", "µT")]
)
def test_every_spelling_of_a_unit_is_recognised(unit, same):
    texts = [exported("px4", SensorCorrection("a", u, (0.1, 0.2, 0.3), EYE, u)).text for u in (unit, same)]
    assert texts[0] == texts[1]


def test_instance_and_device_id_are_exported_and_checked():
    correction = SensorCorrection("a", "µT", (10.0, 0.0, 0.0), EYE, "µT")
    text = exported("px4", correction, instance=3, device_id=396825).text
    values = formulas.qgroundcontrol(text)
    assert values["CAL_MAG3_ID"] == 396825
    assert "CAL_MAG3_ID" not in text.split("1\t1")[0]
    without = exported("px4", correction).text
    assert "You have to set CAL_MAG0_ID" in without
    assert "CAL_MAG0_ID" not in formulas.qgroundcontrol(without)
    assert set(formulas.mission_planner(exported("ardupilot", correction, instance=2).text)) >= {
        "COMPASS_OFS2_X",
        "COMPASS_DIA2_Y",
        "COMPASS_ODI2_Z",
        "COMPASS_SCALE2",
    }
    for kind, number in (("px4", 4), ("ardupilot", 0), ("ardupilot", 4)):
        with pytest.raises(ExportError, match="--instance"):
            exported(kind, correction, instance=number)
    for identity in (0, 2**31):
        with pytest.raises(ExportError, match="--device-id"):
            exported("px4", correction, device_id=identity)


def test_a_scale_beyond_the_limits_of_ardupilot_is_moved_into_the_diagonal():
    """ArduPilot ignores a scale beyond 1.5, so that it has to be in DIA then."""
    for factor, scale in ((1.2, 1.2), (1.7, 1.0), (0.5, 1.0)):
        matrix = tuple(tuple(factor * v for v in row) for row in EYE)
        text, warnings = exported("ardupilot", SensorCorrection("a", "µT", (0.0, 0.0, 0.0), matrix, "µT"))
        values = formulas.mission_planner(text)
        assert values["COMPASS_SCALE"] == pytest.approx(scale)
        assert values["COMPASS_SCALE"] * values["COMPASS_DIA_X"] == pytest.approx(factor)
        assert bool(warnings) == (scale == 1.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"offset": (190.0, 0.0, 0.0)}, "COMPASS_OFFS_MAX"),
        ({"matrix": ((6.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.5))}, "accepts DIA from 0.2 to 5"),
        ({"matrix": ((2.0, 1.2, 0.0), (1.2, 1.5, 0.0), (0.0, 0.0, 0.8))}, "accepts ODI below 1"),
        ({"field_strength": 95.0}, "arms in a field of 185 to 875 mG"),
        ({"current": CurrentCoefficients((150.0, 0.0, 0.0), 0.0, "I")}, "COMPASS_MOT is limited to 1000 mG/A"),
    ],
)
def test_numbers_beyond_ardupilots_limits_have_warnings(change, words):
    correction = SensorCorrection("a", "µT", (10.0, 0.0, 0.0), EYE, "µT", 48.0)
    assert exported("ardupilot", correction).warnings == ()
    text, warnings = exported("ardupilot", dataclasses.replace(correction, **change))
    assert any(words in warning for warning in warnings)
    assert words in text


def test_a_scale_beyond_px4s_range_has_a_warning():
    matrix = ((3.5, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    assert "from 0.1 to 3" in exported("px4", SensorCorrection("a", "µT", (0.0, 0.0, 0.0), matrix, "µT")).warnings[0]


@pytest.mark.parametrize("kind", ["px4", "ardupilot"])
def test_a_rotation_is_left_out_with_a_warning_and_a_mirror_is_rejected(kind):
    angle = np.radians(3.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    shape = np.array([[1.1, 0.05, 0.0], [0.05, 0.95, -0.02], [0.0, -0.02, 1.0]])
    correction = SensorCorrection("a", "µT", (5.0, 6.0, 7.0), tuple(map(tuple, (turn @ shape).tolist())), "µT")
    text, warnings = exported(kind, correction)
    assert "3.00° about (+0.00, +0.00, +1.00)" in warnings[0]
    readings = np.random.default_rng(1).normal(size=(20, 3)) * 40e-6
    formula, parse = {
        "px4": (formulas.px4, formulas.qgroundcontrol),
        "ardupilot": (formulas.ardupilot, formulas.mission_planner),
    }[kind]
    expected = (readings - np.array([5e-6, 6e-6, 7e-6])) @ shape.T
    assert np.abs(formula(parse(text), readings) - expected).max() < TOLERANCE_T
    mirrored = tuple(map(tuple, (np.diag([1.0, 1.0, -1.0]) @ turn).tolist()))
    with pytest.raises(ExportError, match="mirrors"):
        exported(kind, dataclasses.replace(correction, matrix=mirrored))


def test_names_cannot_end_their_comment():
    """A name with line ends, or with what ends a comment, breaks no file."""
    correction = SensorCorrection("a\n*/ int x; /*\tb", "µT", (10.0, 0.0, 0.0), EYE, "µT", left_out=("one\ntwo */",))
    assert len(formulas.qgroundcontrol(exported("px4", correction).text)) == 9
    assert len(formulas.mission_planner(exported("ardupilot", correction).text)) == 10
    header = exported("c-header", correction).text
    assert "* / int x; / * b" in header
    assert json.loads(exported("json", correction).text)["name"] == correction.name


@given(st.floats(allow_nan=False, allow_infinity=False, width=32))
def test_numbers_of_32_bits_round_trip(value):
    text = single(value)
    assert float(np.float32(text)) == (value if abs(value) >= np.finfo(np.float32).tiny else 0.0)
    assert "e" not in text
    assert "." in text


def test_numbers_beyond_32_bits_are_refused():
    for kind, offset, strength in (("c-header", 1e60, 48.0), ("px4", 1e60, 48.0), ("c-header", 1e-60, 1e-59)):
        with pytest.raises(ExportError, match="32 bits"):
            exported(kind, SensorCorrection("a", "µT", (offset, 0.0, 0.0), EYE, "µT", strength))
