"""What a finding gains on blocks that the fit has not seen; beside the others, where those may have hidden it."""

from __future__ import annotations

import torch

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.evidence.held_out import Evidence, gain_interval, held_out
from mkc_torch.diagnosis.evidence.held_out_sizes import sizes_of
from mkc_torch.diagnosis.result import HeldOut

__all__ = ["beside_the_others", "test"]

_BESIDE = "Judged beside the other findings: while those are left out, they hide it."
_TOO_SHORT = "one side of the step is shorter than two of the held-out blocks"


def beside_the_others(case: EvidenceContext) -> Evidence | None:
    """The final model without the finding, on held-out blocks, where what was found later may have hidden its gain."""
    if not case.overlaid or _confirmed(case):
        return None
    return held_out(case.without_and_with[0], case.blocks)


def _confirmed(case: EvidenceContext) -> bool:
    """Whether unseen blocks are surely better with it, before anything else was found."""
    before, after = case.pairs[case.number] if case.pairs else case.held_out[case.number : case.number + 2]
    difference = after.log_likelihood - before.log_likelihood
    return gain_interval(difference, case.blocks.block, torch.Generator().manual_seed(case.seed))[1][0] > 0.0


def test(case: EvidenceContext) -> EvidenceResult:
    """The gain in log-likelihood with its interval, and the residuals before and after."""
    if not _long_enough(case, case.number):
        return said(None, _TOO_SHORT)
    before, after = case.held_out[case.number : case.number + 2]
    worse, better = case.pairs[case.number] if case.pairs else (before, after)
    note = ""
    if case.ahead is not None:
        before, after, note = case.ahead, case.held_out[-1], _BESIDE
        worse, better = before, after
    gain, interval = gain_interval(better.log_likelihood - worse.log_likelihood, case.blocks.block, _draws(case))
    outputs, diverged = sizes_of(case.prepared, case.units, before, after, case.blocks)
    one = next(iter(outputs.values())) if len(outputs) == 1 and case.of_states else None
    sizes = (case.rms(before), case.rms(after)) if one is None else (one.before, one.after)
    count, decides = int(case.blocks.block.max()) + 1, not case.located.with_noise
    held = HeldOut(gain, interval, *sizes, case.prepared.unit, outputs, diverged, count, decides)
    return said(held, note)


def said(held: HeldOut | None, note: str) -> EvidenceResult:
    """The gain, or why there is none."""
    return EvidenceResult("held_out", (held, note), keys={"held_out": held, "held_out_note": note})


def _long_enough(case: EvidenceContext, number: int) -> bool:
    """Whether both sides of a finding that sets in can be held out."""
    onset, time = case.found[number].term.shape.get("onset"), case.prepared.time
    if onset is None:
        return True
    shorter = min(int((time < onset).sum()), int((time >= onset).sum()))
    return shorter >= 2 * len(time) // (int(case.blocks.block.max()) + 1)


def _draws(case: EvidenceContext) -> torch.Generator:
    """Draws of blocks that go on where those of the findings before stopped."""
    generator = torch.Generator().manual_seed(case.seed)
    for number in range(case.number):
        if _long_enough(case, number):
            gain_interval(case.held_out[0].log_likelihood, case.blocks.block, generator)
    return generator
