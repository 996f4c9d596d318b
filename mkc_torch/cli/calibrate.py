"""``mkc calibrate``: recordings in, a calibration and a report each out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from mkc_torch.cli.console import (
    FAILURES,
    complain,
    err,
    interrupts_told,
    not_written,
    out,
    parsed_columns,
    progress,
    refuse_same_names,
)
from mkc_torch.cli.loading import loading


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
    sensor: Annotated[
        str, typer.Option(metavar="mag|accel", help="accel: an accelerometer, accel_x, accel_y, accel_z, by gravity.")
    ] = "mag",
    place: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON[,ALT]", help="Where it was recorded, in ° and m: the field's length, with --date."
        ),
    ] = None,
    date: Annotated[str | None, typer.Option(metavar="YYYY-MM-DD", help="When it was recorded, with --place.")] = None,
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
    if sensor not in ("mag", "accel"):
        raise typer.BadParameter(f"--sensor must be mag or accel but is {sensor}.")
    if (place is None) != (date is None):
        raise typer.BadParameter("--place and --date belong together: the field changes from year to year.")
    refuse_same_names(recordings)
    with loading():
        from mkc_torch._parallel.processes import keep_memory
        from mkc_torch.calibration.aided.place import earth_field, parsed_date, parsed_place
        from mkc_torch.cli.calibration_files import calibrate_file
        from mkc_torch.cli.calibration_summary import show
    keep_memory()
    earth = None
    if place is not None and date is not None:
        try:
            earth = earth_field(*parsed_place(place), parsed_date(date))
        except (ValueError, ImportError) as error:
            raise typer.BadParameter(f"--place {place} --date {date}: {error}") from None
    console, failed, left = out(), 0, list(recordings)
    with progress(len(recordings), output) as step, interrupts_told(lambda: not_written(left, output)):
        for path in recordings:
            step(f"calibrating {path.name}")
            try:
                calibration, files = calibrate_file(
                    path,
                    output / path.stem,
                    columns=names,
                    unit=unit,
                    field_strength=field_strength,
                    force=force,
                    earth=earth,
                    sensor=sensor,
                )
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
