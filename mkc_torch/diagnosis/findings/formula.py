"""Approximate an unnamed curve by a short formula, in the units of the data."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.environment import Curve

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["formulas"]

_MOST_TERMS = 3
"""Largest number of terms."""

_CLOSE = 0.02
"""Relative RMS error at which a formula is accepted."""

_INSIDE = 0.95
"""Share of points in the band at which a formula is accepted."""

_EVEN: dict[str, Callable[[Tensor], Tensor]] = {"{}": lambda x: x, "{}²": torch.square, "{}³": lambda x: x**3}
_SIGNED: dict[str, Callable[[Tensor], Tensor]] = {
    **_EVEN, "|{}|": torch.abs, "{0} |{0}|": lambda x: x * x.abs(), "sign({})": torch.sign
}  # fmt: skip
_FROM_ZERO: dict[str, Callable[[Tensor], Tensor]] = {**_EVEN, "√{}": torch.sqrt}
_POSITIVE: dict[str, Callable[[Tensor], Tensor]] = {
    **_FROM_ZERO, "/ {}": torch.reciprocal, "/ {}²": lambda x: x.square().reciprocal()
}  # fmt: skip


def formulas(curve: Curve) -> tuple[str, ...]:
    """Return, for each channel, a constant plus the fewest terms that stay in the curve's band.

    Args:
        curve: with its 95 % band.

    Returns:
        Formulas such as ``δ(rate of speed) = 0.44 − 0.46 speed + 0.027 speed |speed| rad/s²``, each with its relative
        RMS error.

    Example:
        >>> x = torch.linspace(-2.0, 2.0, 81, dtype=torch.float64)
        >>> value = (-0.5 * x * x.abs()).unsqueeze(-1)
        >>> band = torch.full_like(value, 0.01)
        >>> formulas(Curve("speed", "m/s", x, value, band, ("rate of speed",), "m/s²"))
        ('δ(rate of speed) = −0.5 speed |speed| m/s² (RMS error 0 %)',)
    """
    x = curve.x
    columns = {name: make(x) for name, make in _library(float(x.min()), float(x.max())).items()}
    name = curve.driver
    return tuple(
        _formula(channel, name, curve.value_unit, columns, curve.value[:, k], curve.band[:, k])
        for k, channel in enumerate(curve.channels)
    )


def _library(least: float, most: float) -> dict[str, Callable[[Tensor], Tensor]]:
    """Return the terms that are finite over a range."""
    if least < 0.0:
        return _SIGNED if most > 0.0 else _EVEN
    return _POSITIVE if least > 0.0 else _FROM_ZERO


def _formula(
    channel: str,
    driver: str,
    unit: str,
    columns: dict[str, Float[Tensor, " P"]],
    value: Float[Tensor, " P"],
    band: Float[Tensor, " P"],
) -> str:
    size = value.square().mean().sqrt()
    best: tuple[float, tuple[str, ...], Tensor] | None = None
    for count in range(1, _MOST_TERMS + 1):
        fits = [_fitted(names, columns, value, band) for names in combinations(columns, count)]
        best = min(fits, key=lambda fit: fit[0])
        _, names, coefficients = best
        off = (_summed(names, columns, coefficients) - value).abs()
        if float(off.square().mean().sqrt()) <= _CLOSE * float(size) or float((off <= band).double().mean()) >= _INSIDE:
            break
    assert best is not None
    _, names, coefficients = best
    off = (_summed(names, columns, coefficients) - value).square().mean().sqrt()
    text = _formula_text(names, coefficients, driver, float(size))
    amount = f"{text} {unit}" if unit else text
    return f"δ({channel}) = {amount} (RMS error {100.0 * float(off / size.clamp(min=1e-300)):.0f} %)"


def _fitted(
    names: tuple[str, ...], columns: dict[str, Tensor], value: Tensor, band: Tensor
) -> tuple[float, tuple[str, ...], Tensor]:
    """Return weighted misfit, terms and coefficients, the constant first."""
    weight = (band + 0.01 * value.abs().max()).clamp(min=1e-300).reciprocal().unsqueeze(-1)
    design = torch.stack([torch.ones_like(value), *(columns[name] for name in names)], -1)
    scale = design.abs().amax(0)
    found = torch.linalg.lstsq(weight * design / scale, weight * value.unsqueeze(-1)).solution
    left = weight * (design / scale @ found - value.unsqueeze(-1))
    return float(left.square().sum()), names, found.squeeze(-1) / scale


def _summed(names: tuple[str, ...], columns: dict[str, Tensor], coefficients: Tensor) -> Tensor:
    return coefficients[0] + sum(c * columns[name] for c, name in zip(coefficients[1:], names, strict=True))


def _formula_text(names: tuple[str, ...], coefficients: Tensor, driver: str, size: float) -> str:
    constant, *others = coefficients.tolist()
    terms = [(c < 0, f"{abs(c):.3g} {name.format(driver)}") for c, name in zip(others, names, strict=True)]
    if abs(constant) > 1e-3 * size:
        terms.insert(0, (constant < 0, f"{abs(constant):.3g}"))
    first, *rest = terms
    start = ("−" if first[0] else "") + first[1]
    return start + "".join(f" {'−' if negative else '+'} {text}" for negative, text in rest)
