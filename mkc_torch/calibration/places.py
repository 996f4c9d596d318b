"""Positions of samples: their times, or their rows if the recording has no time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.recording.disturbance import RejectedInterval, disturbed_intervals
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_ROW = "row of the recording"
"""Name of the internal column of row numbers."""

ROWS_A_SECOND = 50.0
"""Assumed sampling rate in Hz without a time, for the intervals of rejected samples."""


def numbered(recording: Recording) -> Recording:
    """Add a column of row numbers, from 1, if the recording has no time; they stay the same when rows are dropped.

    Example:
        >>> kept = numbered(Recording({"a": torch.zeros(3)})).rows(torch.tensor([0, 2]))
        >>> places(kept)
        tensor([1., 3.], dtype=torch.float64)
    """
    if recording.time is not None or _ROW in recording:
        return recording
    number = torch.arange(1.0, len(recording) + 1.0, dtype=torch.float64)
    return Recording(
        {**recording.columns, _ROW: number},
        name=recording.name,
        units={**recording.units, _ROW: ""},
        warnings=recording.warnings,
        notes=recording.notes,
        labels=recording.labels,
    )


def places(recording: Recording) -> Float[Tensor, " N"]:
    """Times of the samples in s, or their row numbers from 1, (N,)."""
    if recording.time is not None:
        return recording.time
    if _ROW in recording:
        return recording[_ROW]
    return torch.arange(1.0, len(recording) + 1.0, dtype=torch.float64)


def disturbed_places(recording: Recording, rejected: Bool[Tensor, " N"]) -> tuple[RejectedInterval, ...]:
    """Return :func:`mkc_torch.recording.disturbance.disturbed_intervals`, in rows if there is no time.

    Example:
        >>> row = torch.arange(1, 1001)
        >>> disturbed_places(Recording({"mag_x": row}), (row > 200) & (row <= 350))
        (RejectedInterval(start=201.0, end=350.0),)
    """
    if recording.time is not None:
        return disturbed_intervals(recording.time, rejected)
    found = disturbed_intervals(places(recording) / ROWS_A_SECOND, rejected)
    return tuple(RejectedInterval(*(float(round(end * ROWS_A_SECOND)) for end in interval)) for interval in found)
