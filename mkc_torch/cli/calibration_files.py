"""From a recording's file to the files of its calibrations, one for each magnetometer in it."""

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
from mkc_torch.cli.correction import read_correction
from mkc_torch.cli.exported import exports_of, left_from_before
from mkc_torch.cli.recorded import read_accelerometer, read_magnetometer, refuse_likely_size, sensor_names
from mkc_torch.recording.formats import Topic, read_topics

__all__ = ["CalibrationOutcome", "CalibrationRequest", "calibrations_of", "read_calibration"]


ACCELEROMETER = "accel"
"""The sensor that is no magnetometer."""

Step = Callable[[str], None]
"""Takes the name of a stage of the work."""


class CalibrationRequest(NamedTuple):
    """What a user asked for, of all recordings.

    Attributes:
        columns, units: of the recordings' files.
        sensor: one of those in a file, or "accel"; None for all magnetometers.
        field_strength: in µT, where it is known.
        name: of the sensor; None for the recording's.
        old, old_file: the calibration that the new one is set beside, and where it is from.
        exports: kinds of further files.
        to: for these.
        earth: the field at the place of the recordings, where it is known.
    """

    columns: Mapping[str, str]
    units: Mapping[str, str]
    sensor: str | None
    field_strength: float | None
    name: str | None = None
    old: Calibration | None = None
    old_file: Path | None = None
    exports: tuple[str, ...] = ()
    to: Destination = Destination()
    earth: Field | None = None


class CalibrationOutcome(NamedTuple):
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


def calibrations_of(
    path: Path, folder: Path, asked: CalibrationRequest, *, force: bool, step: Step | None = None
) -> Iterator[tuple[str, CalibrationOutcome | Exception]]:
    """Calibrate each magnetometer of a file: one alone into the folder, several into folders of their names in it.

    Args:
        path: of the file.
        folder: for the results.
        asked: what a user asked for.
        force: replace results.
        step: called with a text at the beginning of each stage.

    Yields:
        What it is of, for messages, and the calibration with its files, or why there is none.
    """
    say = step or (lambda _: None)
    try:
        say(f"reading {path.name}")
        topics = read_topics(path)
        names = sensor_names(path, asked.columns, asked.sensor, topics)
        if len(names) > 1:
            _refuse_for_one(path, asked, [str(name) for name in names])
            claim_folder(folder, overwrite=force)
    except FAILURES as error:
        yield str(path), error
        return
    places = [folder / name for name in folder_names([str(name) for name in names])] if len(names) > 1 else [folder]
    for number, (name, place) in enumerate(zip(names, places, strict=True), start=1):
        subject, which = str(path), path.name
        if len(names) > 1:
            subject, which = f"{path}, sensor {name}", f"{path.name}, sensor {name} ({number} of {len(names)})"
        say(f"calibrating {which}")
        drawing = partial(say, f"drawing the report on {which}")
        try:
            yield subject, _calibrate(path, place, asked._replace(sensor=name), topics, drawing, force=force)
        except FAILURES as error:
            yield subject, error
    remove_if_empty(folder)


def _refuse_for_one(path: Path, asked: CalibrationRequest, names: list[str]) -> None:
    """Refuse what is of one sensor where there are several."""
    for option, given in (("--name", asked.name), ("--compare-with", asked.old)):
        if given is not None:
            raise ValueError(
                f"{path}: the file holds {len(names)} magnetometers, {', '.join(names)}, and {option} is of one; give "
                f"`--sensor {names[0]}` beside it, and each of the others a call of its own."
            )


def _calibrate(
    path: Path,
    folder: Path,
    asked: CalibrationRequest,
    topics: Sequence[Topic],
    drawing: Callable[[], None],
    *,
    force: bool,
) -> CalibrationOutcome:
    """Write calibration.json and report.html of a recording; where it is refused, the report alone says why.

    ``topics`` are the tables of the file; ``drawing`` is called before the report is drawn.
    """
    accel = asked.sensor == ACCELEROMETER
    if accel:
        recording, said = read_accelerometer(path, asked.columns, asked.units, topics), True
    else:
        recording, found = read_magnetometer(path, asked.columns, asked.units, asked.sensor, topics)
        said = bool(found.said & {"mag_x", "mag_y", "mag_z"})
    from mkc_torch.report import calibration_report, refusal_report

    report, result = folder / "report.html", folder / "calibration.json"
    if asked.old_file is not None and result.exists() and result.samefile(asked.old_file):
        raise ValueError(f"{result} is what the new one is set beside, and is not replaced; choose another --output.")
    files = (report.name, result.name, *(EXPORTS[kind].file for kind in asked.exports))
    claim_folder(folder, overwrite=force, files=files)
    with folder_written(folder):
        try:
            calibration = fit(
                recording,
                field_strength=asked.field_strength,
                name=asked.name,
                earth=asked.earth,
                sensor=ACCELEROMETER if accel else "mag",
            )
        except NotIdentifiableError as error:
            page = refusal_report(as_magnetometer(recording) if accel else recording, error)
            write_atomically(report, page, overwrite=force)
            result.unlink(missing_ok=True)  # an old one beside a new refusal would be taken for its result
            told = " ".join([f"{error} See {report}.", *left_from_before(folder, ())])
            raise NotIdentifiableError(told, error.coverage, error.directions) from None
        if not said:
            refuse_likely_size(path, calibration.radius)
        beside, refused = _beside(calibration, asked.old)
        texts, notes, not_exported = exports_of(SensorCorrection.of(calibration), asked.exports, asked.to)
        drawing()
        page = calibration_report(calibration, recording, against=beside)
        write_atomically(result, calibration.to_json(), overwrite=force)
        write_atomically(report, page, overwrite=force)
        for name, text in texts.items():
            write_atomically(folder / name, text, overwrite=force)
        notes += left_from_before(folder, list(texts))
    written = [result, report, *(folder / name for name in texts)]
    return CalibrationOutcome(calibration, written, beside, notes, [*refused, *not_exported])


def _beside(calibration: Calibration, old: Calibration | None) -> tuple[Differences | None, list[ValueError]]:
    """The differences from an old one, over the samples in use; or why there are none."""
    if old is None or calibration.used is None:
        return None, []
    points = calibration.used.magnetometer()
    try:
        return differences(calibration, old, points[calibration.weight(points) >= 0.5]), []
    except ValueError as error:
        return None, [error]
