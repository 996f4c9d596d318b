"""Where an ellipsoid is refused: what else the recording has to calibrate by."""

from __future__ import annotations

import dataclasses
import math

from torch.linalg import LinAlgError  # type: ignore[attr-defined]

from mkc_torch.calibration.aided.calibration import aided_calibration, aids
from mkc_torch.calibration.aided.place import Field
from mkc_torch.calibration.aided.response import PlaceField
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.result import Calibration
from mkc_torch.nonlinear import NoFitError
from mkc_torch.recording.recording import Recording, RecordingError

__all__ = ["with_aid"]

_GROUND = 0.01
"""Standard deviation of what rock and buildings add to the field, as a share of it, and of its inclination in rad."""

_MANY = 0.2
"""Share of rejected samples above which a steady sensor is a doubtful model, as for an ellipsoid."""

_OTHER = 0.15
"""Share by which a field is another one than the place's; gains of a chip are off by some per cent."""


def with_aid(
    usable: Recording,
    refusal: NotIdentifiableError,
    *,
    field_strength: float | None = None,
    earth: Field | None = None,
) -> Calibration:
    """The calibration by an attitude, or else by a gyroscope, with a warning that says so and why.

    Args:
        usable: as prepared for a calibration.
        refusal: of the ellipsoid.
        field_strength: length of the corrected field in µT, if given.
        earth: the field at the place of the recording.

    Raises:
        NotIdentifiableError: the refusal, and why nothing of the recording stands in for what is missing.
    """
    tried, place = [], _known(usable, earth)
    for by in (*aids(usable), *(["place"] if place else [])):
        try:
            found = aided_calibration(usable, by, field_strength=field_strength, place=place)
        except (ValueError, NoFitError, RecordingError, LinAlgError) as error:
            tried.append(str(error).replace("Not identifiable: ", f"With the {by}: ", 1))
            continue
        reason = str(refusal).removeprefix("Not identifiable: ")
        stands = "the field of the place" if by == "place" else f"the {by}"
        told = (
            f"The ellipsoid alone is not identifiable; {stands} stands in for the turns that are missing. "
            f"{reason[:1].upper()}{reason[1:]}"
        )
        return dataclasses.replace(
            found,
            warnings=(
                *found.warnings,
                told,
                *([_taken(place)] if by == "place" and place else []),
                *_rejected(found),
                *_undetermined(found),
                *_other(found, earth),
            ),
        )
    raise NotIdentifiableError(" ".join([str(refusal), *tried]), refusal.coverage, refusal.directions)


def _known(usable: Recording, earth: Field | None) -> PlaceField | None:
    """The field in the recording's unit, where that is µT."""
    if earth is None or usable.units["mag_x"] != "µT":
        return None
    return PlaceField(earth.strength, earth.inclination, _GROUND * earth.strength, _GROUND)


def _taken(place: PlaceField) -> str:
    """What a calibration by place and date takes for true."""
    return (
        "The vehicle is taken to turn on level ground, and the sensor's axes for those of the vehicle: lengths do not "
        "tell how it is turned in it. Each degree about the vertical is one of every heading, and each that it leans "
        f"against the vehicle up to {abs(math.tan(place.inclination)):.2g}°. Compare one heading with a known one."
    )


def _rejected(found: Calibration) -> tuple[str, ...]:
    """A sentence about many samples that the turns do not explain."""
    if found.rejected_share <= _MANY:
        return ()
    return (
        f"{100.0 * found.rejected_share:.0f} % of the samples do not fit how the vehicle turned: currents, or a change "
        "of the offset, may be in them, and errors may be larger than the standard errors say. `mkc diagnose` says "
        "what changed, and when.",
    )


def _other(found: Calibration, earth: Field | None) -> tuple[str, ...]:
    """A sentence about a field that is another one than the place's."""
    if earth is None or found.unit != "µT" or abs(found.radius / earth.strength - 1.0) < _OTHER:
        return ()
    return (
        f"The field found is {found.radius:.3g} µT long, that of the place {earth.strength:.3g} µT: check the unit, "
        "the place and what of iron is near.",
    )


def _undetermined(found: Calibration) -> tuple[str, ...]:
    """What the recording does not determine, and what the calibration is good for."""
    aid = found.aid
    assert aid is not None
    told = []
    offsets = [name[-1] for name in aid.undetermined if name.startswith("offset")]
    entries = [name[-2:] for name in aid.undetermined if name.startswith("matrix")]
    if offsets:
        told.append(f"the offset of {', '.join(offsets)}")
    if entries:
        told.append("the matrix" if len(entries) == 9 else f"the matrix at {', '.join(entries)}")
    if not told:
        return ()
    constant = "" if math.isinf(aid.constant_error) else f", and a constant to {aid.constant_error:.2g}°"
    advice = ", or give place and date of the recording, beside an attitude or an accelerometer"
    return (
        f"Not determined: {' and '.join(told)}, which {'is' if len(told) == 1 else 'are'} what was likely beforehand. "
        f"A heading is good while the vehicle tilts as it did: to {aid.heading_error:.2g}°{constant}. "
        f"Tilt it more{'' if aid.by == 'place' else advice}.",
    )
