"""Backlash between a drive and its load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.share import ShareEffect
from mkc_torch.effects.waveforms import played

if TYPE_CHECKING:
    from jaxtyping import Float

GAPS = (0.03, 0.06, 0.1, 0.2, 0.3)
"""Half the width of the gap, as shares of the largest input."""


class Backlash(ShareEffect):
    """A drive crosses a gap before it moves its load: worn gears, couplings, linkages and valves with play.

    It has memory: after each reversal the load stands still until the gap, 2 c wide, is crossed. A dead zone has no
    memory and acts alike in both directions. At the start of a run the drive is in the middle of the gap.

    Simulation: adds ``γ (y − u)`` to an input u, where y is the load's side, ``y = max(u − c, min(u + c, y before))``;
        γ = 1 is a full gap.
    Drivers: the input only, with its history since the start of the run.
    Units: γ is a share; the shape ``half_gap`` in the unit of the input.
    Plausible: γ from 0 to 1.
    Source: the play operator; Visintin, "Differential Models of Hysteresis" (1994), III.2; Nordin & Gutman, Automatica
        38 (2002), for gears.
    """

    id = "backlash"
    remembers = True
    relative: Mapping[str, tuple[str, str]] = {"half_gap": ("own", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"half_gap": (0.01, 0.5)}
    equation = "δu = γ (y − u),  y = max(u − c, min(u + c, y before))"
    explanation = "After each reversal the drive crosses a gap before it moves its load: there is play between them."
    advice = "Put play of this width behind the input, or preload the gears."
    source = "Visintin, Differential Models of Hysteresis (1994), III.2; Nordin & Gutman, Automatica 38 (2002)"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"half_gap": gap} for gap in GAPS)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.part("own")
        return played(own, context.time, shape["half_gap"], context.runs) - own

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        return (f"{gamma[0]!r} * (played({own}, time, {shape['half_gap']!r}, run) - {own})",)
