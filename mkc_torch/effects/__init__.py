"""The catalogue of effects: one piece of physics a file, with its drivers, units, size and source.

A user's own effect is a class with the attributes of :class:`Effect`; :class:`GainEffect` makes it a dozen lines.
Each class says what the physics is, how it changes the simulation, what drives it, its units, the size that is
plausible, and where that is from.
"""

from __future__ import annotations

from mkc_torch.effects.base import (
    AnchoredEffect,
    ContinuousEffect,
    Effect,
    GainEffect,
    LastingEffect,
    LinearEffect,
    NestedEffect,
    ShapedEffect,
    SignalEffect,
)
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.courses import lagged
from mkc_torch.effects.dynamics import DYNAMICS
from mkc_torch.effects.dynamics.backlash import played
from mkc_torch.effects.dynamics.rate import beyond
from mkc_torch.effects.paired import PAIRED
from mkc_torch.effects.paired.between import shifted
from mkc_torch.effects.sensor import ATTITUDE, SENSOR
from mkc_torch.effects.share import soft_clip

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
    "beyond",
    "lagged",
    "played",
    "shifted",
    "soft_clip",
]

CATALOGUE: tuple[Effect, ...] = (*SENSOR, *ATTITUDE, *DYNAMICS, *PAIRED)
"""All effects; each is tried where a simulation has its port."""
