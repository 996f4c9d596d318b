"""A jump of the offset: a magnetised or steel part was attached, moved, taken off or remagnetised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.waveforms import unit_step

if TYPE_CHECKING:
    from jaxtyping import Float


class HardIronStep(GainEffect):
    """A magnetised or steel part that moves with the sensor changed its field abruptly.

    Simulation: adds Δb to the sensor's axes from the onset on.
    Drivers: none, it is bound to a time; a later recording has Δb throughout.
    Units: Δb in µT, the onset in s.
    Plausible: up to 200 µT; attached or removed parts cause 1-50 µT.
    Source: BROAD trials 34-36, a magnet that is removed from the board (Laidig et al., Data 6(7):72, 2021).

    Example:
        >>> import torch
        >>> from mkc_torch.effects import Context
        >>> time = torch.arange(4.0)
        >>> context = Context(time, torch.zeros(4, 0), (), torch.zeros(4, 1), "µT", ("x",))
        >>> HardIronStep().change(torch.tensor([3.0]), {"onset": 2.0}, context).squeeze(-1)
        tensor([0., 0., 3., 3.])
    """

    id = "hard_iron_step"
    gain = "offset_change"
    continuous: Mapping[str, tuple[float, float]] = {"onset": (0.08, 0.92)}
    equation = "δB = Δb · 1[t ≥ t₀]"
    explanation = "The sensor's offset jumped: a magnetic part that moves with the sensor was attached or removed."
    advice = "Look for what changed at that time; use the calibration from after the step."
    recurrence = "a step does not come at the same moment again"
    plausible = 200.0
    plausible_unit = "µT"
    source = "sizes of 1-50 µT as seen when parts are mounted; BROAD trials 34-36 (Laidig et al., Data 6(7):72, 2021)"

    SPACING = 0.01
    """Spacing of the onsets to search, as a share of the recording's length."""

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        first, length = float(time[0]), float(time[-1] - time[0])
        count = round(1.0 / self.SPACING)
        # a shorter side could not be held out in blocks, nor distinguished from a burst of outliers
        return tuple({"onset": first + length * k / count} for k in range(8, count - 7))

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return unit_step(context.time, shape["onset"])

    def lasting(self, gamma: Float[Tensor, " q"], context: Context) -> Float[Tensor, "N c"]:
        """The change that remains in a later recording of the sensor: the offset at the end."""
        return gamma.expand(len(context.time), -1)
