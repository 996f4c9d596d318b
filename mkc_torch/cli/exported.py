"""Convert calibrations and models to exports, and find stale exports in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.exports import EXPORTS, Destination, ExportError, SensorCorrection

if TYPE_CHECKING:
    from mkc_torch.diagnosis import DiagnosedModel


def correction_of(known: Calibration | DiagnosedModel, path: Path, name: str | None) -> SensorCorrection:
    """Return the exportable part of a calibration or model. A model takes the name of its folder.

    Raises:
        ExportError: the model is not one of a magnetometer.
    """
    given = None if name is None else name.strip()
    if not isinstance(known, Calibration):
        from mkc_torch.diagnosis.io.sensor_correction import sensor_correction  # the import takes a second

        return sensor_correction(known, given or path.resolve().parent.name)
    correction = SensorCorrection.of(known)
    return replace(correction, name=given or correction.name)


def exports_of(
    correction: SensorCorrection, kinds: Sequence[str], to: Destination
) -> tuple[dict[str, str], list[str], list[ExportError]]:
    """Return file names with their texts, the warnings, and the errors."""
    texts: dict[str, str] = {}
    notes: list[str] = []
    refused = []
    for kind in kinds:
        try:
            exported = EXPORTS[kind].text(correction, to)
        except ExportError as error:
            refused.append(error)
            continue
        texts[EXPORTS[kind].file] = exported.text
        notes += [warning for warning in exported.warnings if warning not in notes]
    return texts, notes, refused


def stale_exports(folder: Path, written: Sequence[str]) -> list[str]:
    """Return a sentence on exports in the folder that belong to an earlier calibration, if there are any."""
    old = [export.file for export in EXPORTS.values() if export.file not in written and (folder / export.file).exists()]
    if not old:
        return []
    return [f"{', '.join(old)} in {folder} belongs to an earlier calibration: export it again, or remove it."]
