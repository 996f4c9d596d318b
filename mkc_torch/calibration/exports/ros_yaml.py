"""Export to ROS: a parameter file of ``magnetometer_pipeline``.

Its ``magnetometer_bias_remover`` (https://docs.ros.org/en/jazzy/p/magnetometer_pipeline, released for ROS 1 and ROS 2)
is the only ROS node that accepts a whole matrix; ``imu_calib`` is for accelerometers, and ``imu_filter_madgwick`` only
accepts an offset. It computes, from ``sensor_msgs/MagneticField`` in tesla (``bias_remover.cpp``)::

    field = initial_mag_scaling_matrix * (reading - initial_mag_bias)
"""

from __future__ import annotations

from mkc_torch.calibration.exports.base import MADE_BY, Destination, Export, Exported, SensorCorrection
from mkc_torch.calibration.exports.numbers import one_line
from mkc_torch.calibration.exports.units import converted

__all__ = ["ROS_YAML"]


def text(correction: SensorCorrection, _to: Destination) -> Exported:
    """Write a correction as parameters.

    Raises:
        ExportError: an unknown unit.

    Example:
        >>> eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> file = text(SensorCorrection("mast", "µT", (12.5, -8.0, 21.0), eye, "µT"), Destination()).text
        >>> file.splitlines()[5]
        '    initial_mag_bias_x: 1.25e-05'
    """
    found = converted(correction, "T", "ros-yaml")
    warnings = list(correction.left_out)
    if correction.current is not None:
        warnings.append(
            "current_field is left out: magnetometer_pipeline does not support currents. The offset is valid at "
            f"{found.mean:.3g} A of the column {correction.current.column}."
        )
    comments = [
        f"{MADE_BY}: parameters of ROS's magnetometer_pipeline, of the magnetometer {one_line(correction.name)}",
        "field = matrix (reading - bias) in tesla, as sensor_msgs/MagneticField is; the matrix row by row.",
        "ROS 2: --ros-args --params-file FILE; ROS 1: only the four parameters.",
        *map(one_line, warnings),
    ]
    rows = [f"    initial_mag_bias_{axis}: {_double(v)}" for axis, v in zip("xyz", found.offset, strict=True)]
    matrix = ", ".join(_double(value) for value in found.matrix.ravel())
    lines = [*(f"# {comment}" for comment in comments), "/**:", "  ros__parameters:", *rows]
    return Exported("\n".join([*lines, f"    initial_mag_scaling_matrix: [{matrix}]"]) + "\n", tuple(warnings))


def _double(value: float) -> str:
    """Format a number so that YAML 1.1 reads it as a number: with a decimal point before an exponent."""
    digits, power, exponent = repr(float(f"{value:.12g}")).partition("e")
    return f"{digits if '.' in digits else digits + '.0'}{power}{exponent}"


ROS_YAML = Export("ros-yaml", "magnetometer.yaml", text, "in ROS 2: --ros-args --params-file")
