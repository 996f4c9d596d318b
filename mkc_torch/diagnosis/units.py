"""Columns whose size does not fit their unit: named, never converted."""

from __future__ import annotations

from mkc_torch.recording import Recording

__all__ = ["unit_warnings"]

_AXES = "xyz"


def unit_warnings(recording: Recording) -> tuple[str, ...]:
    """A sentence for each group of columns that looks as if it were in another unit than the recording says.

    Example:
        >>> import torch
        >>> angle = torch.linspace(0.0, 6.0, 20)
        >>> columns = {"mag_x": 0.5 * angle.cos(), "mag_y": 0.5 * angle.sin(), "mag_z": 0.0 * angle}
        >>> "gauss" in unit_warnings(Recording(columns))[0]
        True
    """
    return tuple(s for s in (_field(recording), _rate(recording), _acceleration(recording), _time(recording)) if s)


def _typical(recording: Recording, name: str) -> float | None:
    names = [f"{name}_{axis}" for axis in _AXES]
    if not all(n in recording for n in names):
        return None
    length = recording.stack(*names).square().sum(-1).sqrt()
    length = length[length.isfinite()]
    return float(length.median()) if len(length) else None


def _field(recording: Recording) -> str | None:
    size = _typical(recording, "mag")
    if size is None or recording.units["mag_x"] != "µT" or 10.0 <= size <= 200.0:
        return None
    guesses = [
        (0.1, 1.0, "gauss (1 gauss = 100 µT)"),
        (200.0, 1000.0, "milligauss (10 mG = 1 µT)"),
        (2e4, 1e5, "nanotesla (1000 nT = 1 µT)"),
    ]
    found = [f"; in {unit} that would be an ambient field" for low, high, unit in guesses if low <= size <= high]
    return (
        f"The magnetometer measures about {size:.3g} µT, which is not the size of the Earth's field"
        f"{found[0] if found else '; it may be raw counts'}. Nothing was converted: name the unit with `--unit`, or "
        "convert the columns; sizes of effects are in the columns' own unit."
    )


def _rate(recording: Recording) -> str | None:
    size = _typical(recording, "gyro")
    if size is None or recording.units["gyro_x"] != "rad/s" or size <= 12.0:
        return None
    return (
        f"The gyroscope turns at about {size:.3g} rad/s, faster than a hand or a vehicle; it may be in °/s. Nothing "
        "was converted."
    )


def _acceleration(recording: Recording) -> str | None:
    size = _typical(recording, "accel")
    if size is None or recording.units["accel_x"] != "m/s²" or 3.0 <= size <= 40.0:
        return None
    return f"The accelerometer measures about {size:.3g} m/s² instead of 9.8; it may be in g. Nothing was converted."


def _time(recording: Recording) -> str | None:
    time = recording.time
    if time is None or len(time) < 10:
        return None
    interval = float(time.diff().abs().median())
    if interval < 1.0 or "mag_x" not in recording:
        return None
    return f"The samples lie {interval:.3g} s apart by the column `time`; it may be in ms or µs. Nothing was converted."
