"""The table of the checks before the search, for the page and the terminal."""

from __future__ import annotations

from collections.abc import Iterator

from mkc_torch._support.typesetting import plain, typeset
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.report.diagnosis.evidence import Table

TITLE = "Before the search"

_LABELS = {
    "no equation": "in no equation",
    "no output": "no effect on an output",
    "only together": "not separable",
    "at a bound": "start at a bound",
    "impossible value": "fitted value",
    "unlikely value": "fitted value",
    "diverges": "diverges",
}


def checks_table(diagnosis: Diagnosis) -> Table | None:
    """Return the checks of the simulation's own parameters; None if all parameters pass."""
    if not diagnosis.checks:
        return None
    rows = tuple(
        (plain(", ".join(check.parameters)), _LABELS[check.kind], typeset(check.sentence)) for check in diagnosis.checks
    )
    return Table(TITLE, ("parameter", "check", "what it means"), rows)


def check_lines(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield a line for each check."""
    for check in diagnosis.checks:
        yield typeset(check.sentence)
