"""What a diagnosis says at first sight: how it looks, the headline, what to do, and what was noticed."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Literal

from mkc_torch._words.terms import term
from mkc_torch._words.typesetting import capital, plain, several
from mkc_torch.diagnosis.findings.advice import nothing_shows
from mkc_torch.diagnosis.findings.grading import small, transfers, worth_correcting
from mkc_torch.diagnosis.findings.misfit import follows_all
from mkc_torch.diagnosis.result import Diagnosis, Finding
from mkc_torch.diagnosis.stop import notices
from mkc_torch.report.diagnosis.findings import finding_name, inseparable, rivals, unrecorded, with_names
from mkc_torch.report.words.numbers import size

__all__ = [
    "Tone",
    "apply_command",
    "headline",
    "left_in_short",
    "left_open",
    "reasons",
    "said_first",
    "to_do",
    "tone",
    "warned",
]

Tone = Literal["good", "found", "faint", "open"]
"""Nothing is missing; physics is, and it is named; nothing that is worth correcting; the simulation does not follow, or
something without a name drives it."""


def tone(diagnosis: Diagnosis) -> Tone:
    """How a headline looks."""
    d = diagnosis
    if d.verdict in ("unfit", "unexplained"):
        return "open"
    if any(worth_correcting(f) for f in d.findings):
        return "found"
    if d.verdict == "adequate":
        return "good" if nothing_shows(d) else "open"
    return "faint" if d.findings else "open"


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in a sentence or two, the findings by their grades."""
    d = diagnosis
    if d.verdict == "unfit" or (d.verdict == "adequate" and not follows_all(d.world)):
        return term("verdict.unfit")
    if nothing_shows(d):
        real = [f for f in d.findings if f.grade != "not confirmed"]
        return f"{term('verdict.not_worth')} {_found(real)}" if real else term("verdict.nothing")
    told = [_found(d.findings), left_open(d)]
    if not any(worth_correcting(f) for f in d.findings):
        told.reverse()  # what is there comes before what it is not
    return " ".join(filter(None, told))


def _found(findings: Sequence[Finding]) -> str:
    told = []
    for kind in (_LEFT_OUT, _NEAREST, _SMALL, _UNCONFIRMED, _BOTH, _CANNOT_BE):
        of_it = [f for f in findings if _kind(f) == kind]
        if of_it:
            told.append(term(kind, findings="; ".join(_named(f, alone=len(findings) == 1) for f in of_it)))
    return " ".join(told)


_LEFT_OUT, _NEAREST = "verdict.left_out", "verdict.nearest"
_CANNOT_BE = "verdict.cannot_be"
_SMALL, _UNCONFIRMED, _BOTH = "verdict.small", "verdict.unconfirmed", "verdict.unconfirmed_and_small"


def _kind(finding: Finding) -> str:
    """The sentence that a finding belongs to."""
    if finding.grade == "not confirmed" and finding.cannot_be:
        return _CANNOT_BE
    if finding.grade == "not confirmed":
        return _BOTH if small(finding) else _UNCONFIRMED
    return {"left out": _LEFT_OUT, "real but small": _SMALL}.get(finding.grade, _NEAREST)


def _named(finding: Finding, *, alone: bool) -> str:
    name, others = finding_name(finding), inseparable(finding)
    if finding.grade == "nearest in the catalogue":
        gain = finding.shape.free_curve_gain if finding.shape is not None else math.nan
        return term("verdict.nearest_one", finding=name, nats=size(gain)) if math.isfinite(gain) else name
    if not others:
        return name
    if not alone:
        return term("verdict.or_a_rival", finding=name)
    if len(others) == 1:
        return term("verdict.or_one", finding=name, rival=rivals(finding))
    return term("verdict.or_many", finding=name, count=len(others))


def left_open(diagnosis: Diagnosis) -> str:
    """What no finding accounts for; empty where there is nothing."""
    d = diagnosis
    if d.stop is not None:
        return term("verdict.unfinished")
    beside = any(worth_correcting(f) for f in d.findings)
    if d.verdict == "unexplained" and d.world.pushes:
        rates, places = _driven(d)
        pair = ("verdict.pushed", "verdict.yet_pushed") if rates else ("verdict.slow", "verdict.yet_slow")
        return term(pair[int(beside)], places=several(places))
    if d.remaining:
        return term("verdict.yet_smooth" if beside else "verdict.smooth", columns=several(d.remaining))
    passed = d.p_value is not None and d.p_value <= d.level
    if not d.findings and passed and d.verdict == "adequate":
        return term("verdict.unnamed")
    if d.verdict != "unexplained":
        return ""
    if any(unrecorded(f) for f in d.findings):
        return term("verdict.course_alone")
    return term("verdict.yet_structure" if beside else "verdict.structure")


def _driven(diagnosis: Diagnosis) -> tuple[bool, list[str]]:
    """The states whose rates something pushes, and whether there are any; else the outputs that it is added to."""
    pushes = diagnosis.world.pushes
    rates = [push.place for push in pushes if push.at_rate]
    places = rates or [push.place for push in pushes]
    return bool(rates), [f"`{plain(place)}`" for place in dict.fromkeys(places)]


def left_in_short(diagnosis: Diagnosis) -> str:
    """Where something is without a name, in a few words; empty where nothing is."""
    d = diagnosis
    if not left_open(d):
        return ""
    if d.stop is not None:
        return term("world.unfinished")
    if d.verdict == "unexplained" and d.world.pushes:
        rates, places = _driven(d)
        return term("world.rate_of", place=several(places)) if rates else several(places)
    return several(d.remaining) if d.remaining else term("world.structure")


def reasons(diagnosis: Diagnosis) -> list[str]:
    """Why the simulation does not follow, the most likely first."""
    return [capital(with_names(sentence, ())) for sentence in diagnosis.world.reasons]


def to_do(diagnosis: Diagnosis) -> list[str]:
    """What to do next, as the diagnosis advises it."""
    ids = _ids(diagnosis)
    return [capital(with_names(sentence, ids, _kinds(diagnosis))) for sentence in diagnosis.advice]


def warned(diagnosis: Diagnosis) -> list[str]:
    """The warnings by weight: what casts doubt on a finding or its driver first; effects in them by their names.

    What says that all is a quick look, or that the search was stopped, stands apart, before everything else.
    """
    d, ids = diagnosis, _ids(diagnosis)
    doubted = {name for f in d.findings for name in (f.effect, *f.drivers)}
    first = said_first(d)
    ordered = sorted(
        [one for one in d.warnings if one not in first],
        key=lambda sentence: doubted.isdisjoint(re.findall(r"\w+", sentence)),
    )
    return [capital(with_names(sentence, ids, _kinds(d))) for sentence in ordered]


def _kinds(diagnosis: Diagnosis) -> dict[str, str]:
    """Of what quantity each effect that was found acts on."""
    return {finding.effect: finding.kind for finding in diagnosis.findings}


def said_first(diagnosis: Diagnosis) -> tuple[str, ...]:
    """What a reader has to know before anything else: that it is a quick look, or that the search was stopped."""
    return notices(diagnosis.stop, quick=diagnosis.quick)


def _ids(diagnosis: Diagnosis) -> set[str]:
    """Of all effects that a sentence may be about; those of one word are words."""
    d = diagnosis
    found = {f.effect for f in d.findings} | {a.effect for f in d.findings for a in f.alternatives}
    return {effect for effect in found | {c.effect for c in d.candidates} if "_" in effect}


def apply_command(diagnosis: Diagnosis) -> str:
    """The command that uses on another recording what was found; empty where nothing found is of use there."""
    d = diagnosis
    if not any(transfers(f) for f in d.findings):
        return ""
    own = {
        "magnetometer": " --output corrected.csv",
        "simulated": " --simulator-output NEW_SIM.csv --output corrected.csv",
    }.get(d.simulation, f" --simulation FILE.py:{plain(d.simulation) or 'CLASS'} --output simulated.csv")
    return f"mkc apply model.json NEW.csv{own}"
