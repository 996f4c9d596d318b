"""A diagnosis as a row: the numbers that are judged and compared, and its cost."""

from __future__ import annotations

import json
import math
import resource
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from examples.blind_proof.diagnose import corrected_columns
from examples.blind_proof.run import content_of
from mkc_torch.cli.diagnosis_files import simulation_of
from mkc_torch.cli.diagnosis_request import MAGNETOMETER, Request
from mkc_torch.recording.recording import Recording

_FINDING = ("effect", "grade", "drivers", "channels", "p_value", "region")
_ALTERNATIVE = ("effect", "drivers", "separable")


def row(folder: Path, recording: Path, request: Request) -> dict[str, Any]:
    """Return the row of a diagnosis in a folder; ``verdict`` is "" if there is none.

    Args:
        folder: folder of ``diagnosis.json`` and ``model.json``.
        recording: the diagnosed file.
        request: options of the diagnosis.
    """
    content = content_of(folder / "diagnosis.json") or {}
    fits = content.get("goodness_of_fit") or {}
    return {
        "verdict": content.get("verdict", ""),
        "p_value": content.get("p_value"),
        "findings": [finding(entry) for entry in content.get("findings") or ()],
        "residual_before": {output: numbers.get("residual") for output, numbers in fits.items()},
        "residual_after": _open_loop(folder / "model.json", recording, request) if content else {},
        "parameters": _parameters(folder / "model.json", request) if content else {},
        "sentences": [*content.get("advice", ()), *content.get("warnings", ())],
        "stopped": (content.get("search") or {}).get("stopped"),
    }


def finding(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the judged parts of a finding of ``diagnosis.json``.

    Example:
        >>> finding({"effect": "backlash"})["parameters"]
        []
    """
    others = entry.get("alternatives") or ()
    return {key: entry.get(key) for key in _FINDING} | {
        "alternatives": [
            {key: other.get(key) for key in _ALTERNATIVE} | {"parameters": _sizes(other)} for other in others
        ],
        "parameters": _sizes(entry),
    }


def _sizes(entry: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the parameters of a finding or of an alternative."""
    numbers = ("name", "value", "standard_error", "unit")
    return [{key: p.get(key) for key in numbers} for p in entry.get("parameters") or ()]


def _parameters(model: Path, request: Request) -> dict[str, float]:
    """Return the simulation's own parameters, fitted with the findings, by name."""
    if not model.is_file() or request.simulator_output is not None or request.simulation == MAGNETOMETER:
        return {}
    values = json.loads(model.read_text(encoding="utf-8"))["parameters"]
    names = getattr(simulation_of(request), "parameters", {})
    return dict(zip(names, values, strict=False))  # initial states follow


def _open_loop(model: Path, recording: Path, request: Request) -> dict[str, float | None]:
    """Return the RMS residual of the open-loop simulation with the findings, by output.

    Empty for a magnetometer, whose corrected field has no recorded counterpart, and without a model.
    """
    if not model.is_file() or (request.simulator_output is None and request.simulation == MAGNETOMETER):
        return {}
    table = Recording.read(recording, recognise=False)
    try:
        simulated = corrected_columns(model, simulation_of(request), table)
    except ValueError:  # a model that does not transfer
        return {}
    outputs = [name for name in simulated if name not in ("time", "experiment") and name in table]
    found = {}
    for name in outputs:
        same_rows = len(simulated[name]) == len(table)
        rms = float((simulated[name] - table[name]).square().nanmean().sqrt()) if same_rows else math.nan
        found[name] = rms if math.isfinite(rms) else None
    return found


def write_row(recording: Path, request: Request, folder: Path) -> None:
    """Diagnose in this process, one thread, and write ``row.json``, ``diagnosis.json`` and ``model.json``.

    The row also has CPU and wall seconds and the peak memory of the process; ``failed`` is the error of a failed
    diagnosis.
    """
    from mkc_torch._parallel.pool import allow_copies
    from mkc_torch._parallel.processes import keep_memory, one_thread
    from mkc_torch.cli.console import ConsoleStyle
    from mkc_torch.cli.diagnosis_files import diagnose_file

    one_thread()
    keep_memory()
    allow_copies(0)
    for old in ("diagnosis.json", "model.json"):
        (folder / old).unlink(missing_ok=True)
    cpu, wall = _cpu_seconds(), time.perf_counter()
    outcomes = diagnose_file(recording, folder, request, ConsoleStyle(terminal=False, width=100))
    seconds = {
        "cpu_seconds": round(_cpu_seconds() - cpu, 2),
        "wall_seconds": round(time.perf_counter() - wall, 2),
        "memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }
    failed = "; ".join(outcome.text for outcome in outcomes if outcome.failed)
    found = row(folder, recording, request) | ({"failed": failed} if failed else {}) | seconds
    folder.mkdir(parents=True, exist_ok=True)  # a failed diagnosis leaves no folder
    (folder / "row.json").write_text(json.dumps(found), encoding="utf-8")


def _cpu_seconds() -> float:
    """Return user and system time of this process and its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in used)
