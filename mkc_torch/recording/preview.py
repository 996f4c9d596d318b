"""Show a recording as a line, and as a table in a notebook."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from mkc_torch._support.html_table import html_table

_MOST_COLUMNS = 30
_MOST_WARNINGS = 6


class TablePreview:
    """``repr`` and HTML table of a table of named columns."""

    __slots__ = ()

    @property
    def name(self) -> str:
        raise NotImplementedError

    @property
    def columns(self) -> Mapping[str, Tensor]:
        raise NotImplementedError

    @property
    def units(self) -> Mapping[str, str]:
        raise NotImplementedError

    @property
    def warnings(self) -> tuple[str, ...]:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"Recording({self.name!r}, {_count(self.columns)} samples: {', '.join(self.columns)})"

    def _repr_html_(self) -> str:
        rows = [_row(name, values, self.units.get(name, "")) for name, values in self.columns.items()]
        below = list(self.warnings[:_MOST_WARNINGS])
        if len(rows) > _MOST_COLUMNS:
            below.insert(0, f"And {len(rows) - _MOST_COLUMNS} more columns.")
        if len(self.warnings) > _MOST_WARNINGS:
            below.append(f"And {len(self.warnings) - _MOST_WARNINGS} more warnings.")
        caption = f"{self.name or 'Recording'}: {_count(self.columns):,} samples"
        heads = ("column", "unit", "least", "median", "most", "missing")
        return html_table(caption, heads, rows[:_MOST_COLUMNS], below)


def _count(columns: Mapping[str, Tensor]) -> int:
    return len(next(iter(columns.values())))


def _row(name: str, values: Tensor, unit: str) -> tuple[str, ...]:
    finite = values[values.isfinite()]
    missing = len(values) - len(finite)
    statistics = (finite.min(), finite.median(), finite.max()) if len(finite) else ()
    numbers = [f"{float(value):.5g}".replace("-", "−") for value in statistics] or ["", "", ""]
    return (name, unit, *numbers, f"{missing:,}" if missing else "")
