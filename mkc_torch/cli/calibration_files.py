"""From a recording's file to the files of its calibration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.calibration.calibrate import Calibration, prepared
from mkc_torch.calibration.calibrate import calibrate as fit
from mkc_torch.calibration.differences import Differences, differences
from mkc_torch.calibration.exports import EXPORTS, Destination, SensorCorrection
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.cli.console import folder_written, with_unit
from mkc_torch.cli.correction import read_correction
from mkc_torch.cli.exported import exports_of, left_from_before
from mkc_torch.recording.recording import Recording

__all__ = ["Asked", "Found", "calibrate_file", "read_calibration"]


class Asked(NamedTuple):
    """What a user asked for, of all recordings.

    Attributes:
        columns, unit: of the recordings' files.
        field_strength: in µT, where it is known.
        name: of the sensor; None for the recording's.
        old, old_file: the calibration that the new one is set beside, and where it is from.
        exports: kinds of further files.
        to: for these.
    """

    columns: Mapping[str, str]
    unit: str
    field_strength: float | None
    name: str | None = None
    old: Calibration | None = None
    old_file: Path | None = None
    exports: tuple[str, ...] = ()
    to: Destination = Destination()


class Found(NamedTuple):
    """A calibration and what came of it.

    Attributes:
        calibration: of the recording.
        files: that were written.
        differences: from the old one.
        notes: what to notice of the exports.
        refused: what was asked for besides the calibration and could not be done.
    """

    calibration: Calibration
    files: list[Path]
    differences: Differences | None
    notes: list[str]
    refused: list[ValueError]


def read_calibration(path: Path) -> Calibration:
    """The calibration of a file.

    Raises:
        ValueError: it is none.
        OSError: the file cannot be read.
    """
    known = read_correction(path)
    if not isinstance(known, Calibration):
        raise ValueError("this is the model of a diagnosis; give the calibration.json of `mkc calibrate`.")
    return known


def calibrate_file(path: Path, folder: Path, asked: Asked, *, force: bool) -> Found:
    """Write calibration.json and report.html of a recording; where it is refused, the report alone says why."""
    recording = with_unit(Recording.read(path, columns=asked.columns), asked.unit)
    from mkc_torch.report import calibration_report, refusal_report

    report, result = folder / "report.html", folder / "calibration.json"
    if asked.old_file is not None and result.exists() and result.samefile(asked.old_file):
        raise ValueError(f"{result} is what the new one is set beside, and is not replaced; choose another --output.")
    files = (report.name, result.name, *(EXPORTS[kind].file for kind in asked.exports))
    claim_folder(folder, overwrite=force, files=files)
    with folder_written(folder):
        try:
            calibration = fit(recording, field_strength=asked.field_strength, name=asked.name)
        except NotIdentifiableError as error:
            page = refusal_report(recording, error)
            write_atomically(report, page, overwrite=force)
            result.unlink(missing_ok=True)  # an old one beside a new refusal would be taken for its result
            told = " ".join([f"{error} See {report}.", *left_from_before(folder, ())])
            raise NotIdentifiableError(told, error.coverage, error.directions) from None
        beside, refused = _beside(calibration, recording, asked.old)
        texts, notes, not_exported = exports_of(SensorCorrection.of(calibration), asked.exports, asked.to)
        page = calibration_report(calibration, recording, against=beside)
        write_atomically(result, calibration.to_json(), overwrite=force)
        write_atomically(report, page, overwrite=force)
        for name, text in texts.items():
            write_atomically(folder / name, text, overwrite=force)
        notes += left_from_before(folder, list(texts))
    written = [result, report, *(folder / name for name in texts)]
    return Found(calibration, written, beside, notes, [*refused, *not_exported])


def _beside(
    calibration: Calibration, recording: Recording, old: Calibration | None
) -> tuple[Differences | None, list[ValueError]]:
    """The differences from an old one, over the samples in use; or why there are none."""
    if old is None:
        return None, []
    points = prepared(recording).magnetometer()
    try:
        return differences(calibration, old, points[calibration.weight(points) >= 0.5]), []
    except ValueError as error:
        return None, [error]
