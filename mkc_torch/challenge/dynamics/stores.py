"""Unmeasured companions of a state: a second store behind a resistance, a mass on a spring."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mkc_torch.challenge.dynamics.plant import Array, RateChange


def second_store(row: int, flow: Callable[[Array], Array]) -> RateChange:
    """A store connected to that of a state, with ``size`` times its capacity; one own state, in the state's unit.

    Args:
        row: row of the state.
        flow: rate of the store, given its distance from the state; both are positive.

    References:
        Bacher & Madsen, "Identifying suitable models for the heat dynamics of buildings", Energy and Buildings 43
        (2011).
    """

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
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

    def change(x: Array, z: Array, u: Array, known: Array, size: Array) -> tuple[Array, Array]:  # noqa: ARG001
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
