"""Effects on a vector sensor and the field around it: one piece of physics a file."""

from __future__ import annotations

from mkc_torch.effects.base import Effect
from mkc_torch.effects.sensor.cubic_nonlinearity import CubicNonlinearity
from mkc_torch.effects.sensor.current_field import CurrentField
from mkc_torch.effects.sensor.driver_offset import DriverOffset
from mkc_torch.effects.sensor.field_gradient import FieldGradient
from mkc_torch.effects.sensor.hard_iron_step import HardIronStep
from mkc_torch.effects.sensor.heading_reset import HeadingReset
from mkc_torch.effects.sensor.magnetic_pole import MagneticPole
from mkc_torch.effects.sensor.offset_drift import OffsetDrift
from mkc_torch.effects.sensor.temperature_offset import TemperatureOffset
from mkc_torch.effects.sensor.unknown import Unknown

__all__ = ["ATTITUDE", "SENSOR"]

SENSOR: tuple[Effect, ...] = (
    HardIronStep(),
    OffsetDrift(),
    TemperatureOffset(),
    CurrentField(),
    FieldGradient(),
    MagneticPole(),
    CubicNonlinearity(),
    DriverOffset(),
    Unknown(),
)
"""The candidate effects for a vector sensor."""

ATTITUDE: tuple[Effect, ...] = (HeadingReset(),)
"""The candidate effects for an attitude that is recorded together with a sensor."""
