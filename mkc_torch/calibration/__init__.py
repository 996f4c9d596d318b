"""Calibration of magnetometers by an ellipsoid fit or by aiding sensors, and its file calibration.json."""

from mkc_torch.calibration.aided.place import earth_field
from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.calibration.field_messages import MagneticFieldMessages, magnetic_field_messages
from mkc_torch.calibration.file import CalibrationFileError
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.plot import CalibrationPlot
from mkc_torch.calibration.result import Calibration

__all__ = [
    "Calibration",
    "CalibrationFileError",
    "CalibrationPlot",
    "EllipsoidFit",
    "MagneticFieldMessages",
    "NotIdentifiableError",
    "calibrate",
    "earth_field",
    "magnetic_field_messages",
]
