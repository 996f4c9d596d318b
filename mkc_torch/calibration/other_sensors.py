"""Calibrate an accelerometer by the ellipsoid of gravity, and estimate a gyroscope's bias from rest."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.plain_values import vector_of
from mkc_torch.calibration.result import Calibration, RestBias
from mkc_torch.calibration.turning import turning
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

GRAVITY = 9.80665
"""Standard gravity in m/s²; local gravity is within 0.3 % of it."""

MAG = ("mag_x", "mag_y", "mag_z")
ACCEL = ("accel_x", "accel_y", "accel_z")
GYRO = ("gyro_x", "gyro_y", "gyro_z")

_GRAVITY = (8.0, 12.0)
"""Plausible range of the radius in m/s², given the gains of an uncalibrated chip."""

_FEWEST_RESTS = 9
"""Fewest rests, one for each unknown, with which the accelerated samples between rests are left out."""

_WINDOW = 1.0
"""Length of a window in which a gyroscope may be at rest, in s."""

_STILL = 3.0
"""Largest scatter of a window at rest, in multiples of the scatter of the quietest window."""

_FEWEST_WINDOWS = 3
"""Fewest windows at rest for a bias."""


def as_magnetometer(recording: Recording) -> Recording:
    """Rename ``accel_*`` to ``mag_*``, and leave out the samples between rests."""
    axes = dict(zip(MAG, recording.stack(*ACCEL).unbind(-1), strict=True))
    kept = {name: recording[name] for name in ("time", "experiment") if name in recording}
    unit = recording.units[ACCEL[0]] or "m/s²"
    table = Recording(
        {**kept, **axes},
        name=recording.name,
        units=dict.fromkeys(MAG, unit),
        warnings=recording.warnings,
        notes=recording.notes,
        labels={name: values for name, values in recording.labels.items() if name in kept},
    )
    finite = table.finite(*MAG)
    resting = _rests(finite.magnetometer())
    if resting is None or bool(resting.all()):
        return table
    return finite.rows(
        resting,
        f"Left out {int((~resting).sum())} of {len(finite)} samples between rests, where motion accelerates the "
        "sensor.",
    )


def accelerometer(recording: Recording, calibrate: Callable[[Recording], Calibration]) -> Calibration:
    """Calibrate ``accel_*`` by the ellipsoid of gravity.

    If the recording has nine rests or more, as when the sensor is laid down on each side by hand, the samples between
    rests are left out, because motion accelerates the sensor there.

    Args:
        recording: recording with ``accel_x``, ``accel_y``, ``accel_z``.
        calibrate: calibrates the columns renamed to ``mag_*``, in m/s².
    """
    found = calibrate(as_magnetometer(recording))
    warnings = found.warnings
    if found.unit == "m/s²" and not _GRAVITY[0] < found.radius < _GRAVITY[1]:
        warnings = (
            f"The radius of the ellipsoid is {found.radius:.3g} m/s², which is not gravity; the columns may be in g or "
            "counts. The corrected acceleration is still in m/s²; offset and semi-axes are in the columns' own unit.",
            *warnings,
        )
    return dataclasses.replace(found, warnings=warnings, field_unit="m/s²", sensor="accel")


def _rests(points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"] | None:
    """Mask of the samples at rest, (N,); None if there are too few rests."""
    turns = turning(points)
    if turns is None:
        return None
    kinds, _ = torch.unique_consecutive(turns, return_counts=True)
    return ~turns if int((~kinds).sum()) >= _FEWEST_RESTS else None


def rest_bias(recording: Recording) -> RestBias | None:
    """Estimate the bias of a gyroscope at rest; None without a time or a rest of three seconds.

    A window of a second is at rest if its rates scatter little more than in the quietest window and agree with the
    rates of the other windows at rest.

    Args:
        recording: recording with ``time`` and ``gyro_*``, sorted by time.

    Example:
        >>> draw = torch.Generator().manual_seed(0)
        >>> rate = 0.01 * torch.randn(1000, 3, generator=draw) + torch.tensor([0.02, 0.0, -0.01])
        >>> rate[300:700] += torch.sin(torch.arange(400.0) / 30.0)[:, None]
        >>> columns = dict(zip(GYRO, rate.unbind(-1)))
        >>> found = rest_bias(Recording({"time": torch.arange(1000) / 50.0, **columns}))
        >>> [round(v, 2) for v in found.value], found.seconds > 10.0
        ([0.02, 0.0, -0.01], True)
    """
    if recording.time is None or not all(name in recording for name in GYRO):
        return None
    rate, time = recording.stack(*GYRO), recording.time
    step = float(time.diff().clamp(min=0.0).median()) if len(time) > 1 else 0.0
    if not step > 0.0:
        return None
    count = max(8, round(_WINDOW / step))
    known = rate.isfinite().all(-1)
    rate = rate[known]
    windows = len(rate) // count
    if windows < _FEWEST_WINDOWS:
        return None
    parts = rate[: windows * count].unflatten(0, (windows, count))
    middle, scatter = parts.mean(1), parts.std(1)
    quiet = (scatter <= _STILL * scatter.amin(0)).all(-1)
    # a turn at a constant rate is as quiet; the smallest rates belong to rest
    size = torch.linalg.vector_norm(middle, dim=-1)
    slowest = middle[quiet][size[quiet].argmin()] if bool(quiet.any()) else middle[0]
    noise = _STILL * scatter.amin(0) * (0.5 + 3.0 * count**-0.5)
    still = quiet & ((middle - slowest).abs() <= noise).all(-1)
    if int(still.sum()) < _FEWEST_WINDOWS or float(torch.linalg.vector_norm(slowest)) > _MOST_BIAS:
        return None
    chosen = middle[still]
    error = chosen.std(0) / math.sqrt(len(chosen))
    return RestBias(vector_of(chosen.mean(0)), vector_of(error), float(len(chosen) * count * step))


_MOST_BIAS = 0.2
"""Largest bias in rad/s, 11 °/s; a larger rate is a turn."""
