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
from mkc_torch.report.words.terms import term
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
        return term("verdict.nothing")
    return " ".join(filter(None, [_found(d.findings), _open(d)]))


def _found(findings: Sequence[Finding]) -> str:
    worth = [f for f in findings if worth_correcting(f)]
    told = [term("verdict.left_out", findings=_names(worth, findings))] if worth else []
    for reason in (_SMALL, _UNCONFIRMED, _BOTH):
        of_it = [f for f in findings if f not in worth and _why(f) == reason]
        if of_it:
            told.append(term(reason, findings=_names(of_it, findings)))
    return " ".join(told)


_SMALL, _UNCONFIRMED, _BOTH = "verdict.small", "verdict.unconfirmed", "verdict.unconfirmed_and_small"


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
        return term("verdict.or_a_rival", finding=name)
    if len(others) == 1:
        return term("verdict.or_one", finding=name, rival=rivals(finding))
    return term("verdict.or_many", finding=name, count=len(others))


def _open(diagnosis: Diagnosis) -> str:
    """What no finding accounts for."""
    d = diagnosis
    if d.remaining:
        return term("verdict.yet_smooth" if d.findings else "verdict.smooth", columns=several(d.remaining))
    if not d.findings and d.p_value <= d.level and d.verdict == "adequate":
        return term("verdict.unnamed")
    if d.verdict != "unexplained":
        return ""
    if any(unrecorded(f) for f in d.findings):
        return term("verdict.course_alone")
    return term("verdict.yet_structure" if d.findings else "verdict.structure")


def lead(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """How large, where, how sure, how much better: questions with their answers."""
    d = diagnosis
    sure = (_label("label.how_sure"), chance(d.findings[0].p_value if d.findings else d.p_value, d))
    if not d.findings:
        unit = f" {plain(d.traces.unit)}" if d.traces.unit else ""
        left = term("verdict.residual", residual=f"{size(d.baseline.rmse)}{unit}")
        beside = smooth_fit(d)
        rows = [sure, (_label("label.residual"), left), (_label("label.noise"), f"{capital(noise_model(d.noise))}.")]
        return [*rows, (_label("label.for_comparison"), f"{capital(beside)}.")] if beside else rows
    improved = term("verdict.improved", change=residual_sizes(d))
    if len(d.findings) > 1:
        return [sure, (_label("label.how_much_better"), f"{improved}.")]
    f = d.findings[0]
    told = [largest(p) for p in f.parameters[:2]]
    large = [(_label("label.how_large"), "; ".join(told) + ".")] if told else []
    acts = f"; {acts_on(f)}" if f.channels else ""
    if f.held_out:
        confirms = f": {better(f.held_out)}, {gain(f.held_out)}."
    else:
        confirms = f"; {term('evidence.not_measured')}: {f.held_out_note}."
    return [
        *large,
        (_label("label.where"), f"{capital(where(f, clock_of(d.traces)))}{acts}."),
        sure,
        (_label("label.how_much_better"), f"{improved}{confirms}"),
    ]


def _label(key: str) -> str:
    return capital(term(key))


def chance(p_value: float, diagnosis: Diagnosis) -> str:
    """What a p-value means, in a sentence."""
    d = diagnosis
    told = share(p_value)
    return term(
        "verdict.chance",
        candidates=f"{d.candidates_tried:,}",
        share=term("verdict.at_most", share=told) if p_value <= (1.0 + 1e-9) / (1 + d.surrogates) else told,
        evidence=evidence(p_value, d.surrogates),
        level=f"{d.level:g}",
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
