"""A finding of a diagnosis in words: what it is, where it acts, what drives it, and what it could be instead."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence

from mkc_torch._words.terms import term
from mkc_torch._words.typesetting import plain, several, typeset
from mkc_torch.diagnosis.environment import Grade, Run
from mkc_torch.diagnosis.result import Alternative, CandidateScore, Finding, Region
from mkc_torch.effects import is_curve, words_of
from mkc_torch.report.diagnosis.evidence import of_driver
from mkc_torch.report.diagnosis.numbers import TimeFormat, probability
from mkc_torch.report.diagnosis.recordings import recording_called
from mkc_torch.report.words.numbers import number, size

__all__ = [
    "acts_on",
    "counted_from",
    "driven_by",
    "finding_name",
    "grade",
    "inseparable",
    "label_name",
    "region",
    "rivals",
    "role",
    "shape",
    "shares_of_runs",
    "unrecorded",
    "where",
    "with_drivers",
    "with_names",
]

_MOST_RUNS = 6
_AXES: dict[tuple[str, ...], str] = {
    ("x", "y", "z"): "finding.acts_on_axes",
    ("east", "north", "up"): "finding.acts_on_world",
}
_GRADES: dict[Grade, str] = {
    "left out": "grade.left_out",
    "real but small": "grade.small",
    "not confirmed": "grade.not_confirmed",
    "nearest in the catalogue": "grade.nearest",
}
_BOUNDS = {
    "below": "where.below",
    "above": "where.above",
    "near zero": "where.near_zero",
    "far from zero": "where.far_from_zero",
}


def with_drivers(effect: str, drivers: Sequence[str], at: str = "", kind: str = "") -> str:
    """An effect with what drives it, and where it acts; by the name that it has for a kind of quantity.

    Example:
        >>> with_drivers("current_field", ["battery_A"]), with_drivers("offset_drift", [])
        ('current field (battery_A)', 'offset drift')
        >>> with_drivers("linear_drag", [], "rate of speed")
        'linear drag on the rate of speed'
        >>> with_drivers("linear_drag", [], "rate of room", "temperature")
        'loss of heat on the rate of room'
        >>> with_drivers("clock_drift", [], "all outputs")
        'clock drift on all outputs'
        >>> with_drivers("field_gradient", ["position_x", "position_y", "position_z"])
        'field gradient (position)'
    """
    driven = words_of(effect, kind) + (f" ({_together(drivers)})" if drivers else "")
    if not at:
        return driven
    key = "finding.on" if at.startswith("all ") else "finding.on_the"
    return term(key, effect=driven, place=plain(at.removeprefix("loaded ")))


def _together(names: Sequence[str]) -> str:
    """Names one after the other; the three of a vector by what they have in common."""
    whole = names[0].removesuffix("_x")
    return plain(whole) if list(names) == [f"{whole}_{axis}" for axis in "xyz"] else several(names, 3)


def finding_name(finding: Finding) -> str:
    """A finding by its effect and what drives it; one that goes along time alone and has no name is told as a cause."""
    if unrecorded(finding):
        return term("finding.unrecorded")
    told = with_drivers(finding.effect, finding.drivers, kind=finding.kind)
    return term("finding.comes_and_goes", finding=told) if finding.comes_and_goes else told


def unrecorded(finding: Finding) -> bool:
    return is_curve(finding.effect) and finding.curve is not None and finding.curve.driver == "time"


def label_name(label: str) -> str:
    """The label of a candidate, an id and what drives it, in words.

    Example:
        >>> label_name("current_field (battery_A)")
        'current field (battery_A)'
    """
    effect, space, rest = label.partition(" ")
    return words_of(plain(effect)) + space + plain(rest)


def counted_from(finding: Finding) -> str:
    """What the equation counts its drivers from; empty where there is none.

    Example:
        >>> from mkc_torch.diagnosis.result import Reference
        >>> finding = Finding(
        ...     "current_field",
        ...     ("current",),
        ...     (),
        ...     (),
        ...     None,
        ...     "δB = k (I − Ī)",
        ...     "",
        ...     (),
        ...     0.01,
        ...     (),
        ...     True,
        ...     "",
        ...     references=(Reference("current", 10.934, "A"),),
        ... )
        >>> counted_from(finding)
        'Ī: the mean of current over this recording, 10.9 A.'
    """
    if not finding.references:
        return ""
    marked = re.search("[A-Za-z]\u0304", unicodedata.normalize("NFD", finding.equation))
    symbol = unicodedata.normalize("NFC", marked[0]) if marked else term("finding.counted_from")
    names = several([one.column for one in finding.references])
    values = ", ".join(f"{size(one.value)} {plain(one.unit)}".rstrip() for one in finding.references)
    key = "finding.means" if len(finding.references) > 1 else "finding.mean"
    return term(key, symbol=symbol, columns=names, values=values)


def where(finding: Finding, clock: TimeFormat) -> str:
    """When the finding acts.

    Example:
        >>> from dataclasses import replace
        >>> from mkc_torch.diagnosis.result import Told
        >>> finding = Finding("offset_drift", (), ("mag_x",), (), None, "", "", (), 0.01, (), True, "")
        >>> clock = TimeFormat(1, has_time=True)
        >>> where(finding, clock), where(replace(finding, onset=41.32), clock)
        ('throughout the recording', 'from 41.3 s on')
        >>> where(replace(finding, onset=41.32, evidence=(Told("onset", (41.24, 41.5)),)), clock)
        'from 41.3 s on (95 %: 41.2 to 41.5 s)'
        >>> where(replace(finding, intervals=((1.0, 2.0), (7.0, 9.5))), clock)
        'mainly from 1.0 to 2.0 s and from 7.0 to 9.5 s'
        >>> where(replace(finding, onset=61.1, moments=(61.1, 77.8)), clock)
        'anew at 61.1 s and 77.8 s'
        >>> switched = replace(finding, intervals=((8.0, 9.0), (34.0, 37.3)), evidence=(Told("switched", True),))
        >>> where(replace(switched, onset=6.2), clock)
        'first at 6.2 s, then it comes and goes, mainly from 8.0 to 9.0 s and from 34.0 to 37.3 s'
    """
    begins = ""
    if finding.moments:
        begins = term("where.anew", moments=_and([clock.moment(moment) for moment in finding.moments]))
    elif finding.onset is not None:
        key = "where.first" if finding.comes_and_goes else "where.from_on"
        begins = term(key, moment=clock.moment(finding.onset))
    if finding.onset_interval is not None:
        begins = term("where.band", onset=begins, interval=clock.interval(*finding.onset_interval))
    if finding.comes_and_goes:
        begins = term("where.then_goes", onset=begins)
    each = [term("where.from", interval=clock.interval(start, end)) for start, end in finding.intervals]
    spans = [end - start for start, end in finding.intervals]
    if len(each) > 3:
        mainly = term("where.mainly_many", count=len(each), longest=each[spans.index(max(spans))])
    else:
        mainly = term("where.mainly", intervals=_and(each)) if each else ""
    return ", ".join(filter(None, [begins, mainly])) or term("where.throughout")


def acts_on(finding: Finding) -> str:
    """The channels that a finding acts on, and whose axes they are; empty where it has none.

    Example:
        >>> finding = Finding("offset_drift", (), ("x", "y", "z"), (), None, "", "", (), 0.01, (), True, "")
        >>> acts_on(finding)
        "acts on x, y, z, the sensor's axes"
    """
    if not finding.channels:
        return ""
    return term(_AXES.get(finding.channels, "finding.acts_on"), channels=several(finding.channels))


def _and(each: Sequence[str]) -> str:
    return term("number.and").join(filter(None, [", ".join(each[:-1]), *each[-1:]]))


def region(found: Region) -> str:
    """In which states most of the gain arises.

    Example:
        >>> region(Region("speed", "rad/s", "near zero", 0.3, 0.824, 0.2))
        '82 % of the gain where speed is within ±0.300 rad/s, 20 % of the time'
        >>> region(Region("level", "cm", "above", 14.23, 0.91, 0.1))
        '91 % of the gain where level is above 14.2 cm, 10 % of the time'
    """
    unit = f" {found.unit}" if found.unit else ""
    bounds = term(_BOUNDS[found.kind], bound=f"{size(found.bound)}{unit}")
    gain, time = (f"{100.0 * one:.0f} %" for one in (found.share_of_gain, found.share_of_time))
    return term("where.region", gain=gain, state=plain(found.state), bounds=bounds, time=time)


def shares_of_runs(shares: Sequence[float], runs: Sequence[Run] = ()) -> str:
    """Each run's share of the gain, the largest first.

    Example:
        >>> shares_of_runs((0.1, 0.7, 0.2))
        'run 2: 70 %, run 3: 20 %, run 1: 10 %'
        >>> shares_of_runs((0.4, 0.6), (Run(1, "a.csv", 0), Run(2, "b.csv", 0)))
        'recording 2 (b.csv): 60 %, recording 1 (a.csv): 40 %'
    """
    known = runs if len(runs) == len(shares) else [Run(0, "", k + 1) for k in range(len(shares))]
    order = sorted(range(len(shares)), key=lambda k: -shares[k])
    told = [term("where.share", run=_run(known[k]), share=number(100.0 * shares[k], 0)) for k in order[:_MOST_RUNS]]
    more = len(shares) - len(told)
    each = ", ".join(told)
    return term("where.more_runs", runs=each, count=more) if more else each


def _run(run: Run) -> str:
    """A run by its recording and its number in it, as far as there are others.

    Example:
        >>> _run(Run(2, "b.csv", 3)), _run(Run(0, "", 3))
        ('run 3 of recording 2 (b.csv)', 'run 3')
    """
    if not run.recording:
        return term("where.run", number=run.number)
    recording = recording_called(run.recording, run.name)
    return term("where.run_of", number=run.number, recording=recording) if run.number else recording


def grade(finding: Finding) -> str:
    """What a finding is worth, in words.

    Example:
        >>> grade(Finding("offset_drift", (), (), (), None, "", "", (), 0.01, (), True, "", grade="real but small"))
        'real, but small beside the noise'
    """
    if finding.grade == "not confirmed" and finding.cannot_be:
        return term("grade.cannot_be")
    return term(_GRADES[finding.grade])


def shape(finding: Finding) -> str:
    """Whether the shape that a name claims is the recording's; empty where that was not asked.

    Example:
        >>> from mkc_torch.diagnosis.environment import Shape
        >>> right = Finding("linear_drag", (), (), (), None, "", "", (), 0.01, (), True, "", shape=Shape(1.2, 0.4))
        >>> shape(right)
        'a free curve of the same variables is not clearly better (p = 0.4)'
    """
    found = finding.shape
    if found is None:
        return ""
    p = probability(found.p_value)
    if finding.grade != "nearest in the catalogue":
        return term("evidence.as_good", p=p)
    return term("evidence.free_curve", nats=size(found.free_curve_gain), p=p)


def inseparable(finding: Finding) -> tuple[Alternative, ...]:
    """The candidates that the recording cannot tell from a finding."""
    return tuple(a for a in finding.alternatives if not a.separable)


def rivals(finding: Finding, most: int = 3) -> str:
    """The names of those, one after the other; empty where there are none."""
    each = list(dict.fromkeys(_rival(a, finding) for a in inseparable(finding)))
    told = ", ".join(each[:most])
    return term("number.and_more", first=told, count=len(each) - most) if len(each) > most else told


def _rival(alternative: Alternative, finding: Finding) -> str:
    """The name of an alternative; by the kind of quantity that the finding acts on, where it acts there too."""
    at = _elsewhere(alternative, finding)
    return with_drivers(alternative.effect, alternative.drivers, at, "" if at else finding.kind)


def _elsewhere(alternative: Alternative, finding: Finding) -> str:
    """Where an alternative acts, if that is not where the finding does."""
    return "" if _at(alternative.at, finding) else alternative.at


def _at(place: str, finding: Finding) -> bool:
    """Whether a place of a simulation is where a finding acts."""
    own = place.removeprefix("loaded ").removeprefix("output ")
    both = tuple(f"rate of {name}" for name in own.removeprefix("exchange of ").split(" and "))
    return not place or own in finding.channels or both == finding.channels


def role(candidate: CandidateScore, findings: Sequence[Finding]) -> str:
    """What became of a candidate: the number of its finding, or whether it can be told from one."""
    own = candidate.effect, candidate.drivers
    for i, finding in enumerate(findings, 1):
        if own == (finding.effect, finding.drivers) and _at(candidate.at, finding):
            return term("evidence.is_finding", number=i)
    for i, finding in enumerate(findings, 1):
        for a in finding.alternatives:
            if (*own, candidate.at) == (a.effect, a.drivers, a.at):
                return term("evidence.told_apart" if a.separable else "evidence.not_told_apart", number=i)
    return ""


def with_names(sentence: str, ids: Collection[str], kinds: Mapping[str, str] | None = None) -> str:
    """A sentence with effects by their names instead of their ids, its numbers as they are printed.

    Args:
        sentence: to be told.
        ids: of effects.
        kinds: of the quantity that each acts on, where that is known.

    Example:
        >>> with_names("hard_iron_step: p = 4e-05, by -6.1 µT.", {"hard_iron_step"})
        'hard-iron step: p = 4 × 10⁻⁵, by −6.1 µT.'
    """
    known = kinds or {}
    named = re.sub(
        r"[a-z]\w*", lambda word: words_of(word[0], known.get(word[0], "")) if word[0] in ids else word[0], sentence
    )
    return typeset(named)


def driven_by(finding: Finding) -> str:
    """The driver, and what tests say of it."""
    if not finding.drivers:
        return term("finding.no_driver")
    return "; ".join([several(finding.drivers), *of_driver(finding.evidence)])
