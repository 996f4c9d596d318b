"""The catalogue of effects: one piece of physics a file, with its drivers, units, size and source.

A user's own effect is a class with the attributes of :class:`Effect`; :class:`GainEffect` makes it a dozen lines.
Each class says what the physics is, how it changes the simulation, what drives it, its units, the size that is
plausible, and where that is from.
"""

from __future__ import annotations

from mkc_torch.effects.cubic_nonlinearity import CubicNonlinearity
from mkc_torch.effects.current_field import CurrentField
from mkc_torch.effects.driver_offset import DriverOffset
from mkc_torch.effects.dynamics import DYNAMICS
from mkc_torch.effects.field_gradient import FieldGradient
from mkc_torch.effects.hard_iron_step import HardIronStep
from mkc_torch.effects.heading_reset import HeadingReset
from mkc_torch.effects.magnetic_pole import MagneticPole
from mkc_torch.effects.offset_drift import OffsetDrift
from mkc_torch.effects.paired import PAIRED
from mkc_torch.effects.protocol import (
    AnchoredEffect,
    Context,
    ContinuousEffect,
    Effect,
    GainEffect,
    LastingEffect,
    LinearEffect,
    NestedEffect,
    Quantity,
    Shape,
    ShapedEffect,
    SignalEffect,
)
from mkc_torch.effects.temperature_offset import TemperatureOffset
from mkc_torch.effects.unknown import Unknown

__all__ = [
    "ATTITUDE",
    "CATALOGUE",
    "DYNAMICS",
    "PAIRED",
    "SENSOR",
    "AnchoredEffect",
    "Context",
    "ContinuousEffect",
    "Effect",
    "GainEffect",
    "LastingEffect",
    "LinearEffect",
    "NestedEffect",
    "Quantity",
    "Shape",
    "ShapedEffect",
    "SignalEffect",
]

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
"""The effects that a diagnosis of a sensor tries."""

ATTITUDE: tuple[Effect, ...] = (HeadingReset(),)
"""The effects of an attitude that is recorded beside a sensor."""

CATALOGUE: tuple[Effect, ...] = (*SENSOR, *ATTITUDE, *DYNAMICS, *PAIRED)
"""All effects; each is tried where a simulation has its port."""
