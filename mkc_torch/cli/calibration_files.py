"""From a recording's file to the files of its calibrations, one for each magnetometer in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.calibrate import calibrate as fit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.cli.console import FAILURES, folder_names, folder_removed_on_failure, remove_if_empty
from mkc_torch.cli.recorded import read_magnetometer, refuse_likely_size, sensor_names

__all__ = ["calibrate_file", "calibrations_of"]


def calibrations_of(
    path: Path,
    folder: Path,
    *,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    sensor: str | None,
    field_strength: float | None,
    force: bool,
) -> Iterator[tuple[str, tuple[Calibration, list[Path]] | Exception]]:
    """Calibrate each magnetometer of a file: one alone into the folder, several into folders of their names in it.

    Yields:
        What it is of, for messages, and the calibration with its files, or why there is none.
    """
    try:
        names = sensor_names(path, columns, sensor)
        if len(names) > 1:
            claim_folder(folder, overwrite=force)
    except FAILURES as error:
        yield str(path), error
        return
    places = [folder / name for name in folder_names([str(name) for name in names])] if len(names) > 1 else [folder]
    for name, place in zip(names, places, strict=True):
        subject = f"{path}, sensor {name}" if len(names) > 1 else str(path)
        try:
            yield (
                subject,
                calibrate_file(
                    path, place, columns=columns, units=units, sensor=name, field_strength=field_strength, force=force
                ),
            )
        except FAILURES as error:
            yield subject, error
    remove_if_empty(folder)


def calibrate_file(
    path: Path,
    folder: Path,
    *,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    sensor: str | None,
    field_strength: float | None,
    force: bool,
) -> tuple[Calibration, list[Path]]:
    """Write calibration.json and report.html of a recording; where it is refused, the report alone says why."""
    recording, found = read_magnetometer(path, columns, units, sensor)
    from mkc_torch.report import calibration_report, refusal_report

    report, result = folder / "report.html", folder / "calibration.json"
    claim_folder(folder, overwrite=force, files=(report.name, result.name))
    with folder_removed_on_failure(folder):
        try:
            calibration = fit(recording, field_strength=field_strength)
        except NotIdentifiableError as error:
            page = refusal_report(recording, error)
            write_atomically(report, page, overwrite=force)
            result.unlink(missing_ok=True)  # an old one beside a new refusal would be taken for its result
            raise NotIdentifiableError(f"{error} See {report}.", error.coverage, error.directions) from None
        if not found.said & {"mag_x", "mag_y", "mag_z"}:
            refuse_likely_size(path, calibration.radius)
        page = calibration_report(calibration, recording)
        write_atomically(result, calibration.to_json(), overwrite=force)
        write_atomically(report, page, overwrite=force)
    return calibration, [result, report]
