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
    """A leak through gravel by Darcy and Forchheimer: linear for small levels, less so for large ones."""
    return added(row, lambda x, _: -forchheimer(np.maximum(x[row], 0.0), bend))


def forchheimer(head: Array, bend: float) -> Array:
    """Flow q ≥ 0 with ``q + bend q² = head``.

    Example:
        >>> float(forchheimer(np.array(6.0), 1.0))
        2.0
    """
    return 2.0 * head / (1.0 + np.sqrt(1.0 + 4.0 * bend * head))


def exchange(one: int, other: int, flow: Callable[[Array], Array], ratio: float) -> RateChange:
    """A flow from the higher of two states to the lower, of their difference; ``ratio`` of what one loses is gained."""

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
        away = x[other] - x[one]
        passed = size * np.sign(away) * flow(np.abs(away))
        rates = known.copy()
        rates[one] += passed
        rates[other] -= ratio * passed
        return rates, z

    return change


def tap(row: int, head: float) -> RateChange:
    """A dripping tap on a main of that head: by Torricelli, against the level."""
    return added(row, lambda x, _: np.sqrt(np.maximum(1.0 - x[row] / head, 0.0)))


def radiation(row: int, room: float, slope: float) -> RateChange:
    """Radiation to walls at ``room`` °C, with an emissivity that changes by ``slope`` a K; in K/s near room."""

    def force(x: Array, _: Array) -> Array:
        hot, cold = x[row] + ZERO, room + ZERO
        return -(1.0 + slope * (x[row] - room)) * (hot**4 - cold**4) / (4.0 * cold**3)

    return added(row, force)


def melting(row: int, place: float, width: float) -> RateChange:
    """Wax in the body that melts about a temperature: its heat capacity rises there by the size."""

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
        rates = known.copy()
        rates[row] = known[row] / (1.0 + size * np.exp(-(((x[row] - place) / width) ** 2)))
        return rates, z

    return change
