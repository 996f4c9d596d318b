"""An ambient field with a magnetic pole, such as the end of a beam or a bar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.waveforms import apply_basis

if TYPE_CHECKING:
    from jaxtyping import Float

_GRID = (-0.8, -0.4, 0.0, 0.4, 0.8)
"""Positions to search along each axis, over the distance of the farthest sample from the middle of the path."""

_RADIUS = 0.1
"""Radius of the pole, over the same distance."""

_FAR = 3.0
"""Bound of the fitted position along each axis, over the same distance: farther away a field is a polynomial."""


class MagneticPole(Effect):
    """The end of a magnetised beam, bar or pipe distorts the field around it.

    Simulation: adds to the ambient field the field of a pole at a place c, ``q r / (r² + s²)^(3/2)``, with r from c to
    the sensor and s a tenth of the distance of the farthest sample, because no pole is a point. Where the port carries
    the field's vector (east, north, up) there is one amplitude, q; where it carries only the strength there are three,
    q along the axes, because the direction of the ambient field is not known.
    Drivers: the position, three columns.
    Units: q in µT·m², the place in m from the middle of the path.
    Plausible: up to 100 µT·m², a beam of 0.01 m² magnetised to 10⁵ A/m.
    Source: Telford, Geldart & Sheriff, Applied Geophysics (1990), 3.6, the isolated pole.

    Example:
        >>> from mkc_torch.effects import Context
        >>> position = torch.tensor([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])  # in m from the middle of the path
        >>> axes = ("east", "north", "up")
        >>> context = Context(torch.arange(2.0), position, ("m",) * 3, torch.zeros(2, 3), "µT", axes)
        >>> shape = {"place_x": 0.0, "place_y": 0.0, "place_z": 0.0, "radius": 0.0}
        >>> MagneticPole().change(torch.tensor([8.0]), shape, context)
        tensor([[8., 0., 0.],
                [2., 0., 0.]])
    """

    id = "field_gradient"
    port = "field"
    roles = ("position",)
    equation = "B(p) = B₀ + q r / r³,  r = p - c"
    explanation = (
        "The ambient field is not uniform: the end of a beam or a bar of iron is near. Its position is given from the "
        "middle of the path."
    )
    advice = "Record in the open, or turn the sensor on the spot."
    recurrence = "an effect of the place recurs at that place, and is gone in the open"
    form_parameters = ("radius",)
    location_specific = True
    plausible = 100.0
    plausible_unit = "µT·m²"
    source = "a beam of 0.01 m² magnetised to 10⁵ A/m; Telford et al., Applied Geophysics (1990), 3.6"
    relative: Mapping[str, tuple[str, str]] = dict.fromkeys(
        ("place_x", "place_y", "place_z", "radius"), ("driver", "largest")
    )
    fitted_shape: Mapping[str, tuple[float, float]] = {f"place_{axis}": (-_FAR, _FAR) for axis in "xyz"}

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        return tuple(
            {"place_x": x, "place_y": y, "place_z": z, "radius": _RADIUS} for x, y, z in product(_GRID, repeat=3)
        )

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        unit = f"{context.signal_unit}·{context.units[0]}²" if context.units[0] else context.signal_unit
        return (Quantity("pole", 3 if len(context.channels) == 1 else 1, unit),)

    def equation_of(self, shape: Shape, context: Context) -> str:
        strength_only = len(context.channels) == 1
        pole = "q·r / (r² + s²)^(3/2),  B the strength" if strength_only else "q r / (r² + s²)^(3/2)"
        size = sized(float(shape["radius"]), context.units[0])
        return f"B(p) = B₀ + {pole},  r = p − p̄ − c,  s = {size}, chosen, for no pole is a point"

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:
        return ("q_x", "q_y", "q_z") if len(context.channels) == 1 else ()

    def basis(self, shape: Shape, context: Context) -> Float[Tensor, "N c q"]:
        p = context.drivers
        place = torch.stack([torch.as_tensor(shape[f"place_{a}"], dtype=p.dtype, device=p.device) for a in "xyz"])
        away, softening = p - place, p.new_tensor(shape["radius"] ** 2)
        field = away * (away.square().sum(-1, keepdim=True) + softening) ** -1.5
        return field.unsqueeze(1 if len(context.channels) == 1 else -1)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        return apply_basis(self.basis(shape, context), gamma)
