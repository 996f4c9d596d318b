"""From a recording's file to the files of its calibration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.calibration.aided.place import Field
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.calibrate import calibrate as fit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.other_sensors import as_magnetometer
from mkc_torch.cli.console import folder_removed_on_failure, with_unit
from mkc_torch.recording.recording import Recording

__all__ = ["calibrate_file"]


def calibrate_file(
    path: Path,
    folder: Path,
    *,
    columns: Mapping[str, str],
    unit: str,
    field_strength: float | None,
    force: bool,
    earth: Field | None = None,
    sensor: str = "mag",
) -> tuple[Calibration, list[Path]]:
    """Write calibration.json and report.html of a recording; where it is refused, the report alone says why."""
    recording = Recording.read(path, columns=columns)
    recording = with_unit(recording, unit) if sensor == "mag" else recording
    from mkc_torch.report import calibration_report, refusal_report

    report, result = folder / "report.html", folder / "calibration.json"
    claim_folder(folder, overwrite=force, files=(report.name, result.name))
    with folder_removed_on_failure(folder):
        try:
            calibration = fit(recording, field_strength=field_strength, earth=earth, sensor=sensor)
        except NotIdentifiableError as error:
            page = refusal_report(as_magnetometer(recording) if sensor == "accel" else recording, error)
            write_atomically(report, page, overwrite=force)
            result.unlink(missing_ok=True)  # an old one beside a new refusal would be taken for its result
            raise NotIdentifiableError(f"{error} See {report}.", error.coverage, error.directions) from None
        page = calibration_report(calibration, recording)
        write_atomically(result, calibration.to_json(), overwrite=force)
        write_atomically(report, page, overwrite=force)
    return calibration, [result, report]
