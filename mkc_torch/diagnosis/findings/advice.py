"""What to do about a diagnosis, in sentences: what each effect calls for, and what would tell it from its rivals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mkc_torch.diagnosis.findings.worth import carries_over, change, confirmed, worth_correcting
from mkc_torch.diagnosis.result import Alternative, Diagnosis, Finding
from mkc_torch.effects import is_curve

__all__ = ["advice_of", "nothing_shows"]


def nothing_shows(diagnosis: Diagnosis) -> bool:
    """Whether nothing speaks for structure: no finding, none that noise alone rarely makes, and none that remains."""
    d = diagnosis
    return d.verdict == "adequate" and d.p_value > d.level and not d.remaining


def advice_of(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Sentences on what to do, the most important first; effects by their ids."""
    d = diagnosis
    if nothing_shows(d):
        return ("Use the simulation as it is, within what this recording covers.",)
    advice = [sentence for finding in d.findings for sentence in _of(finding, alone=len(d.findings) == 1)]
    if d.remaining:
        advice.append(f"Find out what else goes along with {', '.join(d.remaining)}: something smooth remains there.")
    elif not d.findings or d.verdict == "unexplained":
        advice.append(
            "Record again, for longer, with more columns that could drive what remains, such as temperature, current "
            "and motion."
        )
    use = [_called(f) for f in d.findings if carries_over(f)]
    if use:
        advice.append(f"The model found here corrects for {', '.join(use)}: confirm it on a second recording.")
    return tuple(dict.fromkeys(advice))


def _of(finding: Finding, *, alone: bool) -> Iterator[str]:
    f = finding
    what = _SWITCHED if f.comes_and_goes else f.advice if worth_correcting(f) else ""
    if what:
        yield what if alone else f"{_called(f)}: {what[:1].lower()}{what[1:]}"
    if not worth_correcting(f):
        yield _hold_back(f)
    near = [a for a in f.alternatives if not a.separable]
    if near:
        yield _tell_apart(f, near)
    if not f.plausible:
        yield f"The size of {f.effect} is not plausible: look for another cause before correcting it."


def _hold_back(finding: Finding) -> str:
    """Why not to correct for it."""
    f = finding
    if confirmed(f) and f.held_out is not None:
        return (
            f"Leave {_called(f)} alone, unless means over many samples matter: it makes the residual of a sample "
            f"smaller by {max(100.0 * change(f.held_out), 0.0):.1f} % only."
        )
    wider = f", with {', '.join(f.drivers)} over a wider range," if f.drivers else ","
    return (
        f"Do not correct for {_called(f)} yet: blocks that the fit has not seen do not confirm it. Record again, for "
        f"longer{wider} and see whether it comes back."
    )


_SWITCHED = (
    "Look for something that is switched on and off, such as a heater, a lamp or a motor, and record it: the offset "
    "comes and goes."
)


def _called(finding: Finding) -> str:
    if not is_curve(finding.effect):
        return finding.effect
    return f"the curve along {', '.join(finding.drivers)}" if finding.drivers else "the course without a recorded cause"


def _tell_apart(finding: Finding, near: Sequence[Alternative]) -> str:
    told = ", ".join(dict.fromkeys(f"{a.effect} ({', '.join(a.drivers)})" if a.drivers else a.effect for a in near))
    asked = f"To tell {finding.effect} from {told}, record again{_how(finding, near)}."
    return f"{asked} {near[0].told_by}".rstrip()


def _how(finding: Finding, near: Sequence[Alternative]) -> str:
    every: tuple[Finding | Alternative, ...] = (finding, *near)
    columns = list(dict.fromkeys(column for one in every for column in one.drivers))
    if all(one.drivers for one in every):
        if len(columns) == 1:
            return f" with {columns[0]} over a wider range"
        return " while they go different ways: change one and hold the other"
    clauses = list(dict.fromkeys(one.again for one in every if one.again and not one.drivers))
    if columns:
        clauses.append(f"what follows {', '.join(columns)} goes along with it, so let that change at other times")
    return f": {'; '.join(clauses)}" if clauses else " at other speeds, loads and amplitudes"
