"""The correction that an autopilot applied before it logged the field is undone, or an export is refused."""

import struct

import numpy as np
import pytest
import torch

pytest.importorskip("polars")

from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.calibration.exports import EXPORTS, Destination, ExportError, SensorCorrection
from mkc_torch.recording.logged_correction import corrected_already
from mkc_torch.recording.recording import Recording
from tests.calibration.exports import formulas
from tests.recording.formats import writers

OFFSET = np.array([-97.79, 118.11, 213.18])  # mG, added by the autopilot
DIAGONAL, ODD, SCALE = (0.97, 1.04, 1.01), (0.02, -0.01, 0.03), 1.1
MATRIX = SCALE * np.array([[DIAGONAL[0], ODD[0], ODD[1]], [ODD[0], DIAGONAL[1], ODD[2]], [ODD[1], ODD[2], DIAGONAL[2]]])


def readings():
    """Raw readings in mG: a distorted field with a large offset, which the autopilot's offset leaves in part."""
    draw = np.random.default_rng(1)
    field = draw.normal(size=(400, 3))
    field *= 480.0 / np.linalg.norm(field, axis=1, keepdims=True)
    return field @ np.linalg.inv(MATRIX).T + [120.0, -90.0, -200.0] + draw.normal(scale=2.0, size=(400, 3))


def parameters(suffix="", offset=OFFSET):
    axes = "XYZ"
    values = {f"COMPASS_OFS{suffix}_{axes[k]}": offset[k] for k in range(3)}
    values |= {f"COMPASS_DIA{suffix}_{axes[k]}": DIAGONAL[k] for k in range(3)}
    values |= {f"COMPASS_ODI{suffix}_{axes[k]}": ODD[k] for k in range(3)}
    return values | {f"COMPASS_SCALE{suffix}": SCALE}


def ardupilot(path, logged, known, offsets=None, instance=0):
    """Write a text log with parameters, a pair each, and a row of MAG for each sample."""
    out = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    out.append("FMT, 129, 31, PARM, QNf, TimeUS,Name,Value")
    names = "TimeUS,I,MagX,MagY,MagZ" + (",OfsX,OfsY,OfsZ" if offsets is not None else "")
    out.append(f"FMT, 130, 23, MAG, QB{'f' * (3 if offsets is None else 6)}, {names}")
    out += [f"PARM, 1, {name}, {float(value)!r}" for name, value in known]
    rows = logged if offsets is None else np.concatenate([logged, offsets], 1)
    out += [f"MAG, {20000 * k}, {instance}, " + ", ".join(map(repr, row)) for k, row in enumerate(rows.tolist())]
    path.write_text("\n".join([*out, ""]), encoding="utf-8")


def assert_raw(path, raw_mg):
    recording = Recording.read(path)
    np.testing.assert_allclose(recording.magnetometer().numpy(), 0.1 * raw_mg, atol=1e-9)
    assert any("raw readings" in note for note in recording.notes)
    assert not corrected_already(recording.notes)


def test_parameters_of_ardupilot_are_undone_and_an_export_holds_totals(tmp_path):
    raw, path = readings(), tmp_path / "flight.log"
    ardupilot(path, (raw + OFFSET) @ MATRIX.T, parameters().items())
    assert_raw(path, raw)
    result = calibrate(Recording.read(path), field_strength=48.0)
    text = EXPORTS["ardupilot"].text(SensorCorrection.of(result), Destination()).text
    values = formulas.mission_planner(text)
    assert values["COMPASS_OFS_X"] == pytest.approx(-120.0, abs=3.0)
    assert values["COMPASS_OFS_Z"] == pytest.approx(200.0, abs=3.0)
    length = np.linalg.norm(formulas.ardupilot(values, raw * 1e-7), axis=1)
    assert np.median(np.abs(length - 48e-6)) < 0.3e-6


def test_offsets_of_each_row_count_if_they_change_during_the_log(tmp_path):
    raw, path = readings(), tmp_path / "learning.log"
    offsets = OFFSET + np.linspace(0.0, 40.0, len(raw))[:, None]
    changed = [*parameters().items(), ("COMPASS_OFS_X", 0.0)]
    ardupilot(path, (raw + offsets) @ MATRIX.T, changed, offsets)
    np.testing.assert_allclose(Recording.read(path).magnetometer().numpy(), 0.1 * raw, atol=0.1)


def test_the_compass_is_found_by_its_priority(tmp_path):
    raw, path = readings(), tmp_path / "priority.log"
    wrong = parameters(offset=np.zeros(3))
    ids = {"COMPASS_DEV_ID": 11, "COMPASS_DEV_ID2": 22, "COMPASS_PRIO1_ID": 22, "COMPASS_PRIO2_ID": 11}
    ardupilot(path, (raw + OFFSET) @ MATRIX.T, (wrong | parameters("2") | ids).items())
    assert_raw(path, raw)


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ([], "the log does not contain"),
        ([*parameters().items(), ("COMPASS_DIA_X", 1.2)], "COMPASS_DIA_X changed during the log"),
        ([*parameters().items(), ("COMPASS_OFS_Y", 1.2)], "COMPASS_OFS_Y changed during the log"),
    ],
)
@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_an_export_without_the_parameters_is_refused(tmp_path, known, words, kind):
    path = tmp_path / "flight.log"
    ardupilot(path, readings(), known)
    recording = Recording.read(path)
    np.testing.assert_allclose(recording.magnetometer().numpy(), 0.1 * readings(), atol=1e-9)
    correction = SensorCorrection.of(calibrate(recording))
    with pytest.raises(ExportError, match=words):
        EXPORTS[kind].text(correction, Destination())
    assert "corrected already" in EXPORTS["c-header"].text(correction, Destination()).text


def test_a_table_of_the_message_is_known_to_be_corrected(tmp_path):
    path = tmp_path / "mag.csv"
    rows = [",".join(map(repr, row)) for row in readings().tolist()]
    path.write_text("\n".join(["MagX,MagY,MagZ,OfsX,OfsY,OfsZ", *(f"{row},0,0,0" for row in rows), ""]))
    assert "the file does not contain" in corrected_already(Recording.read(path, units={"mag": "mG"}).notes)


def test_an_uncorrected_log_is_left_as_it_is(tmp_path):
    path = tmp_path / "flight.log"
    ardupilot(path, readings(), [(f"COMPASS_OFS_{axis}", 0.0) for axis in "XYZ"])
    recording = Recording.read(path)
    np.testing.assert_allclose(recording.magnetometer().numpy(), 0.1 * readings(), atol=1e-9)
    assert not corrected_already(recording.notes)


def px4(path, logged, known, bias=None):
    """Write a ULog of ``vehicle_magnetometer`` in gauss, with parameters and perhaps an estimated bias."""
    message = writers._ulog_message
    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1), message("B", bytes(40))]
    out.append(message("F", b"vehicle_magnetometer:uint64_t timestamp;uint32_t device_id;float[3] magnetometer_ga;"))
    out.append(message("F", b"magnetometer_bias_estimate:uint64_t timestamp;float[4] bias_x;"))
    for name, value in known.items():
        key = f"{'int32_t' if isinstance(value, int) else 'float'} {name}".encode()
        body = struct.pack("<i" if isinstance(value, int) else "<f", value)
        out.append(message("P", bytes([len(key)]) + key + body))
    out.append(message("A", struct.pack("<BH", 0, 0) + b"vehicle_magnetometer"))
    if bias is not None:
        out.append(message("A", struct.pack("<BH", 0, 1) + b"magnetometer_bias_estimate"))
        out.append(message("D", struct.pack("<HQ4f", 1, 1, bias, 0.0, 0.0, 0.0)))
    out += [message("D", struct.pack("<HQI3f", 0, 20000 * k, 77, *row)) for k, row in enumerate(logged.tolist())]
    path.write_bytes(b"".join(out))


CAL_MAG = {
    "CAL_MAG1_ID": 77,
    "CAL_MAG1_ROT": 0,
    **{f"CAL_MAG1_{axis}OFF": -1e-3 * float(OFFSET[k]) for k, axis in enumerate("XYZ")},
    **{f"CAL_MAG1_{axis}SCALE": SCALE * DIAGONAL[k] for k, axis in enumerate("XYZ")},
    **{f"CAL_MAG1_{axis}ODIAG": SCALE * ODD[k] for k, axis in enumerate("XYZ")},
}


def test_parameters_of_px4_are_undone(tmp_path):
    pytest.importorskip("pyulog")
    raw, path = readings(), tmp_path / "flight.ulg"
    px4(path, 1e-3 * (raw + OFFSET) @ MATRIX.T, CAL_MAG)
    recording = Recording.read(path)
    torch.testing.assert_close(recording.magnetometer(), torch.tensor(0.1 * raw), atol=1e-4, rtol=0.0)
    EXPORTS["px4"].text(SensorCorrection.of(calibrate(recording)), Destination())


@pytest.mark.parametrize(
    ("known", "bias", "words"),
    [
        ({}, None, "does not contain"),
        ({**CAL_MAG, "CAL_MAG1_ROT": 4}, None, "rotates the axes"),
        ({**CAL_MAG, "CAL_MAG1_ID": 78}, None, "does not contain"),
        (CAL_MAG, 0.02, "changed during the log"),
    ],
)
def test_an_export_of_a_corrected_topic_of_px4_is_refused(tmp_path, known, bias, words):
    pytest.importorskip("pyulog")
    path = tmp_path / "flight.ulg"
    px4(path, 1e-3 * readings(), known, bias)
    with pytest.raises(ExportError, match=f"{words}.*sensor_mag"):
        EXPORTS["px4"].text(SensorCorrection.of(calibrate(Recording.read(path))), Destination())


def test_a_model_of_a_corrected_recording_is_not_exported_to_an_autopilot():
    from mkc_torch.diagnosis.io.sensor_correction import sensor_correction
    from tests.diagnosis.files.test_sensor_correction import model_of

    model = model_of([], [])
    model.state["corrected_already"] = "The logged field is corrected already by COMPASS_OFS."
    with pytest.raises(ExportError, match="COMPASS_OFS"):
        EXPORTS["ardupilot"].text(sensor_correction(model, "mast"), Destination())


def test_the_state_of_a_view_names_a_correction_that_was_not_undone(tmp_path):
    from mkc_torch.simulation import Magnetometer

    path = tmp_path / "flight.log"
    ardupilot(path, readings(), [])
    assert "COMPASS_OFS" in str(Magnetometer().prepare(Recording.read(path)).state["corrected_already"])
