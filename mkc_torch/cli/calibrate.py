"""``mkc calibrate``: write a calibration and a report for each recording."""

from __future__ import annotations

import math
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mkc_torch.cli.console import (
    DOUBTFUL,
    FAILURES,
    complain,
    err,
    interrupts_reported,
    not_written,
    out,
    parsed_columns,
    progress,
    refuse_same_names,
)
from mkc_torch.cli.early import refuse_unreadable
from mkc_torch.cli.export_options import DEVICE_ID, INSTANCE, checked_exports
from mkc_torch.cli.loading import loading
from mkc_torch.cli.units_option import (
    CONVERT_HELP,
    CONVERT_METAVAR,
    LABEL_HELP,
    SENSOR_HELP,
    parsed_units,
    reading_options,
    split_trailing_pairs,
)

if TYPE_CHECKING:
    from mkc_torch.calibration import Calibration


class Quantity(str, Enum):
    """The vector that a sensor measures."""

    mag = "mag"
    accel = "accel"


def calibrate(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC...", help="CSV or Parquet files with a header, or logs.")
    ],
    output: Annotated[Path, typer.Option(help="Folder for the results; each REC gets a subfolder of its name.")] = Path(
        "results"
    ),
    columns: Annotated[
        str | None,
        typer.Option(metavar="NAME=COLUMN,...", help="Names of the columns in the file: mag_x=mx,mag_y=my,mag_z=mz"),
    ] = None,
    field_strength: Annotated[
        float | None,
        typer.Option(
            metavar="µT",
            help="Length of the corrected field in µT (accelerometer: m/s²); default: as measured.",
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the sensor in all results; default: the name of the recording.")
    ] = None,
    compare_with: Annotated[
        Path | None,
        typer.Option(metavar="OLD.json", help="An earlier calibration.json to compare the new one with."),
    ] = None,
    export: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="Also write the calibration as px4, ardupilot, c-header, ros-yaml, imu-calib or json; repeatable.",
        ),
    ] = None,
    instance: INSTANCE = None,
    device_id: DEVICE_ID = None,
    convert: Annotated[list[str] | None, typer.Option(metavar=CONVERT_METAVAR, help=CONVERT_HELP)] = None,
    unit_label: Annotated[str | None, typer.Option(metavar="UNIT", help=LABEL_HELP)] = None,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help=SENSOR_HELP)] = None,
    quantity: Annotated[
        Quantity, typer.Option(help="Calibrate the magnetometer, or the accelerometer in accel_x, accel_y, accel_z.")
    ] = Quantity.mag,
    place: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON[,ALT]",
            help="Where it was recorded, in ° and m; with --recorded-on this sets the field's length.",
        ),
    ] = None,
    date: Annotated[
        str | None,
        typer.Option("--recorded-on", metavar="YYYY-MM-DD", help="When it was recorded; needs --place."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Calibrate a magnetometer: estimate offset, gains and cross-axis coupling while the sensor is turned.

    A file with several magnetometers gets a calibration for each, in a subfolder of the sensor's name. Several REC also
    get fleet.html, fleet.csv and fleet.json, which compare their calibrations.

    The exit code is 0 if every recording was calibrated, 1 if one was not, and 3 if all were but a result is doubtful:
    the correction reduces no scatter, a third of the samples was rejected, or the sensor's offset changed.
    """
    names = parsed_columns(columns)
    if field_strength is not None and not (math.isfinite(field_strength) and field_strength > 0):
        raise typer.BadParameter(f"--field-strength must be a positive number of µT but is {field_strength:g}.")
    if name is not None and (not name.strip() or len(recordings) > 1):
        raise typer.BadParameter("--name names one sensor: give it with one REC, and not empty.")
    if (place is None) != (date is None):
        raise typer.BadParameter(
            "--place and --recorded-on need each other, because the field changes from year to year."
        )
    if sensor is not None and quantity is Quantity.accel:
        raise typer.BadParameter("--sensor names a magnetometer; leave it out with --quantity accel.")
    exports = checked_exports("--export", export or [], instance, device_id)
    recordings, conversions = split_trailing_pairs(recordings, convert or [])
    units = parsed_units(conversions, unit_label)
    refuse_same_names(recordings)
    read_with = reading_options(names, conversions, unit_label)
    if len(recordings) == 1:  # of several, the others are calibrated all the same
        refuse_unreadable(recordings[0], names, sensor, magnetometer=quantity is Quantity.mag)
    with loading():
        from mkc_torch._parallel.processes import keep_memory
        from mkc_torch.calibration.aided.place import earth_field, parsed_date, parsed_place
        from mkc_torch.calibration.exports import Destination
        from mkc_torch.cli.calibration_files import (
            CalibrationOutcome,
            CalibrationRequest,
            calibrations_of,
            read_calibration,
        )
        from mkc_torch.cli.calibration_results import show_results
        from mkc_torch.cli.console import sentence_of
        from mkc_torch.cli.fleet_files import claim_page, write_calibrations
    keep_memory()
    earth = None
    if place is not None and date is not None:
        try:
            earth = earth_field(*parsed_place(place), parsed_date(date))
        except (ValueError, ImportError) as error:
            raise typer.BadParameter(f"--place {place} --recorded-on {date}: {error}") from None
    try:
        old = None if compare_with is None else read_calibration(compare_with)
    except FAILURES as error:
        complain(str(compare_with), error)
        raise typer.Exit(1) from None
    request = CalibrationRequest(
        columns=names,
        units=units,
        sensor=sensor,
        quantity=quantity.value,
        field_strength=field_strength,
        name=None if name is None else name.strip(),
        old=old,
        old_file=compare_with,
        exports=exports,
        to=Destination(instance, device_id),
        earth=earth,
        read_with=read_with,
    )
    shown_with = reading_options(names, conversions, unit_label, sensor)
    console, total, failed, doubtful, left = out(), 0, 0, 0, list(recordings)
    done: dict[Path, Calibration] = {}
    failures: dict[str, str] = {}
    if len(recordings) > 1:
        claim_page(output)
    with progress(len(recordings), output, lines=True) as step, interrupts_reported(lambda: not_written(left, output)):
        for path in recordings:
            results = list(calibrations_of(path, output / path.stem, request, force=force, step=step))
            with step.aside():
                counts = show_results(console, path, results, shown_with)
            total += len(results)
            failed += counts.failed
            doubtful += counts.doubtful
            for subject, outcome in results:
                if isinstance(outcome, CalibrationOutcome):
                    done[outcome.files[0].parent] = outcome.calibration
                else:
                    failures[subject] = sentence_of(outcome)
            left.remove(path)
            step(None)
        if len(recordings) > 1:
            for written in write_calibrations(done, output, failures):
                console.print(f"written       {written}", soft_wrap=True)
    if total > 1 and failed:
        things = "recordings" if total == len(recordings) else "sensors"
        what = "not done in full" if request.exports or request.old else "not calibrated"
        err().print(f"mkc: {failed} of {total} {things} were {what}.", soft_wrap=True)
    raise typer.Exit(1 if failed else DOUBTFUL if doubtful else 0)
