"""The same samples in every dialect of text that is read."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from decimal import Decimal

import numpy as np

SAMPLES = 60
UNITS = {"uT": 0, "µT": 0, "nT": 3, "mT": -3, "T": -6, "gauss": -2, "Ga": -2, "mG": 1, "mGauss": 1}
"""Power of ten of the ratio of a number in the unit to the number in µT."""
TIMES = {
    "s": 0, "ms": 3, "us": 6, "ns": 9,
    "epoch s": 0, "epoch ms": 3, "epoch us": 6, "epoch ns": 9, "iso": None, "iso zone": None, "iso blank": None,
}  # fmt: skip
SINCE = 1_700_000_000
NAMES = {
    "mag_{}": "xyz", "mag{}": "XYZ", "m{}": "xyz", "Mag.{}": "XYZ", "MAG_{}": "XYZ", "magnetic_field.{}": "xyz",
    "B{}": "xyz", "magnetometer[{}]": "012", "compass_{}": "xyz", "{}mag": "xyz", "mag_raw_{}": "xyz", "Mag {}": "XYZ",
}  # fmt: skip


def samples():
    """Times of whole ms in 100 µs, and the field in whole 0.1 nT: an ellipsoid all around."""
    generator = np.random.default_rng(7)
    direction = generator.normal(size=(SAMPLES, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    field = direction * [47.0, 54.0, 58.0] + [-0.6, -10.5, 2.0] + 0.2 * generator.normal(size=(SAMPLES, 3))
    time = np.concatenate([[0], 10 * generator.integers(6, 170, SAMPLES - 1)]).cumsum()
    return time, np.round(field * 1e4).astype(int)


TIME, FIELD = samples()
SECONDS = np.array([float(Decimal(int(t)).scaleb(-4)) for t in TIME])
MICROTESLA = np.array([[float(Decimal(int(v)).scaleb(-4)) for v in row] for row in FIELD])
"""What every dialect reads as, to the last digit."""


@dataclass(frozen=True)
class Dialect:
    """How a table is written."""

    separator: str = ","
    comma: bool = False
    names: str = "mag_{}"
    unit: str = ""
    unit_in: str = "none"
    time: str = "s"
    time_unit: bool = False
    end: str = "\n"
    encoding: str = "utf-8"
    comments: int = 0
    mark: str = "#"
    among: bool = False
    above: int = 0
    cut: bool = False
    zeros: int = 0
    header_again: bool = False
    quoted: bool = False
    trailing: bool = False

    def text(self) -> str:
        blank = "\t" if self.separator == " " else self.separator
        cells = [[self._time(int(t)), *(self._field(int(v)) for v in row)] for t, row in zip(TIME, FIELD, strict=True)]
        rows = [self._line(row) for row in cells]
        header, units = self._header()
        lines = [f"{self.mark} recorded by a logger, {i}" for i in range(self.comments)]
        lines += ["Logger v1.3", "free text, of any kind. And: more"][: self.above]
        lines += [header, *units, *rows]
        if self.among:
            lines.insert(len(lines) - 20, f"{self.mark} battery low")
        if self.header_again:
            lines[len(lines) - 10 : len(lines) - 10] = ["Logger v1.3", header, *units]
        if self.cut:
            lines.append(rows[0][: rows[0].rindex(blank if self.separator != " " else " ") - 1])
        return self.end.join(lines) + ("" if self.cut else self.end)

    def bytes(self) -> bytes:
        return self.text().encode(self.encoding) + b"\0" * self.zeros

    def _line(self, cells: list[str]) -> str:
        written = [f'"{cell}"' for cell in cells] if self.quoted else cells
        return self.separator.join(written) + (self.separator if self.trailing else "")

    def _header(self) -> tuple[str, list[str]]:
        axes = [self.names.format(axis) for axis in NAMES[self.names]]
        time = "time" if self.time == "s" else "timestamp"
        unit = self.time.split()[-1] if self.time_unit and "iso" not in self.time else ""
        if self.unit_in == "brackets":
            axes = [f"{name} [{self.unit}]" for name in axes]
        elif self.unit_in == "parentheses":
            axes = [f"{name}({self.unit})" for name in axes]
        elif self.unit_in == "suffix":
            axes = [f"{name}_{self.unit}" for name in axes]
        names = [f"{time}_{unit}" if unit and self.unit_in == "suffix" else f"{time} [{unit}]" if unit else time, *axes]
        row = [unit or ("s" if self.time == "s" else "-"), *[self.unit] * 3]
        header = self.separator.join(f'"{name}"' if self.quoted or " " in name else name for name in names)
        return header, [self.separator.join(row)] if self.unit_in == "row" else []

    def _number(self, value: Decimal) -> str:
        text = format(value, "f")
        return text.replace(".", ",") if self.comma else text

    def _field(self, value: int) -> str:
        return self._number(Decimal(value).scaleb(-4 + UNITS.get(self.unit, 0)))

    def _time(self, value: int) -> str:
        if "iso" in self.time:
            zone = timezone(timedelta(hours=2)) if self.time == "iso zone" else None
            moment = datetime.fromtimestamp(SINCE, timezone.utc).astimezone(zone) + timedelta(microseconds=100 * value)
            text = moment.isoformat() if zone else moment.replace(tzinfo=None).isoformat()
            return text.replace("T", " ") if self.time == "iso blank" else text
        since = SINCE if "epoch" in self.time else 0
        number = (Decimal(value).scaleb(-4) + since).scaleb(TIMES[self.time])
        return self._number(
            number if self.time.endswith("s") and TIMES[self.time] == 0 else number.quantize(Decimal(1))
        )
