"""One row of the gate: what a diagnosis says, in the few numbers that are judged and compared."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mkc_torch.challenge.pool import content_of
from mkc_torch.cli.correction import correct, read_correction
from mkc_torch.cli.diagnosis_files import simulation_of
from mkc_torch.cli.diagnosis_request import MAGNETOMETER, Request
from mkc_torch.recording.recording import Recording

_FINDING = ("effect", "grade", "drivers", "channels", "p_value")
_ALTERNATIVE = ("effect", "drivers", "separable")


def row(folder: Path, recording: Path, request: Request) -> dict[str, Any]:
    """The row of a diagnosis in a folder; ``verdict`` is "" where there is none.

    Args:
        folder: with ``diagnosis.json`` and ``model.json``.
        recording: the file that was diagnosed.
        request: what was asked of it.
    """
    content = content_of(folder / "diagnosis.json") or {}
    follows = content.get("follows") or {}
    return {
        "verdict": content.get("verdict", ""),
        "p_value": content.get("p_value"),
        "findings": [finding(entry) for entry in content.get("findings") or ()],
        "residual_before": {output: numbers.get("residual") for output, numbers in follows.items()},
        "residual_after": _open_loop(folder / "model.json", recording, request) if content else {},
        "sentences": [*content.get("advice", ()), *content.get("warnings", ())],
    }


def finding(entry: Mapping[str, Any]) -> dict[str, Any]:
    """A finding of ``diagnosis.json`` with the alternatives and parameters that are judged.

    Example:
        >>> finding({"effect": "backlash"})["parameters"]
        []
    """
    numbers = ("name", "value", "standard_error", "unit")
    return {key: entry.get(key) for key in _FINDING} | {
        "alternatives": [{key: other.get(key) for key in _ALTERNATIVE} for other in entry.get("alternatives") or ()],
        "parameters": [{key: p.get(key) for key in numbers} for p in entry.get("parameters") or ()],
    }


def _open_loop(model: Path, recording: Path, request: Request) -> dict[str, float | None]:
    """Root mean square of recording less open-loop simulation with the findings, by output.

    Empty for a magnetometer, whose corrected field has no recorded counterpart, and where no model was written.
    """
    if not model.is_file() or (request.simulated is None and request.simulation == MAGNETOMETER):
        return {}
    table = Recording.read(recording, recognise=False)
    try:
        simulated = correct(read_correction(model, simulation_of(request)), table).columns
    except ValueError:  # a model that does not carry over
        return {}
    outputs = [name for name in simulated if name not in ("time", "experiment") and name in table]
    found = {}
    for name in outputs:
        same_rows = len(simulated[name]) == len(table)
        rms = float((simulated[name] - table[name]).square().nanmean().sqrt()) if same_rows else math.nan
        found[name] = rms if math.isfinite(rms) else None
    return found
