"""What the tests of evidence say, as lines and tables of a page and of the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch._words.typesetting import typeset
from mkc_torch.diagnosis.result import EvidenceResult, Row, Table

__all__ = ["of_driver", "rows", "tables"]


_DRIVEN_BY = "driven by"
"""What is said of a driver stands where the driver is named."""


def of_driver(evidence: Sequence[EvidenceResult]) -> list[str]:
    """What is said of a finding's driver."""
    return [typeset(row.text) for row in _rows(evidence) if row.label == _DRIVEN_BY]


def rows(evidence: Sequence[EvidenceResult], *, terminal: bool = False) -> list[tuple[str, str]]:
    """Lines of their own, with their labels.

    Example:
        >>> said = [
        ...     EvidenceResult(
        ...         "my_test", rows=(Row("left over", "-0.5 nats"), Row("in print", "more", in_terminal=False))
        ...     )
        ... ]
        >>> rows(said), rows(said, terminal=True)
        ([('left over', '−0.5 nats'), ('in print', 'more')], [('left over', '−0.5 nats')])
    """
    return [
        (typeset(row.label), typeset(row.text))
        for row in _rows(evidence)
        if row.label != _DRIVEN_BY and (row.in_terminal or not terminal)
    ]


def tables(evidence: Sequence[EvidenceResult]) -> list[Table]:
    """Tables of a page."""
    return [said.table for said in evidence if said.table is not None]


def _rows(evidence: Sequence[EvidenceResult]) -> list[Row]:
    return [row for said in evidence for row in said.rows]
