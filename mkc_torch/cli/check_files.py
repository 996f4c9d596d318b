"""Check a model on a file and write the results, for `mkc check`."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.calibration.result import SCHEMA as CALIBRATION
from mkc_torch.cli.console import folder_written
from mkc_torch.cli.correction import read_correction, with_sizes_of
from mkc_torch.cli.diagnosis_files import failure_sentence, read_recording, simulation_of
from mkc_torch.cli.diagnosis_request import MAGNETOMETER, Request, is_file_of_a_simulation
from mkc_torch.diagnosis import DiagnosedModel, RecordingCheck, check
from mkc_torch.diagnosis.io.selected_sizes import refuse_unselected
from mkc_torch.report.check.page import check_report
from mkc_torch.simulation.load import raised_in

WRITTEN = ("check.json", "check.html")


@dataclass(frozen=True)
class CheckedFile:
    """The check of a file.

    Attributes:
        path: the recording.
        check: the result; None after an error.
        files: the written files.
        error: the sentence on the error; empty without one.
    """

    path: Path
    check: RecordingCheck | None
    files: tuple[Path, ...] = ()
    error: str = ""

    @property
    def holds(self) -> bool:
        """Whether the model holds on the recording."""
        return self.check is not None and self.check.holds


def model_of(path: Path, request: Request, sizes_of: str | None = None) -> tuple[DiagnosedModel, Request]:
    """Read a model with its simulation. Returns it with the request, whose simulation is set for a magnetometer.

    Args:
        path: the model.
        request: the options.
        sizes_of: diagnosed recording whose sizes apply, where sizes differ between recordings.

    Raises:
        ValueError, OSError: the file is not a model, its simulation is not given, or another one; or no recording is
            given whose sizes apply.
    """
    own = None
    if not request.undecided and request.simulation != MAGNETOMETER:
        own = simulation_of(request)
    _refuse_calibration(path)
    known = with_sizes_of(read_correction(path, own), sizes_of)
    assert isinstance(known, DiagnosedModel)
    refuse_unselected(known.terms)
    return known, replace(request, simulation=MAGNETOMETER) if own is None else request


def check_file(
    model: DiagnosedModel, path: Path, folder: Path, request: Request, start_seconds: float | None
) -> CheckedFile:
    """Check a model on a file, and write check.json and check.html into a folder."""
    try:
        recording = read_recording(path, request)
        found = check(model, recording, start_seconds=start_seconds, input_hold=request.input_hold)
        claim_folder(folder, overwrite=request.force, files=WRITTEN)
        with folder_written(folder):
            texts = {"check.json": found.to_json(), "check.html": check_report(found)}
            for name, text in texts.items():
                write_atomically(folder / name, text, overwrite=request.force)
    # the user's simulation can raise anything: a row of the table, and the other recordings are checked
    except Exception as error:
        own = raised_in(request.simulation, error) if is_file_of_a_simulation(request.simulation) else None
        return CheckedFile(path, None, error=failure_sentence(path, "", own or error))
    return CheckedFile(path, found, tuple(folder / name for name in texts))


def _refuse_calibration(path: Path) -> None:
    """Raise for a calibration: it holds neither the recording's samples nor a simulation to predict with."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError):
        return  # the message on an unreadable file follows
    if isinstance(content, dict) and content.get("schema") == CALIBRATION:
        raise ValueError(
            "this is a calibration, which has no findings to check. Compare it with a calibration of the new "
            f"recording: `mkc calibrate NEW.csv --compare-with {path}`; or diagnose the sensor, and check its "
            "model.json."
        )
