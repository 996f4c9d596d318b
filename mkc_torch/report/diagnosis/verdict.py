"""What a diagnosis says at first sight: the headline, how large, where, how sure, how much better, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from mkc_torch.diagnosis.findings.advice import nothing_shows
from mkc_torch.diagnosis.findings.worth import carries_over, confirmed, small, worth_correcting
from mkc_torch.diagnosis.result import Diagnosis, Finding
from mkc_torch.report.diagnosis.findings import (
    acts_on,
    better,
    finding_name,
    inseparable,
    rivals,
    unrecorded,
    where,
    with_names,
)
from mkc_torch.report.diagnosis.noise import noise_model, smooth_fit
from mkc_torch.report.diagnosis.numbers import clock_of, evidence, gain, largest, residual_sizes
from mkc_torch.report.words.numbers import share, size
from mkc_torch.report.words.typesetting import capital, plain, several

__all__ = ["Tone", "apply_command", "chance", "headline", "lead", "to_do", "tone", "warned"]

Tone = Literal["good", "found", "faint", "open"]
"""Nothing is missing; something is, and it is named; nothing that is worth correcting; something is, without a name."""


def tone(diagnosis: Diagnosis) -> Tone:
    """How a headline looks."""
    d = diagnosis
    if nothing_shows(d):
        return "good"
    if d.verdict == "unexplained" or not d.findings:
        return "open"
    return "found" if any(worth_correcting(f) for f in d.findings) else "faint"


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in a sentence or two, graded by what the findings are worth."""
    d = diagnosis
    if nothing_shows(d):
        return "Nothing is missing that this recording could show."
    return " ".join(filter(None, [_found(d.findings), _open(d)]))


def _found(findings: Sequence[Finding]) -> str:
    worth = [f for f in findings if worth_correcting(f)]
    told = [f"Left out of the simulation: {_names(worth, findings)}."] if worth else []
    for reason in (_SMALL, _UNCONFIRMED, _BOTH):
        of_it = [f for f in findings if f not in worth and _why(f) == reason]
        if of_it:
            told.append(f"{reason}: {_names(of_it, findings)}.")
    return " ".join(told)


_SMALL = "Real, but small beside the noise"
_UNCONFIRMED = "Found, but not confirmed on unseen blocks"
_BOTH = "Found, but not confirmed on unseen blocks and too small to be worth correcting"


def _why(finding: Finding) -> str:
    """Why a finding is not worth correcting."""
    if confirmed(finding):
        return _SMALL
    return _BOTH if small(finding) else _UNCONFIRMED


def _names(some: Sequence[Finding], every: Sequence[Finding]) -> str:
    return "; ".join(_or_a_rival(f, alone=len(every) == 1) for f in some)


def _or_a_rival(finding: Finding, *, alone: bool) -> str:
    name, others = finding_name(finding), inseparable(finding)
    if not others:
        return name
    if not alone:
        return f"{name}, or a rival"
    if len(others) == 1:
        return f"{name} or {rivals(finding)}, which this recording cannot tell apart"
    return f"{name} or one of {len(others)} others that this recording cannot tell from it"


def _open(diagnosis: Diagnosis) -> str:
    """What no finding accounts for."""
    d = diagnosis
    yet = "Yet something" if d.findings else "Something"
    if d.remaining:
        return f"{yet} smooth remains along {several(d.remaining)} that no effect in the catalogue accounts for."
    if not d.findings and d.p_value <= d.level and d.verdict == "adequate":
        return (
            "Something is there that noise alone rarely makes, but no effect that also predicts unseen blocks: nothing "
            "is named."
        )
    if d.verdict != "unexplained":
        return ""
    if any(unrecorded(f) for f in d.findings):
        return "Its course over time is all that is known of it."
    return f"{'Yet structure' if d.findings else 'Structure'} remains that no effect in the catalogue accounts for."


def lead(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """How large, where, how sure, how much better: questions with their answers."""
    d = diagnosis
    sure = ("How sure", chance(d.findings[0].p_value if d.findings else d.p_value, d))
    if not d.findings:
        unit = f" {plain(d.traces.unit)}" if d.traces.unit else ""
        left = f"{size(d.baseline.rmse)}{unit}, root mean square on data the fit had not seen."
        beside = smooth_fit(d)
        rows = [sure, ("Residual", left), ("Noise", f"{capital(noise_model(d.noise))}.")]
        return [*rows, ("For comparison", f"{capital(beside)}.")] if beside else rows
    improved = f"On data the fit had not seen, the residual is {residual_sizes(d)}"
    if len(d.findings) > 1:
        return [sure, ("How much better", f"{improved}.")]
    f = d.findings[0]
    told = [largest(p) for p in f.parameters[:2]]
    large = [("How large", "; ".join(told) + ".")] if told else []
    acts = f"; {acts_on(f)}" if f.channels else ""
    confirms = f": {better(f.held_out)}, {gain(f.held_out)}." if f.held_out else f"; not measured: {f.held_out_note}."
    return [
        *large,
        ("Where", f"{capital(where(f, clock_of(d.traces)))}{acts}."),
        sure,
        ("How much better", f"{improved}{confirms}"),
    ]


def chance(p_value: float, diagnosis: Diagnosis) -> str:
    """What a p-value means, in a sentence."""
    d = diagnosis
    most = "at most " if p_value <= (1.0 + 1e-9) / (1 + d.surrogates) else ""
    return (
        f"If nothing were missing, a search like this, of {d.candidates_tried:,} candidates, would find as much in "
        f"{most}{share(p_value)} of recordings ({evidence(p_value, d.surrogates)}; the level asked for is {d.level:g})."
    )


def to_do(diagnosis: Diagnosis) -> list[str]:
    """What to do next, as the diagnosis advises it."""
    ids = _ids(diagnosis)
    return [capital(with_names(sentence, ids)) for sentence in diagnosis.advice]


def warned(diagnosis: Diagnosis) -> list[str]:
    """The warnings, effects in them by their names."""
    ids = _ids(diagnosis)
    return [capital(with_names(sentence, ids)) for sentence in diagnosis.warnings]


def _ids(diagnosis: Diagnosis) -> set[str]:
    """Of all effects that a sentence may be about; those of one word are words."""
    d = diagnosis
    found = {f.effect for f in d.findings} | {a.effect for f in d.findings for a in f.alternatives}
    return {effect for effect in found | {c.effect for c in d.candidates} if "_" in effect}


def apply_command(diagnosis: Diagnosis) -> str:
    """The command that uses on another recording what was found; empty where nothing found is of use there."""
    d = diagnosis
    if not any(carries_over(f) for f in d.findings):
        return ""
    own = {
        "magnetometer": " --output corrected.csv",
        "simulated": " --simulated NEW_SIM.csv --output corrected.csv",
    }.get(d.simulation, f" --simulation FILE.py:{plain(d.simulation) or 'CLASS'} --output simulated.csv")
    return f"mkc apply model.json NEW.csv{own}"
