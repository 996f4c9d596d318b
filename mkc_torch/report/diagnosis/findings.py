"""Texts of a finding: name, place, driver, grade and alternatives."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence

from mkc_torch._support.typesetting import plain, several, typeset
from mkc_torch.diagnosis.environment import Grade, Run
from mkc_torch.diagnosis.result import Alternative, CandidateScore, EffectParameter, Finding, Region
from mkc_torch.diagnosis.vetoes import is_refused_by_blocks, refusal
from mkc_torch.effects import is_curve, words_of
from mkc_torch.effects.base import PER_RECORDING
from mkc_torch.report.diagnosis.evidence import of_driver
from mkc_torch.report.diagnosis.numbers import TimeFormat, curve_lines, largest, probability
from mkc_torch.report.diagnosis.recordings import recording_called
from mkc_torch.report.words.numbers import number, size

_MOST_RUNS = 6
_USUAL_LEVEL = 0.05
"""p-value of a free curve up to which readers expect a reason why the name is kept."""

_AXES: dict[tuple[str, ...], str] = {
    ("x", "y", "z"): "acts on {channels}, the sensor's axes",
    ("east", "north", "up"): "acts on {channels}, the axes x, y, z of the frame of the attitude",
}
_GRADES: dict[Grade, str] = {
    "left_out": "left out of the simulation",
    "small": "real, but small compared with the noise",
    "unconfirmed": "not confirmed on held-out blocks",
    "nearest": "nearest in the catalogue",
}
_BOUNDS = {
    "below": "below {bound}",
    "above": "above {bound}",
    "near zero": "within ±{bound}",
    "far from zero": "beyond ±{bound}",
}


NOT_TESTED = "not tested on held-out blocks"
"""Grade of a finding whose held-out blocks were not computed, as in a quick look."""


def with_drivers(effect: str, drivers: Sequence[str], at: str = "", kind: str = "") -> str:
    """Return the name of an effect with its drivers and its port; the name depends on the kind of quantity.

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
    key = "{effect} on {place}" if at.startswith("all ") else "{effect} on the {place}"
    return key.format(effect=driven, place=plain(at.removeprefix("loaded ")))


def _together(names: Sequence[str]) -> str:
    """Join names; the three components of a vector by their common prefix."""
    whole = names[0].removesuffix("_x")
    return plain(whole) if list(names) == [f"{whole}_{axis}" for axis in "xyz"] else several(names, 3)


def finding_name(finding: Finding) -> str:
    """Return the name of a finding with its drivers."""
    if unrecorded(finding):
        return "an unrecorded cause"
    if is_curve(finding.effect) and not finding.drivers and finding.curve is not None:
        return f"an unknown dependence of the {several(finding.channels)} on {finding.curve.driver}"
    text = with_drivers(finding.effect, finding.drivers, kind=finding.kind)
    return f"intermittent {text}" if finding.comes_and_goes else text


def unrecorded(finding: Finding) -> bool:
    return is_curve(finding.effect) and finding.curve is not None and finding.curve.driver == "time"


def label_name(label: str) -> str:
    """Return the label of a candidate with the name of its effect.

    Example:
        >>> label_name("current_field (battery_A)")
        'current field (battery_A)'
    """
    effect, space, rest = label.partition(" ")
    return words_of(plain(effect)) + space + plain(rest)


def references_of(finding: Finding) -> str:
    """Return the reference values of the drivers in the equation; empty if there are none.

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
        >>> references_of(finding)
        'Ī: the mean of current over this recording, 10.9 A.'
    """
    if not finding.references:
        return ""
    marked = re.search("[A-Za-z]\u0304", unicodedata.normalize("NFD", finding.equation))
    symbol = unicodedata.normalize("NFC", marked[0]) if marked else "Reference"
    names = several([item.column for item in finding.references])
    values = ", ".join(f"{size(reference.value)} {plain(reference.unit)}".rstrip() for reference in finding.references)
    key = (
        "{symbol}: the means of {columns} over this recording, {values}."
        if len(finding.references) > 1
        else "{symbol}: the mean of {columns} over this recording, {values}."
    )
    return key.format(symbol=symbol, columns=names, values=values)


def where(finding: Finding, clock: TimeFormat) -> str:
    """Return when the finding acts.

    Example:
        >>> from dataclasses import replace
        >>> from mkc_torch.diagnosis.result import EvidenceResult
        >>> finding = Finding("offset_drift", (), ("mag_x",), (), None, "", "", (), 0.01, (), True, "")
        >>> clock = TimeFormat(1, has_time=True)
        >>> where(finding, clock), where(replace(finding, onset=41.32), clock)
        ('throughout the recording', 'from 41.3 s on')
        >>> where(replace(finding, onset=41.32, evidence=(EvidenceResult("onset", (41.24, 41.5)),)), clock)
        'from 41.3 s on (95 %: 41.2 to 41.5 s)'
        >>> where(replace(finding, intervals=((1.0, 2.0), (7.0, 9.5))), clock)
        'mainly from 1.0 to 2.0 s and from 7.0 to 9.5 s'
        >>> where(replace(finding, onset=61.1, event_times=(61.1, 77.8)), clock)
        'at 61.1 s and 77.8 s'
        >>> switched = replace(
        ...     finding, intervals=((8.0, 9.0), (34.0, 37.3)), evidence=(EvidenceResult("switched", True),)
        ... )
        >>> where(replace(switched, onset=6.2), clock)
        'first at 6.2 s, then intermittent, mainly from 8.0 to 9.0 s and from 34.0 to 37.3 s'
    """
    begins = ""
    if finding.event_times:
        begins = f"at {_and([clock.moment(moment) for moment in finding.event_times])}"
    elif finding.onset is not None:
        key = "first at {moment}" if finding.comes_and_goes else "from {moment} on"
        begins = key.format(moment=clock.moment(finding.onset))
    if finding.onset_interval is not None:
        begins = f"{begins} (95 %: {clock.interval(*finding.onset_interval)})"
    if finding.comes_and_goes:
        begins = f"{begins}, then intermittent"
    each = [f"from {clock.interval(start, end)}" for start, end in finding.intervals]
    spans = [end - start for start, end in finding.intervals]
    if len(each) > 3:
        mainly = f"mainly in {len(each)} intervals, the longest {each[spans.index(max(spans))]}"
    else:
        mainly = f"mainly {_and(each)}" if each else ""
    return ", ".join(filter(None, [begins, mainly])) or "throughout the recording"


def acts_on(finding: Finding) -> str:
    """Return the channels that a finding acts on, and the frame of the axes; empty without channels.

    Example:
        >>> finding = Finding("offset_drift", (), ("x", "y", "z"), (), None, "", "", (), 0.01, (), True, "")
        >>> acts_on(finding)
        "acts on x, y, z, the sensor's axes"
        >>> acts_on(Finding("linear_drag", (), ("rate of speed",), (), None, "", "", (), 0.01, (), True, ""))
        'acts on the rate of speed'
    """
    if not finding.channels:
        return ""
    channels = [f"the {name}" if name.startswith(("rate of ", "parameter ")) else name for name in finding.channels]
    return _AXES.get(finding.channels, "acts on {channels}").format(channels=several(channels))


def _and(each: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(each[:-1]), *each[-1:]]))


def region(found: Region) -> str:
    """Return the part of a state's range with most of the gain.

    Example:
        >>> region(Region("speed", "rad/s", "near zero", 0.3, 0.824, 0.2))
        '82 % of the gain, in 20 % of the time: speed within ±0.300 rad/s'
        >>> region(Region("level", "cm", "above", 14.23, 0.91, 0.1))
        '91 % of the gain, in 10 % of the time: level above 14.2 cm'
    """
    unit = f" {found.unit}" if found.unit else ""
    bounds = _BOUNDS[found.kind].format(bound=f"{size(found.bound)}{unit}")
    gain, time = (f"{100.0 * item:.0f} %" for item in (found.share_of_gain, found.share_of_time))
    return f"{gain} of the gain, in {time} of the time: {plain(found.state)} {bounds}"


def shares_of_runs(shares: Sequence[float], runs: Sequence[Run] = ()) -> str:
    """Return each run's share of the gain, the largest first.

    Example:
        >>> shares_of_runs((0.1, 0.7, 0.2))
        'run 2: 70 %, run 3: 20 %, run 1: 10 %'
        >>> shares_of_runs((0.4, 0.6), (Run(1, "a.csv", 0), Run(2, "b.csv", 0)))
        'recording 2 (b.csv): 60 %, recording 1 (a.csv): 40 %'
    """
    known = runs if len(runs) == len(shares) else [Run(0, "", k + 1) for k in range(len(shares))]
    order = sorted(range(len(shares)), key=lambda k: -shares[k])
    sentences = [f"{_run(known[k])}: {number(100.0 * shares[k], 0)} %" for k in order[:_MOST_RUNS]]
    more = len(shares) - len(sentences)
    each = ", ".join(sentences)
    return f"{each}, and {more} more" if more else each


def _run(run: Run) -> str:
    """Return the name of a run; its number is omitted if it is the only run of its recording.

    Example:
        >>> _run(Run(2, "b.csv", 3)), _run(Run(0, "", 3))
        ('run 3 of recording 2 (b.csv)', 'run 3')
    """
    if not run.recording:
        return f"run {run.number}"
    recording = recording_called(run.recording, run.name)
    return f"run {run.number} of {recording}" if run.number else recording


def grade(finding: Finding) -> str:
    """Return the grade in words.

    Example:
        >>> grade(Finding("offset_drift", (), (), (), None, "", "", (), 0.01, (), True, "", grade="small"))
        'real, but small compared with the noise'
    """
    if finding.grade == "unconfirmed" and finding.cannot_be:
        return "not confirmed: impossible size"
    if finding.grade == "unconfirmed" and finding.held_out is None:
        return NOT_TESTED
    if finding.grade == "unconfirmed" and not is_refused_by_blocks(finding):
        return f"not confirmed: {refusal(finding)}"
    return _GRADES[finding.grade]


def shape(finding: Finding) -> str:
    """Return the test of the finding's shape against a free curve; empty if it was not tested.

    Example:
        >>> from dataclasses import replace
        >>> from mkc_torch.diagnosis.environment import ShapeCheck
        >>> right = Finding("linear_drag", (), (), (), None, "", "", (), 0.01, (), True, "", shape=ShapeCheck(1.2, 0.4))
        >>> shape(right)
        'a free curve of the same variables is not clearly better (p = 0.4)'
        >>> shape(replace(right, shape=ShapeCheck(6.3, 0.005)))
        'a free curve of the same variables is only a little better (p = 0.005 if the name is right): the name is kept'
    """
    found = finding.shape
    if found is None:
        return ""
    p = probability(found.p_value)
    if found.curve is None and found.p_value > _USUAL_LEVEL:
        return f"a free curve of the same variables is not clearly better ({p})"
    if found.curve is None:
        text = "a free curve of the same variables is only a little better"
        return f"{text} ({p} if the name is right): the name is kept"
    return f"a free curve of the same variables at the same port is clearly better ({p} if the name is right)"


def inseparable(finding: Finding) -> tuple[Alternative, ...]:
    """Return the alternatives that the recording cannot distinguish from a finding."""
    return tuple(a for a in finding.alternatives if not a.separable)


def stated_parameters(finding: Finding) -> tuple[EffectParameter, ...]:
    """Return the parameters that are stated: of a curve those of its form, since its coefficients are no values.

    A share of 1, a whole lag say, is left out where other parameters give the size.

    Example:
        >>> lag = EffectParameter("share", 1.0, 0.0, ""), EffectParameter("lag", 0.2, None, "s", of_shape=True)
        >>> found = Finding("sensor_lag", (), ("output",), (), None, "", "", lag, 0.01, (), True, "")
        >>> [parameter.name for parameter in stated_parameters(found)]
        ['lag']
    """
    if not is_curve(finding.effect):
        whole = [p for p in finding.parameters if p.name == "share" and p.value == 1.0 and not p.standard_error]
        others = tuple(p for p in finding.parameters if p not in whole)
        return others or finding.parameters
    return tuple(parameter for parameter in finding.parameters if parameter.of_shape)


def curve_values(finding: Finding) -> list[str]:
    """Return values of a finding's curve where the recording has samples; empty for a named effect."""
    return curve_lines(finding.curve) if is_curve(finding.effect) and finding.curve is not None else []


def rivals(finding: Finding, *, sizes: bool = False) -> str:
    """Return the names of the inseparable alternatives; empty if there are none.

    Args:
        finding: with its alternatives.
        sizes: also return the fitted parameters of each alternative, as far as they are known.
    """
    each = [
        f"{_rival(a, finding)} with {fitted_sizes(a)}" if sizes and fitted_sizes(a) else _rival(a, finding)
        for a in inseparable(finding)
    ]
    return several(list(dict.fromkeys(each)), 3)


def fitted_sizes(alternative: Alternative) -> str:
    """Return the fitted parameters of an alternative; empty for a free curve, and if they are not known.

    Example:
        >>> from mkc_torch.diagnosis.result import EffectParameter
        >>> drag = EffectParameter("drag", 0.00047, 0.0001, "1/m")
        >>> fitted_sizes(Alternative("quadratic_drag", (), 0.4, False, parameters=(drag,)))
        'drag (4.7 ± 1.0) × 10⁻⁴ 1/m'
    """
    return "" if is_curve(alternative.effect) else "; ".join(largest(p) for p in alternative.parameters)


def _rival(alternative: Alternative, finding: Finding) -> str:
    """Return the name of an alternative; at the finding's port, the name depends on the kind of quantity."""
    at = "" if _at(alternative.port, finding) else alternative.port
    return with_drivers(alternative.effect, alternative.drivers, at, "" if at else finding.kind)


def _at(place: str, finding: Finding) -> bool:
    """Whether a finding acts at a port."""
    own = place.removeprefix("loaded ").removeprefix("output ")
    both = tuple(f"rate of {name}" for name in own.removeprefix("exchange of ").split(" and "))
    return not place or own in finding.channels or both == finding.channels


def role(candidate: CandidateScore, findings: Sequence[Finding]) -> str:
    """Return the number of a candidate's finding, or whether it is distinguished from a finding."""
    own = candidate.effect, candidate.drivers
    for i, finding in enumerate(findings, 1):
        effects = finding.effect, f"{finding.effect}{PER_RECORDING}"
        if candidate.effect in effects and candidate.drivers == finding.drivers and _at(candidate.port, finding):
            return f"finding {i}"
    for i, finding in enumerate(findings, 1):
        for a in finding.alternatives:
            if (*own, candidate.port) == (a.effect, a.drivers, a.port):
                return (
                    "distinguished from finding {number}" if a.separable else "not distinguished from finding {number}"
                ).format(number=i)
    return ""


def with_names(sentence: str, ids: Collection[str], kinds: Mapping[str, str] | None = None) -> str:
    """Replace effect ids in a sentence by names, and typeset its numbers.

    Args:
        sentence: with effect ids.
        ids: of effects.
        kinds: kind of quantity that each effect acts on, if known.

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
    """Return the driver and the tests of it."""
    if not finding.drivers:
        return "no recorded column"
    return "; ".join([several(finding.drivers), *of_driver(finding.evidence)])
