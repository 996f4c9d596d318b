"""A force that no named effect describes, as a curve of the state, of its surroundings or of its position."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import SURROUNDINGS, RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["NUMBERS", "UnknownRate", "spline_within"]

NUMBERS = 6
"""Of the curve: of its seven splines the middle one is left out, for a constant is no shape."""

CUBIC = 3


class UnknownRate(RateEffect):
    """The rate of a state follows a curve over a part of the motion: physics that the catalogue does not have.

    Simulation: adds ``f(y)`` to the rate, y the state itself, its difference to an input that is its surroundings, or
        the position whose speed it is. f is a sum of cubic B-splines over the visited range, and constant beyond its
        ends, where they are narrower than in its middle: what is near a ground, a rim or a stop acts there alone, and a
        polynomial that follows it sways everywhere else.
    Drivers: none but the state and its surroundings.
    Units: γ, the height of each spline but the middle one, in the state's unit per s; the ends of the range in that of
        what the curve is over.
    Plausible: any size, either sign.
    Source: none; it is a curve and no physics. De Boor, "A Practical Guide to Splines" (2001), ch. IX, of the splines.

    Args:
        of: what the curve is over, ``own``, ``difference`` or ``position``.
    """

    id = "unknown"
    words = "an effect outside the catalogue"
    is_curve = True
    least = -math.inf
    gain = "height"
    equation = "δẋ = f(x), a smooth curve"
    explanation = "The rate follows a curve that no effect of the catalogue describes."
    advice = "Look at the curve; find out what acts there."
    source = "none: a curve, not physics"

    def __init__(self, of: str = "own") -> None:
        self.of = of
        part = SURROUNDINGS if of == "difference" else of
        self.along = "position" if of == "position" else "own"
        self.needs = tuple(dict.fromkeys(("own", part)))
        self.choices = self._lowest, self._highest = f"lowest_of_{of}", f"highest_of_{of}"
        ends = {self._lowest: (part, "lowest"), self._highest: (part, "highest")}
        self.relative: Mapping[str, tuple[str, str]] = ends

    def equation_of(self, shape: Shape, context: Context) -> str:
        unit = context.unit_of(self.along)
        ends = " to ".join(sized(float(shape[name]), unit) for name in (self._lowest, self._highest))
        beside = f",  u = {context.parts[SURROUNDINGS]}" if self.of == "difference" else ""
        of = "f(x − u)" if self.of == "difference" else "f(x)"
        return f"δẋ = {of}, a smooth curve over {ends}, constant beyond{beside}"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return ({self._lowest: 1.0, self._highest: 1.0},)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return tuple(Quantity(f"{self.gain}_{j}", 1, context.signal_unit) for j in range(1, NUMBERS + 1))

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        y = context.part(self.along)
        if self.of == "difference":
            y = y - context.part(SURROUNDINGS)
        return spline_within(y, shape[self._lowest], shape[self._highest], gamma).unsqueeze(-1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        y = names[self.along]
        if self.of == "difference":
            y = f"{y} - {names[SURROUNDINGS]}"
        ends = f"{shape[self._lowest]!r}, {shape[self._highest]!r}"
        return (f"spline_within({y}, {ends}, [{', '.join(map(repr, gamma))}])",)


def spline_within(
    values: Float[Tensor, " N"], lowest: float, highest: float, heights: Float[Tensor, " q"] | Sequence[float]
) -> Float[Tensor, " N"]:
    """A curve over a range, of cubic B-splines that are narrower near its ends; constant beyond them.

    The q − 2 intervals of the range are bounded by Chebyshev's places, ``(low + high) / 2 − (high − low) / 2 cos(π j /
    (q − 2))``. The middle one of the q + 1 splines is left out, for all of them together are a constant.

    Args:
        values: where.
        lowest, highest: the ends of the range.
        heights: what the other splines are multiplied by, an even number of at least four; the first and the last are
            the curve's values at the ends.

    Example:
        >>> found = spline_within(torch.tensor([-1.0, 0.0, 0.25, 1.0, 2.0]), 0.0, 1.0, [4.0, 1.0, 0.0, 0.0, 0.0, -2.0])
        >>> [round(float(one), 2) for one in found]
        [4.0, 4.0, 0.18, -2.0, -2.0]
    """
    given = torch.as_tensor(heights, dtype=values.dtype, device=values.device)
    if not highest > lowest:
        return 0.0 * given[0] * values  # a range without width has no curve
    places, turned = (one.to(values) for one in _truncated(len(given)))
    half = len(given) // 2
    amplitudes = turned @ torch.cat([given[:half], given.new_zeros(1), given[half:]])
    u = ((values - lowest) / (highest - lowest)).clamp(0.0, 1.0)
    return _powers(u, places) @ amplitudes


def _powers(u: Float[Tensor, " N"], places: Float[Tensor, " k"]) -> Float[Tensor, "N q"]:
    """``1, u, u², u³`` and for each place ``max(u − p, 0)³``: the same curves as of the splines, and far quicker."""
    beyond = (u.unsqueeze(-1) - places).clamp(min=0.0)
    return torch.cat([torch.stack([torch.ones_like(u), u, u * u, u * u * u], -1), beyond * beyond * beyond], -1)


@lru_cache(maxsize=4)
def _truncated(count: int) -> tuple[Float[Tensor, " k"], Float[Tensor, "q q"]]:
    """The places inside of the range [0, 1], and what each spline is in powers that begin there."""
    turn = torch.arange(count - 1, dtype=torch.float64) * (math.pi / (count - 2))
    places = 0.5 * (1.0 - turn.cos())
    knots = torch.cat([places.new_zeros(CUBIC), places, places.new_ones(CUBIC)])
    share = torch.tensor([0.1, 0.4, 0.6, 0.9], dtype=torch.float64)
    at = torch.lerp(places[:-1, None], places[1:, None], share).reshape(-1, 1)
    splines = ((at >= knots[:-1]) & (at < knots[1:])).double()
    for degree in range(1, CUBIC + 1):
        width = knots[degree:] - knots[:-degree]
        share = torch.where(width > 0.0, (at - knots[:-degree]) / torch.where(width > 0.0, width, 1.0), 0.0)
        rest = torch.where(width > 0.0, 1.0 - share, 0.0)
        splines = share[:, :-1] * splines[:, :-1] + rest[:, 1:] * splines[:, 1:]
    return places[1:-1], torch.linalg.lstsq(_powers(at[:, 0], places[1:-1]), splines).solution
