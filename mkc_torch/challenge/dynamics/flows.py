"""Flows of water and heat between, into and out of states."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mkc_torch.challenge.dynamics.forces import added
from mkc_torch.challenge.dynamics.plant import Array, RateChange

ZERO = 273.15
"""0 °C in K."""


def weir(row: int, rim: float, power: float) -> RateChange:
    """Flow over a rim: Poleni's rectangular weir, power 1.5, or a V-notch, 2.5."""
    return added(row, lambda x, _: -(np.maximum(x[row] - rim, 0.0) ** power))


def seepage(row: int, bend: float) -> RateChange:
    """A leak through gravel by Darcy and Forchheimer: linear for small levels, less than linear for large."""
    return added(row, lambda x, _: -forchheimer(np.maximum(x[row], 0.0), bend))


def forchheimer(head: Array, bend: float) -> Array:
    """Return the flow q ≥ 0 with ``q + bend q² = head``.

    Example:
        >>> float(forchheimer(np.array(6.0), 1.0))
        2.0
    """
    return 2.0 * head / (1.0 + np.sqrt(1.0 + 4.0 * bend * head))


def exchange(first: int, second: int, flow: Callable[[Array], Array], ratio: float) -> RateChange:
    """A flow from the higher state to the lower, by their difference; the second changes by ``-ratio`` times it."""

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
        away = x[second] - x[first]
        passed = size * np.sign(away) * flow(np.abs(away))
        rates = known.copy()
        rates[first] += passed
        rates[second] -= ratio * passed
        return rates, z

    return change


def tap(row: int, head: float) -> RateChange:
    """A dripping tap from a supply of this head: Torricelli's law against the level."""
    return added(row, lambda x, _: np.sqrt(np.maximum(1.0 - x[row] / head, 0.0)))


def slot(row: int, top: float, power: float, throat: float) -> RateChange:
    """A slot that starts at the bottom: flow by a power 1.5 or 2.5 of the level over ``top``."""
    return added(row, lambda x, _: -((np.maximum(x[row], 0.0) / top) ** power) * (1.0 - throat * x[row] / top))


def evaporation(row: int, room: float, wet: float) -> RateChange:
    """Water that evaporates into air at ``room`` °C, by the difference of the vapour pressures.

    Args:
        row: row of the temperature.
        room: room temperature, °C.
        wet: temperature in °C at which the loss is ``size`` K/s.

    References:
        Magnus' formula with the numbers of Sonntag (1990); Dalton's law of evaporation.
    """

    def pressure(temperature: Array) -> Array:
        return np.exp(17.62 * temperature / (243.12 + temperature))

    dry = pressure(np.asarray(room))
    return added(row, lambda x, _: -(pressure(x[row]) - dry) / (pressure(np.asarray(wet)) - dry))


def natural_convection(row: int, room: float, hot: float, power: float) -> RateChange:
    """Natural convection by a power of the excess over ``room`` °C; ``size`` K/s at ``hot`` °C."""

    def force(x: Array, _: Array) -> Array:
        away = (x[row] - room) / (hot - room)
        return -np.sign(away) * np.abs(away) ** power

    return added(row, force)


def radiation(row: int, room: float, slope: float) -> RateChange:
    """Radiation to walls at ``room`` °C, with an emissivity that changes by ``slope`` a K; in K/s near room."""

    def force(x: Array, _: Array) -> Array:
        hot, cold = x[row] + ZERO, room + ZERO
        return -(1.0 + slope * (x[row] - room)) * (hot**4 - cold**4) / (4.0 * cold**3)

    return added(row, force)


def melting(row: int, place: float, width: float) -> RateChange:
    """Wax in the body that melts near a temperature: the heat capacity rises there by the size."""

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
        rates = known.copy()
        rates[row] = known[row] / (1.0 + size * np.exp(-(((x[row] - place) / width) ** 2)))
        return rates, z

    return change
