"""A resonance that is missing in the equations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import duration, sized
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect, second_mass, size_of_second
from mkc_torch.effects.kinds import MOTION, kind_at
from mkc_torch.effects.runs import first_of_runs, linear_recurrence

if TYPE_CHECKING:
    from jaxtyping import Float, Int

PERIODS = 10
"""Number of periods to search, in a geometric series up to :data:`LONGEST`."""

SAMPLES = 5.0
"""Samples in the shortest period to search."""

SHORTEST = 0.002
"""Shortest period to search, as a share of the longest run."""

LONGEST = 0.25
"""Longest period to search, as a share of the longest run."""

DAMPING = 0.1
"""Damping ratio in the search: the resonance is as wide as the distance of the periods."""

_MIN_DIVISOR = 1e-12
"""Lower limit of divisors."""

_SOMETHING = ("a second store", "of the first", "that swings with it")
"""The second store for a quantity of unknown kind."""

_EXAMPLES = {
    "position": "; a flexible joint, a load on a rope, a liquid that sloshes",
    "speed": "; a flexible joint, a load on a rope, a liquid that sloshes",
    "rotation": "; a flexible joint or belt, a load behind it",
    "angle": "; a flexible joint or belt, a load behind it",
    "level": "; a pipe between two vessels",
    "pressure": "; a long line",
}
"""Examples of the second mass or store, by the kind of quantity."""

_SLOW = 10.0
"""Period in s from which it is reported instead of the frequency."""


def _frequency(period: float) -> str:
    """A frequency in Hz as text, or a long period.

    Example:
        >>> _frequency(0.1408), _frequency(420.0)
        ('7.1 Hz', 'a period of 7 min')
    """
    return sized(float(f"{1.0 / period:.2g}"), "Hz") if period < _SLOW else f"a period of {duration(period)}"


class HiddenMode(RateEffect):
    """A second mass on a spring: a flexible joint or shaft, a load on a rope, sloshing.

    Simulation: adds ``γ (ω² s + 2 ζ ω ṡ)`` to the rate of a speed v, with two internal states: the spring's deflection
        s, 0 at the start of each run, and the second mass's speed w, which starts at v:
        ``ṡ = w − v``, ``ẇ = −ω² s − 2 ζ ω (w − v)``. For a level it is a second surface behind a column with inertia.
    Drivers: the state only, with its history since the start of the run.
    Units: γ, the second mass as a share of the first, is a number, or at the force on a joint its inertia in kg m² or
        kg; the period 2π/ω in s; the damping ratio ζ is a number.
    Plausible: γ from 0 to 10. A second mass on a stiff spring only adds to the first; where that is a parameter of the
        simulation, γ is not identifiable without this bound.
    Source: Den Hartog, "Mechanical Vibrations" (1956), 3.2; Spong, Journal of Dynamic Systems, Measurement, and Control
        109 (1987), for flexible joints; Dodge, "The New Dynamic Behavior of Liquids in Moving Containers" (2000).
    """

    id = "hidden_mode"
    port = "resonant rate"
    is_generalisation = True
    needs = ("own", "flowing")  # heat has no inertia
    continuous: Mapping[str, tuple[float, float]] = {"period": (0.0005, 0.6)}
    fitted_shape: Mapping[str, tuple[float, float]] = {"period": (0.0005, 0.6), "damping": (0.002, 0.9)}
    shape_units: Mapping[str, str] = {"period": "s"}
    upper = 10.0
    gain = "share"
    plot_axis = ""
    equation = "δv̇ = γ (ω² s + 2 ζ ω ṡ),  ṡ = w − v,  ẇ = −ω² s − 2 ζ ω ṡ,  ω = 2π / period"
    explanation = "There is a resonance that is not in the equations."
    advice = "Add a second mass on a spring with this period, such as a flexible joint or a sloshing liquid."
    seconds: Mapping[str, tuple[str, str, str]] = {
        "rotation": ("a second inertia", "of the turning one", "on a flexible shaft"),
        "angle": ("a second inertia", "of the turning one", "on a flexible shaft"),
        "level": ("a second surface", "of the first", "behind a column of liquid with inertia"),
        "pressure": ("a second volume", "of the first", "behind a column with inertia"),
        "voltage": ("a second capacitor", "of the first", "behind a coil"),
        "current": ("a second coil", "of the first", "behind a capacitor"),
    }
    """The second mass or store, what its share refers to, and its connection, by the kind of quantity."""
    source = (
        "Den Hartog, Mechanical Vibrations (1956), 3.2; Spong (1987), for flexible joints; Dodge (2000), for sloshing"
    )

    def second(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        """A phrase with the second mass or store, its size, its frequency and its damping ratio."""
        kind = kind_at(context)
        plain = ("a second mass", "of the moving one", "on a spring") if kind in MOTION else _SOMETHING
        what, of_what, behind = self.seconds.get(kind, plain)
        frequency, damping = _frequency(float(shape["period"])), float(f"{float(shape['damping']):.1g}")
        size = size_of_second(float(gamma[0]), context, of_what)
        return f"{what}, {size}, {behind}: {frequency}, damping ratio {sized(damping)}"

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"Not in the equations is {self.second(gamma, shape, context)}."

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"Add {self.second(gamma, shape, context)}{_EXAMPLES.get(kind_at(context), '')}."

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time.max() - time.min())
        steps = time.diff()
        step = float(steps[steps > 0].median()) if bool((steps > 0).any()) else length
        shortest = min(max(SAMPLES * step, SHORTEST * length), 0.5 * LONGEST * length)
        ratio = (LONGEST * length / max(shortest, _MIN_DIVISOR)) ** (1.0 / (PERIODS - 1))
        return tuple({"period": shortest * ratio**k, "damping": DAMPING} for k in range(PERIODS))

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (second_mass(context),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        """The force and, while a trajectory is solved, the rates of s and w, (N, 3); else along the path, (N, 1)."""
        v, memories, damping = context.part("own"), context.memories, shape["damping"]
        omega = 2.0 * math.pi / shape["period"]
        if memories is None:
            return (gamma[0] * spring_force(v, context.time, omega, damping, context.runs)).unsqueeze(-1)
        s, w = memories.unbind(-1)
        force = omega * (omega * s + 2.0 * damping * (w - v))
        return torch.stack([gamma[0] * force, w - v, -force], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        v, s, w = names["own"], names["memory"], names["memory_2"]
        omega = 2.0 * math.pi / shape["period"]
        force = f"({omega**2!r} * {s} + {2.0 * shape['damping'] * omega!r} * ({w} - {v}))"
        return f"{gamma[0]!r} * {force}", f"{w} - {v}", f"-{force}"


def spring_force(
    speed: Float[Tensor, " N"],
    time: Float[Tensor, " N"],
    omega: float | Tensor,
    damping: float | Tensor,
    run: Int[Tensor, " N"],
) -> Float[Tensor, " N"]:
    """The force of a mass on a spring on a support whose speed is known, per unit of the mass, (N,).

    ``ω² s + 2 ζ ω ṡ`` with ``s̈ + 2 ζ ω ṡ + ω² s = −v̇``, in steady state at the first sample of each run; exact for v
    linear between samples, at any sampling intervals.

    Args:
        speed: v at the samples.
        time: times of the samples in s.
        omega: 2π times the natural frequency, in rad/s.
        damping: damping ratio ζ, between 0 and 1.
        run: number of each sample's run.

    Example:
        A step of the support's speed with an undamped mass behind it, for half a period:

        >>> time = torch.linspace(0.0, torch.pi, 1001, dtype=torch.float64)
        >>> speed = (time > 0.0).double()
        >>> force = spring_force(speed, time, 1.0, 1e-9, torch.zeros(1001, dtype=torch.long))
        >>> [round(float(force[k]), 2) for k in (250, 500, 750)]  # -sin(t)
        [-0.71, -1.0, -0.71]
    """
    omega, damping = (torch.as_tensor(value, dtype=speed.dtype) for value in (omega, damping))
    first = first_of_runs(run)
    step = torch.where(first, 0.0, torch.cat([time.new_zeros(1), time.diff()])).clamp(min=0.0)
    gained = torch.where(first, 0.0, torch.cat([speed.new_zeros(1), speed.diff()]))
    # with the pole p, q = ṡ − p̄ s obeys the first-order equation q̇ = p q − v̇
    swing = omega * (1.0 - damping.square()).sqrt()
    pole = torch.complex(-damping * omega, swing)
    turned = pole * step.clamp(min=_MIN_DIVISOR)
    keep = torch.where(first, 0.0, torch.exp(turned))
    q = linear_recurrence(keep, -gained * (torch.exp(turned) - 1.0) / turned)
    s = q.imag / swing
    return omega.square() * s + 2.0 * damping * omega * (q.real - damping * omega * s)
