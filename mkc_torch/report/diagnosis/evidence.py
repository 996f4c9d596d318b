"""Rows and tables of the tests of evidence, for the page and the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch._words.typesetting import typeset
from mkc_torch.diagnosis.result import EvidenceResult, Row, Table

__all__ = ["of_driver", "rows", "tables"]


_DRIVEN_BY = "driven by"
"""Label of rows that are shown with the driver's name."""


def of_driver(evidence: Sequence[EvidenceResult]) -> list[str]:
    """Return the rows on a finding's driver."""
    return [typeset(row.text) for row in _rows(evidence) if row.label == _DRIVEN_BY]


def rows(evidence: Sequence[EvidenceResult], *, terminal: bool = False) -> list[tuple[str, str]]:
    """Return the other rows, with their labels.

    Example:
        >>> results = [
        ...     EvidenceResult(
        ...         "my_test", rows=(Row("residual", "-0.5 nats"), Row("in print", "more", in_terminal=False))
        ...     )
        ... ]
        >>> rows(results), rows(results, terminal=True)
        ([('residual', '−0.5 nats'), ('in print', 'more')], [('residual', '−0.5 nats')])
    """
    return [
        (typeset(row.label), typeset(row.text))
        for row in _rows(evidence)
        if row.label != _DRIVEN_BY and (row.in_terminal or not terminal)
    ]


def tables(evidence: Sequence[EvidenceResult]) -> list[Table]:
    """Return the tables of a page."""
    return [result.table for result in evidence if result.table is not None]


def _rows(evidence: Sequence[EvidenceResult]) -> list[Row]:
    return [row for result in evidence for row in result.rows]
