"""A fluid carries what dips into it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


DIPS = ((2.0, 0.5), *((surface, draught) for surface in (0.5, 0.25, 0.0, -0.25, -0.5) for draught in (0.15, 0.6)))
"""Surface and draught as shares of the largest height; a body is below the first one all the time."""


class Buoyancy(RateEffect):
    """A fluid carries a body by the weight of what it displaces: more, the deeper the body dips in, until it is under.

    A body that is under all the time is pushed up by a constant force, and no data tells the two apart. The effect is
    tried where the height takes either sign: on a long fall it would be a curve of the height alone.

    Simulation: adds ``γ clip((c − x) / h, 0, 1)`` to the rate of the speed whose height is x, which has to grow
        upwards: at x = c the body touches the surface, and h below that it is under.
    Drivers: none but the height: a position whose name begins with ``height``, ``altitude``, ``elevation``, ``heave``
        or ``z``.
    Units: γ in the speed's unit per s; the shapes ``surface``, c, and ``draught``, h, in that of the height.
    Plausible: γ ≥ 0, upwards; g times the ratio of the fluid's density to the body's.
    Source: Archimedes' principle; Newman, "Marine Hydrodynamics" (1977), 6.16, for bodies at the surface.
    """

    id = "buoyancy"
    relative: Mapping[str, tuple[str, str]] = {"surface": ("position", "largest"), "draught": ("position", "largest")}
    needs = ("height", "deflection")  # heights that are measured from about where the surface is
    gain = "lift"
    plot_axis = "position"
    equation = "δv̇ = γ clip((c − x) / h, 0, 1)"
    explanation = "Something carries the body upwards, below a height: it dips into a fluid."
    advice = "Add the weight of the fluid that is displaced."
    source = "Archimedes' principle; Newman, Marine Hydrodynamics (1977)"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return tuple({"surface": surface, "draught": draught} for surface, draught in DIPS)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return ((shape["surface"] - context.part("position")) / shape["draught"]).clamp(0.0, 1.0)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        dip = f"(({shape['surface']!r} - {names['position']}) / {shape['draught']!r}).clamp(0.0, 1.0)"
        return (f"{gamma[0]!r} * {dip}",)
