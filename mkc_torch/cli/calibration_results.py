"""Print the results of a file's sensors, and count the failures and the doubtful calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from mkc_torch.calibration.quality import doubts
from mkc_torch.cli.calibration_files import CalibrationOutcome
from mkc_torch.cli.calibration_summary import SensorResult, show, show_sensors
from mkc_torch.cli.console import complain, sentence_of


class Counts(NamedTuple):
    """Numbers of sensors that failed, in whole or in part, and of doubtful calibrations."""

    failed: int
    doubtful: int


def show_results(
    console: Console,
    path: Path,
    results: Sequence[tuple[str, CalibrationOutcome | Exception]],
    read_with: Sequence[str] = (),
) -> Counts:
    """Print the results of a file: in full for a single sensor, on one page for several; errors on standard error.

    Args:
        console: standard output.
        path: the file.
        results: the subject for messages of each sensor, and its calibration or the error.
        read_with: options with which the file was read, for the proposed command.
    """
    done = [outcome for _, outcome in results if isinstance(outcome, CalibrationOutcome)]
    if len(results) > 1 and done:
        show_sensors(console, path.stem, [_result(subject, outcome) for subject, outcome in results])
    else:
        for found in done:
            show(console, found.calibration, found.files, found.differences, found.notes, path, read_with)
    for subject, outcome in results:
        for error in [outcome] if isinstance(outcome, Exception) else outcome.refused:
            complain(subject, error)
    failed = sum(isinstance(outcome, Exception) or bool(outcome.refused) for _, outcome in results)
    return Counts(failed, sum(bool(doubts(found.calibration)) for found in done))


def _result(subject: str, outcome: CalibrationOutcome | Exception) -> SensorResult:
    name = subject.rpartition(", sensor ")[2]
    if isinstance(outcome, Exception):
        return SensorResult(name, None, (), (), sentence_of(outcome))
    return SensorResult(name, outcome.calibration, outcome.files, outcome.notes)
