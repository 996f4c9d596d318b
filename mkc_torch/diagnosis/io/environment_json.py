"""What diagnosis.json has of the world around a simulation: how it follows, what pushes it, and what remains."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from torch import Tensor

from mkc_torch.diagnosis.environment import DisturbanceEstimate, NoiseEnvironment, ProcessNoise
from mkc_torch.diagnosis.result import Diagnosis

__all__ = ["follows_of", "forcing_of", "noise_of", "of_recordings", "remaining_of"]

_MOST_POINTS = 500
"""Of a course that are written."""

_DIGITS = 5
"""Significant ones of what is written of a course."""
_TIME_DIGITS = 6
"""Decimals of a moment in s."""


def follows_of(world: NoiseEnvironment) -> dict[str, Any]:
    """How the simulation follows each output, by its name.

    Example:
        >>> from mkc_torch.diagnosis.environment import Follows
        >>> one = Follows("angle", "rad", 0.0049, 0.35, 0.9997, 0.005, "declared", 0.35, 0.02)
        >>> follows_of(NoiseEnvironment(follows=(one,)))["angle"]["explained"]
        0.9997
    """
    return {
        one.output: {
            "unit": one.unit,
            "residual": _finite(one.residual),
            "variation": _finite(one.variation),
            "explained": _finite(one.explained),
            "noise_floor": _finite(one.noise_floor),
            "floor_source": one.floor_source,
            "mean_predicts": _finite(one.mean_predicts),
            "last_value_predicts": _finite(one.last_value_predicts),
        }
        for one in world.follows
    }


def noise_of(world: NoiseEnvironment) -> dict[str, Any]:
    """What the noise of the world adds to that of the fit: pushes on states, slow parts of sensors, and inputs."""
    return {
        "process": _by_place(push for push in world.pushes if push.at_rate),
        "sensor": _by_place(push for push in world.pushes if not push.at_rate),
        "between": dict(world.input_hold),
    }


def _by_place(pushes: Iterable[ProcessNoise]) -> dict[str, Any]:
    """The strongest of each place, with the others of it."""
    found: dict[str, Any] = {}
    for push in pushes:
        told = {
            "size": push.size,
            "standard_error": _finite(push.standard_error),
            "unit": push.unit,
            "lasting": _finite(push.lasting),
            "nats": _finite(push.nats),
        }
        if push.place in found:
            found[push.place].setdefault("besides", []).append(told)
        else:
            found[push.place] = told
    return found


def of_recordings(world: NoiseEnvironment) -> dict[str, Any]:
    """The runs that shares are of, and the offsets of outputs in each of several recordings; neither where none is.

    Example:
        >>> from mkc_torch.diagnosis.environment import Offset
        >>> of_recordings(NoiseEnvironment(offsets=(Offset("speed", "m/s", 2, "b.csv", -0.2, 0.001),)))
        {'offsets': [{'output': 'speed', 'unit': 'm/s', 'recording': 2, 'name': 'b.csv', 'value': -0.2, ...}]}
    """
    offsets = [{**asdict(one), "standard_error": _finite(one.standard_error)} for one in world.offsets]
    runs = [asdict(one) for one in world.runs]
    return {**({"runs": runs} if runs else {}), **({"offsets": offsets} if offsets else {})}


def forcing_of(world: NoiseEnvironment) -> list[dict[str, Any]]:
    """The course of each push, of a long recording at evenly chosen samples."""
    return [_course(forcing) for forcing in world.forcing]


def _course(forcing: DisturbanceEstimate) -> dict[str, Any]:
    step = max(-(-len(forcing.time) // _MOST_POINTS), 1)
    return {
        "state": forcing.place,
        "at_rate": forcing.at_rate,
        "unit": forcing.unit,
        "time": [round(float(t), _TIME_DIGITS) for t in forcing.time[::step]],
        "value": _rounded(forcing.value[::step]),
        "band": _rounded(forcing.band[::step]),
        "sentences": forcing.sentences,
    }


def _rounded(values: Tensor) -> list[float | None]:
    """Numbers to a few digits; None for what is not finite."""
    return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in values.tolist()]


def remaining_of(diagnosis: Diagnosis) -> dict[str, Any]:
    """Whether what the corrected model leaves over is white, and if not, up to which lag and where."""
    d = diagnosis
    told: Mapping[str, Any] = next((said.content for said in d.evidence if said.test == "whiteness"), {})
    channels = told.get("channels", ())
    coloured = [one["channel"] for one in channels if not one["white"]]
    return {
        "white": not coloured if channels else None,
        "largest_lag": max((one["lag"] for one in channels), default=None),
        "unit": told.get("unit", ""),
        "channels": coloured,
        "driven": list(dict.fromkeys(push.place for push in d.world.pushes if push.at_rate)),
        "smooth_along": list(d.remaining),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
