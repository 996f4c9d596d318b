"""Export to ROS: a parameter file of ``magnetometer_pipeline``.

Its ``magnetometer_bias_remover`` (https://docs.ros.org/en/jazzy/p/magnetometer_pipeline, released for ROS 1 and ROS 2)
is the only ROS node that accepts a whole matrix. It computes, from ``sensor_msgs/MagneticField`` in tesla
(``bias_remover.cpp``)::

    field = initial_mag_scaling_matrix * (reading - initial_mag_bias)

and copies ``magnetic_field_covariance`` from the reading's message. So the covariance belongs into that message: the
parameter ``magnetic_field_covariance``, nine numbers in T² row by row as in the message, is for the driver or node that
publishes the reading; ROS 2 ignores parameters that a node does not declare.

Other packages: ``imu_filter_madgwick`` reads only an offset, ``mag_bias_x`` …, and no covariance
(https://docs.ros.org/en/jazzy/p/imu_filter_madgwick); ``imu_transformer`` of ``imu_pipeline`` rotates field and
covariance into another frame (https://github.com/ros-perception/imu_pipeline); ``imu_calib`` is for accelerometers
(:mod:`mkc_torch.calibration.exports.imu_calib`).
"""

from __future__ import annotations

from mkc_torch.calibration.exports.base import MADE_BY, Destination, Export, Exported, SensorCorrection
from mkc_torch.calibration.exports.numbers import one_line, yaml_double
from mkc_torch.calibration.exports.units import converted


def text(correction: SensorCorrection, _to: Destination) -> Exported:
    """Write a correction as parameters.

    Raises:
        ExportError: an unknown unit.

    Example:
        >>> eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> file = text(SensorCorrection("mast", "µT", (12.5, -8.0, 21.0), eye, "µT"), Destination()).text
        >>> file.splitlines()[6]
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
        "magnetic_field_covariance: of an undisturbed sample in T², for the node that publishes the reading.",
        "ROS 2: --ros-args --params-file FILE; ROS 1: only the parameters below ros__parameters.",
        *map(one_line, warnings),
    ]
    rows = [f"    initial_mag_bias_{axis}: {yaml_double(v)}" for axis, v in zip("xyz", found.offset, strict=True)]
    matrix = ", ".join(yaml_double(value) for value in found.matrix.ravel())
    rows.append(f"    initial_mag_scaling_matrix: [{matrix}]")
    if found.covariance is not None:
        rows.append(
            f"    magnetic_field_covariance: [{', '.join(yaml_double(value) for value in found.covariance.ravel())}]"
        )
    lines = [*(f"# {comment}" for comment in comments), "/**:", "  ros__parameters:", *rows]
    return Exported("\n".join(lines) + "\n", tuple(warnings))


ROS_YAML = Export("ros-yaml", "magnetometer.yaml", text, "in ROS 2: --ros-args --params-file")
