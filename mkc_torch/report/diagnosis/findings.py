"""The findings of a diagnosis in words and figures, the same in the terminal and on a page."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from mkc_torch.diagnosis.findings.worth import confirmation
from mkc_torch.diagnosis.result import (
    Alternative,
    Candidate,
    DensityCheck,
    Diagnosis,
    Extrapolation,
    Finding,
    HeldOut,
    Noise,
    Number,
    Parameter,
    Region,
    Traces,
)
from mkc_torch.effects import is_curve, words_of
from mkc_torch.report.words.numbers import bandwidth, decimals, number, share, size
from mkc_torch.report.words.typesetting import plain, superscript, typeset

__all__ = [
    "Clock",
    "acts_on",
    "behind",
    "better",
    "channel_notes",
    "clock_of",
    "counted_from",
    "density_check",
    "driven_by",
    "evidence",
    "experiments",
    "extrapolation",
    "finding_name",
    "gain",
    "held_out_rows",
    "improvement",
    "inseparable",
    "label_name",
    "largest",
    "measured",
    "named_lines",
    "noise_model",
    "noise_parameters",
    "parameter_lines",
    "parameter_name",
    "probability",
    "region",
    "residual_sizes",
    "rivals",
    "role",
    "several",
    "smooth_fit",
    "unrecorded",
    "where",
    "with_drivers",
    "with_names",
]

_FEWEST_LARGE, _MOST_SMALL = 1e6, 1e-3  # beyond these a number is written with a power of ten
_MOST_NUMBERS = 12
_CLEARLY = 0.99  # of a residual, below which another one is smaller
_LONG = 4  # numbers from which a list is told by its largest
_MOST_EXPERIMENTS = 6


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
    digits = max(2 - math.floor(math.log10(span)), int(span < 1000.0)) if span > 0 else 1
    return Clock(min(max(digits, 0), 6), traces.has_time)


def with_drivers(effect: str, drivers: Sequence[str], at: str = "") -> str:
    """An effect with what drives it, and where it acts.

    Example:
        >>> with_drivers("current_field", ["battery_A"]), with_drivers("offset_drift", [])
        ('current field (battery_A)', 'offset drift')
        >>> with_drivers("linear_drag", [], "rate of speed")
        'linear drag on the rate of speed'
        >>> with_drivers("clock_drift", [], "all outputs")
        'clock drift on all outputs'
        >>> with_drivers("field_gradient", ["position_x", "position_y", "position_z"])
        'field gradient (position)'
    """
    place = f" on {'' if at.startswith('all ') else 'the '}{plain(at.removeprefix('loaded '))}" if at else ""
    return words_of(effect) + (f" ({_together(drivers)})" if drivers else "") + place


def _together(names: Sequence[str]) -> str:
    """Names one after the other; the three of a vector by what they have in common."""
    whole = names[0].removesuffix("_x")
    return plain(whole) if list(names) == [f"{whole}_{axis}" for axis in "xyz"] else several(names, 3)


def finding_name(finding: Finding) -> str:
    """A finding by its effect and what drives it; one that goes along time alone and has no name is told as a cause."""
    if unrecorded(finding):
        return "a cause that no column recorded"
    return with_drivers(finding.effect, finding.drivers) + (" that comes and goes" if finding.comes_and_goes else "")


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
    digits = _Digits.of(rows, errors)
    lines = []
    for i, row in enumerate(rows[:_MOST_NUMBERS]):
        beside = errors[i] if i < len(errors) and len(errors[i]) == len(row) else [math.nan] * len(row)
        cells = [digits.cell(v, e) for v, e in zip(row, beside, strict=True)]
        rest = len(cells) - _MOST_NUMBERS
        text = ", ".join(cells[:_MOST_NUMBERS]) + (f", … {rest} more" if rest > 0 else "")
        bare = isinstance(value, (int, float)) and not (digits.power and "±" in text)
        lines.append((text if bare else f"({text})") + digits.factor + (f" {plain(unit)}" if unit else ""))
    return [*lines, f"… {len(rows) - _MOST_NUMBERS} more rows"] if len(rows) > _MOST_NUMBERS else lines


@dataclass(frozen=True)
class _Digits:
    """How numbers of one list are written: the power of ten that they share, and the decimals that errors leave."""

    power: int
    places: int

    @classmethod
    def of(cls, rows: Sequence[Sequence[float]], errors: Sequence[Sequence[float]]) -> _Digits:
        values = [v for row in rows for v in row if math.isfinite(v)]
        known = [e for row in errors for e in row if math.isfinite(e) and e > 0]
        largest = max((abs(v) for v in [*values, *known]), default=0.0)
        power = 0 if largest == 0 or _MOST_SMALL <= largest < _FEWEST_LARGE else math.floor(math.log10(largest))
        scale = 10.0**power
        return cls(power, decimals(max(known) / scale) if known else _three_digits(largest / scale))

    @property
    def factor(self) -> str:
        return f" × 10{superscript(self.power)}" if self.power else ""

    def cell(self, value: float, error: float) -> str:
        """A number with its error, without the power of ten."""
        if not math.isfinite(value):
            return "not known"
        told, scale = number(value / 10.0**self.power, self.places), 10.0**self.power
        return f"{told} ± {error / scale:.{self.places}f}" if math.isfinite(error) and error > 0 else told


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


def parameter_name(parameter: Parameter) -> str:
    """A parameter's name in words.

    Example:
        >>> parameter_name(Parameter("field_per_ampere", 1.0, None, "µT/A"))
        'field per ampere'
    """
    name = plain(parameter.name)
    curve = re.fullmatch(r"legendre_(\d+)", name)
    return f"amplitude of P{_lowered(curve[1])}" if curve else name.replace("_", " ")


def _lowered(digits: str) -> str:
    return digits.translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def parameter_lines(parameter: Parameter, channels: Sequence[str]) -> list[str]:
    """A parameter as :func:`measured` has it; of one whose numbers are not one for each channel, one line a number.

    Example:
        >>> parameter_lines(Parameter("k", (1.0, 2.0), (0.1, 0.1), "µT", ("x", "y")), ("x", "y"))
        ['(1.00 ± 0.10, 2.00 ± 0.10) µT']
        >>> parameter_lines(
        ...     Parameter("jumps", (11.2, -1.2), (4.4, 0.6), "°", ("at 61.1 s", "at 103.2 s")), ("heading",)
        ... )
        ['at 61.1 s: 11.2 ± 4.4 °', 'at 103.2 s: −1.2 ± 0.6 °']
        >>> parameter_lines(Parameter("lag", 1.5, None, "s"), ("x",))
        ['1.50 s, standard error not estimated']
    """
    p = parameter
    if not p.components or tuple(p.components) == tuple(channels):
        lines = measured(p.value, p.standard_error, p.unit)
        return lines if _known(p.standard_error) else [*lines[:-1], f"{lines[-1]}, {_NOT_ESTIMATED}"]
    each = _listed(p)
    return each if _known(p.standard_error) else [*each, _NOT_ESTIMATED]


_NOT_ESTIMATED = "standard error not estimated"


def _listed(parameter: Parameter) -> list[str]:
    """What each number of a list is, and the number, with the digits and the power of ten of all."""
    p = parameter
    (values,) = _rows(p.value)
    errors = next(_rows(p.standard_error)) if isinstance(p.standard_error, Sequence) else [math.nan] * len(values)
    digits = _Digits.of([values], [errors])
    cells = [digits.cell(v, e) for v, e in zip(values, errors, strict=True)]
    tail = digits.factor + (f" {plain(p.unit)}" if p.unit else "")
    told = [f"({cell}){tail}" if digits.power and "±" in cell else f"{cell}{tail}" for cell in cells]
    return [f"{plain(one)}: {cell}" for one, cell in zip(p.components, told, strict=True)]


def _known(error: Number | None) -> bool:
    """Whether any of it is."""
    return any(math.isfinite(e) for row in _rows(error) for e in row)


def named_lines(parameter: Parameter, channels: Sequence[str]) -> list[str]:
    """The same with the parameter's name before the first."""
    first, *rest = parameter_lines(parameter, channels)
    own = parameter.components and tuple(parameter.components) != tuple(channels)
    return [f"{parameter_name(parameter)}{',' if own else ''} {first}", *rest]


def largest(parameter: Parameter) -> str:
    """How large a parameter is, in short: of a long list its largest number.

    Example:
        >>> names = ("∂B_x/∂x", "∂B_x/∂y", "∂B_x/∂z", "∂B_z/∂z")
        >>> largest(Parameter("gradient", (0.1, 0.2, 0.3, -1.06), (0.6, 0.3, 0.3, 0.25), "µT/m", names))
        'gradient up to ∂B_z/∂z: −1.06 ± 0.25 µT/m'
    """
    p = parameter
    if len(p.components) < _LONG:
        return f"{parameter_name(p)} {' '.join(measured(p.value, p.standard_error, p.unit))}"
    (sizes,) = ([abs(v) for v in row] for row in _rows(p.value))
    return f"{parameter_name(p)} up to {_listed(p)[sizes.index(max(sizes))]}"


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
        ...     None,
        ...     "",
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
    symbol = unicodedata.normalize("NFC", marked[0]) if marked else "Counted from"
    names = several([one.column for one in finding.references])
    values = ", ".join(f"{size(one.value)} {plain(one.unit)}".rstrip() for one in finding.references)
    means = "the means" if len(finding.references) > 1 else "the mean"
    return f"{symbol}: {means} of {names} over this recording, {values}."


def _cell(value: float, error: float, places: int) -> str:
    if not math.isfinite(value):
        return "not known"
    told = number(value, places)
    return f"{told} ± {error:.{places}f}" if math.isfinite(error) and error > 0 else told


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
        >>> where(replace(finding, onset=61.1, moments=(61.1, 77.8)), clock)
        'anew at 61.1 s and 77.8 s'
        >>> where(replace(finding, onset=6.2, intervals=((8.0, 9.0), (34.0, 37.3)), comes_and_goes=True), clock)
        'first at 6.2 s, then it comes and goes, mainly from 8.0 to 9.0 s and from 34.0 to 37.3 s'
    """
    begins = ""
    if finding.moments:
        begins = f"anew at {_and([clock.moment(moment) for moment in finding.moments])}"
    elif finding.onset is not None:
        moment = clock.moment(finding.onset)
        begins = f"first at {moment}" if finding.comes_and_goes else f"from {moment} on"
    if finding.onset_interval is not None:
        begins += f" (95 %: {clock.interval(*finding.onset_interval)})"
    if finding.comes_and_goes:
        begins += ", then it comes and goes"
    each = [f"from {clock.interval(start, end)}" for start, end in finding.intervals]
    spans = [end - start for start, end in finding.intervals]
    if len(each) > 3:
        mainly = f"mainly in {len(each)} intervals, the longest {each[spans.index(max(spans))]}"
    else:
        mainly = f"mainly {_and(each)}" if each else ""
    return ", ".join(filter(None, [begins, mainly])) or "throughout the recording"


def acts_on(finding: Finding) -> str:
    """The channels that a finding acts on, and whose axes they are; empty where it has none.

    Example:
        >>> finding = Finding("offset_drift", (), ("x", "y", "z"), (), None, "", "", (), 0.01, None, "", (), True, "")
        >>> acts_on(finding)
        "acts on x, y, z, the sensor's axes"
    """
    whose = _AXES.get(finding.channels, "")
    return f"acts on {several(finding.channels)}{whose}" if finding.channels else ""


_AXES: dict[tuple[str, ...], str] = {
    ("x", "y", "z"): ", the sensor's axes",
    ("east", "north", "up"): ", the axes of the world that the attitude turns into, its x, y, z",
}


def _and(each: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(each[:-1]), *each[-1:]]))


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


def better(held_out: HeldOut) -> str:
    """Whether unseen blocks show that the finding makes it better.

    Example:
        >>> better(HeldOut(0.3, (0.2, 0.4), 1.0, 0.8, "µT")), better(HeldOut(0.13, (-0.02, 0.28), 1.0, 0.9, "µT"))
        ('surely better on unseen blocks', 'probably better on unseen blocks, not surely')
    """
    return _BETTER[confirmation(held_out.log_likelihood_gain, held_out.confidence_interval)]


_BETTER = {
    "surely": "surely better on unseen blocks",
    "probably": "probably better on unseen blocks, not surely",
    "not shown": "not shown to be better on unseen blocks",
    "worse": "worse on unseen blocks",
}


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
    if diagnosis.ceiling is not None and _shown(diagnosis):
        rows.append(("with a smooth correction by all recorded columns", diagnosis.ceiling))
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


def with_names(sentence: str, ids: Collection[str]) -> str:
    """A sentence with effects by their names instead of their ids, its numbers as they are printed.

    Example:
        >>> with_names("hard_iron_step: p = 4e-05, by -6.1 µT.", {"hard_iron_step"})
        'hard-iron step: p = 4 × 10⁻⁵, by −6.1 µT.'
    """
    named = re.sub(r"[a-z]\w*", lambda word: words_of(word[0]) if word[0] in ids else word[0], sentence)
    return typeset(named)


def noise_model(noise: Noise) -> str:
    """The noise in words."""
    kind = {"white": "white", "ar": "autoregressive", "random_walk": "random walk"}[noise.model]
    return f"{kind}: {plain(noise.description)}" if noise.description.strip() else f"{kind} noise"


def noise_parameters(noise: Noise, channels: Sequence[str]) -> list[tuple[str, str]]:
    """The numbers of the noise model in words, those of the density once a channel."""
    rows: list[tuple[str, str]] = []
    for name, value in noise.parameters.items():
        unit = noise.units.get(name, "")
        if name == "autoregression":
            rows += _memory(value, channels)
        elif name in _NOISE:
            rows.append((_NOISE[name][0], _NOISE[name][1].format(" ".join(measured(value, None, unit)))))
        else:
            rows.append((plain(name), " ".join(measured(value, None, unit))))
    unit = f" {plain(noise.unit)}" if noise.unit else ""
    density = zip(noise.sigma, noise.d, noise.bound, strict=True)
    for i, (sigma, d, bound) in enumerate(density):
        named = f" of {plain(channels[i])}" if len(noise.sigma) > 1 and i < len(channels) else ""
        rows.append((f"density{named}", f"σ = {bandwidth(sigma)}, d = {size(d)}{unit}, within ±{size(bound)}{unit}"))
    return rows


_NOISE = {
    "wander": ("slow wander of the offset", "{}, its standard deviation over the recording"),
    "wander_period": ("the wander falls off", "below a period of {}"),
}


def _memory(value: Number, channels: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Autoregression coefficients, a row a channel that has some."""
    each = list(value) if isinstance(value, Sequence) else [value]
    for i, one in enumerate(each):
        if not isinstance(one, Sequence) or one:
            named = f" of {plain(channels[i])}" if len(each) > 1 and i < len(channels) else ""
            told = measured(one, None, "")[0].removeprefix("(").removesuffix(")")
            yield f"memory{named}", f"{told} times the samples before it"


def density_check(check: DensityCheck) -> tuple[str, str, str]:
    """How far a channel's density is off, how far a Student-t is, and what that says.

    Example:
        >>> density_check(DensityCheck("norm", 0.021, 0.034, 4.0, 0.05, False))
        ('0.021', '0.034 (4 degrees of freedom)', 'no more than chance')
    """
    said = "a Student-t is closer" if check.closer else "no more than chance"
    if not check.closer and check.distance > check.allowed:
        said = "the density is off, and a Student-t clearly no better"
    freedom = f"{check.degrees_of_freedom:g} degree{'' if check.degrees_of_freedom == 1 else 's'} of freedom"
    return f"{check.distance:.2g}", f"{check.student_distance:.2g} ({freedom})", said


def channel_notes(channels: Sequence[str]) -> str:
    """What a magnetometer's channels are called; empty for others."""
    return "; ".join(note for name, note in _CHANNELS.items() if name in channels)


_CHANNELS = {
    "norm": "norm: the length of the field, less what the simulation has for it",
    "along": "along: the part of the residual along the ambient field, which its length shows too",
    "across_1": "across_1 and across_2: the two parts at right angles to it, which errors of the attitude enter",
}


def smooth_fit(diagnosis: Diagnosis) -> str:
    """How far a smooth correction by all columns comes, beside the residual; empty where what was found is better."""
    d = diagnosis
    if d.ceiling is None or not _shown(d):
        return ""
    unit = plain(d.traces.unit)
    reached = f"a smooth correction by all recorded columns and by time reaches {size(d.ceiling.rmse)} {unit}".rstrip()
    with_it = "with the findings it is" if d.findings else "the residual is"
    return f"{reached}; {with_it} {size(d.corrected.rmse)} {unit}".rstrip()


def _shown(diagnosis: Diagnosis) -> bool:
    """Whether the smooth correction says something that the findings do not."""
    d = diagnosis
    return d.ceiling is not None and (not d.findings or d.ceiling.rmse < _CLEARLY * d.corrected.rmse)


def behind(candidate: Candidate) -> str:
    """How far a candidate is behind the first one, in nats.

    Example:
        >>> behind(Candidate("hard_iron_step", (), "", 72.3, 12.0, behind=30.25))
        '30.2'
    """
    return size(candidate.behind) if math.isfinite(candidate.behind) else "not possible"


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
