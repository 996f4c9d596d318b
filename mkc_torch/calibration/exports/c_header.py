"""Export to a C header with offset, matrix and a function, for custom firmware."""

from __future__ import annotations

import re
from collections.abc import Sequence

from mkc_torch.calibration.exports.base import MADE_BY, Destination, Export, Exported, SensorCorrection
from mkc_torch.calibration.exports.numbers import SMALLEST, not_held, one_line, single


def text(correction: SensorCorrection, _to: Destination) -> Exported:
    """Write a correction as a header in its own units, for C99 and C++.

    Raises:
        ExportError: a number is beyond the range of 32 bits.

    Example:
        >>> eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> header = text(SensorCorrection("mast 2", "counts", (12.5, -8.0, 21.0), eye, "counts"), Destination()).text
        >>> header.splitlines()[1], "mag_offset[3] = {12.5f, -8.0f, 21.0f}" in header
        ('#ifndef MAG_CALIBRATION_MAST_2_H', True)
    """
    c = correction
    if c.field_strength is not None:
        reading = c.field_strength / max(SMALLEST, *(abs(value) for row in c.matrix for value in row))
        if reading < SMALLEST:
            raise not_held(reading)
    guard = f"MAG_CALIBRATION_{re.sub('[^A-Z0-9]+', '_', c.name.upper()).strip('_') or 'SENSOR'}_H"
    unit, field_unit = one_line(c.unit) or "recorded units", one_line(c.field_unit) or "recorded units"
    rows = ",\n".join(f"    {_listed(row)}" for row in c.matrix)
    argument, away, used, arrays = "", "", "", ""
    if c.current is not None:
        arrays = (
            f"/* field of a current at the sensor, {unit} per A, and the current in A at which it is in mag_offset */\n"
            f"static const float mag_field_per_ampere[3] = {_listed(c.current.per_ampere)};\n"
            f"static const float mag_mean_current = {_literal(c.current.mean)};\n"
        )
        argument, used = ", float current", " - mag_field_per_ampere * (current - mag_mean_current)"
        away = " - mag_field_per_ampere[i] * (current - mag_mean_current)"
    notes = "".join(f" * {one_line(sentence)}\n" for sentence in c.left_out)
    return Exported(
        f"/* {MADE_BY}: calibration of the magnetometer {one_line(c.name)} */\n"
        f"#ifndef {guard}\n#define {guard}\n\n"
        f"/* field = mag_matrix * (measured - mag_offset{used})\n"
        f" * measured in {unit}, field in {field_unit}\n{notes} */\n"
        f"static const float mag_offset[3] = {_listed(c.offset)}; /* {unit} */\n"
        f"static const float mag_matrix[3][3] = {{ /* {field_unit} per {unit} */\n{rows}\n}};\n{arrays}\n"
        f"static inline void mag_correct(const float measured[3]{argument}, float field[3])\n{{\n"
        "    float away[3];\n"
        f"    for (int i = 0; i < 3; i++)\n        away[i] = measured[i] - mag_offset[i]{away};\n"
        "    for (int i = 0; i < 3; i++)\n"
        "        field[i] = mag_matrix[i][0] * away[0] + mag_matrix[i][1] * away[1] + mag_matrix[i][2] * away[2];\n"
        f"}}\n\n#endif /* {guard} */\n",
        c.left_out,
    )


def _listed(values: Sequence[float]) -> str:
    return f"{{{', '.join(_literal(value) for value in values)}}}"


def _literal(value: float) -> str:
    return f"{single(value)}f"


C_HEADER = Export("c-header", "mag_calibration.h", text, "in C: #include it and call mag_correct")
