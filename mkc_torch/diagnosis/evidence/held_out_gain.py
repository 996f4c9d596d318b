"""Gain of a finding on held-out blocks; given the other findings, if those may have masked it."""

from __future__ import annotations

import torch

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.evidence.held_out import Evidence, gain_interval, held_out
from mkc_torch.diagnosis.evidence.held_out_sizes import sizes_of
from mkc_torch.diagnosis.result import HeldOut

__all__ = ["test", "without_finding"]

_GIVEN_OTHERS = "Scored given the other findings; without them, it is masked."
_TOO_SHORT = "a side of the step is shorter than two held-out blocks"


def without_finding(case: EvidenceContext) -> Evidence | None:
    """Score the final model without the finding, if later findings may have masked its gain."""
    if not case.overlaid or _confirmed(case):
        return None
    return held_out(case.without_and_with[0], case.blocks)


def _confirmed(case: EvidenceContext) -> bool:
    """Whether held-out blocks confirm the finding without the later findings."""
    before, after = case.pairs[case.number] if case.pairs else case.held_out[case.number : case.number + 2]
    difference = after.log_likelihood - before.log_likelihood
    return gain_interval(difference, case.blocks.block, torch.Generator().manual_seed(case.seed))[1][0] > 0.0


def test(case: EvidenceContext) -> EvidenceResult:
    """Return the log-likelihood gain with its interval, and the residuals before and after."""
    if not _long_enough(case, case.number):
        return as_result(None, _TOO_SHORT)
    before, after = case.held_out[case.number : case.number + 2]
    worse, better = case.pairs[case.number] if case.pairs else (before, after)
    note = ""
    if case.ahead is not None:
        before, after, note = case.ahead, case.held_out[-1], _GIVEN_OTHERS
        worse, better = before, after
    gain, interval = gain_interval(better.log_likelihood - worse.log_likelihood, case.blocks.block, _draws(case))
    outputs, diverged = sizes_of(case.prepared, case.units, before, after, case.blocks)
    only = next(iter(outputs.values())) if len(outputs) == 1 and case.of_states else None
    sizes = (case.rms(before), case.rms(after)) if only is None else (only.before, only.after)
    count, decides = int(case.blocks.block.max()) + 1, not case.located.with_noise
    held = HeldOut(gain, interval, *sizes, case.prepared.unit, outputs, diverged, count, decides)
    return as_result(held, note)


def as_result(held: HeldOut | None, note: str) -> EvidenceResult:
    """Return the gain, or the reason why it was not measured."""
    return EvidenceResult("held_out", (held, note), keys={"held_out": held, "held_out_note": note})


def _long_enough(case: EvidenceContext, number: int) -> bool:
    """Whether both sides of a finding's onset can be held out."""
    onset, time = case.found[number].term.shape.get("onset"), case.prepared.time
    if onset is None:
        return True
    shorter = min(int((time < onset).sum()), int((time >= onset).sum()))
    return shorter >= 2 * len(time) // (int(case.blocks.block.max()) + 1)


def _draws(case: EvidenceContext) -> torch.Generator:
    """Return the generator after the draws of the previous findings."""
    generator = torch.Generator().manual_seed(case.seed)
    for number in range(case.number):
        if _long_enough(case, number):
            gain_interval(case.held_out[0].log_likelihood, case.blocks.block, generator)
    return generator
