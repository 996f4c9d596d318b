"""Sections of diagnosis.json: goodness of fit, process noise and drift, disturbances, and the residual's whiteness."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from torch import Tensor

from mkc_torch.diagnosis.environment import DisturbanceEstimate, NoiseEnvironment, ProcessNoise
from mkc_torch.diagnosis.result import Diagnosis

__all__ = ["disturbance_json", "goodness_of_fit_json", "noise_json", "recordings_json", "remaining_json"]

_MOST_POINTS = 500
"""Largest number of samples of a disturbance that are written."""

_DIGITS = 5
"""Significant digits of a disturbance's values."""
_TIME_DIGITS = 6
"""Decimals of a time in s."""


def goodness_of_fit_json(environment: NoiseEnvironment) -> dict[str, Any]:
    """Return the goodness of fit of each output, by its name.

    Example:
        >>> from mkc_torch.diagnosis.environment import GoodnessOfFit
        >>> fit = GoodnessOfFit("angle", "rad", 0.0049, 0.35, 0.9997, 0.005, "declared", 0.35, 0.02)
        >>> goodness_of_fit_json(NoiseEnvironment(goodness_of_fit=(fit,)))["angle"]["explained"]
        0.9997
    """
    return {
        fit.output: {
            "unit": fit.unit,
            "residual": _finite(fit.residual),
            "variation": _finite(fit.variation),
            "explained": _finite(fit.explained),
            "noise_floor": _finite(fit.noise_floor),
            "floor_source": fit.floor_source,
            "rmse_of_mean": _finite(fit.rmse_of_mean),
            "rmse_of_last_value": _finite(fit.rmse_of_last_value),
        }
        for fit in environment.goodness_of_fit
    }


def noise_json(environment: NoiseEnvironment) -> dict[str, Any]:
    """Return the process noise of states, the drift of outputs, and the input hold: the rest of the key "noise"."""
    return {
        "process": _by_place(process for process in environment.process_noise if process.at_rate),
        "sensor": _by_place(process for process in environment.process_noise if not process.at_rate),
        "input_hold": dict(environment.input_hold),
    }


def _by_place(processes: Iterable[ProcessNoise]) -> dict[str, Any]:
    """Return the strongest process of each state or output, with the weaker ones under "weaker"."""
    found: dict[str, Any] = {}
    for process in processes:
        content = {
            "size": process.size,
            "standard_error": _finite(process.standard_error),
            "unit": process.unit,
            "correlation_time": _finite(process.correlation_time),
            "log_likelihood_gain": _finite(process.log_likelihood_gain),
        }
        if process.place in found:
            found[process.place].setdefault("weaker", []).append(content)
        else:
            found[process.place] = content
    return found


def recordings_json(environment: NoiseEnvironment) -> dict[str, Any]:
    """Return the keys "runs" and "offsets" of several recordings; a key without entries is absent.

    Example:
        >>> from mkc_torch.diagnosis.environment import Offset
        >>> recordings_json(NoiseEnvironment(offsets=(Offset("speed", "m/s", 2, "b.csv", -0.2, 0.001),)))
        {'offsets': [{'output': 'speed', 'unit': 'm/s', 'recording': 2, 'name': 'b.csv', 'value': -0.2, ...}]}
    """
    offsets = [{**asdict(offset), "standard_error": _finite(offset.standard_error)} for offset in environment.offsets]
    runs = [asdict(run) for run in environment.runs]
    return {**({"runs": runs} if runs else {}), **({"offsets": offsets} if offsets else {})}


def disturbance_json(environment: NoiseEnvironment) -> list[dict[str, Any]]:
    """Return each estimated disturbance; a long recording is thinned evenly."""
    return [_course(estimate) for estimate in environment.disturbance]


def _course(estimate: DisturbanceEstimate) -> dict[str, Any]:
    step = max(-(-len(estimate.time) // _MOST_POINTS), 1)
    return {
        "state": estimate.place,
        "at_rate": estimate.at_rate,
        "unit": estimate.unit,
        "time": [round(float(t), _TIME_DIGITS) for t in estimate.time[::step]],
        "value": _rounded(estimate.value[::step]),
        "band": _rounded(estimate.band[::step]),
        "sentences": estimate.sentences,
    }


def _rounded(values: Tensor) -> list[float | None]:
    """Round to ``_DIGITS`` significant digits; None for values that are not finite."""
    return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in values.tolist()]


def remaining_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return whether the residual of the corrected model is white, and if not, its correlation and location."""
    d = diagnosis
    test: Mapping[str, Any] = next((result.content for result in d.evidence if result.test == "whiteness"), {})
    channels = test.get("channels", ())
    coloured = [channel["channel"] for channel in channels if not channel["white"]]
    return {
        "white": not coloured if channels else None,
        "largest_lag": max((channel["lag"] for channel in channels), default=None),
        "unit": test.get("unit", ""),
        "channels": coloured,
        "disturbed_states": list(
            dict.fromkeys(process.place for process in d.environment.process_noise if process.at_rate)
        ),
        "smooth_along": list(d.remaining),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
