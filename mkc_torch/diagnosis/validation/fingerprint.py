"""Recognise a recording that a model was fitted to, whatever its file's name, format or origin of time."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.runs import experiment_runs

MAGNETOMETER = ("mag_x", "mag_y", "mag_z")
"""Columns of a magnetometer, whose residual is that of a vector's length or of other axes."""


def of_runs(recording: Recording, outputs: Sequence[str]) -> tuple[str, ...]:
    """Return a hash of the recorded outputs of each run.

    Noise makes the outputs of any two recordings differ, so equal hashes mean the same samples. Times and missing
    values are left out: another origin of time, or other empty rows, leave the hash unchanged.

    Args:
        recording: its column ``experiment`` separates the runs.
        outputs: names of the measured columns.

    Example:
        >>> import torch
        >>> first = Recording({"time": torch.arange(3.0), "angle": torch.tensor([0.1, 0.2, 0.4])})
        >>> later = Recording({"time": torch.arange(3.0) + 7.0, "angle": torch.tensor([0.1, 0.2, 0.4])})
        >>> of_runs(first, ["angle"]) == of_runs(later, ["angle"])
        True
    """
    values = recording.stack(*outputs).double()
    run = values.new_zeros(len(values)).long() if recording.time is None else experiment_runs(recording)
    hashes = []
    for number in range(int(run.max()) + 1):
        found = hashlib.sha256()
        for name, column in zip(outputs, values[run == number].unbind(-1), strict=True):
            found.update(name.encode())
            found.update(column[column.isfinite()].numpy().tobytes())
        hashes.append(found.hexdigest())
    return tuple(hashes)


def measured_columns(recording: Recording, channels: Sequence[str]) -> tuple[str, ...]:
    """Return the columns that a simulation is compared with: its channels, or those of a magnetometer.

    Example:
        >>> import torch
        >>> measured_columns(Recording({f"mag_{axis}": torch.zeros(2) for axis in "xyz"}), ["norm"])
        ('mag_x', 'mag_y', 'mag_z')
    """
    return tuple(channels) if all(name in recording for name in channels) else MAGNETOMETER
