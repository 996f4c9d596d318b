"""A resonance that the equations do not have."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import duration, share_of, sized
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect
from mkc_torch.effects.kinds import MOTION, kind_at
from mkc_torch.effects.runs import first_of_runs, passed_on

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["HiddenMode", "spring_force"]

PERIODS = 10
"""That are searched: from a few samples up to :data:`LONGEST`, each the same times as long as the one before."""

SAMPLES, SHORTEST, LONGEST = 5.0, 0.002, 0.25
"""Samples in the shortest period that is searched; least and greatest one as shares of the longest run."""

DAMPING = 0.1
"""Share of critical damping that is searched: a resonance as wide as the periods are apart."""

_LEAST = 1e-12

_SOMETHING = ("a second store", "of the first", "that swings with it")
"""Of a quantity that is of no known kind."""

_EXAMPLES = {
    "position": "; a flexible joint, a load on a rope, a liquid that sloshes",
    "speed": "; a flexible joint, a load on a rope, a liquid that sloshes",
    "rotation": "; a flexible joint or belt, a load behind it",
    "angle": "; a flexible joint or belt, a load behind it",
    "level": "; a pipe between two vessels",
    "pressure": "; a long line",
}
"""What swings along may be."""

_SLOW = 10.0
"""Period in s from which on it is told in place of a frequency."""


def _frequency(period: float) -> str:
    """A frequency in Hz, or the period where it is long.

    Example:
        >>> _frequency(0.1408), _frequency(420.0)
        ('7.1 Hz', 'a period of 7 min')
    """
    return sized(float(f"{1.0 / period:.2g}"), "Hz") if period < _SLOW else f"a period of {duration(period)}"


class HiddenMode(RateEffect):
    """A second mass on a spring, which swings along: a flexible joint or shaft, a load on a rope, sloshing.

    Simulation: adds ``γ (ω² s + 2 ζ ω ṡ)`` to the rate of a speed v, with two internal states of its own: the spring's
        deflection s, 0 at the beginning of each run, and the second mass's speed w, at first v:
        ``ṡ = w − v``, ``ẇ = −ω² s − 2 ζ ω (w − v)``. Of a level it is a second surface behind a column with inertia.
    Drivers: none but the state, all of its course since the run's beginning.
    Units: γ, the second mass as a share of the first, is a number; the period 2π/ω in s; the damping ζ, as a share of
        critical damping, is a number.
    Plausible: γ from 0 to ten; a second mass on a stiff spring only adds to the first, often a parameter of the
        simulation, and then nothing would hold γ.
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
    explanation = "Something swings along that is not in the equations, with a period of its own."
    advice = "Add a second mass on a spring of this period, as of a flexible joint or of a liquid that sloshes."
    seconds: Mapping[str, tuple[str, str, str]] = {
        "rotation": ("a second inertia", "of the turning one", "on a flexible shaft"),
        "angle": ("a second inertia", "of the turning one", "on a flexible shaft"),
        "level": ("a second surface", "of the first", "behind a column of liquid with inertia"),
        "pressure": ("a second volume", "of the first", "behind a column with inertia"),
        "voltage": ("a second capacitor", "of the first", "behind a coil"),
        "current": ("a second coil", "of the first", "behind a capacitor"),
    }
    """What swings along, what its share is of, and what it hangs on, by the kind of quantity."""
    source = (
        "Den Hartog, Mechanical Vibrations (1956), 3.2; Spong (1987), for flexible joints; Dodge (2000), for sloshing"
    )

    def second(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        """What swings along with its size, its frequency and its damping, as a person says them."""
        kind = kind_at(context)
        plain = ("a second mass", "of the moving one", "on a spring") if kind in MOTION else _SOMETHING
        what, of_what, behind = self.seconds.get(kind, plain)
        times, damping = _frequency(float(shape["period"])), float(f"{float(shape['damping']):.1g}")
        share = share_of(float(gamma[0]))
        return f"{what}, {share} {of_what}, {behind}: {times}, damping ratio {sized(damping)}"

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"Not in the equations is {self.second(gamma, shape, context)}."

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"Add {self.second(gamma, shape, context)}{_EXAMPLES.get(kind_at(context), '')}."

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time.max() - time.min())
        steps = time.diff()
        step = float(steps[steps > 0].median()) if bool((steps > 0).any()) else length
        least = min(max(SAMPLES * step, SHORTEST * length), 0.5 * LONGEST * length)
        ratio = (LONGEST * length / max(least, _LEAST)) ** (1.0 / (PERIODS - 1))
        return tuple({"period": least * ratio**k, "damping": DAMPING} for k in range(PERIODS))

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, 1, ""),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        """The force, and beside it the internal states' rates, where they are solved for; else along the known path."""
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
    """What a mass on a spring pulls with at a support whose speed is known, for each unit of its mass.

    ``ω² s + 2 ζ ω ṡ`` with ``s̈ + 2 ζ ω ṡ + ω² s = −v̇``, at rest at the first sample of each run; exact for intervals of
    any length where v goes straight from sample to sample.

    Args:
        speed: v, at the samples.
        time: of the samples in s.
        omega: 2π times the natural frequency, in rad/s.
        damping: ζ, as a share of critical damping; between 0 and 1.
        run: of each sample's run.

    Example:
        A support that sets off at once, and a mass without damping behind it, for half a period:

        >>> time = torch.linspace(0.0, torch.pi, 1001, dtype=torch.float64)
        >>> speed = (time > 0.0).double()
        >>> force = spring_force(speed, time, 1.0, 1e-9, torch.zeros(1001, dtype=torch.long))
        >>> [round(float(force[k]), 2) for k in (250, 500, 750)]  # -sin(t)
        [-0.71, -1.0, -0.71]
    """
    omega, damping = (torch.as_tensor(one, dtype=speed.dtype) for one in (omega, damping))
    first = first_of_runs(run)
    step = torch.where(first, 0.0, torch.cat([time.new_zeros(1), time.diff()])).clamp(min=0.0)
    gained = torch.where(first, 0.0, torch.cat([speed.new_zeros(1), speed.diff()]))
    # with the pole p, q = ṡ − p̄ s obeys the first-order equation q̇ = p q − v̇
    swing = omega * (1.0 - damping.square()).sqrt()
    pole = torch.complex(-damping * omega, swing)
    turned = pole * step.clamp(min=_LEAST)
    keep = torch.where(first, 0.0, torch.exp(turned))
    q = passed_on(keep, -gained * (torch.exp(turned) - 1.0) / turned)
    s = q.imag / swing
    return omega.square() * s + 2.0 * damping * omega * (q.real - damping * omega * s)
