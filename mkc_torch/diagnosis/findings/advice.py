"""What to do about a diagnosis, in sentences: what each effect calls for, and what would tell it from its rivals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from mkc_torch._support.unit_text import tidy
from mkc_torch.diagnosis.environment import ProcessNoise
from mkc_torch.diagnosis.findings.grading import change, transfers, worth_correcting
from mkc_torch.diagnosis.findings.misfit import follows_all
from mkc_torch.diagnosis.result import Alternative, Diagnosis, Finding
from mkc_torch.effects import is_curve
from mkc_torch.effects.kinds import MOTION

__all__ = ["advice_of", "nothing_shows"]


def nothing_shows(diagnosis: Diagnosis) -> bool:
    """Whether the simulation may be used as it is: it follows, and what is left is the sensor's noise."""
    d = diagnosis
    quiet = bool(d.findings) or d.p_value is None or d.p_value > d.level
    return d.verdict == "adequate" and quiet and not d.remaining and follows_all(d.environment)


def advice_of(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Sentences on what to do, the most important first; effects by their ids."""
    d = diagnosis
    if d.stop is not None:
        return ("Let the search end: what stands here is what was known when it was stopped.",)
    if d.verdict == "unfit":
        return _mend_first(d)
    if d.quick:
        return ("Confirm it by a full diagnosis.", *_after_the_search(d))
    return _after_the_search(d)


def _after_the_search(diagnosis: Diagnosis) -> tuple[str, ...]:
    d = diagnosis
    if nothing_shows(d):
        return (_USE, *(_hold_back(f, d) for f in d.findings))
    advice = [sentence for finding in d.findings for sentence in _of(finding, d)]
    advice += _of_what_remains(d)
    use = [_called(f, d) for f in d.findings if transfers(f)]
    if use:
        advice.append(f"The model found here corrects for {', '.join(use)}: confirm it on a second recording.")
    return tuple(dict.fromkeys(advice))


def _mend_first(diagnosis: Diagnosis) -> tuple[str, ...]:
    known = "what stands under the reasons" if diagnosis.environment.reasons else "its signs, units, delays and start values"
    return (f"Do not rely on this simulation yet: check {known}, then diagnose again.",)


def _of_what_remains(diagnosis: Diagnosis) -> Iterator[str]:
    d = diagnosis
    rates = [push for push in d.environment.process_noise if push.at_rate]
    if d.remaining:
        yield f"Find out what else goes along with {', '.join(d.remaining)}: something smooth remains there."
    elif d.verdict == "unexplained" and rates:
        yield _find_what_pushes(rates[0])
    elif d.verdict == "unexplained" and d.environment.process_noise:
        yield (
            f"Find out what moves the sensor of `{d.environment.process_noise[0].place}` slowly, such as warming up, and record it."
        )
    elif any(f.grade == "nearest" for f in d.findings):
        return  # its curve is where to look
    elif not d.findings or d.verdict == "unexplained":
        yield (
            "Record again, for longer, with more columns that could drive what remains, such as temperature, current "
            "and motion."
        )


def _find_what_pushes(push: ProcessNoise) -> str:
    size = f"{push.size:.2g} {tidy(push.unit)}".rstrip()
    return (
        f"Look for what drives the rate of `{push.place}`, in the picture of what pushes it, and record it. Until then "
        f"count on {size} there wherever the simulation predicts, as the process noise of a filter, say."
    )


def _of(finding: Finding, d: Diagnosis) -> Iterator[str]:
    f = finding
    near = [a for a in f.alternatives if not a.separable]
    if f.grade == "nearest":
        yield _by_its_curve(f, d)
        return
    if not worth_correcting(f):
        yield _hold_back(f, d)
    elif not f.plausible and not f.cannot_be:
        yield f"The size of {_called(f, d)} is not plausible: look for another cause before correcting it."
    if near:
        yield _tell_apart(f, near)
    if f.plausible and worth_correcting(f):
        what = _SWITCHED if f.comes_and_goes else f.advice
        if what and near:
            yield f"If it is {_called(f, d)}: {_small_letter(what)}"
        elif what:
            yield what if len(d.findings) == 1 else f"{_called(f, d)}: {_small_letter(what)}"


def _small_letter(sentence: str) -> str:
    return f"{sentence[:1].lower()}{sentence[1:]}"


def _by_its_curve(finding: Finding, d: Diagnosis) -> str:
    """What to do where the form that a name claims is not the recording's."""
    f = finding
    formula = f.shape.formula if f.shape is not None else ""
    what = f"the formula {formula}" if formula else "the curve of the report"
    of = f" of {', '.join(f.drivers)}" if f.drivers else ""
    return (
        f"Do not build {_called(f, d)} in: what this recording shows has another form. Look for physics with"
        f" {what}{of}, or use that within the range that was recorded."
    )


def _hold_back(finding: Finding, d: Diagnosis) -> str:
    """Why not to correct for it."""
    f = finding
    if f.grade == "small" and f.held_out is not None:
        return (
            f"Leave {_called(f, d)} alone, unless means over many samples matter: it makes the residual of a sample "
            f"smaller by {max(100.0 * change(f.held_out), 0.0):.1f} % only."
        )
    if f.cannot_be:
        return (
            f"Do not correct for {_called(f, d)}: {_small_letter(f.plausibility)} Look for other physics that acts at "
            "the same place."
        )
    wider = f", with {', '.join(f.drivers)} over a wider range," if f.drivers else ","
    return (
        f"Do not correct for {_called(f, d)} yet: blocks that the fit has not seen do not confirm it. Record again, for"
        f" longer{wider} and see whether it comes back."
    )


_USE = "Use the simulation as it is, within what this recording covers."

_SWITCHED = (
    "Look for something that is switched on and off, such as a heater, a lamp or a motor, and record it: the offset "
    "comes and goes."
)


def _called(finding: Finding, d: Diagnosis) -> str:
    """Its name, with the place where another finding has the same name."""
    f = finding
    if is_curve(f.effect):
        name = f"the curve along {', '.join(f.drivers)}" if f.drivers else "the course without a recorded cause"
    else:
        name = f.effect
    same = [other for other in d.findings if (other.effect, other.drivers) == (f.effect, f.drivers)]
    return f"{name} on the {', '.join(f.channels)}" if len(same) > 1 and f.channels else name


def _tell_apart(finding: Finding, near: Sequence[Alternative]) -> str:
    text = ", ".join(dict.fromkeys(f"{a.effect} ({', '.join(a.drivers)})" if a.drivers else a.effect for a in near))
    asked = f"To tell {finding.effect} from {text}, record again{_how(finding, near)}."
    return f"{asked} {near[0].distinguishing_state}".rstrip()


def _how(finding: Finding, near: Sequence[Alternative]) -> str:
    every: tuple[Finding | Alternative, ...] = (finding, *near)
    columns = list(dict.fromkeys(column for one in every for column in one.drivers))
    if all(one.drivers for one in every):
        if len(columns) == 1:
            return f" with {columns[0]} over a wider range"
        return " while they go different ways: change one and hold the other"
    clauses = list(dict.fromkeys(candidate.recurrence for candidate in every if candidate.recurrence and not candidate.drivers))
    if columns:
        clauses.append(f"what follows {', '.join(columns)} goes along with it, so let that change at other times")
    return f": {'; '.join(clauses)}" if clauses else _OTHERWISE.get(finding.kind, " with other inputs and amplitudes")


_OTHERWISE: Mapping[str, str] = {
    **dict.fromkeys(MOTION, " at other speeds, loads and amplitudes"),
    "temperature": " from another temperature, with other heating and cooling",
    "level": " from another level, with other flows in and out",
    "pressure": " from another pressure, with other flows in and out",
    "voltage": " at other voltages and loads",
    "current": " at other voltages and loads",
}
"""How to record again, by the kind of quantity that a finding acts on."""
