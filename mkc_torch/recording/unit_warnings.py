"""Columns whose size does not fit their unit: named, never converted."""

from __future__ import annotations

import math
import re

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.recording.recording import Recording
from mkc_torch.recording.unit_words import conversion

__all__ = ["RECORDED", "converted_from", "field_size", "field_warning", "likely_unit", "time_warning", "unit_warnings"]

RECORDED = "recorded units"
"""What measurements are in whose size does not fit the unit that they were taken for."""

_AXES = "xyz"

_FIELD = (10.0, 200.0)
"""The Earth's field in µT is 22 to 67; iron nearby and a sensor's gains change it."""

_EARTH = (20.0, 70.0)

_GUESSES = (
    (1e-5, 1e-4, "tesla (1 T = 1000000 µT)", "tesla"),
    (0.01, 0.1, "millitesla (1 mT = 1000 µT)", "mT"),
    (0.1, 1.0, "gauss (1 gauss = 100 µT)", "gauss"),
    (200.0, 1000.0, "milligauss (10 mG = 1 µT)", "mG"),
    (2e4, 1e5, "nanotesla (1000 nT = 1 µT)", "nT"),
)


_FEWEST, _ENOUGH, _REWEIGHTED = 20, 1000, 20
"""Fewest samples that a centre is sought from, how many of more, and how often they are weighed anew."""

_LARGER = 1.2
_SCATTER, _ASIDE = 0.25, 0.7
"""Scatter of the distances from a centre, as a share of them, and length of the mean of the directions, up to which a
sensor turned about that centre: one that hardly turns shows its field and its offset as one."""

_TIMES = ((1e3, "ms", 1e-3), (1e6, "µs", 1e-6), (math.inf, "ns", 1e-9))
"""Up to which interval a time is taken for one in which unit: fifty samples a second are in the midst of it."""


def unit_warnings(recording: Recording) -> tuple[str, ...]:
    """A sentence for each group of columns that looks as if it were in another unit than the recording says.

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
    """Length of the field, without a large offset of the sensor where its turns tell the two apart.

    In the unit of ``mag_x``; None where an axis is missing, or all of its samples.

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
    # an offset makes the length larger; a sphere that is larger itself goes through outliers
    if not 0.0 < radius < _LARGER * length or float(torch.linalg.vector_norm(center)) < 0.5 * radius:
        return length
    scatter = float(robust_scale(distance.unsqueeze(-1) - radius)) / radius
    aside = float(torch.linalg.vector_norm((away / distance.clamp(min=1e-300).unsqueeze(-1)).mean(0)))
    return radius if scatter < _SCATTER and aside < _ASIDE else length


def _center(field: Tensor) -> Tensor:
    """Of the sphere nearest to most samples, as near to their median as they leave it open."""
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
        left = (square - regressors @ known).abs()
        weight = (1.0 + (left / (2.0 * left.median()).clamp(min=1e-12)).square()).reciprocal().square()
    return middle + size * known[:3]


def converted_from(recording: Recording) -> str:
    """The unit that the magnetometer was converted from; empty where it was not.

    Example:
        >>> import torch
        >>> told = ("`mag_x`, `mag_y`, `mag_z`: converted from gauss, as the file says, to µT.",)
        >>> converted_from(Recording({"mag_x": torch.zeros(3)}, warnings=told))
        'gauss'
    """
    found = [re.match(r"`mag_x`.*: converted from (\S+), ", sentence) for sentence in recording.warnings]
    return next((one[1] for one in found if one), "")


def field_warning(size: float, unit: str, what: str, numbers: str, before: str = "") -> str | None:
    """A sentence about a field that is in another unit than is said; None where it may be right.

    Args:
        size: of the field.
        unit: that is said; any but µT is believed.
        what: the subject and verb of the sentence.
        numbers: what is in the columns' own unit.
        before: the unit that was said, and that the columns were converted from.

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
        mend = f"; say `--unit mag={option}` if that is what they are in" if option else ""
        return (
            f"The {what} {_shown(size)} µT, which is not the size of the Earth's field, since the columns "
            f"were converted from {before}; they may be in another unit than was said{mend}."
        )
    guess = _guess(size)
    likely = "these may be raw counts" if guess is None else f"in {guess[0]} it would be"
    option = "name the unit with `--unit`, or" if guess is None else f"say `--unit mag={guess[1]}` if it is, or"
    return (
        f"The {what} {_shown(size)} µT, which is not the size of the Earth's field; {likely}. Nothing was converted: "
        f"{option} convert the columns; {numbers} are in the columns' own unit."
    )


def _other_unit(size: float, before: str) -> str:
    """The unit in which the numbers would be the Earth's field; empty where there is none."""
    known = conversion("mag", before)
    raw = size / float(known.factor) if known is not None else math.nan
    for option in ("uT", "gauss", "mG", "nT", "tesla", "mT"):
        other = conversion("mag", option)
        if other is not None and _EARTH[0] <= raw * float(other.factor) <= _EARTH[1]:
            return option
    return ""


def likely_unit(size: float) -> tuple[str, str] | None:
    """The unit in which a field would be the Earth's, that is not so in µT; None where it is, or where none fits.

    Args:
        size: of the field, taken for µT.

    Returns:
        The unit in words, and as ``--unit mag=`` takes it.

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
        "was converted: say `--unit gyro=deg/s` if it is."
    )


def _acceleration(recording: Recording) -> str | None:
    size = _typical(recording, "accel")
    if size is None or recording.units["accel_x"] != "m/s²" or 3.0 <= size <= 40.0:
        return None
    return (
        f"The accelerometer measures about {size:.3g} m/s² instead of 9.8; it may be in g. "
        "Nothing was converted: say `--unit accel=g` if it is."
    )


def time_warning(recording: Recording) -> str | None:
    """A sentence about times of a sensor that are not in seconds; None where they may be.

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
    option = unit.replace("µ", "u")
    return (
        f"The samples lie {_shown(interval)} s apart by the column `time`, which looks like {unit} "
        f"({_shown(1.0 / (interval * seconds))} samples a second then). Nothing was converted: "
        f"say `--unit time={option}` if it is."
    )


def _shown(value: float) -> str:
    """Three digits, all digits of a large number where they are not too many."""
    return f"{float(f'{value:.3g}'):.0f}" if 1e3 <= value < 1e9 else f"{value:.3g}"
