"""Outputs that are missing at some samples: sensors of several rates, and a sensor that fails for a while."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.note import Note
from mkc_torch.recording.recording import Recording
from mkc_torch.recording.time_order import note_if_few

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


def usable_rows(recording: Recording, inputs: Sequence[str], outputs: Sequence[str]) -> Recording:
    """Return the rows with a finite time, finite inputs and, without inputs, an output, in the order of time.

    A row without outputs keeps its inputs, which drive the states between the samples. Infinite outputs are missing.

    Raises:
        RecordingError: no row has all of them, or an output is missing in all rows.

    Example:
        >>> nan = float("nan")
        >>> columns = {
        ...     "time": torch.arange(3.0),
        ...     "u": torch.tensor([0.0, 1.0, nan]),
        ...     "y": torch.tensor([0.1, nan, 0.3]),
        ... }
        >>> usable_rows(Recording(columns), ["u"], ["y"])["time"].tolist()
        [0.0, 1.0]
    """
    used = recording.finite("time", *inputs)
    for name in outputs:
        used.finite(name)  # an output without values raises
    known = used.stack(*outputs).isfinite()
    notes = [
        f"`{name}` is missing at {int((~seen).sum())} of {len(used)} samples, whose inputs are kept."
        for name, seen in zip(outputs, known.unbind(-1), strict=True)
        if inputs and not bool(seen.all())
    ]
    if not inputs and not bool(known.any(-1).all()):
        lost = int((~known.any(-1)).sum())
        dropped = f"Dropped {lost} of {len(used)} samples without an output."
        used = used.rows(known.any(-1), note_if_few(dropped, lost, len(used)))
    return used.rows(torch.arange(len(used)), *map(Note, notes)).sorted_by_time()


def filled(values: Float[Tensor, "N m"], time: Float[Tensor, " N"], begins: Bool[Tensor, " N"]) -> Float[Tensor, "N m"]:
    """Replace missing values by a line through their neighbours in the same run; the median in a run without any.

    Only first guesses use the replaced values.

    Example:
        >>> time = torch.arange(4.0)
        >>> filled(torch.tensor([[1.0], [torch.nan], [3.0], [torch.nan]]), time, time == 0.0).flatten().tolist()
        [1.0, 2.0, 3.0, 3.0]
    """
    if bool(values.isfinite().all()):
        return values
    columns, run = values.numpy().copy(), (begins.long().cumsum(0) - 1).numpy()
    for column in columns.T:
        usual = float(np.median(column[np.isfinite(column)]))
        for number in range(int(run[-1]) + 1):
            own = run == number
            known = own & np.isfinite(column)
            column[own] = np.interp(time[own], time[known], column[known]) if known.any() else usual
    return torch.from_numpy(columns)


def nearest_recorded(
    recorded: Bool[Tensor, "N m"], time: Float[Tensor, " N"], begins: Bool[Tensor, " N"]
) -> Int[Tensor, "N m"]:
    """Return the row of the recorded value nearest in time, in the same run where that has one.

    A residual at these rows has the size of the recorded residuals, also in statistics without a mask.

    Example:
        >>> recorded = torch.tensor([[True], [False], [False], [True]])
        >>> nearest_recorded(recorded, torch.arange(4.0), torch.tensor([True, False, False, False])).flatten().tolist()
        [0, 0, 3, 3]
    """
    rows = torch.arange(len(time))
    run = begins.long().cumsum(0) - 1
    columns = []
    for known in recorded.unbind(-1):
        before = torch.where(known, rows, -1).cummax(0).values
        after = torch.where(known, rows, len(rows)).flip(0).cummin(0).values.flip(0)
        after = torch.where(after < len(rows), after, before)
        before = torch.where(before >= 0, before, after)
        late = (time[after] - time).abs() < (time - time[before]).abs()
        late = torch.where(run[before] == run[after], late, run[after] == run)
        columns.append(torch.where(late, after, before))
    return torch.stack(columns, -1)


def recorded_weight(recorded: Bool[Tensor, "N m"], rows: Float[Tensor, " N"] | None = None) -> Float[Tensor, "N m"]:
    """Return weights of the residuals: those of the rows where an output was recorded, else 0.

    An output that was recorded in none of these rows is compared with its nearest values.

    Example:
        >>> recorded_weight(torch.tensor([[True, True], [True, False]]), torch.tensor([0.0, 1.0])).tolist()
        [[0.0, 0.0], [1.0, 1.0]]
    """
    weight = recorded.double()
    if rows is not None:
        weight = weight * rows.unsqueeze(-1)
        weight = torch.where(weight.sum(0) > 0, weight, rows.unsqueeze(-1))
    return weight


def with_lines(samples: Recording, outputs: Sequence[str], begins: Bool[Tensor, " N"]) -> Recording:
    """Return the samples with missing outputs replaced by :func:`filled`."""
    values = samples.stack(*outputs)
    if bool(values.isfinite().all()):
        return samples
    lines = filled(values, samples["time"], begins).unbind(-1)
    return Recording(
        {**samples.columns, **dict(zip(outputs, lines, strict=True))},
        name=samples.name,
        units=samples.units,
        labels=samples.labels,
        warnings=samples.warnings,
        notes=samples.notes,
    )


@dataclass(frozen=True)
class MissingOutputs:
    """The samples at which outputs are missing.

    Attributes:
        recorded: (N, m), True where an output was recorded.
        nearest: (N, m), see :func:`nearest_recorded`.
    """

    recorded: Bool[Tensor, "N m"]
    nearest: Int[Tensor, "N m"]

    @classmethod
    def of(
        cls, recorded: Bool[Tensor, "N m"], time: Float[Tensor, " N"], begins: Bool[Tensor, " N"]
    ) -> MissingOutputs | None:
        """Return None where no output is missing."""
        return None if bool(recorded.all()) else cls(recorded, nearest_recorded(recorded, time, begins))

    def left_out(self, left: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
        """Return the residual with 0 where it is missing, so that whitening mixes nothing into other outputs."""
        return torch.where(self.recorded, left, 0.0)

    def replaced(self, left: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
        """Return the residual with the nearest recorded value where it is missing."""
        return left.gather(0, self.nearest)
