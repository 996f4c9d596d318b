"""Table of a regression's coefficients as text, for a terminal and as HTML for a notebook."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from rich.console import Group

LIGHT = 0.1
"""Values with a weight below this are counted in the heading as nearly excluded. It has no other effect."""

_KINDS = {
    "sandwich": "the sandwich",
    "hac": "the sandwich of a time series",
    "homoscedastic": "Huber's formula for errors that are alike at every X",
}

_FACTS = ("scale", "robust R²")


@dataclass(frozen=True)
class Coefficient:
    """A row of the table: the estimate, its standard error, the p-value of the coefficient being 0, the interval."""

    name: str
    value: float
    standard_error: float
    p_value: float
    low: float
    high: float


@dataclass(frozen=True)
class Summary:
    """Coefficients of a robust regression with standard errors, p-values and intervals.

    Attributes:
        title: name of the estimator.
        coefficients: rows of the table.
        level: confidence level of the intervals.
        num_values, num_light: number of values, and how many of them have a weight below 0.1.
        scale, r_squared: of each channel; empty where the estimator has none.
        dof: degrees of freedom.
        kind: kind of the covariance.
    """

    title: str
    coefficients: tuple[Coefficient, ...]
    level: float
    num_values: int
    num_light: int
    scale: tuple[float, ...]
    r_squared: tuple[float, ...]
    dof: float
    kind: str

    @property
    def heading(self) -> str:
        light = f", {self.num_light} with a weight below {LIGHT:g}" if self.num_light else ""
        return f"{self.title} of {self.num_values} values{light}"

    @property
    def footing(self) -> str:
        facts = [
            f"{word} {', '.join(f'{v:.4g}' for v in values)}"
            for word, values in zip(_FACTS, (self.scale, self.r_squared), strict=True)
            if values
        ]
        return ", ".join([*facts, f"{self.dof:g} degrees of freedom", f"standard errors by {_KINDS[self.kind]}"])

    @property
    def columns(self) -> tuple[str, ...]:
        return ("", "coefficient", "std. error", "p-value", f"{100 * self.level:g} % interval")

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """The cells as text; coefficients and intervals have the decimals that the standard error justifies."""
        return [_cells(c) for c in self.coefficients]

    def __str__(self) -> str:
        table = [self.columns, *self.rows]
        width = [max(len(row[k]) for row in table) for k in range(len(self.columns))]
        lines = (
            "   ".join([row[0].ljust(width[0]), *(c.rjust(w) for c, w in zip(row[1:], width[1:], strict=True))])
            for row in table
        )
        return "\n".join([self.heading, "", *lines, "", self.footing])

    def __rich__(self) -> Group:
        from rich import box
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table(box=box.SIMPLE_HEAD)
        table.add_column(self.columns[0])
        for column in self.columns[1:]:
            table.add_column(column, justify="right", no_wrap=True)
        for name, *cells in self.rows:
            # brackets in a name are not markup
            table.add_row(Text(name), *cells)
        return Group(Text(self.heading), table, Text(self.footing))

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{html.escape(c)}</th>" for c in self.columns)
        body = "".join(
            f"<tr><th>{html.escape(name)}</th>{''.join(f'<td>{c}</td>' for c in cells)}</tr>"
            for name, *cells in self.rows
        )
        return (
            f"<table><caption>{html.escape(self.heading)}</caption><thead><tr>{head}</tr></thead>"
            f"<tbody>{body}</tbody></table><p>{html.escape(self.footing)}</p>"
        )


def coefficients_of(
    names: Sequence[str] | None, columns: tuple[Tensor, Tensor, Tensor, Tensor]
) -> tuple[Coefficient, ...]:
    """Rows of the table from its columns: coefficients, standard errors, p-values (n,) and intervals (n, 2)."""
    value, error, p_value, interval = (c.detach().cpu().double().tolist() for c in columns)
    names = [f"x{k}" for k in range(len(value))] if names is None else list(names)
    if len(names) != len(value):
        raise ValueError(
            f"Expected argument `names` to hold {len(value)} names but got {len(names)}; pass one per coefficient."
        )
    rows = zip(names, value, error, p_value, interval, strict=True)
    return tuple(Coefficient(str(n), v, e, p, *ends) for n, v, e, p, ends in rows)


def _cells(c: Coefficient) -> tuple[str, ...]:
    decimals = _decimals(c.standard_error)
    return (
        c.name,
        _fixed(c.value, decimals),
        f"{c.standard_error:.4g}",
        f"{c.p_value:.2g}",
        f"{_fixed(c.low, decimals)} to {_fixed(c.high, decimals)}",
    )


def _decimals(error: float) -> int | None:
    """Decimals that show three digits of a standard error; None where the number would be too long."""
    if not 0.0 < error < math.inf:
        return None
    decimals = 2 - math.floor(math.log10(error))
    return max(decimals, 0) if decimals <= 8 else None


def _fixed(value: float, decimals: int | None) -> str:
    return f"{value:.6g}" if decimals is None or abs(value) >= 1e9 else f"{value:.{decimals}f}"


def one_problem(problem: tuple[int, ...], batch: tuple[int, ...]) -> tuple[int, ...]:
    """Return the index of one problem of a batch.

    Raises:
        IndexError: no problem is chosen, or there is no such problem.
    """
    fits = len(problem) == len(batch) and all(-size <= k < size for k, size in zip(problem, batch, strict=True))
    if not fits:
        raise IndexError(
            f"Expected argument `problem` to be the index of one problem of the batch {batch} but got {problem}; "
            "a summary shows one problem."
        )
    return problem
