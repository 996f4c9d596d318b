"""Bristle friction models: presliding deflection with hysteresis."""

from __future__ import annotations

import numpy as np

from mkc_torch.challenge.dynamics.plant import Array, RateChange


def bristles(row: int, deflection: float, speed: float, rise: float = 0.0) -> RateChange:
    """LuGre friction on the rate of a speed; its own state is the mean deflection of the bristles.

    Args:
        row: row of the speed.
        deflection: deflection of the bristles when they slide, in the unit of the position.
        speed: speed at which the rise has fallen to a third; it also scales the damping of the bristles.
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
    """Bristle friction of gear teeth, in proportion to the load on them.

    Args:
        row: row of the speed.
        deflection: deflection of the bristles when they slide.
        load: state that presses the teeth together, such as a motor's current.
        gain: gain of the load relative to the constant part.
    """

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
        v = x[row]
        inner = v - np.abs(v) * z[0] / deflection
        rates = known.copy()
        rates[row] -= size * (0.3 + gain * np.abs(x[load])) * z[0] / deflection
        return rates, inner[None]

    return change


def rubber(row: int, yields: tuple[float, ...]) -> RateChange:
    """A rubber bushing: Bouc-Wen elements that yield one after the other, each with a state of its own.

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
