"""The catalogue of effects: one piece of physics a file, with its drivers, units, size and source.

A user's own effect is a class derived from :class:`Effect`; :class:`GainEffect` makes it a dozen lines. The docstring
of each class states the physics, its change of the simulation, its drivers, units and plausible size, and the source.

To add an effect to the catalogue, write it into a file of its own and enter it in the list of that folder's
``__init__``: ``sensor/`` and ``SENSOR`` for a vector sensor and the field around it (``ATTITUDE`` for a recorded
attitude), ``dynamics/`` and ``DYNAMICS`` for rates, inputs and outputs of differential equations, ``paired/`` and
``PAIRED`` for outputs of simulations without a state. What all effects share has defaults in :class:`Effect`; override
what differs. The tests run one common suite over every effect of the catalogue, the new effect included.
"""

from __future__ import annotations

from mkc_torch.effects.base import Effect, GainEffect, in_words
from mkc_torch.effects.clock import resampled
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics import DYNAMICS
from mkc_torch.effects.dynamics.input_transport_delay import travelled
from mkc_torch.effects.dynamics.rate import beyond
from mkc_torch.effects.dynamics.unknown_near_ends import curve_within
from mkc_torch.effects.kinds import kind_of
from mkc_torch.effects.paired import PAIRED
from mkc_torch.effects.paired.between import shifted
from mkc_torch.effects.per_recording import selected_size
from mkc_torch.effects.sensor import ATTITUDE, SENSOR
from mkc_torch.effects.share import soft_clip
from mkc_torch.effects.waveforms import lagged, played, rate_limited

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
    "curve_within",
    "is_curve",
    "kind_of",
    "lagged",
    "played",
    "rate_limited",
    "resampled",
    "selected_size",
    "shifted",
    "soft_clip",
    "travelled",
    "words_of",
]

# all that these classes required has a default in Effect
AnchoredEffect = Effect
"""Another name of :class:`Effect`, for files of users that import it."""
ContinuousEffect = Effect
"""Another name of :class:`Effect`, for files of users that import it."""
LastingEffect = Effect
"""Another name of :class:`Effect`, for files of users that import it."""
LinearEffect = Effect
"""Another name of :class:`Effect`, for files of users that import it."""
NestedEffect = Effect
"""Another name of :class:`Effect`, for files of users that import it."""
ShapedEffect = Effect
"""Another name of :class:`Effect`, for files of users that import it."""
SignalEffect = Effect
"""Another name of :class:`Effect`, for files of users that import it."""

CATALOGUE: tuple[Effect, ...] = (*SENSOR, *ATTITUDE, *DYNAMICS, *PAIRED)
"""All effects; each is tried where a simulation has its port."""

_NAMES = {effect.id: effect.display_name for effect in CATALOGUE}
_NAMES_BY_KIND = {(effect.id, kind): name for effect in CATALOGUE for kind, name in effect.display_name_by_kind.items()}
_CURVES = frozenset(effect.id for effect in CATALOGUE if effect.is_curve)


def words_of(effect_id: str, kind: str = "") -> str:
    """The name of an effect in a report; for a user's own effect, its id in words.

    Args:
        effect_id: id of the effect.
        kind: kind of the quantity it acts on, such as "temperature", see :func:`kind_of`; empty if not known.

    Example:
        >>> words_of("linear_drag"), words_of("linear_drag", "temperature")
        ('linear drag', 'loss of heat')
        >>> words_of("hard_iron_step"), words_of("coulomb_friction"), words_of("unknown"), words_of("supply_offset")
        ('hard-iron step', 'Coulomb friction', 'an effect outside the catalogue', 'supply offset')
    """
    return _NAMES_BY_KIND.get((effect_id, kind)) or _NAMES.get(effect_id) or in_words(effect_id)


def is_curve(effect_id: str) -> bool:
    """Whether the catalogue's effect with this id is a curve fitted to the data rather than physics.

    Example:
        >>> is_curve("unknown"), is_curve("linear_drag")
        (True, False)
    """
    return effect_id in _CURVES
