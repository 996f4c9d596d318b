"""Where an ellipsoid is refused: what else the recording has to calibrate by."""

from __future__ import annotations

import dataclasses

import torch

from mkc_torch.calibration.aided.calibration import aided_calibration, aids
from mkc_torch.calibration.aided.response import Place
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.result import Calibration
from mkc_torch.nonlinear import NoFitError
from mkc_torch.recording.recording import Recording, RecordingError

__all__ = ["with_aid"]


def with_aid(
    usable: Recording,
    refusal: NotIdentifiableError,
    *,
    field_strength: float | None = None,
    place: Place | None = None,
) -> Calibration:
    """The calibration by an attitude, or else by a gyroscope, with a warning that says so and why.

    Args:
        usable: as prepared for a calibration.
        refusal: of the ellipsoid.
        field_strength: length of the corrected field in µT, if given.
        place: what is known of the field, in the recording's unit.

    Raises:
        NotIdentifiableError: the refusal, and why nothing of the recording stands in for what is missing.
    """
    tried = []
    for by in aids(usable):
        try:
            found = aided_calibration(usable, by, field_strength=field_strength, place=place)
        except (ValueError, NoFitError, RecordingError, torch.linalg.LinAlgError) as error:
            tried.append(str(error).replace("Not identifiable: ", f"With the {by}: ", 1))
            continue
        reason = str(refusal).removeprefix("Not identifiable: ")
        told = (
            f"The ellipsoid alone is not identifiable; the {by} stands in for the turns that are missing. "
            f"{reason[:1].upper()}{reason[1:]}"
        )
        return dataclasses.replace(found, warnings=(*found.warnings, told, *_undetermined(found)))
    raise NotIdentifiableError(" ".join([str(refusal), *tried]), refusal.coverage, refusal.directions)


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
    return (
        f"Not determined: {' and '.join(told)}, which {'is' if len(told) == 1 else 'are'} what was likely beforehand. "
        f"A heading is good while the vehicle tilts as it did: to {aid.heading_error:.2g}°, and a constant to "
        f"{aid.constant_error:.2g}°. Tilt it more, or give the field's length and inclination by place and date.",
    )
