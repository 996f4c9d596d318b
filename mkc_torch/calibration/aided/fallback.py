"""Calibrate with the aids in a recording if the ellipsoid fit is rejected."""

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

_GROUND = 0.01
"""Standard deviation of the local anomaly of rock and buildings: of the field's length, relative; and of its
inclination, in rad."""

_MANY = 0.2
"""Share of rejected samples above which there is a warning that the sensor may have changed."""

_OTHER = 0.15
"""Relative difference from the place's field above which there is a warning; gains differ by a few per cent."""


def with_aid(
    usable: Recording, refusal: NotIdentifiableError, *, field_strength: float | None = None, earth: Field | None = None
) -> Calibration:
    """Calibrate by an attitude, a gyroscope or the field of the place; a note gives the reason.

    Args:
        usable: recording as prepared for a calibration.
        refusal: the error of the ellipsoid fit.
        field_strength: length of the corrected field in µT, if given.
        earth: the field at the place of the recording.

    Raises:
        NotIdentifiableError: the error of the ellipsoid fit and of each aid.
    """
    tried, place = [], _known(usable, earth)
    for by in (*aids(usable), *(["place"] if place else [])):
        try:
            found = aided_calibration(usable, by, field_strength=field_strength, place=place)
        except (ValueError, NoFitError, RecordingError, LinAlgError) as error:
            tried.append(str(error).replace("Not identifiable: ", f"With the {by}: ", 1))
            continue
        reason = str(refusal).removeprefix("Not identifiable: ").split(" Turn the sensor ")[0]
        stands = "the field of the place" if by == "place" else f"the {by}"
        explanation = (
            f"The ellipsoid alone is not identifiable; {stands} replaces the missing turns. "
            f"{reason[:1].upper()}{reason[1:]}"
        )
        return dataclasses.replace(
            found,
            warnings=(
                *_rejected(found),
                *_undetermined(found),
                *_other(found, earth),
                *([_taken(place)] if by == "place" and place else []),
                *found.warnings,
            ),
            notes=(*found.notes, explanation),
        )
    raise NotIdentifiableError(" ".join([str(refusal), *tried]), refusal.coverage, refusal.directions)


def _known(usable: Recording, earth: Field | None) -> PlaceField | None:
    """The prior of the field in the recording's unit; None if that is not µT."""
    if earth is None or usable.units["mag_x"] != "µT":
        return None
    return PlaceField(earth.strength, earth.inclination, _GROUND * earth.strength, _GROUND)


def _taken(place: PlaceField) -> str:
    """The assumptions of a calibration by place and date, as a warning."""
    return (
        "This assumes that the vehicle turns on level ground, and that the sensor's axes are those of the vehicle: "
        "lengths do not determine its mounting. Each degree of rotation about the vertical is a degree in every "
        f"heading, and each degree of tilt up to {abs(math.tan(place.inclination)):.2g}°. Compare a heading with a "
        "known heading."
    )


def _rejected(found: Calibration) -> tuple[str, ...]:
    """A warning if many samples do not fit the turns of the vehicle."""
    if found.rejected_share <= _MANY:
        return ()
    return (
        f"{100.0 * found.rejected_share:.0f} % of the samples do not fit the vehicle's turns: they may contain fields "
        "of currents, or a change of the offset, and errors may be larger than the standard errors. `mkc diagnose` "
        "reports what changed and when.",
    )


def _other(found: Calibration, earth: Field | None) -> tuple[str, ...]:
    """A warning about a field that differs from the place's field."""
    if earth is None or found.unit != "µT" or abs(found.radius / earth.strength - 1.0) < _OTHER:
        return ()
    return (
        f"The length of the field is {found.radius:.3g} µT, but that of the place is {earth.strength:.3g} µT: check "
        "the unit, the place, and iron nearby.",
    )


def _undetermined(found: Calibration) -> tuple[str, ...]:
    """A warning about what the recording does not determine, and the resulting accuracy of a heading."""
    aid = found.aid
    assert aid is not None
    parts = []
    offsets = [name[-1] for name in aid.undetermined if name.startswith("offset")]
    entries = [name[-2:] for name in aid.undetermined if name.startswith("matrix")]
    if offsets:
        parts.append(f"the offset of {', '.join(offsets)}")
    if entries:
        parts.append("the matrix" if len(entries) == 9 else f"the matrix at {', '.join(entries)}")
    if not parts:
        return ()
    constant = "" if math.isinf(aid.constant_error) else f", and a constant offset of it to {aid.constant_error:.2g}°"
    advice = ", or give place and date of the recording, with an attitude or an accelerometer"
    return (
        f"Not determined: {' and '.join(parts)}, which {'keeps its' if len(parts) == 1 else 'keep their'} prior value. "
        f"While the vehicle tilts no more than it did, a heading is known to {aid.heading_error:.2g}°{constant}. "
        f"Tilt it more{'' if aid.by == 'place' else advice}.",
    )
