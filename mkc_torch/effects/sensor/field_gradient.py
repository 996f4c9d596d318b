"""An ambient field that changes with position, as it does in buildings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.waveforms import apply_basis, per

if TYPE_CHECKING:
    from jaxtyping import Float


class FieldGradient(Effect):
    """Iron in a building distorts the Earth's field, so that it changes with position.

    Simulation: adds a polynomial of degree 1 or 2 of the centred position to the ambient field. Where the port carries
    the field's vector (east, north, up), the polynomial is the gradient of a harmonic polynomial, as in a room without
    sources: 5 terms of degree 1 and 7 of degree 2. Where the port carries only the strength it is any polynomial: 3 and
    6 terms.
    Drivers: the position, three columns.
    Units: gradient in µT/m, curvature in µT/m².
    Plausible: up to 200 µT/m; some µT/cm occur near steel.
    Source: Maxwell's equations in a room without sources; BROAD trial 21 (Laidig et al., Data 6(7):72, 2021).

    Example:
        >>> from mkc_torch.effects import Context
        >>> position = torch.tensor([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.5]])  # in m, less its mean
        >>> context = Context(torch.arange(2.0), position, ("m",) * 3, torch.zeros(2, 1), "µT", ("strength",))
        >>> FieldGradient().change(torch.tensor([3.0, 0.0, 2.0]), {"degree": 1.0}, context).squeeze(-1)
        tensor([-3.,  4.])
    """

    id = "field_gradient"
    port = "field"
    roles = ("position",)
    equation = "B(p) = B₀ + G p + …,  ∇·B = 0, ∇×B = 0"
    explanation = "The ambient field is not uniform: nearby iron distorts it."
    advice = "Record in the open, or turn the sensor on the spot."
    recurrence = "an effect of the place recurs at that place, and is gone in the open"
    form_parameters = ("degree",)
    location_specific = True
    plausible = 200.0
    plausible_unit = "µT/m"
    source = "indoor gradients of up to some µT/cm near steel; BROAD trial 21 (Laidig et al., Data 6(7):72, 2021)"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        return ({"degree": 1.0}, {"degree": 2.0})

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        first = per(context.signal_unit, context.units[0])
        second = f"{first}²" if context.units[0] else first
        sizes = (3, 6) if len(context.channels) == 1 else (5, 7)
        gradient, curvature = Quantity("gradient", sizes[0], first), Quantity("curvature", sizes[1], second)
        return (gradient,) if shape["degree"] < 2 else (gradient, curvature)

    def equation_of(self, shape: Shape, context: Context) -> str:
        quadratic, second = ("", "") if shape["degree"] < 2 else (" + ½ (p − p̄)ᵀ H (p − p̄)", ", H = ∂²B/∂p²")
        if len(context.channels) == 1:
            return f"B(p) = B₀ + g·(p − p̄){quadratic},  B the strength,  g = ∂B/∂p{second} at p̄"
        return f"B(p) = B₀ + G (p − p̄){quadratic},  ∇·B = 0, ∇×B = 0,  G = ∂B/∂p{second} at p̄"

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:
        strength_only = len(context.channels) == 1
        if quantity == "gradient":
            return _STRENGTH_GRADIENT if strength_only else _GRADIENT
        return _STRENGTH_CURVATURE if strength_only else _CURVATURE

    def basis(self, shape: Shape, context: Context) -> Float[Tensor, "N c q"]:
        terms = _polynomials if len(context.channels) == 1 else _harmonic_gradients
        return terms(context.drivers, int(shape["degree"])).mT

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        return apply_basis(self.basis(shape, context), gamma)


_STRENGTH_GRADIENT = ("∂B/∂x", "∂B/∂y", "∂B/∂z")
_STRENGTH_CURVATURE = ("½ ∂²B/∂x²", "½ ∂²B/∂y²", "½ ∂²B/∂z²", "∂²B/∂x∂y", "∂²B/∂x∂z", "∂²B/∂y∂z")
"""The coefficients of :func:`_polynomials` as derivatives of the field's strength."""

_GRADIENT = (
    "∂B_x/∂y = ∂B_y/∂x", "∂B_x/∂z = ∂B_z/∂x", "∂B_y/∂z = ∂B_z/∂y", "(∂B_x/∂x − ∂B_y/∂y) / 2", "∂B_z/∂z / 2",
)  # fmt: skip
_CURVATURE = (
    "∂²B_x/∂y∂z",
    "(∂²B_x/∂x² − 3 ∂²B_x/∂y²) / 24",
    "(3 ∂²B_y/∂x² − ∂²B_y/∂y²) / 24",
    "(∂²B_z/∂x² − ∂²B_z/∂y²) / 4",
    "∂²B_x/∂z² / 8",
    "∂²B_y/∂z² / 8",
    "∂²B_z/∂z² / 12",
)
"""The coefficients of :func:`_harmonic_gradients` as derivatives of the field, in the axes of the position."""


def _polynomials(p: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N f 1"]:
    """The monomials x, y, z and, for degree 2, x², y², z², xy, xz, yz."""
    x, y, z = p.unbind(-1)
    terms = [x, y, z]
    if degree > 1:
        terms += [x * x, y * y, z * z, x * y, x * z, y * z]
    return torch.stack(terms, -1).unsqueeze(-1)


def _harmonic_gradients(p: Float[Tensor, "N 3"], degree: int) -> Float[Tensor, "N f 3"]:
    """Gradients of the harmonic polynomials of degree 2 and, for degree 2, of degree 3 as well."""
    x, y, z = p.unbind(-1)
    o = torch.zeros_like(x)
    fields = [(y, x, o), (z, o, x), (o, z, y), (x, -y, o), (-x, -y, 2 * z)]
    if degree > 1:
        fields += [
            (y * z, x * z, x * y),
            (3 * (x * x - y * y), -6 * x * y, o),
            (6 * x * y, 3 * (x * x - y * y), o),
            (2 * x * z, -2 * y * z, x * x - y * y),
            (4 * z * z - 3 * x * x - y * y, -2 * x * y, 8 * x * z),
            (-2 * x * y, 4 * z * z - x * x - 3 * y * y, 8 * y * z),
            (-6 * x * z, -6 * y * z, 6 * z * z - 3 * x * x - 3 * y * y),
        ]
    return torch.stack([torch.stack(f, -1) for f in fields], 1)
