"""Lines and tables of the tests of evidence, for the page and the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mkc_torch._support.typesetting import typeset
from mkc_torch.diagnosis.result import DensityCheck, DriverShift, EvidenceResult

_DRIVEN_BY = "driven by"
"""Label of rows that are shown with the driver's name."""


@dataclass(frozen=True)
class Row:
    """A line of facts; ``in_terminal`` shows it on the terminal. The label "driven by" adds it to the driver's line."""

    label: str
    text: str
    in_terminal: bool = True


@dataclass(frozen=True)
class Table:
    """A table of the report; its first column is the heading of each row, ``note`` explains how to read it."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Section:
    """The lines and the table of a result."""

    rows: tuple[Row, ...] = ()
    table: Table | None = None


def of_driver(evidence: Sequence[EvidenceResult]) -> list[str]:
    """Return the rows on a finding's driver.

    Example:
        >>> of_driver([EvidenceResult("driver_shift", DriverShift(38, 0, 22.5))])
        ['none of 38 copies shifted by up to 22.5 s gains as much']
    """
    return [typeset(row.text) for row in _rows(evidence) if row.label == _DRIVEN_BY]


def rows(evidence: Sequence[EvidenceResult], *, terminal: bool = False) -> list[tuple[str, str]]:
    """Return the other rows, with their labels.

    Example:
        >>> from mkc_torch.diagnosis.result import Extrapolation
        >>> results = [EvidenceResult("extrapolation", Extrapolation(0.31, (0.28, 0.35)))]
        >>> rows(results)[0][0], rows(results, terminal=True)
        ('beyond its range', [])
    """
    return [
        (typeset(row.label), typeset(row.text))
        for row in _rows(evidence)
        if row.label != _DRIVEN_BY and (row.in_terminal or not terminal)
    ]


def tables(evidence: Sequence[EvidenceResult]) -> list[Table]:
    """Return the tables of a page."""
    return [section.table for section in _sections(evidence) if section.table is not None]


def _rows(evidence: Sequence[EvidenceResult]) -> list[Row]:
    return [row for section in _sections(evidence) for row in section.rows]


def _sections(evidence: Sequence[EvidenceResult]) -> list[Section]:
    return [
        SECTIONS[result.test](result) for result in evidence if result.test in SECTIONS and result.value is not None
    ]


def _driver_shift(result: EvidenceResult) -> Section:
    shift: DriverShift = result.value
    some = {0: "none", 1: "one"}.get(shift.as_good, str(shift.as_good))
    gain = "gain" if shift.as_good > 1 else "gains"
    text = f"{some} of {shift.copies} copies shifted by up to {shift.reach:.3g} s {gain} as much"
    return Section((Row(_DRIVEN_BY, text),))


def _extrapolation(result: EvidenceResult) -> Section:
    low, high = result.value.confidence_interval
    verb = "improves the prediction" if low > 0.0 else "degrades the prediction" if high < 0.0 else "is not significant"
    text = f"fitted at low values of its driver, it {verb} at high values"
    return Section((Row("beyond its range", text, in_terminal=False),))


def _density(result: EvidenceResult) -> Section:
    checks: Sequence[DensityCheck] = result.value
    level = max((check.level for check in checks), default=0.0)
    note = (
        "Kolmogorov distance of the residuals from the fitted density, and from the most likely Student-t; 0 is a "
        f"perfect fit. The critical distance has level {level:.1g}."
    )
    columns = ("channel", "distance of the density", "distance of a Student-t", "critical distance", "")
    return Section(table=Table("Is the density right?", columns, tuple(_distances(check) for check in checks), note))


def _distances(check: DensityCheck) -> tuple[str, ...]:
    """Format the distances of a channel and their conclusion.

    Example:
        >>> _distances(DensityCheck("norm", 0.021, 0.034, 4.0, 0.05, False))
        ('norm', '0.021', '0.034 (4 degrees of freedom)', '0.05', 'not significant')
    """
    verdict = "a Student-t is closer" if check.closer else "not significant"
    if not check.closer and check.distance > check.allowed:
        verdict = "significant, but a Student-t is not clearly better"
    freedom = f"{check.degrees_of_freedom:g} degree{'' if check.degrees_of_freedom == 1 else 's'} of freedom"
    student = f"{check.student_distance:.2g} ({freedom})"
    return check.channel, f"{check.distance:.2g}", student, f"{check.allowed:.2g}", verdict


def _whiteness(result: EvidenceResult) -> Section:
    unit, channels = result.content["unit"], result.content["channels"]
    first = next(iter(result.value.values()))
    note = (
        "Autocorrelation of the final model's residual, without rejected samples: the last significant lag, the "
        f"correlation of neighbours, and the p-value of the first {first.lags} lags together. The level is "
        f"{first.level:.2g}."
    )
    lines = tuple(
        (
            channel["channel"],
            "white" if channel["white"] else f"{channel['lag']:.3g} {unit}",
            f"{channel['neighbours']:.2f}",
            f"{channel['p_value']:.2g}" if channel["p_value"] >= 1e-4 else "< 0.0001",
        )
        for channel in channels
    )
    columns = ("channel", "correlated up to", "correlation of neighbours", "p-value")
    return Section(
        (Row("residual", _correlated(channels, unit)),), Table("Whiteness of the residual", columns, lines, note)
    )


def _correlated(channels: Sequence[Mapping[str, Any]], unit: str) -> str:
    """Return the channel with the longest correlation, and the number of white channels.

    Example:
        >>> x = {"channel": "x", "white": True, "lag": 0.0}
        >>> y = {"channel": "y", "white": False, "lag": 0.4}
        >>> _correlated([x], "s"), _correlated([y], "s"), _correlated([x, y], "s")
        ('white', 'correlated up to 0.4 s', 'y correlated up to 0.4 s; 1 of 2 channels white')
    """
    longest = max(channels, key=lambda channel: float(channel["lag"]))
    if longest["white"]:
        return "white"
    reach = f"correlated up to {longest['lag']:.3g} {unit}"
    if len(channels) == 1:
        return reach
    white = sum(channel["white"] for channel in channels)
    return f"{longest['channel']} {reach}; {white or 'none'} of {len(channels)} channels white"


SECTIONS: dict[str, Callable[[EvidenceResult], Section]] = {
    "driver_shift": _driver_shift,
    "extrapolation": _extrapolation,
    "density": _density,
    "whiteness": _whiteness,
}
"""Functions that word the results, by the id of the test; results of other tests are not shown."""
