"""``mkc calibrate``: recordings in, a calibration and a report each out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.calibrate import calibrate as fit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.cli.calibration_summary import show
from mkc_torch.cli.console import (
    FAILURES,
    complain,
    err,
    folder_removed_on_failure,
    interrupts_told,
    not_written,
    out,
    parsed_columns,
    progress,
    refuse_same_names,
    with_unit,
)
from mkc_torch.recording.recording import Recording


def calibrate(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC...", help="CSV or Parquet files with a header.")],
    output: Annotated[Path, typer.Option(help="Folder; each REC gets a folder of its name in it.")],
    columns: Annotated[
        str | None,
        typer.Option(metavar="NAME=COLUMN,...", help="What the columns are called: mag_x=mx,mag_y=my,mag_z=mz"),
    ] = None,
    field_strength: Annotated[
        float | None,
        typer.Option(metavar="µT", help="Length of the corrected field in µT; default: as measured."),
    ] = None,
    unit: Annotated[str, typer.Option(help="Unit of the magnetometer's columns, such as counts.")] = "µT",
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Find a magnetometer's offset, gains and cross-axis coupling in recordings of it being turned.

    Exits with 0 when every recording was calibrated and 1 when some were not.
    """
    names = parsed_columns(columns)
    if field_strength is not None and not (math.isfinite(field_strength) and field_strength > 0):
        raise typer.BadParameter(f"--field-strength must be a positive number of µT but is {field_strength:g}.")
    if not unit.strip():
        raise typer.BadParameter("--unit is empty; name the unit, such as counts.")
    refuse_same_names(recordings)
    console, failed, left = out(), 0, list(recordings)
    with progress(len(recordings)) as step, interrupts_told(lambda: not_written(left, output)):
        for path in recordings:
            step(f"calibrating {path.name}")
            try:
                recording = with_unit(Recording.read(path, columns=names), unit)
                calibration, files = calibrate_into(output / path.stem, recording, field_strength, force=force)
            except FAILURES as error:
                failed += 1
                with step.aside():
                    complain(path, error)
            else:
                with step.aside():
                    show(console, calibration, files)
            left.remove(path)
            step(None)
    if len(recordings) > 1 and failed:
        err().print(f"mkc: {failed} of {len(recordings)} recordings were not calibrated.", soft_wrap=True)
    raise typer.Exit(1 if failed else 0)


def calibrate_into(
    folder: Path, recording: Recording, field_strength: float | None, *, force: bool
) -> tuple[Calibration, list[Path]]:
    """Write calibration.json and report.html of a recording; where it is refused, the report alone says why."""
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
        page = calibration_report(calibration, recording)
        write_atomically(result, calibration.to_json(), overwrite=force)
        write_atomically(report, page, overwrite=force)
    return calibration, [result, report]
