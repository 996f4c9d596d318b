"""What the calibrations of several sensors have in common."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping

from mkc_torch.calibration import Calibration
from mkc_torch.calibration.quality import doubts
from mkc_torch.diagnosis.verdict import NAMED
from mkc_torch.report.fleet.content import Fleet, FleetRecording, Quantity, Size, compared

_AXES = "xyz"


def fleet_of_calibrations(calibrations: Mapping[str, Calibration], failures: Mapping[str, str] | None = None) -> Fleet:
    """Return what the calibrations of several sensors have in common: offsets, gains and cross-axis coupling.

    Args:
        calibrations: by the name of the recording.
        failures: reason by the name of each recording that was not calibrated.

    Example:
        >>> fleet_of_calibrations({}).quantities
        ()
    """
    recordings, sizes = [], dict[tuple[str, str, str, str], list[Size]]()
    for number, (name, calibration) in enumerate(calibrations.items()):
        recordings.append(_recording(name, calibration))
        for key, value, error in _numbers(calibration):
            sizes.setdefault(key, []).append(Size(number, value, error, NAMED[0]))
    quantities = tuple(compared(Quantity(*key, tuple(found)), recordings) for key, found in sizes.items())
    return Fleet(tuple(recordings), quantities, {} if failures is None else failures, kind="calibrated")


def _recording(name: str, calibration: Calibration) -> FleetRecording:
    doubtful, content = bool(doubts(calibration)), json.loads(calibration.to_json())
    before, after = (content["residual"][which]["robust"] for which in ("before", "after"))
    return FleetRecording(
        name,
        "",
        "doubtful" if doubtful else "calibrated",
        "look" if doubtful else "usable",
        stopped=False,
        residuals={"length of the field": (before, after, content["unit"])},
        conditions={},
    )


def _numbers(calibration: Calibration) -> Iterator[tuple[tuple[str, str, str, str], float, float]]:
    """Each offset and each element of the matrix, as effect, place, parameter and unit, with its standard error."""
    content = json.loads(calibration.to_json())
    offset, matrix = content["center"], content["matrix"]
    for k, axis in enumerate(_AXES):
        yield ("offset", axis, "offset", content["unit"]), offset["value"][k], _error(offset["standard_error"][k])
    for k, axis in enumerate(_AXES):
        for j in range(k, 3):
            effect, place = ("gain", axis) if j == k else ("cross-axis coupling", f"{axis} and {_AXES[j]}")
            yield (effect, place, effect, ""), matrix["value"][k][j], _error(matrix["standard_error"][k][j])


def _error(value: float | None) -> float:
    return math.nan if value is None else value
