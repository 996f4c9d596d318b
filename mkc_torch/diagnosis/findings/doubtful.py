"""Reasons for which a diagnosis must be looked at before its results are used."""

from __future__ import annotations

import math
from typing import Literal

from mkc_torch.diagnosis.findings.advice import follows_all, nothing_shows
from mkc_torch.diagnosis.findings.grading import worth_correcting
from mkc_torch.diagnosis.result import Diagnosis

DiagnosisDoubt = Literal["unfit", "unexplained", "unconfirmed", "not_better", "much_rejected"]
"""``unfit``: the simulation does not fit the recording.
``unexplained``: structure remains that no finding explains, or the search was stopped.
``unconfirmed``: every finding is unconfirmed.
``not_better``: the residual on held-out blocks is not smaller with the findings than without.
``much_rejected``: a third or more of the samples of an output were rejected.
"""

MUCH_REJECTED = 1.0 / 3.0
"""Share of rejected samples from which a diagnosis is doubtful."""

_REJECTED = 0.5
"""Weight below which a sample counts as rejected, as in the reports."""


def diagnosis_doubts(diagnosis: Diagnosis) -> tuple[DiagnosisDoubt, ...]:
    """Return the reasons for doubt; empty for a result that can be used unseen."""
    d = diagnosis
    found: list[DiagnosisDoubt] = []
    if d.verdict == "unfit" or not follows_all(d.environment):
        found.append("unfit")
    elif d.verdict == "unexplained" or (d.verdict == "adequate" and not nothing_shows(d)):
        found.append("unexplained")
    if d.findings and not nothing_shows(d) and all(f.grade == "unconfirmed" for f in d.findings):
        found.append("unconfirmed")
    if any(worth_correcting(f) for f in d.findings) and not _better(d):
        found.append("not_better")
    if rejected_share(d) >= MUCH_REJECTED:
        found.append("much_rejected")
    return tuple(found)


def rejected_share(diagnosis: Diagnosis) -> float:
    """Return the share of rejected samples of the output with the most."""
    weight = diagnosis.traces.weight
    return float((weight < _REJECTED).double().mean(0).max()) if weight.numel() else 0.0


def _better(diagnosis: Diagnosis) -> bool:
    """Whether the residual of an output, or of all outputs together, is smaller with the findings."""
    d = diagnosis
    held = [f.held_out for f in d.findings if f.held_out is not None]
    if held and held[0].outputs and held[-1].outputs:
        last = held[-1].outputs
        return any(last[name].after < sizes.before for name, sizes in held[0].outputs.items() if name in last)
    before, after = d.baseline.rmse, d.corrected.rmse
    return not math.isfinite(before) or after < before
