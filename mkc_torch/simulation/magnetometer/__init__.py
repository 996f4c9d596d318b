"""The magnetometer: a constant ambient field, an offset and a matrix; effects describe all further physics."""

from mkc_torch.simulation.magnetometer.correction import MagnetometerCorrection
from mkc_torch.simulation.magnetometer.sensor import Magnetometer

__all__ = ["Magnetometer", "MagnetometerCorrection"]
