"""A loss or a restoring force by a power that is no whole number."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import SURROUNDINGS, RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float

EXPONENTS = (0.5, 1.25, 1.5, 1.75, 2.5, 3.0)
"""That are searched; 1 and 2 are those of linear and quadratic drag."""

ROUNDED = 1e-3
"""Share of the scale within which the curve is straight, so that its slope at 0 is finite."""

_OF = {"own": "x", "difference": "x − u", "position": "x"}


class PowerLaw(RateEffect):
    """A state is driven back by a power of itself: convection, flow through an orifice, wind, a spring of felt.

    Natural convection carries heat off with the 5/4th to 4/3rd power of the difference in temperature, in corners up to
    the 3/2nd; a vessel empties with the square root of its level; drag between Stokes' and Rayleigh's has an exponent
    between 1 and 2. What drag, dry friction or a cubic spring explains as well is theirs.

    Simulation: adds ``−γ |y/c|ᵖ sign y`` to the rate of a state, y the state itself, its difference to an input that is
        its surroundings, or the position whose speed it is; within a thousandth of c about 0 the curve is straight.
    Drivers: none but the state and its surroundings.
    Units: γ in the state's unit per s, what there is of it at y = c; the scale c, the largest y, in that of y; the
        exponent p is a number.
    Plausible: γ ≥ 0, but for a spring, which softens with a negative one.
    Source: Churchill & Chu, International Journal of Heat and Mass Transfer 18 (1975), of natural convection;
        Torricelli's law; Clift, Grace & Weber, "Bubbles, Drops, and Particles" (1978), of drag.

    Args:
        of: what it is a power of, ``own``, ``difference`` or ``position``.
    """

    id = "power_law"
    general = True
    fitted_shape: Mapping[str, tuple[float, float]] = {"exponent": (0.3, 6.0)}
    explanation = "Something drives the state back by a power of its size, as natural convection or an orifice does."
    advice = "Add a term with this exponent; it tells what kind of flow or spring it is."
    source = "Churchill & Chu (1975), of natural convection; Torricelli's law; Clift, Grace & Weber (1978), of drag"

    def __init__(self, of: str = "own") -> None:
        self.of = of
        part = SURROUNDINGS if of == "difference" else of
        self.along = "position" if of == "position" else "own"
        # of a temperature in °C a power is no physics
        self.needs = {"own": ("own", "flowing"), "position": ("position", "deflection")}.get(of, ("own", part))
        self.least = -math.inf if of == "position" else 0.0
        self.gain = "stiffness" if of == "position" else "loss"
        self._scale = f"scale_of_{of}"
        self.choices = (self._scale,)
        self.relative: Mapping[str, tuple[str, str]] = {self._scale: (part, "largest")}
        self.equation = f"δ{'v̇' if of == 'position' else 'ẋ'} = −γ |({_OF[of]})/c|ᵖ sign({_OF[of]})"

    def equation_of(self, shape: Shape, context: Context) -> str:
        scale = sized(float(shape[self._scale]), context.unit_of(self.along))
        beside = f",  u = {context.parts[SURROUNDINGS]}" if self.of == "difference" else ""
        return f"{self.equation},  c = {scale}, the largest of the recording{beside}"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return tuple({self._scale: 1.0, "exponent": exponent} for exponent in EXPONENTS)

    def course(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        y = context.part(self.along)
        if self.of == "difference":
            y = y - context.part(SURROUNDINGS)
        t = y / shape[self._scale]
        return -t * (t.square() + ROUNDED**2) ** (0.5 * (shape["exponent"] - 1.0))

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        y = names[self.along]
        if self.of == "difference":
            y = f"({y} - {names[SURROUNDINGS]})"
        t, raised = f"({y} / {shape[self._scale]!r})", round(0.5 * (shape["exponent"] - 1.0), 12)
        return (f"-({gamma[0]!r}) * {t} * ({t} ** 2 + {ROUNDED**2!r}) ** {raised!r}",)
