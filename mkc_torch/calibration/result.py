"""The result of a calibration, and its file calibration.json of the schema "mkc-calibration/1"."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.html_table import html_table, with_error
from mkc_torch.calibration.aided_result import AidedResult, aid_from_json, aid_to_json
from mkc_torch.calibration.coverage import Coverage, Gap, nearest_axis
from mkc_torch.calibration.file import (
    CalibrationFileError,
    CheckedValues,
    Matrix,
    Vector,
    finite_or_none,
    refuse_constant,
)
from mkc_torch.calibration.offset_change import OffsetChange
from mkc_torch.calibration.plain_values import ResidualSpread
from mkc_torch.calibration.plot import CalibrationPlot
from mkc_torch.density.tails import ChannelTails
from mkc_torch.functional import mkc_weight
from mkc_torch.recording.disturbance import RejectedInterval
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["SCHEMA", "Calibration", "ResidualSpread", "RestBias", "calibration_from_json", "calibration_to_json"]

SCHEMA = "mkc-calibration/1"


class RestBias(NamedTuple):
    """Bias of a gyroscope at rest and its standard errors, in rad/s, and the duration of the rest, in s."""

    value: Vector
    standard_error: Vector
    seconds: float


@dataclass(frozen=True)
class Calibration:
    """The calibration of a magnetometer: ``field = matrix @ (measured - center)``.

    Lengths are in ``unit``, the unit of the recording; the corrected field is in ``field_unit``.

    Attributes:
        recording: name of the recording.
        samples: number of samples in the fit.
        unit: unit of the measurements.
        center, center_se: offset (hard iron) and its standard errors.
        semi_axes, semi_axes_se: semi-axes of the ellipsoid, ascending, and their standard errors.
        rotation: columns along the semi-axes, determinant +1.
        matrix, matrix_se: the calibration matrix, symmetric, and its standard errors.
        radius: geometric mean of the semi-axes.
        field_strength, field_unit: length of the corrected field and its unit; the radius unless it was given.
        sigma, d, bound: MKC density of :meth:`algebraic_residual`, no units; ``sigma`` is inf for Gaussian residuals.
        before: spread of the measured norm about its median.
        after: spread of :meth:`norm_residual`, including rejected samples.
        rejected: number of samples with a weight below 0.5.
        disturbed: intervals in which most samples are rejected.
        disturbed_unit: unit of ``disturbed``: "s", or "row" (counted from 1) if the recording has no time.
        aid: the aiding data that replaced missing turns, and what remains undetermined; None for a plain ellipsoid fit.
            With an aid, the matrix also rotates the sensor's axes into those of the gyroscope or the attitude, and
            need not be symmetric.
        sensor: "mag", or "accel" for an accelerometer, whose field is gravity.
        rest_bias: bias of the gyroscope at rest; None without a gyroscope or a rest.
        coverage: coverage of directions by the samples in use.
        warnings: reasons to doubt the result, most important first.
        notes: how the recording was read and fitted.
        name: name of the sensor; the recording's name unless another name was given.
        tails: tails of :meth:`algebraic_residual` compared with a Gaussian's, and the expected share of errors beyond
            3 d; None for an exact fit, and for a file without them.
        offset_change: a change of the offset during the recording, which makes the calibration doubtful; None if none
            was found.
        used: the samples of the fit, for plots; None if the calibration was read from a file.
    """

    recording: str
    samples: int
    unit: str
    center: Vector
    center_se: Vector
    semi_axes: Vector
    semi_axes_se: Vector
    rotation: Matrix
    matrix: Matrix
    matrix_se: Matrix
    radius: float
    field_strength: float
    field_unit: str
    sigma: float
    d: float
    bound: float
    before: ResidualSpread
    after: ResidualSpread
    rejected: int
    disturbed: tuple[RejectedInterval, ...]
    coverage: Coverage
    warnings: tuple[str, ...]
    name: str = ""
    disturbed_unit: str = "s"
    aid: AidedResult | None = None
    sensor: str = "mag"
    rest_bias: RestBias | None = None
    tails: ChannelTails | None = None
    used: Recording | None = field(default=None, repr=False, compare=False)
    notes: tuple[str, ...] = ()
    offset_change: OffsetChange | None = None

    @property
    def plot(self) -> CalibrationPlot:
        """The plots of the report on matplotlib axes, such as ``calibration.plot.residual()``."""
        return CalibrationPlot(self, self.used)

    def __repr__(self) -> str:
        return f"Calibration({self.recording!r}, {self.samples} samples: center {self.center} {self.unit})"

    def _repr_html_(self) -> str:
        c = self
        rows = [
            (name, *(with_error(v, e) for v, e in zip(values, errors, strict=True)))
            for name, values, errors in (
                ("offset x, y, z", c.center, c.center_se),
                ("semi-axes, ascending", c.semi_axes, c.semi_axes_se),
            )
        ]
        below = (
            f"Residual {c.before.robust:.3g} → {c.after.robust:.3g} {c.unit} robust; {100 * c.rejected_share:.1f} % of "
            f"{c.samples:,} samples rejected; {100 * c.coverage.fraction:.0f} % of all directions covered.",
            *c.warnings,
            *c.notes,
        )
        return html_table(f"Calibration of {c.recording or 'a recording'}, {c.unit}", ("", "", "", ""), rows, below)

    @property
    def rejected_share(self) -> float:
        return self.rejected / self.samples

    def corrected(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """The corrected field in ``field_unit`` of measurements in ``unit``."""
        center, matrix = points.new_tensor(self.center), points.new_tensor(self.matrix)
        return (points - center) @ matrix.mT

    def norm_residual(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Length of the corrected field minus its nominal length, in ``unit``."""
        relative = torch.linalg.vector_norm(self.corrected(points), dim=-1) / self.field_strength
        return self.radius * (relative - 1.0)

    def algebraic_residual(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """``(|field| / field_strength)² - 1``, twice the relative error of the length to first order."""
        return (self.corrected(points) / self.field_strength).square().sum(-1) - 1.0

    def weight(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The weight in [0, 1] of measurements in the fit."""
        return mkc_weight(self.algebraic_residual(points), self.sigma, self.d)

    def apply(self, recording: Recording) -> dict[str, Float[Tensor, " N"]]:
        """Correct a recording row by row: ``time`` if it has a time, ``field_x``, ``field_y``, ``field_z`` in
        ``field_unit``.

        No row is dropped; the field is NaN where a measurement is missing. For an accelerometer, ``accel_*`` is
        corrected.

        Raises:
            MissingColumnError: the recording has no ``mag_x``, ``mag_y`` or ``mag_z``.

        Example:
            >>> from mkc_torch.calibration.calibrate import calibrate
            >>> from mkc_torch.recording.demonstration import simulated_recording
            >>> recording, _ = simulated_recording()
            >>> calibration = calibrate(recording, field_strength=48.0)
            >>> field = calibration.apply(recording)
            >>> list(field), round(float(torch.stack(list(field.values())[1:]).norm(dim=0).median()), 1)
            (['time', 'field_x', 'field_y', 'field_z'], 48.0)
        """
        measured = recording.stack(*(f"{self.sensor}_{axis}" for axis in "xyz"))
        field = self.corrected(measured)
        time = {} if recording.time is None else {"time": recording.time}
        return time | dict(zip(("field_x", "field_y", "field_z"), field.unbind(-1), strict=True))

    def to_json(self) -> str:
        """Encode the calibration as JSON of the schema "mkc-calibration/1", the inverse of :meth:`from_json`.

        Numbers round-trip exactly. JSON has no infinity and no NaN: ``sigma`` is the string "inf" for Gaussian
        residuals, and an unknown standard error is null.
        """
        return calibration_to_json(self)

    @staticmethod
    def from_json(text: str) -> Calibration:
        """Decode a calibration from a JSON text.

        Raises:
            CalibrationFileError: not JSON, another schema, or a value that is missing or of the wrong kind.

        Example:
            >>> Calibration.from_json('{"schema": "mkc-model/1"}')
            Traceback (most recent call last):
            mkc_torch.calibration.file.CalibrationFileError: this is not a calibration: its schema is "mkc-model/1", ...
        """
        return calibration_from_json(text)


def calibration_to_json(calibration: Calibration) -> str:
    """Encode a calibration; see :meth:`Calibration.to_json`."""
    c = calibration
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "recording": c.recording,
        "name": c.name,
        "samples": c.samples,
        "unit": c.unit,
        "center": {"value": c.center, "standard_error": finite_or_none(c.center_se)},
        "semi_axes": {"value": c.semi_axes, "standard_error": finite_or_none(c.semi_axes_se)},
        "rotation": c.rotation,
        "matrix": {"value": c.matrix, "standard_error": [finite_or_none(row) for row in c.matrix_se]},
        "radius": c.radius,
        "field_strength": {"value": c.field_strength, "unit": c.field_unit},
        "noise": {
            "residual": "(|matrix (measured - center)| / field_strength)^2 - 1",
            "sigma": "inf" if math.isinf(c.sigma) else c.sigma,
            "d": c.d,
            "bound": c.bound,
            **({} if c.tails is None else c.tails._asdict()),
        },
        "residual": {"before": c.before._asdict(), "after": c.after._asdict()},
        "rejected": {
            "count": c.rejected,
            "share": c.rejected_share,
            "intervals": c.disturbed,
            "interval_unit": c.disturbed_unit,
        },
        "coverage": {
            "fraction": c.coverage.fraction,
            "information": c.coverage.information,
            "gaps": [
                {"axis": nearest_axis(g.direction), "direction": g.direction, "degrees": g.degrees}
                for g in c.coverage.gaps
            ],
        },
        "warnings": c.warnings,
        "notes": c.notes,
    }
    if c.sensor != "mag":
        content["sensor"] = c.sensor
    if c.offset_change is not None:
        content["offset_change"] = c.offset_change._asdict()
    if c.rest_bias is not None:
        content["gyroscope"] = {
            "bias": {"value": c.rest_bias.value, "standard_error": finite_or_none(c.rest_bias.standard_error)},
            "unit": "rad/s",
            "rest_seconds": c.rest_bias.seconds,
        }
    if c.aid is not None:
        content["aided"] = aid_to_json(c.aid)
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, indent=2)
    # join lists of numbers to a line; a JSON string contains no line break, so none is changed
    return re.sub(r"\[\n\s+([^\[\]{}\"]*?)\n\s+\]", lambda m: "[" + " ".join(m[1].split()) + "]", text) + "\n"


def calibration_from_json(text: str) -> Calibration:
    """Decode a calibration; see :meth:`mkc_torch.calibration.Calibration.from_json`."""
    try:
        content = json.loads(text, parse_constant=refuse_constant)
    except json.JSONDecodeError as error:
        raise CalibrationFileError(
            f"this is not a calibration: line {error.lineno} is not JSON ({error.msg}); give a calibration.json."
        ) from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        reason = f'its schema is "{schema}", not "{SCHEMA}"' if isinstance(schema, str) else "it has no schema"
        raise CalibrationFileError(f"this is not a calibration: {reason}; give a calibration.json.")
    c = CheckedValues(content)
    return Calibration(
        recording=c.text("recording"),
        samples=c.count("samples", least=1),
        unit=c.text("unit"),
        center=c.vector("center", "value"),
        center_se=c.vector("center", "standard_error", unknown=True),
        semi_axes=c.vector("semi_axes", "value"),
        semi_axes_se=c.vector("semi_axes", "standard_error", unknown=True),
        rotation=c.matrix("rotation"),
        matrix=c.matrix("matrix", "value"),
        matrix_se=c.matrix("matrix", "standard_error", unknown=True),
        radius=c.positive("radius"),
        field_strength=c.positive("field_strength", "value"),
        field_unit=c.text("field_strength", "unit"),
        sigma=c.sigma(),
        d=c.positive("noise", "d"),
        bound=c.positive("noise", "bound"),
        before=ResidualSpread(c.number("residual", "before", "robust"), c.number("residual", "before", "rms")),
        after=ResidualSpread(c.number("residual", "after", "robust"), c.number("residual", "after", "rms")),
        rejected=c.count("rejected", "count"),
        disturbed=tuple(
            RejectedInterval(*c.numbers("rejected", "intervals", i, length=2)) for i in c.each("rejected", "intervals")
        ),
        coverage=Coverage(
            fraction=c.number("coverage", "fraction"),
            gaps=tuple(
                Gap(c.vector("coverage", "gaps", i, "direction"), c.number("coverage", "gaps", i, "degrees"))
                for i in c.each("coverage", "gaps")
            ),
            information=c.number("coverage", "information"),
        ),
        warnings=tuple(c.text("warnings", i) for i in c.each("warnings")),
        notes=tuple(c.text("notes", i) for i in c.each("notes")) if c.has("notes") else (),
        name=c.text("name") if "name" in content else c.text("recording"),
        disturbed_unit=c.text("rejected", "interval_unit") if c.has("rejected", "interval_unit") else "s",
        aid=aid_from_json(c),
        sensor=c.text("sensor") if c.has("sensor") else "mag",
        offset_change=_change_from(c) if c.has("offset_change") else None,
        rest_bias=RestBias(
            c.vector("gyroscope", "bias", "value"),
            c.vector("gyroscope", "bias", "standard_error", unknown=True),
            c.number("gyroscope", "rest_seconds"),
        )
        if c.has("gyroscope")
        else None,
        tails=ChannelTails(*(c.number("noise", name) for name in ChannelTails._fields))
        if c.has("noise", "likelihood_ratio")
        else None,
    )


def _change_from(c: CheckedValues) -> OffsetChange:
    at = None if c.content["offset_change"].get("at") is None else c.number("offset_change", "at")
    size, p_value = c.positive("offset_change", "size"), c.number("offset_change", "p_value")
    return OffsetChange(c.text("offset_change", "kind"), size, at, p_value)
