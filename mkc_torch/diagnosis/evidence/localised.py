"""Warning for a strongest candidate that acts in a single interval, while other intervals misfit too."""

from __future__ import annotations

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.model.term import Term

__all__ = ["called", "test"]


def test(case: EvidenceContext) -> EvidenceResult:
    """Return a warning with the interval."""
    located, time = case.first, case.prepared.time
    if located is None or located.stretch is None:
        return EvidenceResult("one_stretch")
    begin, end = (float(time[n]) for n in (located.stretch[0], located.stretch[1] - 1))
    sentence = (
        f"From {begin:.1f} to {end:.1f} s the residual fits {called(located.term)}, but hardly elsewhere. Other "
        f"intervals "
        "misfit too and no effect explains them, so this interval counts as a burst of outliers. Record again, for "
        "longer."
    )
    return EvidenceResult("one_stretch", (begin, end), warnings=(sentence,))


def called(term: Term) -> str:
    """Return the name of a candidate in a sentence."""
    if term.effect.unrecorded:
        return "an unrecorded cause"
    along = "a curve along" if term.effect.is_curve else f"{term.effect.id} by"
    if term.columns:
        return f"{along} {', '.join(term.columns)}"
    return "an unnamed curve" if term.effect.is_curve else term.effect.id
