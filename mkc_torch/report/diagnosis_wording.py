"""A diagnosis in words and figures, the same in the terminal and on a page."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from mkc_torch.diagnosis.result import (
    Alternative,
    Candidate,
    Diagnosis,
    Extrapolation,
    Finding,
    HeldOut,
    Noise,
    Number,
    Region,
    Traces,
)
from mkc_torch.report.wording import bandwidth, decimals, number, share, size

__all__ = [
    "Clock",
    "ceiling_reached",
    "chance",
    "clock_of",
    "driven_by",
    "effect_name",
    "evidence",
    "experiments",
    "extrapolation",
    "finding_name",
    "gain",
    "headline",
    "held_out_rows",
    "improvement",
    "inseparable",
    "label_name",
    "lead",
    "measured",
    "noise_model",
    "noise_parameters",
    "plain",
    "probability",
    "region",
    "residual_sizes",
    "rivals",
    "role",
    "several",
    "to_do",
    "where",
    "with_drivers",
]

_FEWEST_LARGE, _MOST_SMALL = 1e6, 1e-3  # beyond these a number is written with a power of ten
_MOST_NUMBERS = 12
_MOST_EXPERIMENTS = 6
_NAMES = {"coulomb": "Coulomb", "stribeck": "Stribeck", "bouc": "Bouc", "wen": "Wen", "magnus": "Magnus"}
_POWER = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Clock:
    """How moments are written: to so many decimals, in s, or as numbers of samples."""

    places: int
    has_time: bool

    def moment(self, value: float) -> str:
        """One moment.

        Example:
            >>> Clock(1, has_time=True).moment(41.32), Clock(0, has_time=False).moment(812.0)
            ('41.3 s', 'sample 812')
        """
        return f"{number(value, self.places)} s" if self.has_time else f"sample {number(value, 0)}"

    def interval(self, start: float, end: float) -> str:
        """From one moment to another.

        Example:
            >>> Clock(1, has_time=True).interval(12.0, 18.44), Clock(0, has_time=False).interval(3.0, 9.0)
            ('12.0 to 18.4 s', 'sample 3 to 9')
        """
        if self.has_time:
            return f"{number(start, self.places)} to {number(end, self.places)} s"
        return f"sample {number(start, 0)} to {number(end, 0)}"


def clock_of(traces: Traces) -> Clock:
    """A clock that tells moments apart to about a thousandth of the recording."""
    known = traces.time[traces.time.isfinite()]
    span = float(known.max() - known.min()) if traces.has_time and len(known) else 0.0
    return Clock(min(max(2 - math.floor(math.log10(span)), 0), 6) if span > 0 else 1, traces.has_time)


def plain(text: str) -> str:
    """A text from a file on one line, without characters that steer a terminal.

    Example:
        >>> plain("coil \\x1b[31m\\n temperature")
        'coil �[31m temperature'
    """
    return "".join(c if c.isprintable() else "�" for c in " ".join(text.split()))


def effect_name(effect: str) -> str:
    """The name of an effect in words.

    Example:
        >>> effect_name("hard_iron_step"), effect_name("coulomb_friction"), effect_name("unknown")
        ('hard-iron step', 'Coulomb friction', 'an effect outside the catalogue')
    """
    if effect == "unknown":
        return "an effect outside the catalogue"
    words = effect.replace("_", " ").replace("hard iron", "hard-iron").replace("soft iron", "soft-iron")
    return " ".join(_NAMES.get(word, word) for word in words.split(" "))


def with_drivers(effect: str, drivers: Sequence[str], at: str = "") -> str:
    """An effect with what drives it, and where it acts.

    Example:
        >>> with_drivers("current_field", ["battery_A"]), with_drivers("offset_drift", [])
        ('current field (battery_A)', 'offset drift')
        >>> with_drivers("linear_drag", [], "rate of speed")
        'linear drag on the rate of speed'
    """
    place = f" on the {plain(at.removeprefix('loaded '))}" if at else ""
    return effect_name(effect) + (f" ({several(drivers, 3)})" if drivers else "") + place


def finding_name(finding: Finding) -> str:
    """A finding by its effect and what drives it; one that goes along time alone and has no name is told as a cause."""
    if _unrecorded(finding):
        return "a cause that no column recorded"
    return with_drivers(finding.effect, finding.drivers)


def _unrecorded(finding: Finding) -> bool:
    return finding.effect == "unknown" and finding.curve is not None and finding.curve.driver == "time"


def label_name(label: str) -> str:
    """The label of a candidate, an id and what drives it, in words.

    Example:
        >>> label_name("current_field (battery_A)")
        'current field (battery_A)'
    """
    effect, space, rest = label.partition(" ")
    return effect_name(plain(effect)) + space + plain(rest)


def several(names: Sequence[str], most: int = 6) -> str:
    """Names one after the other; of many, the first ones.

    Example:
        >>> several(["x", "y"]), several("abcdefgh", 3)
        ('x, y', 'a, b, c and 5 more')
    """
    told = ", ".join(plain(name) for name in names[:most])
    return f"{told} and {len(names) - most} more" if len(names) > most else told


def measured(value: Number, error: Number | None, unit: str) -> list[str]:
    """A parameter with its standard error, to the digits that the error leaves, one line a row of a matrix.

    Example:
        >>> measured((-0.1702, 0.33), (0.0123, 0.0119), "µT/A")
        ['(−0.170 ± 0.012, 0.330 ± 0.012) µT/A']
        >>> measured(4.02e-6, 1.1e-7, "1/µT²"), measured(3.21987, None, "")
        (['(4.02 ± 0.11) × 10⁻⁶ 1/µT²'], ['3.22'])
    """
    rows = list(_rows(value))
    errors = list(_rows(error)) if error is not None else []
    values = [v for row in rows for v in row if math.isfinite(v)]
    known = [e for row in errors for e in row if math.isfinite(e) and e > 0]
    largest = max((abs(v) for v in [*values, *known]), default=0.0)
    power = 0 if largest == 0 or _MOST_SMALL <= largest < _FEWEST_LARGE else math.floor(math.log10(largest))
    scale = 10.0**power
    places = decimals(max(known) / scale) if known else _three_digits(largest / scale)
    factor = f" × 10{str(power).translate(_POWER)}" if power else ""
    lines = []
    for i, row in enumerate(rows[:_MOST_NUMBERS]):
        beside = errors[i] if i < len(errors) and len(errors[i]) == len(row) else [math.nan] * len(row)
        cells = [_cell(v / scale, e / scale, places) for v, e in zip(row, beside, strict=True)]
        rest = len(cells) - _MOST_NUMBERS
        text = ", ".join(cells[:_MOST_NUMBERS]) + (f", … {rest} more" if rest > 0 else "")
        bare = isinstance(value, (int, float)) and not (factor and "±" in text)
        lines.append((text if bare else f"({text})") + factor + (f" {plain(unit)}" if unit else ""))
    return [*lines, f"… {len(rows) - _MOST_NUMBERS} more rows"] if len(rows) > _MOST_NUMBERS else lines


def _cell(value: float, error: float, places: int) -> str:
    if not math.isfinite(value):
        return "not known"
    told = number(value, places)
    return f"{told} ± {error:.{places}f}" if math.isfinite(error) and error > 0 else told


def _three_digits(value: float) -> int:
    return max(2 - math.floor(math.log10(value)), 0) if value > 0 else 0


def _rows(value: Number | None) -> Iterator[list[float]]:
    """Rows of numbers: of a vector one, of a matrix its own; None is a number that is not known."""
    if value is None:
        yield [math.nan]
    elif isinstance(value, (int, float)):
        yield [float(value)]
    elif any(isinstance(v, Sequence) for v in value):
        for v in value:
            yield from _rows(v)
    else:
        yield [cell for v in value for row in _rows(v) for cell in row]


def where(finding: Finding, clock: Clock) -> str:
    """When the finding acts.

    Example:
        >>> from dataclasses import replace
        >>> finding = Finding("offset_drift", (), ("mag_x",), (), None, "", "", (), 0.01, None, "", (), True, "")
        >>> clock = Clock(1, has_time=True)
        >>> where(finding, clock), where(replace(finding, onset=41.32), clock)
        ('throughout the recording', 'from 41.3 s on')
        >>> where(replace(finding, onset=41.32, onset_interval=(41.24, 41.5)), clock)
        'from 41.3 s on (95 %: 41.2 to 41.5 s)'
        >>> where(replace(finding, intervals=((1.0, 2.0), (7.0, 9.5))), clock)
        'mainly from 1.0 to 2.0 s and from 7.0 to 9.5 s'
    """
    begins = "" if finding.onset is None else f"from {clock.moment(finding.onset)} on"
    if finding.onset_interval is not None:
        begins += f" (95 %: {clock.interval(*finding.onset_interval)})"
    each = [f"from {clock.interval(start, end)}" for start, end in finding.intervals]
    if len(each) > 3:
        spans = [end - start for start, end in finding.intervals]
        mainly = f"mainly in {len(each)} intervals, the longest {each[spans.index(max(spans))]}"
    else:
        mainly = "mainly " + " and ".join(filter(None, [", ".join(each[:-1]), *each[-1:]])) if each else ""
    return ", ".join(filter(None, [begins, mainly])) or "throughout the recording"


def region(found: Region) -> str:
    """In which states most of the gain arises.

    Example:
        >>> region(Region("speed", "rad/s", "near zero", 0.3, 0.824, 0.2))
        '82 % of the gain where speed is within ±0.300 rad/s, 20 % of the time'
        >>> region(Region("level", "cm", "above", 14.23, 0.91, 0.1))
        '91 % of the gain where level is above 14.2 cm, 10 % of the time'
    """
    unit = f" {found.unit}" if found.unit else ""
    told = {
        "below": f"below {size(found.bound)}{unit}",
        "above": f"above {size(found.bound)}{unit}",
        "near zero": f"within ±{size(found.bound)}{unit}",
        "far from zero": f"beyond ±{size(found.bound)}{unit}",
    }[found.kind]
    gain, time = (f"{100.0 * one:.0f} %" for one in (found.share_of_gain, found.share_of_time))
    return f"{gain} of the gain where {plain(found.state)} is {told}, {time} of the time"


def experiments(shares: Sequence[float]) -> str:
    """Each experiment's share of the gain, the largest first.

    Example:
        >>> experiments((0.1, 0.7, 0.2))
        'experiment 2: 70 %, experiment 3: 20 %, experiment 1: 10 %'
    """
    order = sorted(range(len(shares)), key=lambda k: -shares[k])
    told = [f"experiment {k + 1}: {number(100.0 * shares[k], 0)} %" for k in order[:_MOST_EXPERIMENTS]]
    more = len(shares) - len(told)
    return ", ".join(told) + (f", and {more} more" if more else "")


def probability(value: float) -> str:
    """A p-value to two digits.

    Example:
        >>> probability(0.005), probability(0.3712), probability(2e-7)
        ('p = 0.005', 'p = 0.37', 'p < 0.0001')
    """
    return f"p = {value:.2g}" if value >= 1e-4 else "p < 0.0001"


def evidence(value: float, surrogates: int) -> str:
    """A p-value, and whether more surrogates could have made it smaller.

    Example:
        >>> evidence(0.005, 199), evidence(0.02, 199)
        ('p = 0.005, the smallest that 199 surrogates can show', 'p = 0.02')
    """
    told = f", the smallest that {surrogates:,} surrogates can show" if _least(value, surrogates) else ""
    return probability(value) + told


def _least(value: float, surrogates: int) -> bool:
    return surrogates > 0 and value <= (1.0 + 1e-9) / (1 + surrogates)


def gain(held_out: HeldOut, *, short: bool = False) -> str:
    """The gain on data the fit has not seen, with its interval; in short without words.

    Example:
        >>> held_out = HeldOut(0.3124, (0.2811, 0.3502), 0.9, 0.5, "µT")
        >>> gain(held_out), gain(held_out, short=True)
        ('+0.312 nats a sample (95 %: 0.281 to 0.350)', '+0.312 [0.281, 0.350]')
    """
    return gain_told(held_out.log_likelihood_gain, held_out.confidence_interval, short=short)


def gain_told(value: float, interval: tuple[float, float], *, short: bool = False) -> str:
    """A gain with its interval, to the digits that the interval leaves."""
    low, high = interval
    known = math.isfinite(low) and math.isfinite(high)
    places = decimals(0.25 * (high - low)) if known and high > low else 3
    told = number(value, places)
    signed = told if told.startswith("−") else f"+{told}"
    if short:
        return f"{signed} [{number(low, places)}, {number(high, places)}]" if known else signed
    if not known:
        return f"{signed} nats a sample (interval not known)"
    return f"{signed} nats a sample (95 %: {number(low, places)} to {number(high, places)})"


def improvement(before: float, after: float, unit: str) -> str:
    """A residual before and after.

    Example:
        >>> improvement(0.912, 0.521, "µT"), improvement(0.5, 0.5, "")
        ('0.912 → 0.521 µT (43 % less)', '0.500 → 0.500 (no change)')
    """
    sizes = f"{size(before)} → {size(after)} {plain(unit)}".rstrip()
    if not (before > 0 and math.isfinite(before) and math.isfinite(after)):
        return sizes
    less = 1.0 - after / before
    if abs(less) < 5e-4:
        return f"{sizes} (no change)"
    return f"{sizes} ({share(abs(less))} {'less' if less > 0 else 'more'})"


def held_out_rows(diagnosis: Diagnosis) -> list[tuple[str, list[str]]]:
    """The models compared on held-out blocks: root mean square, log-likelihood, and σ and d of each channel."""
    rows = [("the simulation as it is", diagnosis.baseline)]
    if diagnosis.findings:
        rows.append(("with the findings", diagnosis.corrected))
    if diagnosis.ceiling is not None:
        rows.append(("with any smooth correction (the ceiling)", diagnosis.ceiling))
    return [
        (
            name,
            [
                size(s.rmse),
                number(s.log_likelihood, 3),
                several([bandwidth(v) for v in s.sigma]),
                several([size(v) for v in s.d]),
            ],
        )
        for name, s in rows
    ]


def residual_sizes(diagnosis: Diagnosis) -> str:
    """The root mean square of the residual on held-out blocks, before and after all findings."""
    return improvement(diagnosis.baseline.rmse, diagnosis.corrected.rmse, diagnosis.traces.unit)


def inseparable(finding: Finding) -> tuple[Alternative, ...]:
    """The candidates that the recording cannot tell from a finding."""
    return tuple(a for a in finding.alternatives if not a.separable)


def rivals(finding: Finding, most: int = 3) -> str:
    """The names of those, one after the other; empty where there are none."""
    each = list(dict.fromkeys(with_drivers(a.effect, a.drivers, _elsewhere(a, finding)) for a in inseparable(finding)))
    told = ", ".join(each[:most])
    return f"{told} and {len(each) - most} more" if len(each) > most else told


def _elsewhere(alternative: Alternative, finding: Finding) -> str:
    """Where an alternative acts, if that is not where the finding does."""
    return "" if _at(alternative.at, finding) else alternative.at


def _at(place: str, finding: Finding) -> bool:
    """Whether a place of a simulation is where a finding acts."""
    own = place.removeprefix("loaded ").removeprefix("output ")
    both = tuple(f"rate of {name}" for name in own.removeprefix("exchange of ").split(" and "))
    return not place or own in finding.channels or both == finding.channels


def role(candidate: Candidate, findings: Sequence[Finding]) -> str:
    """What became of a candidate: the number of its finding, or whether it can be told from one."""
    own = candidate.effect, candidate.drivers
    for i, finding in enumerate(findings, 1):
        if own == (finding.effect, finding.drivers) and _at(candidate.at, finding):
            return f"finding {i}"
    for i, finding in enumerate(findings, 1):
        for a in finding.alternatives:
            if (*own, candidate.at) == (a.effect, a.drivers, a.at):
                return f"told from finding {i}" if a.separable else f"not to be told from finding {i}"
    return ""


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in a sentence."""
    if diagnosis.verdict == "adequate":
        return "Nothing is missing that this recording could show."
    alone = len(diagnosis.findings) == 1
    left_out = "; ".join(_or_a_rival(f, alone=alone) for f in diagnosis.findings)
    if diagnosis.verdict == "explained":
        return f"Left out of the simulation: {left_out}."
    if not diagnosis.findings:
        return "Structure remains that no effect in the catalogue accounts for."
    if any(_unrecorded(f) for f in diagnosis.findings):
        return f"Left out of the simulation: {left_out}. Its course over time is all that is known of it."
    return (
        f"Left out of the simulation: {left_out}. Yet structure remains that no effect in the catalogue accounts for."
    )


def _or_a_rival(finding: Finding, *, alone: bool) -> str:
    name, others = finding_name(finding), inseparable(finding)
    if not others:
        return name
    if not alone:
        return f"{name}, or a rival"
    if len(others) == 1:
        return f"{name} or {rivals(finding)}, which this recording cannot tell apart"
    return f"{name} or one of {len(others)} others that this recording cannot tell from it"


def lead(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """How large, where, how sure, how much better: questions with their answers."""
    d = diagnosis
    sure = ("How sure", chance(d.findings[0].p_value if d.findings else d.p_value, d))
    if not d.findings:
        unit = f" {plain(d.traces.unit)}" if d.traces.unit else ""
        left = f"{size(d.baseline.rmse)}{unit}, root mean square on data the fit had not seen."
        return [sure, ("Residual", left), ("Noise", f"{_capital(noise_model(d.noise))}.")]
    better = ("How much better", f"On data the fit had not seen, the residual is {residual_sizes(d)}.")
    if len(d.findings) > 1:
        return [sure, better]
    f = d.findings[0]
    told = [f"{plain(p.name)} {' '.join(measured(p.value, p.standard_error, p.unit))}" for p in f.parameters[:2]]
    large = [("How large", "; ".join(told) + ".")] if told else []
    acts = f"; acts on {several(f.channels)}" if f.channels else ""
    return [*large, ("Where", f"{_capital(where(f, clock_of(d.traces)))}{acts}."), sure, better]


def chance(p_value: float, diagnosis: Diagnosis) -> str:
    """What a p-value means, in a sentence."""
    d = diagnosis
    most = "at most " if _least(p_value, d.surrogates) else ""
    return (
        f"If nothing were missing, a search like this, of {d.candidates_tried:,} candidates, would find as much in "
        f"{most}{share(p_value)} of recordings ({evidence(p_value, d.surrogates)}; the level asked for is {d.level:g})."
    )


def to_do(diagnosis: Diagnosis) -> list[str]:
    """What to do next: what the diagnosis advises, or else what its verdict asks for."""
    if diagnosis.advice:
        ids = {f.effect for f in diagnosis.findings} | {a.effect for f in diagnosis.findings for a in f.alternatives}
        ids = {one for one in ids if "_" in one}
        return [_with_names(plain(sentence), ids) for sentence in diagnosis.advice]
    return {
        "adequate": ["Use the simulation as it is, within what this recording covers."],
        "explained": ["Use the model found here in place of the simulation, and confirm it on a second recording."],
        "unexplained": ["Record more columns that could drive what remains, such as temperature, current and motion."],
    }[diagnosis.verdict].copy()


def _with_names(sentence: str, ids: Collection[str]) -> str:
    """A sentence with effects by their names."""
    return re.sub(r"[a-z]\w*", lambda word: effect_name(word[0]) if word[0] in ids else word[0], sentence)


def noise_model(noise: Noise) -> str:
    """The noise in words."""
    kind = {"white": "white", "ar": "autoregressive", "random_walk": "random walk"}[noise.model]
    return f"{kind}: {plain(noise.description)}" if noise.description.strip() else f"{kind} noise"


def noise_parameters(noise: Noise, channels: Sequence[str]) -> list[tuple[str, str]]:
    """The numbers of the noise model by name, those of the density once a channel."""
    rows = [(plain(name), " ".join(measured(value, None, ""))) for name, value in noise.parameters.items()]
    density = zip(noise.sigma, noise.d, noise.bound, strict=True)
    for i, (sigma, d, bound) in enumerate(density):
        named = f" of {plain(channels[i])}" if len(noise.sigma) > 1 and i < len(channels) else ""
        rows.append((f"density{named}", f"σ = {bandwidth(sigma)}, d = {size(d)}, on ±{size(bound)}"))
    return rows


def ceiling_reached(diagnosis: Diagnosis) -> str:
    """How far a smooth correction by all columns comes; empty where it was not asked for."""
    if diagnosis.ceiling is None:
        return ""
    unit = plain(diagnosis.traces.unit)
    return f"a smooth correction by all columns and by time reaches {size(diagnosis.ceiling.rmse)} {unit}".rstrip()


def driven_by(finding: Finding) -> str:
    """The driver, and how it compares with copies of it shifted in time."""
    if not finding.drivers:
        return "no recorded column"
    named, found = several(finding.drivers), finding.driver_shift
    if found is None:
        return named
    some = {0: "none", 1: "one"}.get(found.as_good, str(found.as_good))
    gain = "gain" if found.as_good > 1 else "gains"
    return f"{named}; {some} of {found.copies} copies shifted by up to {size(found.reach)} s {gain} as much"


def extrapolation(found: Extrapolation) -> str:
    """What a fit to low values of a driver says of high ones.

    Example:
        >>> extrapolation(Extrapolation(0.3124, (0.2811, 0.3502)))
        'fitted where its driver is low, it predicts where that is high: +0.312 nats a sample (95 %: 0.281 to 0.350)'
        >>> extrapolation(Extrapolation(-0.02, (-0.12, 0.09))).partition(":")[0]
        'fitted where its driver is low, it says nothing where that is high'
    """
    low, high = found.confidence_interval
    told = "predicts" if low > 0.0 else "misleads" if high < 0.0 else "says nothing"
    told_gain = gain_told(found.log_likelihood_gain, found.confidence_interval)
    return f"fitted where its driver is low, it {told} where that is high: {told_gain}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
