"""The conditions of a recording in diagnosis.json, by which sizes of several recordings are compared."""

from __future__ import annotations

from typing import Any

from mkc_torch.diagnosis.parts import Traces


def conditions_json(traces: Traces) -> dict[str, dict[str, Any]]:
    """Return the first time of the recording and the mean of each column that may drive an effect, with units."""
    found = {"start": {"value": float(traces.time[0]), "unit": "s"}} if traces.has_time and len(traces.time) else {}
    for name, values in traces.drivers.items():
        known = values[values.isfinite()]
        if len(known):
            found[name] = {"value": float(known.double().mean()), "unit": traces.driver_units.get(name, "")}
    return found
