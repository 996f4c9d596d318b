"""Read values of calibration.json by their path, and check each value when it is read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


class CalibrationFileError(ValueError):
    """A text is not a calibration; the message states why."""


def finite_or_none(values: Sequence[float]) -> list[float | None]:
    return [v if math.isfinite(v) else None for v in values]


def refuse_constant(name: str) -> NoReturn:
    raise CalibrationFileError(f"this is not a calibration: it holds {name}, which is not JSON; calibrate again.")


class CheckedValues:
    """Values of the file by their path; each method checks the value that it reads."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        self.content = content

    def _at(self, *path: str | int) -> Any:
        value: Any = self.content
        for key in path:
            if isinstance(key, str) and not (isinstance(value, Mapping) and key in value):
                raise CalibrationFileError(f"the calibration has no `{_dotted(path)}`; calibrate again.")
            value = value[key]
        return value

    def has(self, *path: str) -> bool:
        """Whether the file has a value at this path; older files lack some values."""
        value: Any = self.content
        for key in path:
            if not (isinstance(value, Mapping) and key in value):
                return False
            value = value[key]
        return True

    def names(self, *path: str) -> tuple[str, ...]:
        """The names of the values of an object."""
        value = self._at(*path)
        if not isinstance(value, Mapping):
            raise self._wrong(path, "an object")
        return tuple(value)

    def _wrong(self, path: tuple[str | int, ...], expected: str) -> CalibrationFileError:
        shown = json.dumps(self._at(*path), ensure_ascii=False)
        shown = shown if len(shown) <= 40 else shown[:39] + "…"
        return CalibrationFileError(f"`{_dotted(path)}` of the calibration must be {expected} but is {shown}.")

    def text(self, *path: str | int) -> str:
        value = self._at(*path)
        if not isinstance(value, str):
            raise self._wrong(path, "text")
        return value

    def number(self, *path: str | int) -> float:
        value = self._at(*path)
        if not _is_number(value):
            raise self._wrong(path, "a number")
        return float(value)

    def positive(self, *path: str | int) -> float:
        value = self.number(*path)
        if value <= 0:
            raise self._wrong(path, "a positive number")
        return value

    def count(self, *path: str | int, least: int = 0) -> int:
        value = self._at(*path)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise self._wrong(path, f"a whole number of at least {least}")
        return value

    def sigma(self) -> float:
        return math.inf if self._at("noise", "sigma") == "inf" else self.positive("noise", "sigma")

    def each(self, *path: str | int) -> range:
        value = self._at(*path)
        if not isinstance(value, list):
            raise self._wrong(path, "a list")
        return range(len(value))

    def numbers(self, *path: str | int, length: int, unknown: bool = False) -> tuple[float, ...]:
        value = self._at(*path)
        fine = isinstance(value, list) and len(value) == length
        if not fine or not all(_is_number(v) or (unknown and v is None) for v in value):
            raise self._wrong(path, f"a list of {length} numbers")
        return tuple(math.inf if v is None else float(v) for v in value)

    def vector(self, *path: str | int, unknown: bool = False) -> Vector:
        x, y, z = self.numbers(*path, length=3, unknown=unknown)
        return x, y, z

    def matrix(self, *path: str | int, unknown: bool = False) -> Matrix:
        if len(self.each(*path)) != 3:
            raise self._wrong(path, "a list of 3 rows")
        a, b, c = (self.vector(*path, i, unknown=unknown) for i in range(3))
        return a, b, c


def _is_number(value: object) -> bool:
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number beyond the range of float64
        return False


def _dotted(path: tuple[str | int, ...]) -> str:
    return ".".join(str(key) for key in path)
