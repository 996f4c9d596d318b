"""An unnamed smooth force."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import SURROUNDINGS, RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float

DEGREE = 4
"""Degree of the polynomial."""


class UnknownRate(RateEffect):
    """The rate of a state follows a smooth curve: physics outside the catalogue.

    Simulation: adds ``Σ γ_j P_j(x / reach)`` to the rate, with Legendre polynomials P_1 to P_4; x is the state itself,
        its difference from an input that is its surroundings, or the position whose speed it is; beyond the largest
        value in the recording the curve is constant.
    Drivers: the state and its surroundings only.
    Units: γ in the state's unit per s; the reach in the unit of x.
    Plausible: any size, either sign.
    Source: none; it is a curve, not physics.

    Args:
        of: argument x of the curve, ``own``, ``difference`` or ``position``.
    """

    id = "unknown"
    display_name = "an effect outside the catalogue"
    is_curve = True
    lower = -math.inf
    gain = "legendre"
    equation = "δẋ = f(x), a smooth curve"
    explanation = "The rate follows a curve that no effect of the catalogue describes."
    advice = "Look at the curve; find out what acts there."
    source = "none: a curve, not physics"

    def __init__(self, of: str = "own") -> None:
        self.of = of
        part = SURROUNDINGS if of == "difference" else of
        self.plot_axis = "position" if of == "position" else "own"
        self.needs = ("own", part)
        self._reach = f"reach_of_{of}"
        self.form_parameters: tuple[str, ...] = (self._reach,)
        self.relative: Mapping[str, tuple[str, str]] = {self._reach: (part, "largest")}

    def equation_of(self, shape: Shape, context: Context) -> str:
        reach = sized(float(shape[self._reach]), context.unit_of(self.plot_axis))
        argument, input_ = "x", ""
        if self.of == "difference":
            argument, input_ = "(x − u)", f",  u = {context.parts[SURROUNDINGS]}"
        series = f"f(x) = Σ γ_j P_j({argument} / {reach}),  P_j Legendre's polynomials, constant beyond ±1"
        return f"{self.equation},  {series}{input_}"

    def shapes(self, time: object) -> Sequence[Shape]:
        return ({self._reach: 1.0},)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return tuple(Quantity(f"{self.gain}_{j}", 1, context.signal_unit) for j in range(1, DEGREE + 1))

    def over(self, context: Context) -> Float[Tensor, " N"]:
        """The argument of the curve, (N,)."""
        y = context.part(self.plot_axis)
        return y - context.part(SURROUNDINGS) if self.of == "difference" else y

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        t = (self.over(context) / shape[self._reach]).clamp(-1.0, 1.0)
        square = t.square()
        fourth = (35.0 * square.square() - 30.0 * square + 3.0) / 8.0
        curves = torch.stack([t, 1.5 * square - 0.5, 2.5 * t * square - 1.5 * t, fourth], -1)
        return (curves @ gamma).unsqueeze(-1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        y = f"({names['own']} - {names[SURROUNDINGS]})" if self.of == "difference" else names[self.plot_axis]
        t = f"torch.clamp({y} / {shape[self._reach]!r}, -1.0, 1.0)"
        curves = (t, f"(1.5 * {t} ** 2 - 0.5)", f"(2.5 * {t} ** 3 - 1.5 * {t})")
        fourth = f"(35.0 * {t} ** 4 - 30.0 * {t} ** 2 + 3.0) / 8.0"
        return (" + ".join(f"({height!r}) * {curve}" for height, curve in zip(gamma, (*curves, fourth), strict=True)),)
