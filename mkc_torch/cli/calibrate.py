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
from mkc_torch.cli.export_options import DEVICE_ID, INSTANCE, checked_exports
from mkc_torch.cli.loading import loading
from mkc_torch.cli.units_option import HELP, METAVAR, SENSOR_HELP, parsed_units, without_units


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
    name: Annotated[
        str | None, typer.Option(help="What the sensor is called in all results; default: the recording's name.")
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(metavar="OLD.json", help="An older calibration.json to set the new one beside."),
    ] = None,
    export: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="Also write it as px4, ardupilot, c-header, ros-yaml or json; may be given several times.",
        ),
    ] = None,
    instance: INSTANCE = None,
    device_id: DEVICE_ID = None,
    unit: Annotated[list[str] | None, typer.Option(metavar=METAVAR, help=HELP)] = None,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help=SENSOR_HELP)] = None,
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

    A file with several magnetometers gets a calibration of each, in a folder of its name in that of the file.

    Exits with 0 when every recording was calibrated and 1 when some were not.
    """
    names = parsed_columns(columns)
    if field_strength is not None and not (math.isfinite(field_strength) and field_strength > 0):
        raise typer.BadParameter(f"--field-strength must be a positive number of µT but is {field_strength:g}.")
    if name is not None and (not name.strip() or len(recordings) > 1):
        raise typer.BadParameter("--name is the name of one sensor: give it with one REC, and not empty.")
    if (place is None) != (date is None):
        raise typer.BadParameter("--place and --date belong together: the field changes from year to year.")
    exports = checked_exports("--export", export or [], instance, device_id)
    recordings, texts = without_units(recordings, unit or [])
    units = parsed_units(texts)
    refuse_same_names(recordings)
    with loading():
        from mkc_torch._parallel.processes import keep_memory
        from mkc_torch.calibration.aided.place import earth_field, parsed_date, parsed_place
        from mkc_torch.calibration.exports import Destination
        from mkc_torch.cli.calibration_files import CalibrationRequest, calibrations_of, read_calibration
        from mkc_torch.cli.calibration_summary import show
    keep_memory()
    earth = None
    if place is not None and date is not None:
        try:
            earth = earth_field(*parsed_place(place), parsed_date(date))
        except (ValueError, ImportError) as error:
            raise typer.BadParameter(f"--place {place} --date {date}: {error}") from None
    try:
        old = None if against is None else read_calibration(against)
    except FAILURES as error:
        complain(str(against), error)
        raise typer.Exit(1) from None
    asked = CalibrationRequest(
        columns=names,
        units=units,
        sensor=sensor,
        field_strength=field_strength,
        name=None if name is None else name.strip(),
        old=old,
        old_file=against,
        exports=exports,
        to=Destination(instance, device_id),
        earth=earth,
    )
    console, total, failed, left = out(), 0, 0, list(recordings)
    with progress(len(recordings), output, lines=True) as step, interrupts_told(lambda: not_written(left, output)):
        for path in recordings:
            for subject, outcome in calibrations_of(path, output / path.stem, asked, force=force, step=step):
                total += 1
                with step.aside():
                    if isinstance(outcome, Exception):
                        failed += 1
                        complain(subject, outcome)
                        continue
                    show(console, outcome.calibration, outcome.files, outcome.differences, outcome.notes)
                    for refused in outcome.refused:
                        complain(subject, refused)
                    failed += bool(outcome.refused)
            left.remove(path)
            step(None)
    if total > 1 and failed:
        things = "recordings" if total == len(recordings) else "sensors"
        what = "not done in full" if asked.exports or asked.old else "not calibrated"
        err().print(f"mkc: {failed} of {total} {things} were {what}.", soft_wrap=True)
    raise typer.Exit(1 if failed else 0)
