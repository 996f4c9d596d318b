"""Headline, advice and warnings of a diagnosis."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from typing import NamedTuple

from mkc_torch._support.typesetting import capital, plain, several
from mkc_torch.diagnosis.result import UNFINISHED, VERDICT_SENTENCES, Diagnosis, Finding, notices
from mkc_torch.diagnosis.verdict import Answer, DiagnosisDoubt, conclusion, doubted_signs, rejected_share
from mkc_torch.diagnosis.vetoes import is_refused_by_blocks, is_small, transfers, worth_correcting
from mkc_torch.report.diagnosis.findings import NOT_TESTED, finding_name, inseparable, rivals, unrecorded, with_names
from mkc_torch.report.diagnosis.unseen import residual_of_all
from mkc_torch.report.words.numbers import share
from mkc_torch.report.words.verdict import disturbed

_MOST_REJECTED = "Most samples were rejected"
"""Beginning of the warning about a disturbed measurement."""


class RunPaths(NamedTuple):
    """Paths and options of a run, for the commands that are proposed.

    Attributes:
        recording: the diagnosed file.
        model: the model.json.
        options: options for ``mkc apply``, such as ``--simulation`` with the class.
    """

    recording: str
    model: str
    options: tuple[str, ...]


def answer_word(diagnosis: Diagnosis) -> Answer:
    """Return the answer in one word, by which the headline is coloured."""
    return conclusion(diagnosis).answer


_LOOK: dict[DiagnosisDoubt, str] = {
    "unexplained": "a part of the residual has no known cause",
    "unconfirmed": "no finding is confirmed",
    "not_better": "the findings do not make the residual smaller",
    "much_rejected": "many samples were rejected",
}
"""What to look at, by doubt."""


def answer(diagnosis: Diagnosis) -> str:
    """Return whether the simulation can be used: usable, look or unusable, with the reason."""
    found = conclusion(diagnosis)
    if found.answer == "unusable":
        return "unusable: the simulation does not follow the recording"
    if found.answer == "look":
        return f"look: {', '.join(_LOOK[doubt] for doubt in found.doubts if doubt in _LOOK)}"
    corrected = any(worth_correcting(finding) for finding in diagnosis.findings)
    return "usable, corrected by the findings" if corrected else "usable as it is"


def headline(diagnosis: Diagnosis) -> str:
    """Return the verdict in a few sentences, the findings by grade; a doubt and a disturbed measurement come first."""
    first = (_doubtful(diagnosis), disturbed(diagnosis.rejected_intervals))
    return " ".join(filter(None, [*first, _verdict(diagnosis)]))


def _doubtful(diagnosis: Diagnosis) -> str:
    """Return the reasons for doubt that the verdict does not state; empty if there are none."""
    found = conclusion(diagnosis).doubts
    reasons = []
    if "not_better" in found:
        sizes = "; ".join(residual_of_all(diagnosis))
        reasons.append("the findings do not make the residual smaller" + (f" ({sizes})" if sizes else ""))
    if "much_rejected" in found:
        reasons.append(f"{share(rejected_share(diagnosis))} of the samples were rejected")
    return f"Doubtful: {' and '.join(reasons)}." if reasons else ""


def _verdict(diagnosis: Diagnosis) -> str:
    d = diagnosis
    if d.verdict == "unfit":
        return VERDICT_SENTENCES["unfit"]
    if d.too_few:
        return f"Not tested for missing physics: {d.samples} samples are too few."
    if d.verdict == "adequate":
        real = [f for f in d.findings if f.grade != "unconfirmed"]
        return f"No missing physics is worth correcting. {_found(real)}" if real else VERDICT_SENTENCES["adequate"]
    sentences = [_found(d.findings), unexplained(d)]
    if not any(worth_correcting(f) for f in d.findings):
        sentences.reverse()  # state the unnamed structure before unconfirmed findings
    return " ".join(filter(None, sentences))


def _found(findings: Sequence[Finding]) -> str:
    sentences = []
    for kind in (_LEFT_OUT, _NEAREST, _SMALL, _NOT_TESTED, _UNCONFIRMED, _BOTH, _REFUSED, _CANNOT_BE):
        of_it = [f for f in findings if _kind(f) == kind]
        if of_it:
            names = "; ".join(_named(f, alone=len(findings) == 1) for f in of_it)
            sentences.append(kind.format(findings=names))
    return " ".join(sentences)


_LEFT_OUT, _NEAREST = "Left out of the simulation: {findings}.", "Nearest in the catalogue: {findings}."
_REFUSED = "Found, but not confirmed: {findings}."
_CANNOT_BE = "Found, but of an impossible size: {findings}."
_NOT_TESTED = f"Found, but {NOT_TESTED}: {{findings}}."
_BEFORE = (
    "The simulation alone has process noise on the rate of {places}; a quick look does not test whether a finding "
    "explains it."
)
_SMALL, _UNCONFIRMED, _BOTH = (
    "Real, but small compared with the noise: {findings}.",
    "Found, but not confirmed on held-out blocks: {findings}.",
    "Found, but not confirmed on held-out blocks and too small to be worth correcting: {findings}.",
)


def _kind(finding: Finding) -> str:
    """Return the key of the sentence that lists a finding."""
    if finding.grade == "unconfirmed" and finding.cannot_be:
        return _CANNOT_BE
    if finding.grade == "unconfirmed" and finding.held_out is None:
        return _NOT_TESTED
    if finding.grade == "unconfirmed" and not is_refused_by_blocks(finding):
        return _REFUSED
    if finding.grade == "unconfirmed":
        return _BOTH if is_small(finding) else _UNCONFIRMED
    return {"left_out": _LEFT_OUT, "small": _SMALL}.get(finding.grade, _NEAREST)


def _named(finding: Finding, *, alone: bool) -> str:
    name, others = finding_name(finding), inseparable(finding)
    if finding.grade == "nearest":
        return f"{name} (a free curve of the same variables is clearly better)"
    if not others:
        return name
    if not alone:
        return f"{name}, or an alternative"
    if len(others) == 1:
        return f"{name} or {rivals(finding)}, which this recording cannot distinguish"
    return f"{name} or {len(others)} others, which this recording cannot distinguish"


def unexplained(diagnosis: Diagnosis) -> str:
    """State the structure that no finding explains; empty if there is none."""
    d = diagnosis
    if d.stop is not None:
        return UNFINISHED
    signs = doubted_signs(d.decisions)
    if signs:
        return signs
    found = any(worth_correcting(f) for f in d.findings)
    if d.verdict == "unexplained" and d.environment.process_noise:
        rates, places = _driven(d)
        pair = (
            (
                "Process noise acts on the rate of {places}, and no physics in the catalogue explains it.",
                "Process noise remains on the rate of {places}.",
            )
            if rates
            else (
                "A drift of {places} adds to the sensor's noise, and no physics in the catalogue explains it.",
                "A drift of {places} remains.",
            )
        )
        if d.quick and d.findings and rates:
            pair = (_BEFORE, pair[1])
        return pair[int(found)].format(places=several(places))
    if d.remaining:
        return (
            "A smooth trend along {columns} remains that no effect in the catalogue explains."
            if found
            else "The residual has a smooth trend along {columns} that no effect in the catalogue explains."
        ).format(columns=several(d.remaining))
    if d.verdict != "unexplained":
        return ""
    if any(unrecorded(f) for f in d.findings):
        return "Only its course over time is known."
    if d.quick and d.findings:
        return ""  # a finding may explain the structure, but a quick look does not test this
    return "Structure remains that no effect in the catalogue explains." if found else VERDICT_SENTENCES["unexplained"]


def _driven(diagnosis: Diagnosis) -> tuple[bool, list[str]]:
    """Return whether states have process noise, and these states; otherwise the outputs with drift."""
    processes = diagnosis.environment.process_noise
    rates = [process.place for process in processes if process.at_rate]
    places = rates or [process.place for process in processes]
    return bool(rates), [f"`{plain(place)}`" for place in dict.fromkeys(places)]


def unexplained_place(diagnosis: Diagnosis) -> str:
    """Return the place of unexplained structure in a few words; empty if there is none."""
    d = diagnosis
    if d.too_few:
        return "not tested; the samples are too few"
    if not unexplained(d):
        return "the intervals of rejected samples" if d.rejected_intervals else ""
    if d.stop is not None:
        return "unknown; the search was stopped"
    if doubted_signs(d.decisions):
        return "unknown; check signs and units first"
    if d.verdict == "unexplained" and d.environment.process_noise:
        rates, places = _driven(d)
        return f"the rate of {several(places)}" if rates else several(places)
    return several(d.remaining) if d.remaining else "unnamed structure"


def reasons(diagnosis: Diagnosis) -> list[str]:
    """Return why the simulation does not fit, the most likely reason first."""
    return [capital(with_names(sentence, ())) for sentence in diagnosis.environment.reasons]


def to_do(diagnosis: Diagnosis) -> list[str]:
    """Return the advice of the diagnosis, with names for effect ids."""
    ids = _ids(diagnosis)
    return [capital(with_names(sentence, ids, _kinds(diagnosis))) for sentence in diagnosis.advice]


def warned(diagnosis: Diagnosis) -> list[str]:
    """Return the warnings by weight, with names for effect ids: a disturbance, then those on a finding or its driver.

    The notices of a quick look and of a stopped search are not included.
    """
    d, ids = diagnosis, _ids(diagnosis)
    doubted = {name for f in d.findings for name in (f.effect, *f.drivers)}
    first = notices_first(d)
    ordered = sorted(
        [warning for warning in d.warnings if warning not in first],
        key=lambda sentence: (
            not sentence.startswith(_MOST_REJECTED),
            doubted.isdisjoint(re.findall(r"\w+", sentence)),
        ),
    )
    return [capital(with_names(sentence, ids, _kinds(d))) for sentence in ordered]


def _kinds(diagnosis: Diagnosis) -> dict[str, str]:
    """Return the kind of quantity that each found effect acts on."""
    return {finding.effect: finding.kind for finding in diagnosis.findings}


def notices_first(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the notices of a quick look and of a stopped search."""
    return notices(diagnosis.stop, quick=diagnosis.quick, too_few=diagnosis.too_few)


def _ids(diagnosis: Diagnosis) -> set[str]:
    """Return the effect ids that sentences may contain; ids without an underscore are ordinary words."""
    d = diagnosis
    found = {f.effect for f in d.findings} | {a.effect for f in d.findings for a in f.alternatives}
    return {effect for effect in found | {c.effect for c in d.candidates} if "_" in effect}


def apply_command(diagnosis: Diagnosis, paths: RunPaths | None = None) -> str:
    """Return the command that corrects a recording; empty if no finding transfers, or the residual is not smaller.

    ``paths`` are those of the run; None if they are unknown.
    """
    d = diagnosis
    if not any(transfers(f) for f in d.findings) or "not_better" in conclusion(d).doubts:
        return ""
    own = {
        "magnetometer": " --output corrected.csv",
        "simulated": " --simulator-output NEW_SIM.csv --output corrected.csv",
    }.get(d.simulation, f" --simulation FILE.py:{plain(d.simulation) or 'CLASS'} --output simulated.csv")
    if paths is None:
        sizes = next(
            (f" --sizes-of {shlex.quote(f.recordings[0])}" for f in d.findings if f.recordings and transfers(f)), ""
        )
        return f"mkc apply model.json NEW.csv{own}{sizes}"
    output = "corrected.csv" if d.simulation in ("magnetometer", "simulated") else "simulated.csv"
    options = " ".join(map(shlex.quote, (*paths.options, "--output", output)))
    return f"mkc apply {shlex.quote(paths.model)} {shlex.quote(paths.recording)} {options}"
