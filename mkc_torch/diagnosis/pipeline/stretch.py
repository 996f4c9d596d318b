"""The stretch of a long recording that a quick look at a simulation with expensive steps uses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

MOST = 1000
"""Samples of a stretch. By judgement: a fit of each effect takes a simulation of all of them tens of times."""

_PLACES = 4
"""Stretches that are compared start at each quarter of their length."""


def quick_stretch(prepared: PreparedSimulation, recording: Recording) -> Recording | None:
    """Return the stretch of a run in which the outputs move most, for a simulation that steps; None for any other.

    Args:
        prepared: the simulation with the whole recording.
        recording: as given by the user.
    """
    system = prepared.dynamics
    if system is None or system.system.steps is None or len(prepared.time) <= MOST or int(system.begins.sum()) > 1:
        return None
    first = first_of_liveliest(system.measured, MOST)
    last = first + MOST
    begin, end = (float(prepared.time[row]) for row in (first, last - 1))
    note = (
        f"Quick look at {MOST} of {len(prepared.time)} samples, from {begin:.4g} to {end:.4g} s, where the outputs "
        "move most. Leave out --quick (in Python quick=True) to use all."
    )
    columns = {name: recording[name][first:last] for name in recording.names}
    return Recording(
        columns,
        name=recording.name,
        units=recording.units,
        labels=recording.labels,
        warnings=recording.warnings,
        notes=(*recording.notes, note),
    )


def first_of_liveliest(values: Float[Tensor, "N m"], length: int) -> int:
    """Return the first row of the stretch of a length in which the columns change most, each in its own scale.

    Example:
        >>> import torch
        >>> still, moving = torch.zeros(80, 1), torch.sin(torch.arange(40.0)).unsqueeze(-1)
        >>> first_of_liveliest(torch.cat([still, moving, still]), 40)
        80
    """
    known = values.nan_to_num()
    moved = (known.diff(dim=0).abs() / known.std(0).clamp(min=1e-300)).sum(-1).cumsum(0)
    starts = range(0, len(values) - length + 1, max(length // _PLACES, 1))
    return max(starts, key=lambda row: float(moved[row + length - 2] - (moved[row - 1] if row else 0.0)))
