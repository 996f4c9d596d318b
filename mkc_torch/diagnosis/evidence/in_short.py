"""The tests of evidence that take no time, for a quick look and for a search that was stopped."""

from __future__ import annotations

from mkc_torch.diagnosis.evidence import held_out_gain, localised, rejected, whiteness
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, EvidenceTest

__all__ = ["in_short"]


def in_short(*, held_out: bool) -> tuple[EvidenceTest, ...]:
    """The tests.

    Args:
        held_out: whether findings were judged on blocks that their fits have not seen.
    """
    blocks = held_out_gain.test if held_out else _not_judged
    return (
        EvidenceTest(blocks, each_finding=True),
        EvidenceTest(localised.test),
        EvidenceTest(rejected.test),
        EvidenceTest(whiteness.test),
    )


def _not_judged(_: EvidenceContext) -> EvidenceResult:
    return held_out_gain.said(None, "nobody asked unseen blocks, in a quick look or before the search was stopped")
