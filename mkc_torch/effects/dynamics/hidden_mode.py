"""A resonance that the equations do not have."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect
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
    general = True
    needs = ("own", "flowing")  # heat has no inertia
    continuous: Mapping[str, tuple[float, float]] = {"period": (0.0005, 0.6)}
    fitted_shape: Mapping[str, tuple[float, float]] = {"period": (0.0005, 0.6), "damping": (0.002, 0.9)}
    shape_units: Mapping[str, str] = {"period": "s"}
    most = 10.0
    gain = "share"
    along = ""
    equation = "δv̇ = γ (ω² s + 2 ζ ω ṡ),  ṡ = w − v,  ẇ = −ω² s − 2 ζ ω ṡ,  ω = 2π / period"
    explanation = "Something swings along that is not in the equations, with a period of its own."
    advice = "Add a second mass on a spring of this period, as of a flexible joint or of a liquid that sloshes."
    by_kind: Mapping[str, tuple[str, str]] = {
        "level": (
            "The level swings with a second surface, by a period of its own.",
            "Add a second surface behind a column of liquid with inertia, as in a pipe between two vessels.",
        ),
        "pressure": (
            "The pressure swings with a second volume, by a period of its own.",
            "Add a second volume behind a column with inertia, as in a long line.",
        ),
        "voltage": (
            "The voltage rings, with a period of its own.",
            "Add a coil and a second capacitor that ring with this period.",
        ),
        "current": (
            "The current rings, with a period of its own.",
            "Add a capacitor and a second coil that ring with this period.",
        ),
    }
    source = (
        "Den Hartog, Mechanical Vibrations (1956), 3.2; Spong (1987), for flexible joints; Dodge (2000), for sloshing"
    )

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
