"""Outputs with a constant shift in time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.clock import resampled
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

_SAMPLES = (1.0, 3.0, 9.0, 27.0)
"""Shifts in samples, later and earlier, at which the effect is screened."""


class SensorShift(Effect):
    """The outputs are recorded with another offset of time than the inputs. It is outside the catalogue.

    A late input is the `input_delay` of the catalogue. An early input has no effect there, and part of its shift looks
    like a clock of another rate.

    Simulation: adds ``y(t + γ) − y(t)`` to all outputs.
    Drivers: the outputs only.
    Units: s.
    Plausible: any shift.
    Source: Åström & Murray, "Feedback Systems" (2008), 3.4.
    """

    id = "sensor_shift"
    port = "output"
    needs: tuple[str, ...] = ("driven",)
    follows_signal = True
    remembers = True
    open_loop_only = True
    finite_size = "tried_shift"
    form_parameters: tuple[str, ...] = ("tried_shift",)
    equation = "δy = y(t + γ) − y(t)"
    explanation = "The outputs are recorded with another offset of time than the inputs."
    advice = "Take both times from one clock."
    source = "Åström & Murray, Feedback Systems (2008), 3.4"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        step = time.diff()
        usual = float(step[step > 0].median()) if bool((step > 0).any()) else 1.0
        return tuple({"tried_shift": sign * usual * samples} for samples in _SAMPLES for sign in (1.0, -1.0))

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("shift", 1, "s"),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        outputs = context.signal.unbind(-1)
        moved = [resampled(own, context.time, 0.0, context.runs, later=gamma[0]) - own for own in outputs]
        return torch.stack(moved, -1)
