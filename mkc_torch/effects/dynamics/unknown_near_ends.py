"""Effect "unknown near ends": a free curve of the position that may be steep near the ends of its range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.unknown_rate import UnknownRate

if TYPE_CHECKING:
    from jaxtyping import Float

DEGREE = 3
"""Degree of the polynomial."""

WIDTHS = (0.4, 0.15)
"""Widths of the terms that rise towards each end of the visited range, as shares of the range."""

NUMBERS = DEGREE + 2 * len(WIDTHS)
"""Numbers of γ."""

_MIN_DIVISOR = 1e-12
"""Lower limit of a range, a divisor."""


class UnknownNearEnds(UnknownRate):
    """The rate of a speed follows a curve of its position that may be steep near the ends of the visited range.

    A ground, a rim or a stop acts near one end only, where a polynomial that follows it oscillates elsewhere.

    Simulation: adds ``f(x)`` to the rate of the speed whose position is x: over the visited range a cubic spline with
        breaks near its ends, beyond the range a cubic up to the largest value, then a constant.
    Drivers: the position only.
    Units: γ in the speed's unit per s; the ends of the range in the unit of the position.
    Plausible: any size, either sign.
    Source: none; it is a curve, not physics. De Boor, "A Practical Guide to Splines" (2001), ch. VIII: truncated
        powers.
    """

    gain = "height"

    def __init__(self) -> None:
        super().__init__("position")
        self._lowest, self._highest = "lowest_of_position", "highest_of_position"
        self.form_parameters = self._lowest, self._highest
        self.relative: Mapping[str, tuple[str, str]] = {
            self._lowest: ("position", "lowest"),
            self._highest: ("position", "highest"),
        }

    def equation_of(self, shape: Shape, context: Context) -> str:
        ends = [sized(float(shape[name]), context.unit_of(self.plot_axis)) for name in self.form_parameters]
        return f"{self.equation} over {' to '.join(ends)}, with breaks near the ends"

    def shapes(self, time: object) -> Sequence[Shape]:
        return ({self._lowest: 1.0, self._highest: 1.0},)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return tuple(Quantity(f"{self.gain}_{j}", 1, context.signal_unit) for j in range(1, NUMBERS + 1))

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        return curve_within(self.over(context), shape[self._lowest], shape[self._highest], gamma).unsqueeze(-1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        ends = f"{shape[self._lowest]!r}, {shape[self._highest]!r}"
        return (f"curve_within({names[self.plot_axis]}, {ends}, [{', '.join(map(repr, gamma))}])",)


def curve_within(
    values: Float[Tensor, " N"], lowest: float, highest: float, heights: Float[Tensor, " q"] | Sequence[float]
) -> Float[Tensor, " N"]:
    """``Σ γ_j P_j(y / r) + Σ γ_k e_k³``: a cubic over ± r, and terms that rise towards the ends of the visited range.

    r is the largest absolute value in the range; beyond it the cubic is constant. ``e = max(1 − d / w, 0)`` with the
    distance d to an end and each width w of :data:`WIDTHS`; beyond the ends e is 1.

    Args:
        values: y.
        lowest, highest: the ends of the visited range.
        heights: γ, for Legendre's P₁ to P₃, then for the lower and the upper end at each width.

    Example:
        >>> found = curve_within(
        ...     torch.tensor([0.0, 1.0, 1.5, 2.0, 3.0]), 1.0, 2.0, [0.0, 0.0, 0.0, 4.0, -2.0, 0.0, 0.0]
        ... )
        >>> found.tolist()
        [4.0, 4.0, 0.0, -2.0, -2.0]
    """
    gamma = torch.as_tensor(heights, dtype=values.dtype, device=values.device)
    t = (values / max(abs(lowest), abs(highest), _MIN_DIVISOR)).clamp(-1.0, 1.0)
    square, span = t * t, max(highest - lowest, _MIN_DIVISOR)
    curves = [t, 1.5 * square - 0.5, 2.5 * t * square - 1.5 * t]
    for share in WIDTHS:
        for distance in (values - lowest, highest - values):
            rise = (1.0 - distance / (share * span)).clamp(0.0, 1.0)
            curves.append(rise * rise * rise)
    return torch.stack(curves, -1) @ gamma
