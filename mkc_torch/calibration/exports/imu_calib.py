"""Export to ROS's ``imu_calib``: the YAML file of an accelerometer.

Its node ``apply_calib`` corrects the accelerometer of ``sensor_msgs/Imu`` in m/s² (https://github.com/dpkoch/imu_calib,
``accel_calib.cpp``), with ``SM`` row by row::

    corrected = SM * reading - bias
"""

from __future__ import annotations

import numpy as np

from mkc_torch._support.unit_text import ratio
from mkc_torch.calibration.exports.base import MADE_BY, Destination, Export, Exported, ExportError, SensorCorrection
from mkc_torch.calibration.exports.numbers import one_line, yaml_double


def text(correction: SensorCorrection, _to: Destination) -> Exported:
    """Write the correction of an accelerometer.

    Raises:
        ExportError: the correction is not of an acceleration.

    Example:
        >>> matrix = ((2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> print(text(SensorCorrection("imu", "m/s²", (0.1, 0.2, 0.0), matrix, "m/s²"), Destination()).text)
        # Made by mkc_torch: parameters of ROS's imu_calib, of the accelerometer imu
        # corrected = SM reading - bias in m/s²; SM row by row. Give the file as the parameter calib_file.
        SM: [2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        bias: [0.2, 0.2, 0.0]
        <BLANKLINE>
    """
    c = correction
    of_measured, of_field = (ratio(unit, "m/s²") for unit in (c.unit, c.field_unit))
    if of_measured is None or of_field is None:
        raise ExportError(
            f"the calibration is in {c.unit or 'an unknown unit'}, but imu-calib is for accelerometers in m/s²; "
            "nothing was exported. Use `--quantity accel` for an accelerometer, and ros-yaml for a magnetometer."
        )
    matrix = np.array(c.matrix) * (of_field / of_measured)
    bias = matrix @ (np.array(c.offset) * of_measured)
    listed = (", ".join(yaml_double(value) for value in values) for values in (matrix.ravel(), bias))
    return Exported(
        f"# {MADE_BY}: parameters of ROS's imu_calib, of the accelerometer {one_line(c.name)}\n"
        "# corrected = SM reading - bias in m/s²; SM row by row. Give the file as the parameter calib_file.\n"
        "{}".format("".join(f"{name}: [{row}]\n" for name, row in zip(("SM", "bias"), listed, strict=True))),
        c.left_out,
    )


IMU_CALIB = Export("imu-calib", "imu_calib.yaml", text, "in ROS: the parameter calib_file of imu_calib's apply_calib")
