"""Friction by bristles: it winds up before it slides, and remembers which way."""

from __future__ import annotations

import numpy as np

from mkc_torch.challenge.dynamics.plant import Array, RateChange


def bristles(row: int, deflection: float, speed: float, rise: float = 0.0) -> RateChange:
    """LuGre's friction on the rate of a speed, one own state: the mean deflection of the bristles.

    Args:
        row: of the speed.
        deflection: of the bristles when they slide, in the unit of the position.
        speed: at which the rise has fallen to a third, and that the damping of the bristles is relative to.
        rise: how much larger friction is at standstill, as a share; it falls with ``exp(-|v| / speed)``.

    References:
        Canudas de Wit, Olsson, Åström, Lischinsky, "A new model for control of systems with friction", IEEE TAC 40
        (1995); the exponential after Tustin (1947).
    """

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
        v = x[row]
        level = 1.0 + rise * np.exp(-np.abs(v) / speed)
        inner = v - np.abs(v) * z[0] / (deflection * level)
        rates = known.copy()
        rates[row] -= size * (z[0] / deflection + 0.02 * inner / speed)
        return rates, inner[None]

    return change


def teeth(row: int, deflection: float, load: int, gain: float) -> RateChange:
    """Friction of gear teeth by bristles, in proportion to what drives them: a share and the drive's torque.

    Args:
        row: of the speed.
        deflection: of the bristles when they slide.
        load: the state, such as a motor's current, that presses the teeth together.
        gain: of the load that is as much as the part which is always there.
    """

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
        v = x[row]
        inner = v - np.abs(v) * z[0] / deflection
        rates = known.copy()
        rates[row] -= size * (0.3 + gain * np.abs(x[load])) * z[0] / deflection
        return rates, inner[None]

    return change


def rubber(row: int, yields: tuple[float, ...]) -> RateChange:
    """A rubber bushing: elements of Bouc and Wen's kind that yield one after the other, an own state each.

    ``ż = v (1 − (z / y)² (1 + sign(v z)) / 2)``, the sharper knee of the exponent two.
    """
    limit = np.array(yields)[:, None]

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
        v = x[row]
        inner = v * (1.0 - (z / limit) ** 2 * 0.5 * (1.0 + np.sign(v * z)))
        rates = known.copy()
        rates[row] -= size * z.mean(0)
        return rates, inner

    return change
