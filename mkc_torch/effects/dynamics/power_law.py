"""A loss or a restoring force with a fractional exponent."""

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
"""Exponents to search; 1 and 2 are linear and quadratic drag."""

ROUNDED = 1e-3
"""Share of the scale within which the curve is linear, so that its slope at 0 is finite."""

_OF = {"own": "x", "difference": "x − u", "position": "x", "excess": "x − x₀"}
"""The base of the power, in symbols."""


_LOWEST, _HIGHEST = "lowest_of_own", "highest_of_own"

_SPRING = (
    "The restoring force is a power of the deflection, as of a hardening spring.",
    "Add a spring with this exponent: 1 is linear, 1.5 a ball on a plate, 3 a beam at large deflections.",
)
"""Explanation and advice for a power of a position."""


class PowerLaw(RateEffect):
    """A loss or restoring force that is a power of the state: convection, orifice flow, wind, a spring of felt.

    The heat flow of natural convection has exponents 5/4 to 4/3 in the temperature difference, in corners up to 3/2; a
    vessel empties with the square root of its level; drag between Stokes' and Rayleigh's has an exponent between 1 and
    2. Drag, dry friction and a cubic spring are preferred where they explain the recording as well.

    Simulation: adds ``−γ |y/c|ᵖ sign y`` to the rate of a state. By ``of``, y is the state itself; its difference from
        the input that is its surroundings; the excess of a temperature over its lowest value in the recording, if no
        input is its surroundings; or, for a speed, the position. For |y| below c / 1000 the curve is linear.
    Drivers: the state and its surroundings only.
    Units: γ, the size at y = c, in the state's unit per s; the scale c, the largest y, in the unit of y; the exponent p
        is a number.
    Plausible: γ ≥ 0, except for a spring: a negative γ softens it.
    Source: Churchill & Chu, International Journal of Heat and Mass Transfer 18 (1975), natural convection;
        Torricelli's law; Clift, Grace & Weber, "Bubbles, Drops, and Particles" (1978), drag.

    Args:
        of: base of the power, ``own``, ``difference``, ``excess`` or ``position``.
    """

    id = "power_law"
    is_generalisation = True
    fitted_shape: Mapping[str, tuple[float, float]] = {"exponent": (0.3, 6.0)}
    explanation = "The state decays by a power of its size, as by natural convection or through an orifice."
    advice = "Add a term with this exponent, and look for physics that has it."
    by_kind: Mapping[str, tuple[str, str]] = {
        "temperature": (
            "Heat is lost by a power of the excess temperature, as by convection, radiation or evaporation.",
            "Add a loss of heat by this power of the excess temperature: 1.2 to 1.5 is natural convection, more than 2 "
            "evaporation or radiation.",
        ),
        "level": (
            "The level falls by a power of itself, as an orifice or a weir lets out.",
            "Add an outflow with this exponent: 0.5 is an orifice, 1.5 a weir.",
        ),
        "pressure": (
            "The pressure falls by a power of itself, as an orifice lets out.",
            "Add an outflow with this exponent: 0.5 is an orifice, 1 a narrow pipe.",
        ),
        **dict.fromkeys(
            ("speed", "rotation"),
            (
                "The motion is braked by a power of its speed.",
                "Add a drag with this exponent: 1 is viscous, 2 that of air or water at speed.",
            ),
        ),
    }
    source = "Churchill & Chu (1975), natural convection; Torricelli's law; Clift, Grace & Weber (1978), drag"

    def __init__(self, of: str = "own") -> None:
        self.of = of
        part = SURROUNDINGS if of == "difference" else of
        self.plot_axis = "position" if of == "position" else "own"
        # a power of a temperature in °C has no physical meaning
        needs = {"own": ("own", "flowing"), "position": ("position", "deflection"), "excess": ("own", "temperature")}
        self.needs = needs.get(of, ("own", part))
        self.lower = -math.inf if of == "position" else 0.0
        self.gain = "stiffness" if of == "position" else "loss"
        self._scale = f"scale_of_{of}"
        self.relative: Mapping[str, tuple[str, str]] = {self._scale: (part, "largest")}
        if of == "excess":
            self.excludes = (SURROUNDINGS,)  # where they are known, the difference from them is used
            self.relative = {_LOWEST: ("own", "lowest"), _HIGHEST: ("own", "highest")}
        elif of == "position":
            self.by_kind, self.explanation, self.advice = {}, _SPRING[0], _SPRING[1]
        self.form_parameters = tuple(self.relative)
        self.equation = f"δ{'v̇' if of == 'position' else 'ẋ'} = −γ |({_OF[of]})/c|ᵖ sign({_OF[of]})"

    def equation_of(self, shape: Shape, context: Context) -> str:
        if self.of == "excess":
            low, high = float(shape[_LOWEST]), float(shape[_HIGHEST])
            lowest = sized(low, context.unit_of("own"))
            return f"{self.equation},  x₀ = {lowest}, the lowest of the recording,  c = {sized(high - low, 'K')}"
        scale = sized(float(shape[self._scale]), context.unit_of(self.plot_axis))
        input_ = f",  u = {context.parts[SURROUNDINGS]}" if self.of == "difference" else ""
        return f"{self.equation},  c = {scale}, the largest of the recording{input_}"

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"{super().explained(gamma, shape, context)}{self._counted_from(shape, context)}"

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"{super().advised(gamma, shape, context)}{self._counted_from(shape, context)}"

    def _counted_from(self, shape: Shape, context: Context) -> str:
        """A sentence on the reference of a difference or an excess; empty for the state itself."""
        if self.of == "excess":
            lowest = sized(float(shape[_LOWEST]), context.unit_of("own"))
            return f" The excess is counted from {lowest}, the lowest of the recording."
        return f" It is counted from {context.parts[SURROUNDINGS]}." if self.of == "difference" else ""

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({**dict.fromkeys(self.relative, 1.0), "exponent": exponent} for exponent in EXPONENTS)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        y = context.part(self.plot_axis)
        if self.of == "difference":
            y = y - context.part(SURROUNDINGS)
        t = (y - shape[_LOWEST]) / self._reach(shape) if self.of == "excess" else y / shape[self._scale]
        return -t * (t.square() + ROUNDED**2) ** (0.5 * (shape["exponent"] - 1.0))

    def _reach(self, shape: Shape) -> float:
        """The largest excess; 1 for a constant temperature."""
        return (shape[_HIGHEST] - shape[_LOWEST]) or 1.0

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        y = names[self.plot_axis]
        if self.of == "difference":
            y = f"({y} - {names[SURROUNDINGS]})"
        raised = round(0.5 * (shape["exponent"] - 1.0), 12)
        if self.of == "excess":
            t = f"(({y} - {shape[_LOWEST]!r}) / {float(self._reach(shape))!r})"
        else:
            t = f"({y} / {shape[self._scale]!r})"
        return (f"-({gamma[0]!r}) * {t} * ({t} ** 2 + {ROUNDED**2!r}) ** {raised!r}",)
