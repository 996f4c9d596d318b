"""The ψ functions of M-estimation as weights ψ(z) / z of a standardised residual, and their tuning constants."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

PsiName = Literal["huber", "hampel", "tukey", "andrews", "welsch"]

Tuning = tuple[float, ...]

TUNING_95: dict[PsiName, Tuning] = {
    "huber": (1.345,),
    "hampel": (1.35241275, 3.15562975, 7.212868),
    "tukey": (4.685,),
    "andrews": (1.339,),
    "welsch": (2.985,),
}
"""Tuning constants of efficiency 0.95 at Gaussian residuals.

Holland & Welsch, "Robust regression using iteratively reweighted least-squares", Communications in Statistics A6 (1977)
813-827, table 2; for Hampel's ψ (1.5, 3.5, 8) times 0.9016085, as in robustbase (``.Mpsi.tuning.default``).
"""

BISQUARE_50 = 1.547644980928226
"""Tukey's bisquare tuning constant for a breakdown point of 1/2 (Rousseeuw & Yohai, 1984; 1.547645 in robustbase)."""


def huber_weight(z: Float[Tensor, "*shape"], k: float) -> Float[Tensor, "*shape"]:
    """(16) of Indiveri (2009): ψ(z) = z clamped to ±k."""
    return k / z.abs().clamp(min=k)


def hampel_weight(z: Float[Tensor, "*shape"], a: float, b: float, c: float) -> Float[Tensor, "*shape"]:
    """(13) of Indiveri (2009): ψ is z up to a, constant up to b, and falls linearly to 0 at c."""
    size = z.abs()
    fall = ((c - size) / (c - b)).clamp(min=0.0, max=1.0)
    return fall * a / size.clamp(min=a)


def tukey_weight(z: Float[Tensor, "*shape"], c: float) -> Float[Tensor, "*shape"]:
    """(14) of Indiveri (2009), the biweight: (1 - (z / c)²)² within ±c."""
    return (1.0 - (z / c).square().clamp(max=1.0)).square()


def andrews_weight(z: Float[Tensor, "*shape"], a: float) -> Float[Tensor, "*shape"]:
    """(15) of Indiveri (2009) with ω = 1 / a, over ω so that the weight is 1 at 0: sin(z / a) / (z / a) within ±π a."""
    turn = z / (math.pi * a)
    return torch.where(turn.abs() < 1.0, torch.sinc(turn), 0.0)


def welsch_weight(z: Float[Tensor, "*shape"], c: float) -> Float[Tensor, "*shape"]:
    """exp(-(z / c)²), the weight of a Gaussian kernel."""
    return torch.exp(-(z / c).square())


_WEIGHTS: dict[PsiName, Callable[..., Tensor]] = {
    "huber": huber_weight,
    "hampel": hampel_weight,
    "tukey": tukey_weight,
    "andrews": andrews_weight,
    "welsch": welsch_weight,
}


def _huber_slope(z: Tensor, k: float) -> Tensor:
    return (z.abs() < k).to(z.dtype)


def _hampel_slope(z: Tensor, a: float, b: float, c: float) -> Tensor:
    size = z.abs()
    return (size < a).to(z.dtype) - a / (c - b) * ((size > b) & (size < c)).to(z.dtype)


def _tukey_slope(z: Tensor, c: float) -> Tensor:
    square = (z / c).square().clamp(max=1.0)
    return (1.0 - square) * (1.0 - 5.0 * square)


def _andrews_slope(z: Tensor, a: float) -> Tensor:
    return torch.where(z.abs() < math.pi * a, torch.cos(z / a), 0.0)


def _welsch_slope(z: Tensor, c: float) -> Tensor:
    square = (z / c).square()
    return (1.0 - 2.0 * square) * torch.exp(-square)


_SLOPES: dict[PsiName, Callable[..., Tensor]] = {
    "huber": _huber_slope,
    "hampel": _hampel_slope,
    "tukey": _tukey_slope,
    "andrews": _andrews_slope,
    "welsch": _welsch_slope,
}


@dataclass(frozen=True)
class Psi:
    """ψ with its tuning constants: weight ψ(z) / z in [0, 1], value and slope at standardised residuals."""

    name: PsiName
    tuning: Tuning

    def weight(self, z: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        return _WEIGHTS[self.name](z, *self.tuning)

    def value(self, z: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        return z * self.weight(z)

    def slope(self, z: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        return _SLOPES[self.name](z, *self.tuning)

    def kinks(self) -> Tuning:
        """Positive points at which ψ is not smooth."""
        return (math.pi * self.tuning[0],) if self.name == "andrews" else self.tuning

    def ratio(self) -> float:
        """``E w / E w z²`` at Gaussian residuals: 1.2076 for the bisquare at 95 % efficiency."""
        return _ratio(self)


@lru_cache
def _ratio(psi: Psi) -> float:
    return _gaussian_mean(psi.weight, psi.kinks()) / _gaussian_mean(lambda z: z * psi.value(z), psi.kinks())


def checked_tuning(name: str, tuning: float | Tuning | None) -> tuple[PsiName, Tuning]:
    """Return name and tuning constants, by default those of efficiency 0.95.

    Raises:
        ValueError: unknown ψ, or constants that do not suit it.
    """
    if not isinstance(name, str) or name not in _WEIGHTS:
        raise ValueError(f"Expected argument `psi` to be one of {', '.join(map(repr, _WEIGHTS))} but got {name!r}.")
    known: PsiName = name
    default = TUNING_95[known]
    if tuning is None:
        return known, default
    try:
        given = tuple(float(t) for t in tuning) if isinstance(tuning, (tuple, list)) else (float(tuning),)
    except (TypeError, ValueError, OverflowError):
        given = ()
    rising = all(0 < low <= high for low, high in itertools.pairwise(given)) and given[-2:-1] != given[-1:]
    if len(given) != len(default) or not all(0 < t < math.inf for t in given) or not rising:
        expected = "three numbers 0 < a <= b < c" if name == "hampel" else "one positive number"
        raise ValueError(f"Expected argument `tuning` of {name!r} to be {expected} but got {tuning!r}.")
    return known, given


def _gaussian_mean(values: Callable[[Tensor], Tensor], kinks: Tuning) -> float:
    """E values(|Z|) of a standard Gaussian Z, by Gauss-Legendre between the points where ``values`` is not smooth."""
    edges = sorted({0.0, *(min(k, 12.0) for k in kinks), 12.0})
    nodes, weights = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(80))
    total = 0.0
    for low, high in itertools.pairwise(edges):
        z = 0.5 * (high - low) * nodes + 0.5 * (high + low)
        density = torch.exp(-0.5 * z.square()) * math.sqrt(2.0 / math.pi)
        total += 0.5 * (high - low) * float((weights * density * values(z)).sum())
    return total


def gaussian_efficiency(name: PsiName, tuning: Tuning) -> float:
    """(E ψ')² / E ψ² at Gaussian residuals of known scale; E ψ' = E zψ by Stein's identity."""
    psi = Psi(name, tuning)
    slope = _gaussian_mean(lambda z: z * psi.value(z), psi.kinks())
    return slope**2 / _gaussian_mean(lambda z: psi.value(z).square(), psi.kinks())


def _bisect(function: Callable[[float], float], low: float, high: float) -> float:
    """Root of an increasing function between ``low`` and ``high``, by bisection."""
    for _ in range(70):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if function(middle) > 0 else (middle, high)
    return 0.5 * (low + high)


@lru_cache
def bisquare_for_efficiency(efficiency: float) -> float:
    """Tuning constant of the bisquare with this efficiency at Gaussian residuals: 4.685061 for 0.95."""
    return _bisect(lambda c: gaussian_efficiency("tukey", (c,)) - efficiency, 0.5, 60.0)


@lru_cache
def bisquare_for_breakdown(breakdown: float) -> float:
    """The c with E ρ(Z / c) = breakdown for the bisquare ρ of maximum 1: 1.547645 for 1/2."""
    return _bisect(lambda c: breakdown - _gaussian_mean(lambda z: bisquare_rho(z / c), (c,)), 0.1, 60.0)


def bisquare_rho(u: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Tukey's bisquare ρ scaled to a maximum of 1, for u = residual / (c · scale)."""
    return 1.0 - (1.0 - u.square().clamp(max=1.0)).pow(3)
