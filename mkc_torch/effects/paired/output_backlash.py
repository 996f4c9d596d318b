"""Backlash between simulated and measured outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import SEVERAL, Context, Quantity, Shape
from mkc_torch.effects.runs import first_of_runs
from mkc_torch.effects.waveforms import in_contact

if TYPE_CHECKING:
    from jaxtyping import Float

_START = 1e-9
"""Half gap, as a share of the largest output, at which the derivative at γ = 0 is taken; at 0 it does not exist."""


class OutputBacklash(Effect):
    """After each reversal the measured output stands still until a gap is crossed: gears, belts, linkages, dry joints.

    A joint with play is half the gap behind its command in both directions, and stands still while the command
    reverses. A saturation stands still at one value only; play does so at any reversal.

    Simulation: adds ``p − y`` to an output y, where p is the output behind the play,
        ``p = max(y − γ, min(y + γ, p before))``, in the middle of the gap at the start of a run.
    Drivers: the output only, with its history since the start of the run.
    Units: γ, half the width of the gap, in the output's unit.
    Plausible: γ ≥ 0.
    Source: the play operator; Visintin, "Differential Models of Hysteresis" (1994), III.2; Nordin & Gutman, Automatica
        38 (2002), for gears.
    """

    id = "backlash"
    port = "output"
    needs: tuple[str, ...] = ("own", "compared")
    follows_signal = True
    remembers = True
    lower = 0.0
    equation = "δy = p − y,  p = max(y − γ, min(y + γ, p before))"
    explanation = "After each reversal the measured output stands still until a gap is crossed: there is play."
    advice = "Put play of this width behind the simulated output; preload or tighten the drive to remove it."
    recurrence = "play has the same width at any amplitude and speed"
    source = "Visintin, Differential Models of Hysteresis (1994), III.2; Nordin & Gutman, Automatica 38 (2002)"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("half_gap", len(context.channels), context.signal_unit),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        pairs = zip(context.signal.unbind(-1), gamma.unbind(), strict=True)
        return torch.stack([_crossed(own, gap, context) for own, gap in pairs], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"played({names['own']}, time, {gamma[0]!r}, run) - {names['own']}",)


class SeveralBacklash(OutputBacklash):
    """Backlash of all outputs, with one gap for each: the joints of an arm.

    Simulation: adds ``p − y`` to each output y.
    Drivers: the outputs only.
    Units: γ, half the width of each gap, in the outputs' unit.
    Plausible: γ ≥ 0.
    Source: see :class:`OutputBacklash`.
    """

    port = "outputs"
    needs = (SEVERAL,)
    code = Effect.code


def _crossed(own: Float[Tensor, " N"], gap: Tensor, context: Context) -> Float[Tensor, " N"]:
    """The change of an output by play; its derivative at γ = 0 is the one-sided derivative for γ > 0."""
    known = own.detach()
    size = torch.where(gap.detach() > 0.0, gap.detach(), _START * known.abs().amax())
    inside = ~first_of_runs(context.runs)
    touched, side = in_contact(known, size * inside)
    behind = torch.where(gap > 0.0, own[touched], own)
    return behind - own + side * gap * inside
