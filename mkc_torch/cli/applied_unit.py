"""Refuse to correct a recording whose unit is not that of the calibrated recording."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.cli.correction import OTHER_LENGTH, Corrected, unit_of
from mkc_torch.cli.recorded import ReadAgain, refuse_likely_size, unit_option
from mkc_torch.recording.recording import Recording, RecordingError
from mkc_torch.recording.unit_warnings import EARTH, RECORDED, field_size, likely_unit
from mkc_torch.recording.unit_words import CANONICAL, factors
from mkc_torch.report.words.numbers import size

if TYPE_CHECKING:
    from mkc_torch.diagnosis import DiagnosedModel

_FARTHEST = EARTH[1] / EARTH[0]
"""Largest ratio of the Earth's field at two places; a larger ratio of field lengths is another unit or sensor."""


def corrected_in_its_unit(
    path: Path,
    read: ReadAgain,
    known: Calibration | DiagnosedModel,
    correct: Callable[[Recording], Corrected],
) -> Corrected:
    """Correct a recording, unless its unit is not that of the calibrated recording.

    A stated unit is compared by name. Without a stated unit, a field of the size of the Earth's field in another unit
    is refused as `mkc calibrate` refuses it, and so is a corrected field whose length fits the calibrated recording
    only in another unit, or fits no place on the Earth.

    Args:
        path: the recording, for the messages.
        read: the recording and the columns whose unit is stated.
        known: the calibration or the model.
        correct: corrects a recording.

    Raises:
        RecordingError: the recording is in another unit; the message names the option that gives its unit.
    """
    quantity = known.sensor if isinstance(known, Calibration) else "mag"
    axes = tuple(f"{quantity}_{axis}" for axis in "xyz")
    made_in, stated = unit_of(known), read.stated & set(axes)
    comparable = made_in not in ("", RECORDED)
    if stated and comparable:
        _refuse_other_name(path, read.recording.units[min(stated)], quantity, made_in)
    corrected = correct(read.recording)
    if stated and comparable:
        return corrected
    here = _misfit(corrected)
    others = () if made_in != CANONICAL[quantity] else _fitting(read.recording, axes, correct, here)
    measured = field_size(read.recording) if quantity == "mag" and made_in == "µT" else None
    likely = None if measured is None else likely_unit(measured)
    fits = here is not None and here <= math.log(OTHER_LENGTH)
    if measured is not None and likely is not None and (not fits or likely[1] in others):
        refuse_likely_size(path, measured)
    if here is None or fits:
        return corrected
    if others:
        raise RecordingError(
            f"{path}: {', '.join(axes)} have no stated unit; taken in {made_in}, the size of the corrected field is "
            f"{_times(corrected)}; in {others[0]} it would fit. If that is the unit, give "
            f"`--convert {quantity}={others[0]}`; if not, give the unit: `{unit_option(quantity, made_in)}`."
        )
    if here > math.log(_FARTHEST):
        remedy = f"`{unit_option(quantity, made_in)}`" if comparable else "`--convert` or `--unit-label`"
        raise RecordingError(
            f"{path}: the size of the corrected field is {_times(corrected)}, more than between any two places on "
            f"the Earth: {', '.join(axes)} are in another unit, or of another sensor. Convert the columns, or state "
            f"their unit with {remedy}."
        )
    return corrected


def _refuse_other_name(path: Path, unit: str, quantity: str, made_in: str) -> None:
    """Raise if the stated unit is not that of the calibrated recording."""
    if unit != made_in:
        sensor = "magnetometer" if quantity == "mag" else "accelerometer"
        raise RecordingError(
            f"{path}: the {sensor} is in {unit}, but the calibrated recording was in {made_in}; convert the columns, "
            f"or give their unit with `{unit_option(quantity, made_in)}`."
        )


def _misfit(corrected: Corrected) -> float | None:
    """Absolute logarithm of the ratio of the corrected field's size to the calibrated length; None if unknown."""
    ratio = _ratio(corrected)
    return None if ratio is None else abs(math.log(ratio))


def _ratio(corrected: Corrected) -> float | None:
    """Size of the corrected field over the calibrated length; None if either is unknown.

    Of a sensor that turned it is the radius about the field's own centre: in a wrong unit the offset remains, and can
    have the length of the field.
    """
    field = corrected.field()
    if field is None or corrected.length is None:
        return None
    found = field_size(Recording(dict(zip(("mag_x", "mag_y", "mag_z"), field.unbind(-1), strict=True))))
    return None if found is None or not found > 0.0 else found / corrected.length


def _fitting(
    recording: Recording, axes: tuple[str, ...], correct: Callable[[Recording], Corrected], here: float | None
) -> tuple[str, ...]:
    """Return the units, as spelled for `--convert`, in which the corrected field has the calibrated length."""
    quantity, found = axes[0].partition("_")[0], []
    for name, factor in factors(quantity).items():
        # a smaller unit shrinks every field to the offset, whose length can fit by chance
        if factor == 1.0 or here is None or (factor < 1.0 and here <= math.log(_FARTHEST)):
            continue
        misfit = _misfit(correct(_scaled(recording, axes, factor)))
        if misfit is not None and misfit < math.log(OTHER_LENGTH):
            found.append(name)
    return tuple(found)


def _scaled(recording: Recording, axes: tuple[str, ...], factor: float) -> Recording:
    columns = dict(recording.columns) | {axis: factor * recording[axis].to(torch.float64) for axis in axes}
    return Recording(columns, name=recording.name, units=recording.units, labels=recording.labels)


def _times(corrected: Corrected) -> str:
    ratio = _ratio(corrected)
    assert ratio is not None
    assert corrected.length is not None
    return f"{size(ratio)} times the {size(corrected.length)} {corrected.unit} of the calibrated recording".replace(
        "  ", " "
    )
