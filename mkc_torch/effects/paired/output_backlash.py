"""Play between what was simulated and what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.courses import in_contact
from mkc_torch.effects.paired.alike import SEVERAL
from mkc_torch.effects.runs import first_of_runs

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["OutputBacklash", "SeveralBacklash"]

_START = 1e-9
"""Half gap, as a share of the largest output, at which the slope at no gap is taken: at 0 there is none."""


class OutputBacklash(Effect):
    """After each reversal what is measured stands still until a gap is crossed: gears, belts, linkages, dry joints.

    A joint that follows its command with play lags by half the gap in either direction, and stands still while the
    command turns round. A saturation stands still at one value alone; play does so wherever the command reverses.

    Simulation: adds ``p − y`` to an output y, p the output behind play, ``p = max(y − γ, min(y + γ, p before))``; at
        the beginning of a run in the middle of the gap.
    Drivers: none but the output, all of its course since the run's beginning.
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
    explanation = "After each reversal what is measured stands still until a gap is crossed: there is play."
    advice = "Put play of this width behind the simulated output; preload or tighten the drive to be rid of it."
    recurrence = "play is as wide at any amplitude and speed"
    source = "Visintin, Differential Models of Hysteresis (1994), III.2; Nordin & Gutman, Automatica 38 (2002)"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity("half_gap", len(context.channels), context.signal_unit),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:  # noqa: ARG002
        pairs = zip(context.signal.unbind(-1), gamma.unbind(), strict=True)
        return torch.stack([_crossed(own, gap, context) for own, gap in pairs], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:  # noqa: ARG002
        return (f"played({names['own']}, time, {gamma[0]!r}, run) - {names['own']}",)


class SeveralBacklash(OutputBacklash):
    """The same at all outputs, each with a gap of its own: the joints of an arm.

    Simulation: adds ``p − y``, for each output.
    Drivers: none but the outputs.
    Units: γ, half the width of each gap, in the outputs' unit.
    Plausible: γ ≥ 0.
    Source: that of :class:`OutputBacklash`.
    """

    port = "outputs"
    needs = (SEVERAL,)
    code = Effect.code


def _crossed(own: Float[Tensor, " N"], gap: Tensor, context: Context) -> Float[Tensor, " N"]:
    """What play adds to an output; its slope at no gap is that from a gap just above."""
    known = own.detach()
    size = torch.where(gap.detach() > 0.0, gap.detach(), _START * known.abs().amax())
    inside = ~first_of_runs(context.runs)
    touched, side = in_contact(known, size * inside)
    behind = torch.where(gap > 0.0, own[touched], own)
    return behind - own + side * gap * inside
