"""What autopilots, ROS and C compute from a parameter file, after their own sources, without code of the package."""

import csv
import io
import itertools
import re

import numpy as np

TESLA = {"T": 1.0, "mT": 1e-3, "µT": 1e-6, "uT": 1e-6, "nT": 1e-9, "gauss": 1e-4, "G": 1e-4, "mG": 1e-7}
"""Units of the field in tesla (1 G = 1e-4 T, CODATA)."""


def qgroundcontrol(text):
    """Name to value, as QGroundControl's ParameterManager::readParametersFromStream takes a file."""
    values = {}
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        fields = line.split("\t")
        assert len(fields) == 5, line
        assert fields[:2] == ["1", "1"]
        assert len(fields[2]) <= 16  # MAVLink's param_id
        values[fields[2]] = int(fields[3]) if fields[4] == "6" else np.float32(fields[3])
        assert fields[4] in ("6", "9")
    return values


def mission_planner(text):
    """Name to value, as Mission Planner's ParamFile.loadParamFile takes a file."""
    values = {}
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        name, value = next(csv.reader(io.StringIO(line)))
        assert len(name) <= 16
        assert name not in values
        values[name] = np.float32(value)
    return values


def _symmetric(diagonal, off):
    return np.array([[diagonal[0], off[0], off[1]], [off[0], diagonal[1], off[2]], [off[1], off[2], diagonal[2]]])


def px4(values, readings, current=0.0, instance=0):
    """Magnetometer::Correct with no rotation: readings (N, 3) in tesla to the field in tesla, current in A."""

    def per_axis(what):
        return np.array([values[f"CAL_MAG{instance}_{axis}{what}"] for axis in "XYZ"], dtype=np.float64)

    power = np.zeros(len(readings))
    compensation = np.zeros(3)
    if values.get("CAL_MAG_COMP_TYP") == 2:
        power = np.broadcast_to(current, len(readings)) * 0.001  # kA
        compensation = per_axis("COMP")
    data = readings / TESLA["gauss"]
    scale = _symmetric(per_axis("SCALE"), per_axis("ODIAG"))
    return ((data + power[:, None] * compensation) - per_axis("OFF")) @ scale.T * TESLA["gauss"]


def ardupilot(values, readings, current=0.0, instance=""):
    """AP_Compass_Backend::correct_field: readings (N, 3) in tesla to the field in tesla, current in A."""

    def per_axis(what):
        return np.array([values[f"COMPASS_{what}{instance}_{axis}"] for axis in "XYZ"], dtype=np.float64)

    field = readings / TESLA["mG"] + per_axis("OFS")
    factor = float(values[f"COMPASS_SCALE{instance}"])
    if 1 / 1.5 <= factor <= 1.5:
        field = field * factor
    field = field @ _symmetric(per_axis("DIA"), per_axis("ODI")).T
    if values.get("COMPASS_MOTCT") == 2:
        field = field + np.broadcast_to(current, len(field))[:, None] * per_axis("MOT")
    return field * TESLA["mG"]


def magnetometer_pipeline(parameters, readings):
    """MagnetometerBiasRemover::removeBias, of a parsed parameter file of ROS 2."""
    ((node, body),) = parameters.items()
    assert node == "/**"
    values = body["ros__parameters"]
    bias = np.array([values[f"initial_mag_bias_{axis}"] for axis in "xyz"])
    matrix = np.array(values["initial_mag_scaling_matrix"]).reshape(3, 3)
    assert all(isinstance(v, float) for v in itertools.chain(bias.tolist(), values["initial_mag_scaling_matrix"]))
    return (readings - bias) @ matrix.T


def plain_json(numbers, readings, current=0.0):
    """The formula that the file itself gives; readings in tesla to the field in tesla."""
    offset = np.array([numbers[f"offset_{a}"] for a in "xyz"])
    matrix = np.array([[numbers[f"matrix_{a}{b}"] for b in "xyz"] for a in "xyz"])
    k = np.array([numbers[f"field_per_ampere_{a}"] for a in "xyz"])
    away = np.broadcast_to(np.asarray(current) - numbers["mean_current"], len(readings))[:, None] * k
    field = (readings / TESLA[numbers["unit"]] - offset - away) @ matrix.T
    return field * TESLA[numbers["field_unit"]]


def c_header(text, readings, unit, field_unit):
    """What mag_correct computes in single precision; readings in tesla to the field in tesla."""

    def array(name):
        body = re.search(rf"{name}(?:\[3\])+ = (.*?);", text, re.DOTALL)[1]
        return np.array([np.float32(v) for v in re.findall(r"(-?\d+\.\d+)f", body)])

    offset, matrix = array("mag_offset"), array("mag_matrix").reshape(3, 3)
    away = (readings / TESLA[unit]).astype(np.float32) - offset
    return (away @ matrix.T).astype(np.float64) * TESLA[field_unit]
