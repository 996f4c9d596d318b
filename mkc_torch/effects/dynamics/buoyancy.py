"""Buoyancy of a body that dips into a fluid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


DIPS = ((2.0, 0.5), *((surface, draught) for surface in (0.5, 0.25, 0.0, -0.25, -0.5) for draught in (0.15, 0.6)))
"""Surface and draught as shares of the largest height; below the first surface a body is always submerged."""


class Buoyancy(RateEffect):
    """A fluid lifts a body by the weight of the displaced fluid: the more, the deeper it dips in, until submerged.

    On a body that is always submerged it is a constant force; no data distinguish the two. The effect is tried where
    the height takes both signs: on a long fall it would be a mere curve of the height.

    Simulation: adds ``γ clip((c − x) / h, 0, 1)`` to the rate of the speed whose height is x, positive upwards: at
        x = c the body touches the surface, and at c − h it is submerged.
    Drivers: the height only: a position whose name begins with ``height``, ``altitude``, ``elevation``, ``heave`` or
        ``z``.
    Units: γ in the speed's unit per s; the shapes ``surface``, c, and ``draught``, h, in the unit of the height.
    Plausible: γ ≥ 0, upwards; g times the ratio of the fluid's density to the body's.
    Source: Archimedes' principle; Newman, "Marine Hydrodynamics" (1977), 6.16, for bodies at the surface.
    """

    id = "buoyancy"
    relative: Mapping[str, tuple[str, str]] = {"surface": ("position", "largest"), "draught": ("position", "largest")}
    needs = ("height", "deflection")  # heights measured from near the surface
    gain = "lift"
    plot_axis = "position"
    equation = "δv̇ = γ clip((c − x) / h, 0, 1)"
    explanation = "Below a height an upward force acts on the body: it dips into a fluid."
    advice = "Add the weight of the displaced fluid."
    source = "Archimedes' principle; Newman, Marine Hydrodynamics (1977)"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"surface": surface, "draught": draught} for surface, draught in DIPS)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return ((shape["surface"] - context.part("position")) / shape["draught"]).clamp(0.0, 1.0)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        dip = f"(({shape['surface']!r} - {names['position']}) / {shape['draught']!r}).clamp(0.0, 1.0)"
        return (f"{gamma[0]!r} * {dip}",)
