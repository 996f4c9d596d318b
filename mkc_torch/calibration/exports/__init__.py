"""Export calibrations to the formats of other programs, a module each; add an :class:`Export` to ``EXPORTS``."""

from __future__ import annotations

from mkc_torch.calibration.exports.ardupilot import ARDUPILOT
from mkc_torch.calibration.exports.base import (
    CurrentCoefficients,
    Destination,
    Export,
    Exported,
    ExportError,
    SensorCorrection,
)
from mkc_torch.calibration.exports.c_header import C_HEADER
from mkc_torch.calibration.exports.imu_calib import IMU_CALIB
from mkc_torch.calibration.exports.json import JSON
from mkc_torch.calibration.exports.px4 import PX4
from mkc_torch.calibration.exports.ros_yaml import ROS_YAML

__all__ = ["EXPORTS", "CurrentCoefficients", "Destination", "Export", "ExportError", "Exported", "SensorCorrection"]

EXPORTS: dict[str, Export] = {export.name: export for export in (PX4, ARDUPILOT, C_HEADER, ROS_YAML, IMU_CALIB, JSON)}
"""All exports by their name on the command line."""
