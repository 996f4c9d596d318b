"""Whether the strongest candidate is there in one stretch of the recording alone, where others are off too."""

from __future__ import annotations

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.model.term import Term

__all__ = ["called", "test"]


def test(case: EvidenceContext) -> EvidenceResult:
    """A warning of the stretch."""
    located, time = case.first, case.prepared.time
    if located is None or located.stretch is None:
        return EvidenceResult("one_stretch")
    begin, end = (float(time[n]) for n in (located.stretch[0], located.stretch[1] - 1))
    sentence = (
        f"From {begin:.1f} to {end:.1f} s the recording is off as {called(located.term)} would have it, but hardly "
        "elsewhere. Other stretches are off too and no effect explains them, so this one counts as another burst of "
        "outliers. Record again, for longer."
    )
    return EvidenceResult("one_stretch", (begin, end), warnings=(sentence,))


def called(term: Term) -> str:
    """A candidate in a sentence."""
    if term.effect.unrecorded:
        return "a cause that no column recorded"
    along = "a curve along" if term.effect.is_curve else f"{term.effect.id} by"
    if term.columns:
        return f"{along} {', '.join(term.columns)}"
    return "a curve without a name" if term.effect.is_curve else term.effect.id
