"""Export to JSON for programs: each number of the correction under its own name."""

from __future__ import annotations

import json

from mkc_torch.calibration.exports.base import Destination, Export, Exported, SensorCorrection

SCHEMA = "mkc-export/1"


def text(correction: SensorCorrection, _to: Destination) -> Exported:
    """Write the numbers of a correction in its own units, with all digits.

    ``covariance_xx`` … is of the corrected field of an undisturbed sample, in ``field_unit²``; null if unknown.

    Example:
        >>> eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> numbers = json.loads(text(SensorCorrection("mast", "G", (0.1, 0.2, 0.3), eye, "G"), Destination()).text)
        >>> numbers["offset_y"], numbers["matrix_xx"]
        (0.2, 1.0)
    """
    c = correction
    content: dict[str, object] = {
        "schema": SCHEMA,
        "name": c.name,
        "formula": "field = matrix (measured - offset - field_per_ampere (current - mean_current))",
        "unit": c.unit,
        "field_unit": c.field_unit,
    }
    content |= {f"offset_{axis}": value for axis, value in zip("xyz", c.offset, strict=True)}
    content |= {f"matrix_{a}{b}": c.matrix[i][j] for i, a in enumerate("xyz") for j, b in enumerate("xyz")}
    per_ampere, mean = ((0.0, 0.0, 0.0), 0.0) if c.current is None else (c.current.per_ampere, c.current.mean)
    content |= {f"field_per_ampere_{axis}": value for axis, value in zip("xyz", per_ampere, strict=True)}
    covariance = {
        f"covariance_{a}{b}": None if c.covariance is None else c.covariance[i][j]
        for i, a in enumerate("xyz")
        for j, b in enumerate("xyz")
    }
    content |= covariance
    content |= {"mean_current": mean, "field_strength": c.field_strength, "left_out": list(c.left_out)}
    return Exported(json.dumps(content, ensure_ascii=False, allow_nan=False, indent=2) + "\n", c.left_out)


JSON = Export("json", "numbers.json", text, "in any program: a number for each name")
