"""Where samples stand: at their time, or, where there is none, in a row of the recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.recording.disturbance import RejectedInterval, disturbed_intervals
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["disturbed_places", "numbered", "places"]

_ROW = "row of the recording"
"""A column's name that no file has: it would need no renaming."""

_ROWS_A_SECOND = 50.0
"""Rows that are taken for a second, where there is no time: rejected samples count as close together as at 50 Hz."""


def numbered(recording: Recording) -> Recording:
    """The recording with the numbers of its rows, from 1 on, where it has no time; they go along as rows are dropped.

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
        labels=recording.labels,
    )


def places(recording: Recording) -> Float[Tensor, " N"]:
    """Times of the samples in s, or the numbers of their rows, from 1 on."""
    if recording.time is not None:
        return recording.time
    if _ROW in recording:
        return recording[_ROW]
    return torch.arange(1.0, len(recording) + 1.0, dtype=torch.float64)


def disturbed_places(recording: Recording, rejected: Bool[Tensor, " N"]) -> tuple[RejectedInterval, ...]:
    """:func:`mkc_torch.recording.disturbance.disturbed_intervals`, in rows where there is no time.

    Example:
        >>> row = torch.arange(1, 1001)
        >>> disturbed_places(Recording({"mag_x": row}), (row > 200) & (row <= 350))
        (Interval(start=201.0, end=350.0),)
    """
    if recording.time is not None:
        return disturbed_intervals(recording.time, rejected)
    found = disturbed_intervals(places(recording) / _ROWS_A_SECOND, rejected)
    return tuple(RejectedInterval(*(float(round(end * _ROWS_A_SECOND)) for end in one)) for one in found)
