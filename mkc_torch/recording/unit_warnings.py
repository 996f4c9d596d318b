"""Warn about columns whose magnitude does not fit their unit; nothing is converted."""

from __future__ import annotations

import math
import re

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.recording.recording import Recording
from mkc_torch.recording.unit_words import conversion

RECORDED = "recorded units"
"""Unit label of measurements whose magnitude does not fit their assumed unit."""

_AXES = "xyz"

_FIELD = (10.0, 200.0)
"""Plausible range of a measured field, in µT; the Earth's field is 22 to 67, iron nearby and gains change it."""

EARTH = (20.0, 70.0)
"""Range of the Earth's field, in µT."""

_GUESSES = (
    (1e-5, 1e-4, "tesla (1 T = 1000000 µT)", "tesla"),
    (0.01, 0.1, "millitesla (1 mT = 1000 µT)", "mT"),
    (0.1, 1.0, "gauss (1 gauss = 100 µT)", "gauss"),
    (200.0, 1000.0, "milligauss (10 mG = 1 µT)", "mG"),
    (2e4, 1e5, "nanotesla (1000 nT = 1 µT)", "nT"),
)
"""Lower and upper bound of a field's numerical value, likely unit in words, and its spelling for ``--convert mag=``."""

_FEWEST = 20
"""Fewest samples from which a centre is estimated."""

_ENOUGH = 1000
"""Most samples from which a centre is estimated."""

_REWEIGHTED = 20
"""Iterations of the reweighted sphere fit."""

_LARGER = 1.2
"""Largest ratio of a sphere's radius to the median field; a larger sphere passes through outliers."""

_SCATTER = 0.25
"""Largest scatter of the distances from the centre, as a share of the radius, of a sensor that turned."""

_ASIDE = 0.7
"""Largest length of the mean direction from the centre of a sensor that turned; without turns, field and offset cannot
be separated."""

_SLOW_LOGGER = 10.0
"""Longest sampling interval in s of a logger that is slow; below it, the other unit must fit the motion too."""

_FASTEST = 35.0
"""Fastest turn of a sensor in rad/s, the range of a gyroscope of 2000 °/s; a faster turn is another unit of time."""

_TIMES = ((1e3, "ms", 1e-3), (1e6, "µs", 1e-6), (math.inf, "ns", 1e-9))
"""Upper bound of the sampling interval in units of ``time``, the likely unit, and its size in s."""


def unit_warnings(recording: Recording) -> tuple[str, ...]:
    """A warning for each group of columns that seems to be in another unit than the recording states.

    Example:
        >>> import torch
        >>> angle = torch.linspace(0.0, 6.0, 20)
        >>> columns = {"mag_x": 0.5 * angle.cos(), "mag_y": 0.5 * angle.sin(), "mag_z": 0.0 * angle}
        >>> "gauss" in unit_warnings(Recording(columns))[0]
        True
    """
    return tuple(
        s for s in (_field(recording), _rate(recording), _acceleration(recording), time_warning(recording)) if s
    )


def _typical(recording: Recording, name: str) -> float | None:
    names = [f"{name}_{axis}" for axis in _AXES]
    if not all(n in recording for n in names):
        return None
    length = recording.stack(*names).square().sum(-1).sqrt()
    length = length[length.isfinite()]
    return float(length.median()) if len(length) else None


def _field(recording: Recording) -> str | None:
    size = field_size(recording)
    if size is None:
        return None
    return field_warning(
        size, recording.units["mag_x"], "magnetometer measures about", "sizes of effects", converted_from(recording)
    )


def field_size(recording: Recording) -> float | None:
    """Typical magnitude of the field, without a large sensor offset if the sensor turned enough to separate them.

    In the unit of ``mag_x``; None if an axis or all samples are missing.

    Example:
        >>> import torch
        >>> field_size(Recording({f"mag_{axis}": torch.tensor([30.0, 30.0]) for axis in "xyz"}))
        51.96...
    """
    length = _typical(recording, "mag")
    if length is None:
        return None
    field = recording.stack(*(f"mag_{axis}" for axis in _AXES))
    field = field[field.isfinite().all(-1)]
    center = _center(field[:: max(1, len(field) // _ENOUGH)])
    away = field - center
    distance = torch.linalg.vector_norm(away, dim=-1)
    radius = float(distance.median())
    # an offset increases the length; a larger sphere passes through outliers
    if not 0.0 < radius < _LARGER * length or float(torch.linalg.vector_norm(center)) < 0.5 * radius:
        return length
    scatter = float(robust_scale(distance.unsqueeze(-1) - radius)) / radius
    aside = float(torch.linalg.vector_norm((away / distance.clamp(min=1e-300).unsqueeze(-1)).mean(0)))
    return radius if scatter < _SCATTER and aside < _ASIDE else length


def _center(field: Tensor) -> Tensor:
    """Centre of a robustly fitted sphere, (3,); directions that are not determined stay at the median."""
    middle = field.median(0).values
    away = field - middle
    size = torch.linalg.vector_norm(away, dim=-1).median()
    if len(field) < _FEWEST or not bool(size > 0):
        return middle
    scaled = away / size
    regressors = torch.cat([2.0 * scaled, torch.ones_like(scaled[:, :1])], -1)
    square = scaled.square().sum(-1)
    weight = torch.ones_like(square)
    known = square.new_zeros(4)
    for _ in range(_REWEIGHTED):
        root = weight.sqrt().unsqueeze(-1)
        known = torch.linalg.pinv(root * regressors, rtol=1e-6) @ (root[:, 0] * square)
        residual = (square - regressors @ known).abs()
        weight = (1.0 + (residual / (2.0 * residual.median()).clamp(min=1e-12)).square()).reciprocal().square()
    return middle + size * known[:3]


def converted_from(recording: Recording) -> str:
    """The unit that the magnetometer was converted from; empty if it was not converted.

    Example:
        >>> import torch
        >>> warnings = ("`mag_x`, `mag_y`, `mag_z`: converted from gauss, as the file says, to µT.",)
        >>> converted_from(Recording({"mag_x": torch.zeros(3)}, warnings=warnings))
        'gauss'
    """
    found = [
        re.match(r"`mag_x`.*: converted from (\S+), ", sentence) for sentence in (*recording.notes, *recording.warnings)
    ]
    return next((match[1] for match in found if match), "")


def field_warning(size: float, unit: str, what: str, numbers: str, before: str = "") -> str | None:
    """A warning about a field in another unit than stated; None if the unit is plausible.

    Args:
        size: magnitude of the field.
        unit: the stated unit; units other than µT are not checked.
        what: subject and verb of the sentence.
        numbers: which results are in the columns' own unit.
        before: the stated unit that the columns were converted from; empty if they were not converted.

    Example:
        >>> field_warning(46.0, "µT", "radius is", "offset") is None
        True
        >>> field_warning(46e3, "µT", "radius is", "offset").partition(".")[0]
        "The radius is 46000 µT, which is not the size of the Earth's field; in nanotesla (1000 nT = 1 µT) it would be"
    """
    if unit != "µT" or _FIELD[0] <= size <= _FIELD[1]:
        return None
    if before:
        option = _other_unit(size, before)
        remedy = f"; if so, give it: `--convert mag={option}`" if option else ""
        return (
            f"The {what} {_shown(size)} µT, which is not the size of the Earth's field, after the columns "
            f"were converted from {before}; they may be in another unit than stated{remedy}."
        )
    guess = _guess(size)
    likely = "these may be raw counts" if guess is None else f"in {guess[0]} it would be"
    option = (
        "give the unit with `--convert` or `--unit-label`, or"
        if guess is None
        else f"if that is the unit, give `--convert mag={guess[1]}`, or"
    )
    return (
        f"The {what} {_shown(size)} µT, which is not the size of the Earth's field; {likely}. Nothing was converted: "
        f"{option} convert the columns; {numbers} are in the columns' own unit."
    )


def _other_unit(size: float, before: str) -> str:
    """The unit in which the numbers would be the Earth's field; empty if no unit fits."""
    known = conversion("mag", before)
    raw = size / float(known.factor) if known is not None else math.nan
    for option in ("uT", "gauss", "mG", "nT", "tesla", "mT"):
        other = conversion("mag", option)
        if other is not None and EARTH[0] <= raw * float(other.factor) <= EARTH[1]:
            return option
    return ""


def likely_unit(size: float) -> tuple[str, str] | None:
    """The unit in which an implausible field would be the Earth's; None if µT is plausible or no unit fits.

    Args:
        size: magnitude of the field, taken as µT.

    Returns:
        The unit in words, and its spelling for ``--convert mag=``.

    Example:
        >>> likely_unit(0.5), likely_unit(50.0), likely_unit(7000.0)
        (('gauss (1 gauss = 100 µT)', 'gauss'), None, None)
    """
    return None if _FIELD[0] <= size <= _FIELD[1] else _guess(size)


def _guess(size: float) -> tuple[str, str] | None:
    return next(((name, option) for low, high, name, option in _GUESSES if low <= size <= high), None)


def _rate(recording: Recording) -> str | None:
    size = _typical(recording, "gyro")
    if size is None or recording.units["gyro_x"] != "rad/s" or size <= 12.0:
        return None
    return (
        f"The gyroscope turns at about {size:.3g} rad/s, faster than a hand or a vehicle; it may be in °/s. Nothing "
        "was converted: if it is, give `--convert gyro=deg/s`."
    )


def _acceleration(recording: Recording) -> str | None:
    size = _typical(recording, "accel")
    if size is None or recording.units["accel_x"] != "m/s²" or 3.0 <= size <= 40.0:
        return None
    return (
        f"The accelerometer measures about {size:.3g} m/s² instead of 9.8; it may be in g. "
        "Nothing was converted: if it is, give `--convert accel=g`."
    )


def time_warning(recording: Recording) -> str | None:
    """A warning about times of a sensor that are not in seconds; None if seconds are plausible.

    Example:
        >>> import torch
        >>> recording = Recording({"time": 1.7e18 + 2e7 * torch.arange(20).double(), "mag_x": torch.zeros(20)})
        >>> time_warning(recording).partition(".")[0]
        'The samples lie 20000000 s apart by the column `time`, which looks like ns (50 samples a second then)'
    """
    time = recording.time
    if time is None or len(time) < 10:
        return None
    interval = float(time.diff().abs().median())
    if interval < 1.0 or "mag_x" not in recording:
        return None
    unit, seconds = next((u, s) for limit, u, s in _TIMES if interval < limit)
    if interval < _SLOW_LOGGER and _turn_per_sample(recording) / (interval * seconds) > _FASTEST:
        return None
    option = unit.replace("µ", "u")
    return (
        f"The samples lie {_shown(interval)} s apart by the column `time`, which looks like {unit} "
        f"({_shown(1.0 / (interval * seconds))} samples a second then). Nothing was converted: "
        f"if it is, give `--convert time={option}`."
    )


def _turn_per_sample(recording: Recording) -> float:
    """Median angle in rad by which the field turns from one sample to the next, about its centre; 0 if unknown."""
    axes = [f"mag_{axis}" for axis in _AXES]
    if not all(name in recording for name in axes):
        return 0.0
    field = recording.stack(*axes)[:_ENOUGH]
    field = field[field.isfinite().all(-1)].to(torch.float64)
    if len(field) < _FEWEST:
        return 0.0
    direction = torch.nn.functional.normalize(field - _center(field), dim=-1)
    return float((direction[1:] * direction[:-1]).sum(-1).clamp(-1.0, 1.0).acos().median())


def _shown(value: float) -> str:
    """Format a value with three digits, without an exponent below 1e9."""
    return f"{float(f'{value:.3g}'):.0f}" if 1e3 <= value < 1e9 else f"{value:.3g}"
