"""The result of an aided calibration: the aid, and which quantities it determined."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mkc_torch.calibration.file import CheckedValues, Vector, finite_or_none


@dataclass(frozen=True)
class AidedResult:
    """Details of a calibration that the ellipsoid alone does not determine.

    Attributes:
        by: the aid: "gyroscope", "attitude" or "place".
        response: the free parameters of the sensor: "offset", "offset and scale" or "full matrix".
        evidence: log evidence of each response in nats, minus that of the selected response. The most likely response
            is selected; by place and date the full matrix, unless a simpler response is clearly more likely.
        undetermined: offsets and entries of the matrix, as "offset_z" or "matrix_zz", that the recording hardly
            determines. They keep their prior values, zero offset and the unit matrix, and have no standard error.
        heading_error: standard error in ° of heading changes over a level turn.
        constant_error: standard error in ° of the constant heading offset, which only tilting determines; infinite by
            place and date, because a length does not determine a rotation.
        gyro_bias, gyro_bias_se: bias of the gyroscope and its standard error in rad/s; None without a gyroscope.
    """

    by: str
    response: str
    evidence: tuple[tuple[str, float], ...]
    undetermined: tuple[str, ...]
    heading_error: float
    constant_error: float
    gyro_bias: Vector | None
    gyro_bias_se: Vector | None


def aid_to_json(aid: AidedResult) -> Mapping[str, Any]:
    """Encode the part "aided" of calibration.json."""
    content: dict[str, Any] = {
        "by": aid.by,
        "response": aid.response,
        "evidence": dict(aid.evidence),
        "undetermined": aid.undetermined,
        "heading": {
            "standard_error": aid.heading_error,
            "constant": {"standard_error": finite_or_none([aid.constant_error])[0]},
            "unit": "°",
        },
    }
    if aid.gyro_bias is not None and aid.gyro_bias_se is not None:
        content["gyro_bias"] = {
            "value": aid.gyro_bias,
            "standard_error": finite_or_none(aid.gyro_bias_se),
            "unit": "rad/s",
        }
    return content


def aid_from_json(c: CheckedValues) -> AidedResult | None:
    """Decode the part "aided"; None if the file has none, as for a plain ellipsoid fit."""
    if not c.has("aided"):
        return None
    biased = c.has("aided", "gyro_bias")
    unknown = not c.has("aided", "heading", "constant", "standard_error") or (
        c.content["aided"]["heading"]["constant"]["standard_error"] is None
    )
    return AidedResult(
        by=c.text("aided", "by"),
        response=c.text("aided", "response"),
        evidence=tuple((name, c.number("aided", "evidence", name)) for name in c.names("aided", "evidence")),
        undetermined=tuple(c.text("aided", "undetermined", i) for i in c.each("aided", "undetermined")),
        heading_error=c.number("aided", "heading", "standard_error"),
        constant_error=math.inf if unknown else c.number("aided", "heading", "constant", "standard_error"),
        gyro_bias=c.vector("aided", "gyro_bias", "value") if biased else None,
        gyro_bias_se=c.vector("aided", "gyro_bias", "standard_error", unknown=True) if biased else None,
    )
