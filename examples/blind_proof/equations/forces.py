"""Forces on the rate of a speed: drag, springs, stops, cogging, wind, friction by bristles."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from examples.blind_proof.equations.plant import Array, RateChange

CONTACT_LOSS = 0.2
"""Loss of energy of a bumper, s over the unit of the position."""

Force = Callable[[Array, Array, Array], Sequence[Array]]
"""Returns the change of the rate of each row, given states, own states and size."""


def added(row: int, force: Callable[[Array, Array], Array]) -> RateChange:
    """Return a term that adds ``size · force(states, inputs)`` to the rate of one state."""

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:
        rates = known.copy()
        rates[row] += size * force(x, u)
        return rates, z

    return change


def acting(rows: Sequence[int], force: Force, own: Callable[[Array, Array], Array] = lambda _, z: z) -> RateChange:
    """Return a term that adds a force to the rates of ``rows``.

    Args:
        rows: rows of the states.
        force: the force.
        own: rates of the term's own states, given states and own states.
    """

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:
        rates = known.copy()
        for row, part in zip(rows, force(x, z, size), strict=True):
            rates[row] += part
        return rates, own(x, z)

    return change


def drag_factor(speed: Array, typical: float, reynolds: float) -> Array:
    """Return the drag of a sphere over ``-v``, 1 at the typical speed; its coefficient depends on the Reynolds number.

    Args:
        speed: absolute speed.
        typical: speed at which the Reynolds number is ``reynolds``.
        reynolds: Reynolds number at the typical speed.

    References:
        Schiller & Naumann, "A drag coefficient correlation", VDI-Zeitung 77 (1935), with a floor of 0.42.

    Example:
        >>> float(drag_factor(np.array(2.0), 2.0, 1e3))
        1.0
    """

    def raw(v: Array) -> Array:
        return 0.42 * v / typical + 24.0 / reynolds * (1.0 + 0.15 * (reynolds * v / typical) ** 0.687)

    return raw(speed) / raw(np.asarray(typical))


def sphere_drag(row: int, typical: float, reynolds: float) -> RateChange:
    """Drag on one speed; the size is the deceleration at the typical speed, over that speed."""
    return added(row, lambda x, _: -x[row] * drag_factor(np.abs(x[row]), typical, reynolds))


def flight_drag(rows: tuple[int, int], typical: float, reynolds: float) -> RateChange:
    """Drag on a flying body, along its velocity."""

    def force(x: Array, _: Array, size: Array) -> Sequence[Array]:
        across, up = x[rows[0]], x[rows[1]]
        factor = size * drag_factor(np.hypot(across, up), typical, reynolds)
        return -factor * across, -factor * up

    return acting(rows, force)


def creeping_drag(rows: tuple[int, int], typical: float) -> RateChange:
    """Oseen's drag of a small body in a viscous medium: Stokes' with a first correction for inertia."""

    def force(x: Array, _: Array, size: Array) -> Sequence[Array]:
        across, up = x[rows[0]], x[rows[1]]
        factor = size * (1.0 + 3.0 / 16.0 * 0.5 * np.hypot(across, up) / typical)
        return -factor * across, -factor * up

    return acting(rows, force)


def hardening(row: int, position: int, reach: float) -> RateChange:
    """A flexure whose force grows as a hyperbolic sine; ``size x³`` for deflections far below ``reach``."""
    return added(row, lambda x, _: -6.0 * reach**3 * (np.sinh(x[position] / reach) - x[position] / reach))


def felt(row: int, position: int, reach: float, power: float) -> RateChange:
    """A spring of felt: a power of the deflection, linear below a tenth of ``reach``."""
    return added(row, lambda x, _: -x[position] / reach * ((x[position] / reach) ** 2 + 0.01) ** (0.5 * (power - 1.0)))


def contact(row: int, position: int, place: float, ways: tuple[float, ...]) -> RateChange:
    """A bumper beyond a position, on the sides ``ways`` (1, -1): a Hertz contact with energy loss.

    References:
        Hunt & Crossley, "Coefficient of restitution interpreted as damping in vibroimpact", J. Appl. Mech. 42 (1975).
    """

    def force(x: Array, _: Array) -> Array:
        total = np.zeros_like(x[row])
        for way in ways:
            depth = np.maximum(way * x[position] - place, 0.0)
            total = total - way * depth**1.5 * np.maximum(1.0 + CONTACT_LOSS * way * x[row], 0.0)
        return total

    return added(row, force)


def cogging(row: int, position: int, order: int, phase: float, second: float) -> RateChange:
    """Cogging: a force periodic in the angle, with a share ``second`` of the second harmonic."""
    return added(
        row,
        lambda x, _: np.sin(order * x[position] + phase) + second * np.sin(2.0 * (order * x[position] + phase) + 1.0),
    )


def wind(row: int, speed: float) -> RateChange:
    """A steady wind: by the square of the relative velocity; 1 at standstill."""

    def force(x: Array, _: Array) -> Array:
        relative = 1.0 - x[row] / speed
        return relative * np.abs(relative)

    return added(row, force)


def warming_bias(row: int, constant: float, share: float) -> RateChange:
    """A bias of the actuator that decreases by a share while it warms up; one state of its own."""
    return acting([row], lambda _, z, size: [size * (1.0 - share * z[0])], lambda _, z: (1.0 - z) / constant)


def hum(row: int, frequency: float) -> RateChange:
    """A vibrating machine nearby: an oscillator with its own frequency in Hz, two states of its own."""
    omega = 2.0 * np.pi * frequency

    def own(_: Array, z: Array) -> Array:
        return np.stack([-omega * z[1], omega * (z[0] - 1.0)])

    return acting([row], lambda _, z, size: [size * (z[0] - 1.0)], own)


def lift(rows: tuple[int, int], constant: float) -> RateChange:
    """Magnus force on a spinning body, perpendicular to its velocity; the decaying spin is a state of its own."""

    def force(x: Array, z: Array, size: Array) -> Sequence[Array]:
        spin = size * (1.0 - z[0])
        return -spin * x[rows[1]], spin * x[rows[0]]

    return acting(rows, force, lambda _, z: (1.0 - z) / constant)


def fading_drive(row: int, load: int, gain: float, constant: float) -> RateChange:
    """A motor torque that decreases while the windings heat up; one state of its own."""

    def force(x: Array, z: Array, size: Array) -> Sequence[Array]:
        return [-gain * x[load] * size * z[0] / (1.0 + size * z[0])]

    return acting([row], force, lambda x, z: (x[load] ** 2 - z) / constant)


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

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:
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

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:
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

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:
        v = x[row]
        inner = v * (1.0 - (z / limit) ** 2 * 0.5 * (1.0 + np.sign(v * z)))
        rates = known.copy()
        rates[row] -= size * z.mean(0)
        return rates, inner

    return change
