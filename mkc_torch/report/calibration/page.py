"""The calibration report as a self-contained HTML page."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from mkc_torch.calibration.calibrate import ENOUGH_INFORMATION, MAX_REJECTED, Calibration, Vector, prepared
from mkc_torch.calibration.differences import Differences
from mkc_torch.calibration.exports.units import is_known
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.other_sensors import as_magnetometer
from mkc_torch.calibration.places import numbered, places
from mkc_torch.recording.recording import Recording
from mkc_torch.report.calibration import pictures
from mkc_torch.report.rendering import render
from mkc_torch.report.words.comparison import difference_rows, difference_sentences
from mkc_torch.report.words.verdict import calibration_verdict, is_doubtful


@dataclass(frozen=True)
class Comparison:
    """A row of the comparison table: name, centre and semi-axes in the recording's unit."""

    name: str
    center: Vector
    semi_axes: Vector


def calibration_report(
    calibration: Calibration,
    recording: Recording,
    *,
    note: str = "",
    comparison: Sequence[Comparison] = (),
    against: Differences | None = None,
    source: str = "RECORDING.csv",
    result: str = "calibration.json",
    read_with: Sequence[str] = (),
) -> str:
    """Return the page of a calibration and its recording.

    Args:
        calibration: of ``mkc_torch.calibration.calibrate.calibrate``.
        recording: the calibrated recording.
        note: a sentence for the top of the page, for example that the data are simulated.
        comparison: other results, or the truth, for comparison.
        against: differences from an older calibration.
        source, result: paths of the recording and of the calibration, for the proposed commands.
        read_with: options with which the recording was read, such as ``--columns``, for the same commands.

    Returns:
        HTML with inline figures.

    Example:
        >>> from mkc_torch.calibration.calibrate import calibrate
        >>> from mkc_torch.recording.demonstration import simulated_recording
        >>> recording, _ = simulated_recording()
        >>> calibration_report(calibrate(recording), recording).startswith("<!doctype html>")
        True
    """
    usable = calibration.used
    if usable is None:
        usable = prepared(numbered(as_magnetometer(recording) if calibration.sensor == "accel" else recording))
    points = usable.magnetometer()
    in_use = calibration.corrected(points)[calibration.weight(points) >= 0.5]
    return render(
        "calibration.html.j2",
        c=calibration,
        doubtful=is_doubtful(calibration),
        verdict=calibration_verdict(calibration),
        enough=ENOUGH_INFORMATION,
        rejects_many=calibration.rejected_share > MAX_REJECTED,
        note=note,
        source=shlex.join([source, *read_with]),
        result=shlex.quote(result),
        comparison=comparison,
        in_known_unit=is_known(calibration.unit),
        against=against,
        difference_rows=[] if against is None else difference_rows(against),
        difference_sentences=[] if against is None else difference_sentences(against),
        figures={
            "sphere": Markup(pictures.sphere(calibration, points)),
            "residual": Markup(pictures.residual(calibration, points, places(usable))),
            "density": Markup(pictures.density(calibration, points)),
            "coverage": Markup(pictures.coverage_map(calibration.coverage, in_use)),
        },
    )


def refusal_report(recording: Recording, error: NotIdentifiableError) -> str:
    """Return the page of a recording that determines no calibration, with the missing directions.

    Example:
        >>> import torch
        >>> from mkc_torch.calibration.calibrate import calibrate
        >>> angle = torch.linspace(0.0, 6.0, 30)
        >>> flat = Recording({"mag_x": angle.cos(), "mag_y": angle.sin(), "mag_z": 0 * angle}, name="flat")
        >>> try:
        ...     calibrate(flat)
        ... except NotIdentifiableError as error:
        ...     page = refusal_report(flat, error)
        >>> "not identifiable" in page
        True
    """
    picture = None
    if error.coverage is not None and error.directions is not None:
        picture = Markup(pictures.coverage_map(error.coverage, error.directions))
    return render(
        "not_identifiable.html.j2",
        recording=prepared(recording),
        reason=str(error).removeprefix("Not identifiable: "),
        coverage=error.coverage,
        picture=picture,
    )
