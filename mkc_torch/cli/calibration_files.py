"""Calibrate each magnetometer of a file and write the results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.calibration.aided.place import Field
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.calibrate import calibrate as fit
from mkc_torch.calibration.differences import Differences, differences
from mkc_torch.calibration.exports import EXPORTS, Destination, SensorCorrection
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.other_sensors import as_magnetometer
from mkc_torch.cli.console import FAILURES, folder_names, folder_written, remove_if_empty
from mkc_torch.cli.exported import exports_of, stale_exports
from mkc_torch.cli.recorded import read_accelerometer, read_magnetometer, refuse_likely_size, sensor_names
from mkc_torch.recording.formats import Topic, read_topics

ACCELEROMETER = "accel"
"""The quantity of an accelerometer; that of a magnetometer is ``mag``."""

Step = Callable[[str], None]
"""Reports the stage that begins."""


class CalibrationRequest(NamedTuple):
    """Options for calibrating recordings.

    Attributes:
        columns, units: names and units of the columns in the files.
        sensor: name of a magnetometer in the file; None for all.
        quantity: ``mag`` or ``accel``.
        field_strength: length of the field in µT, of gravity in m/s²; None if unknown.
        name: name of the sensor; None for the recording's name.
        old, old_file: the calibration to compare with, and its file.
        exports: formats of additional files.
        to: the vehicle's sensor that the exports are for.
        earth: the Earth's field at the place of the recordings, if known.
        read_with: options with which the recordings are read, without ``--sensor``.
    """

    columns: Mapping[str, str]
    units: Mapping[str, str]
    sensor: str | None
    field_strength: float | None
    quantity: str = "mag"
    name: str | None = None
    old: Calibration | None = None
    old_file: Path | None = None
    exports: tuple[str, ...] = ()
    to: Destination = Destination()
    earth: Field | None = None
    read_with: tuple[str, ...] = ()


class CalibrationOutcome(NamedTuple):
    """A calibration, its files, and the requests that failed.

    Attributes:
        calibration: the result.
        files: paths of the written files.
        differences: differences from the old calibration.
        notes: remarks on the exports.
        refused: errors of the comparison and the exports.
    """

    calibration: Calibration
    files: list[Path]
    differences: Differences | None
    notes: list[str]
    refused: list[ValueError]


def read_calibration(path: Path) -> Calibration:
    """Read a calibration from a file.

    Raises:
        ValueError: the file is not a calibration.
        OSError: the file cannot be read.
    """
    from mkc_torch.cli.correction import read_correction  # with the diagnosis, which takes a second to import

    known = read_correction(path)
    if not isinstance(known, Calibration):
        raise ValueError("this is the model of a diagnosis; give the calibration.json of `mkc calibrate`.")
    return known


def calibrations_of(
    path: Path, folder: Path, request: CalibrationRequest, *, force: bool, step: Step | None = None
) -> Iterator[tuple[str, CalibrationOutcome | Exception]]:
    """Calibrate each magnetometer of a file. Several sensors get a subfolder each.

    Args:
        path: the file.
        folder: folder for the results.
        request: the options.
        force: replace existing results.
        step: called with a text at the beginning of each stage.

    Yields:
        The subject for messages, and its calibration with the files, or the error.
    """
    report_stage = step or (lambda _: None)
    try:
        report_stage(f"reading {path.name}")
        topics = read_topics(path)
        accel = request.quantity == ACCELEROMETER
        names = [None] if accel else sensor_names(path, request.columns, request.sensor, topics)
        if len(names) > 1:
            _refuse_for_one(path, request, [str(name) for name in names])
            claim_folder(folder, overwrite=force)
    except FAILURES as error:
        yield str(path), error
        return
    held = [topics]
    del topics
    places = [folder / name for name in folder_names([str(name) for name in names])] if len(names) > 1 else [folder]
    for number, (name, place) in enumerate(zip(names, places, strict=True), start=1):
        subject, which = str(path), path.name
        if len(names) > 1:
            subject, which = f"{path}, sensor {name}", f"{path.name}, sensor {name} ({number} of {len(names)})"
        report_stage(f"calibrating {which}")
        drawing = partial(report_stage, f"drawing the report on {which}")
        try:
            # the last sensor's calibration releases the tables, which are larger than its columns
            tables = held.pop if number == len(names) else held.__getitem__
            yield subject, _calibrate(path, place, request._replace(sensor=name), tables(0), drawing, force=force)
        except FAILURES as error:
            yield subject, error
    remove_if_empty(folder)


def _refuse_for_one(path: Path, request: CalibrationRequest, names: list[str]) -> None:
    """Raise if an option for a single sensor is given and the file holds several."""
    for option, given in (("--name", request.name), ("--compare-with", request.old)):
        if given is not None:
            raise ValueError(
                f"{path}: the file holds {len(names)} magnetometers, {', '.join(names)}, and {option} is for one "
                f"sensor; add `--sensor {names[0]}`, and calibrate the others in separate calls."
            )


def _holds_only_a_refusal(folder: Path, report: Path) -> bool:
    """Whether a folder holds nothing but the report of a refused recording, which the next attempt may replace."""
    return folder.is_dir() and list(folder.iterdir()) == [report] and "not identifiable" in report.read_text("utf-8")


def _calibrate(
    path: Path,
    folder: Path,
    request: CalibrationRequest,
    topics: Sequence[Topic],
    drawing: Callable[[], None],
    *,
    force: bool,
) -> CalibrationOutcome:
    """Write calibration.json and report.html of a recording. A refusal writes only a report with the reason.

    ``topics`` are the tables of the file; ``drawing`` is called before the report is drawn.
    """
    accel = request.quantity == ACCELEROMETER
    if accel:
        recording, said = read_accelerometer(path, request.columns, request.units, topics), True
    else:
        recording, found = read_magnetometer(path, request.columns, request.units, request.sensor, topics)
        said = bool(found.with_stated_unit & {"mag_x", "mag_y", "mag_z"})
        del found
    del topics
    from mkc_torch.report import calibration_report, refusal_report

    report, result = folder / "report.html", folder / "calibration.json"
    if request.old_file is not None and result.exists() and result.samefile(request.old_file):
        raise ValueError(f"--output would replace {result}, which --compare-with reads; choose another.")
    files = (report.name, result.name, *(EXPORTS[kind].file for kind in request.exports))
    force = force or _holds_only_a_refusal(folder, report)
    claim_folder(folder, overwrite=force, files=files)
    with folder_written(folder):
        try:
            calibration = fit(
                recording,
                field_strength=request.field_strength,
                name=request.name,
                earth=request.earth,
                sensor=ACCELEROMETER if accel else "mag",
            )
        except NotIdentifiableError as error:
            page = refusal_report(as_magnetometer(recording) if accel else recording, error)
            write_atomically(report, page, overwrite=force)
            result.unlink(missing_ok=True)  # an old result would be taken for that of this run
            message = " ".join([f"{error} See {report}.", *stale_exports(folder, ())])
            raise NotIdentifiableError(message, error.coverage, error.directions) from None
        if not said:
            refuse_likely_size(path, calibration.radius)
        compared, refused = _compared(calibration, request.old)
        texts, notes, not_exported = exports_of(SensorCorrection.of(calibration), request.exports, request.to)
        drawing()
        read_with = (*request.read_with, *(("--sensor", request.sensor) if request.sensor else ()))
        page = calibration_report(
            calibration, recording, against=compared, source=str(path), result=str(result), read_with=read_with
        )
        write_atomically(result, calibration.to_json(), overwrite=force)
        write_atomically(report, page, overwrite=force)
        for name, text in texts.items():
            write_atomically(folder / name, text, overwrite=force)
        notes += stale_exports(folder, list(texts))
    written = [result, report, *(folder / name for name in texts)]
    return CalibrationOutcome(calibration, written, compared, notes, [*refused, *not_exported])


def _compared(calibration: Calibration, old: Calibration | None) -> tuple[Differences | None, list[ValueError]]:
    """Return the differences from an old calibration over the inliers, or the error."""
    if old is None or calibration.used is None:
        return None, []
    points = calibration.used.magnetometer()
    try:
        return differences(calibration, old, points[calibration.weight(points) >= 0.5]), []
    except ValueError as error:
        return None, [error]
