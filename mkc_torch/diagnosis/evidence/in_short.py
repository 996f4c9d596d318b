"""The fast tests of evidence, for a quick look and for a stopped search."""

from __future__ import annotations

from mkc_torch.diagnosis.evidence import held_out_gain, localised, rejected, whiteness
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, EvidenceTest

__all__ = ["in_short"]


def in_short(*, held_out: bool) -> tuple[EvidenceTest, ...]:
    """Return the fast tests.

    Args:
        held_out: whether findings were scored on held-out blocks.
    """
    blocks = held_out_gain.test if held_out else _not_judged
    return (
        EvidenceTest(blocks, each_finding=True),
        EvidenceTest(localised.test),
        EvidenceTest(rejected.test),
        EvidenceTest(whiteness.test),
    )


def _not_judged(_: EvidenceContext) -> EvidenceResult:
    return held_out_gain.as_result(None, "no held-out blocks in a quick look, or the search was stopped before")
