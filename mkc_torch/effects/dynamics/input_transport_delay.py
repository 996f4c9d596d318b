"""A delay of an input by a volume over a recorded flow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.input_delay import InputDelay
from mkc_torch.effects.paired.between import shifted

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_STANDSTILL = 1e-6
"""Smallest flow as a share of its mean, so that what is in the pipe keeps its order."""


class InputTransportDelay(InputDelay):
    """The system responds to its input when a flow has filled a pipe: a delay that is long while the flow is slow.

    Simulation: adds ``γ (u(t − τ) − u(t))`` to an input u of differential equations, where the recorded flow q since
    ``t − τ`` is the volume of the pipe, ``∫ q dt = τ̄ q̄``; γ = 1 is a pure delay. τ̄ is the delay at the mean flow q̄.
    Drivers: a column that is nowhere negative, or another such input of the simulation.
    Units: γ is a share; the mean delay in s.
    Plausible: γ from 0 to 1.
    Source: plug flow; Levenspiel, "Chemical Reaction Engineering" (1999), 5.
    """

    id = "input_transport_delay"
    display_name = "delay by a volume over a flow"
    roles: tuple[str, ...] = ("any", "current")
    driven_by_inputs = True
    positive_driver = True
    reduces_to = InputDelay()
    equation = "δu = γ (u(t − τ) − u(t)),  ∫ q dt over τ = τ̄ q̄"
    explanation = "The system responds to its input with a delay that is inversely proportional to this flow."
    advice = "Delay the input by the volume of the pipe over the flow."
    recurrence = "a pipe delays its input by its volume over the flow"
    source = "plug flow; Levenspiel, Chemical Reaction Engineering (1999), 5"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own, mean = context.part("own"), context.driver_means[0] if context.driver_means else 1.0
        through = travelled(context.recorded / mean, context.time, context.runs)
        return shifted(own, through, -shape["delay"], context.runs) - own

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        own, through = names["own"], f"travelled({names['recorded']} / {names['mean']}, time, run)"
        return (f"{gamma[0]!r} * (shifted({own}, {through}, {-shape['delay']!r}, run) - {own})",)


def travelled(
    flow: Float[Tensor, " N"], time: Float[Tensor, " N"], run: Int[Tensor, " N"] | None = None
) -> Float[Tensor, " N"]:
    """The integral of a flow that is linear between samples, from the first sample; between runs it stands still.

    Args:
        flow: the flow, in any unit; less than a millionth counts as a millionth.
        time: times of the samples in s.
        run: number of each sample's run; None: a run begins only where time goes back.

    Returns:
        The integral, (N,), ascending, in the flow's unit times s.

    Example:
        >>> travelled(torch.tensor([1.0, 1.0, 3.0]), torch.tensor([0.0, 2.0, 3.0]))
        tensor([0., 2., 4.])
    """
    flow = flow.clamp(min=_STANDSTILL)
    step = time.diff().clamp(min=0.0)
    if run is not None:
        step = torch.where(run.diff() == 0, step, 0.0)
    passed = 0.5 * (flow[1:] + flow[:-1]) * step
    return torch.cat([torch.zeros_like(flow[:1]), passed.cumsum(0)])
