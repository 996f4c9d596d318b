"""Flows of water and heat between, into and out of states, and unmeasured stores and masses."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from examples.blind_proof.equations.forces import acting, added
from examples.blind_proof.equations.plant import Array, RateChange

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

    def force(x: Array, _: Array, size: Array) -> Sequence[Array]:
        away = x[second] - x[first]
        passed = size * np.sign(away) * flow(np.abs(away))
        return passed, -ratio * passed

    return acting((first, second), force)


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

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:
        rates = known.copy()
        rates[row] = known[row] / (1.0 + size * np.exp(-(((x[row] - place) / width) ** 2)))
        return rates, z

    return change


def second_store(row: int, flow: Callable[[Array], Array]) -> RateChange:
    """A store connected to that of a state, with ``size`` times its capacity; one own state, in the state's unit.

    Args:
        row: row of the state.
        flow: rate of the store, given its distance from the state; both are positive.

    References:
        Bacher & Madsen, "Identifying suitable models for the heat dynamics of buildings", Energy and Buildings 43
        (2011).
    """

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:
        away = x[row] - z[0]
        taken = np.sign(away) * flow(np.abs(away))
        rates = known.copy()
        rates[row] -= size * taken
        return rates, taken[None]

    return change


def second_mass(row: int, omega: float, damping: float, bend: float) -> RateChange:
    """A mass of ``size`` times the first on a hardening spring. Own states: the spring's deflection, the mass's speed.

    Args:
        row: row of the speed of its support.
        omega: natural frequency of the mass on the spring in rad/s, for small deflections.
        damping: share of critical damping.
        bend: relative increase of the stiffness over the square of the deflection.

    References:
        Den Hartog, "Mechanical Vibrations" (1956), 3.2; Spong, "Modeling and control of elastic joint robots" (1987).
    """

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:
        stretched, pace = z[0], z[1] - x[row]
        pull = omega**2 * stretched * (1.0 + bend * stretched**2) + 2.0 * damping * omega * pace
        rates = known.copy()
        rates[row] += size * pull
        return rates, np.stack([pace, -pull])

    return change


def like(row: int) -> Callable[[Array], Array]:
    """Return initial own states (1, R), equal to one of the states (n, R)."""
    return lambda begin: begin[[row]]


def unstretched(row: int) -> Callable[[Array], Array]:
    """Return initial own states (2, R): a deflection of 0 and the speed of the support."""
    return lambda begin: np.stack([np.zeros_like(begin[row]), begin[row]])


def swung(speed: Array, step: float, omegas: Array, dampings: Array) -> Array:
    """Return the force of masses on springs at a support with known speed, for each unit of mass.

    Args:
        speed: speed of the support (F, R), linear between times.
        step: time step in s.
        omegas: natural frequencies in rad/s (q,).
        dampings: shares of critical damping (q,), below 1.

    Returns:
        (F, R, q).

    Example:
        A support that sets off at once, a quarter and three quarters of the period later:

        >>> speed = (np.arange(500) > 0)[:, None].astype(float)
        >>> pull = swung(speed, 0.01, np.array([1.0]), np.array([1e-6]))[:, 0, 0]
        >>> [round(float(pull[k]), 2) for k in (157, 471)]
        [-1.0, 1.0]
    """
    swing = omegas * np.sqrt(1.0 - dampings**2)
    pole = -dampings * omegas + 1j * swing
    keep = np.exp(pole * step)
    gain = (keep - 1.0) / (pole * step)
    q = np.zeros((*speed.shape, len(omegas)), dtype=np.complex128)
    gained = np.diff(speed, axis=0)[..., None]
    for k in range(1, len(speed)):
        q[k] = keep * q[k - 1] - gain * gained[k - 1]
    deflection = q.imag / swing
    return np.asarray(omegas**2 * deflection + 2.0 * dampings * omegas * (q.real - dampings * omegas * deflection))
