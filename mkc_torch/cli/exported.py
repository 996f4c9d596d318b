"""Calibrations and models as what is exported, and the exports of a recording's folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.exports import EXPORTS, Destination, ExportError, SensorCorrection
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.io.sensor_correction import sensor_correction

__all__ = ["correction_of", "exports_of", "left_from_before"]


def correction_of(known: Calibration | DiagnosedModel, path: Path, name: str | None) -> SensorCorrection:
    """What is exported of a file; a model has no name, and is called as its folder is.

    Raises:
        ExportError: a model of another simulation than the magnetometer.
    """
    given = None if name is None else name.strip()
    if isinstance(known, DiagnosedModel):
        return sensor_correction(known, given or path.resolve().parent.name)
    correction = SensorCorrection.of(known)
    return replace(correction, name=given or correction.name)


def exports_of(
    correction: SensorCorrection, kinds: Sequence[str], to: Destination
) -> tuple[dict[str, str], list[str], list[ExportError]]:
    """File names with their texts, what to notice, and what could not be exported."""
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


def left_from_before(folder: Path, written: Sequence[str]) -> list[str]:
    """A sentence about exports in a folder that are of an earlier calibration."""
    old = [export.file for export in EXPORTS.values() if export.file not in written and (folder / export.file).exists()]
    if not old:
        return []
    return [f"{', '.join(old)} in {folder} belongs to an earlier calibration: export it again, or remove it."]
