"""An actuator that answers late."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.protocol import Context, GainEffect, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

SHARES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05)
"""Delays that are searched, as shares of the longest run."""


class InputDelay(GainEffect):
    """The system answers to what its input was a while ago.

    Simulation: adds ``γ (u(t − τ) − u(t))`` to an input; a γ of one is a pure delay.
    Drivers: none but the input.
    Units: γ is a share; the delay in s.
    Plausible: γ from 0 to 1.
    Source: transport delays; Åström & Murray, "Feedback Systems" (2008), 3.4.
    """

    id = "input_delay"
    port = "input"
    follows_signal = True
    least, most = 0.0, 1.0
    needs: tuple[str, ...] = ("own",)
    plausible = 1.5
    gain = "share"
    continuous: Mapping[str, tuple[float, float]] = {"delay": (0.0005, 0.1)}
    equation = "δu = γ (u(t − τ) − u(t))"
    explanation = "The system answers to its input late."
    advice = "Delay the input by this time."
    source = "transport delays; Åström & Murray, Feedback Systems (2008), 3.4"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time.max() - time.min())
        return tuple({"delay": share * length} for share in SHARES)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, 1, ""),)

    def course(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        time, own = context.time, context.part("own")
        # each run by itself: where time goes back, a new one begins
        run = torch.cat([time.new_zeros(1), (time.diff() < 0).double()]).cumsum(0)
        longest = float(time.max() - time.min()) + shape["delay"] + 1.0
        axis = run * 2.0 * longest + time
        then = axis - shape["delay"]
        at = torch.searchsorted(axis, then, right=True) - 1
        seen = (at >= 0) & (run[at.clamp(min=0)] == run)
        at = torch.where(seen, at, torch.searchsorted(run, run))
        after = torch.where(seen, at + 1, at).clamp(max=len(axis) - 1)
        share = ((then - axis[at]) / (axis[after] - axis[at]).clamp(min=1e-300)).clamp(0.0, 1.0)
        return torch.lerp(own[at], own[after], share) - own

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        return (f"{gamma[0]!r} * (shifted({own}, time, {-shape['delay']!r}) - {own})",)
