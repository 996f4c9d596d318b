"""Format times, parameters with standard errors, p-values and gains."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from mkc_torch._support.typesetting import plain, superscript
from mkc_torch.diagnosis.environment import Curve
from mkc_torch.diagnosis.parts import SizeAtInput
from mkc_torch.diagnosis.result import CandidateScore, EffectParameter, HeldOut, Number, Traces
from mkc_torch.report.words.numbers import decimals, number, share, size

_FEWEST_LARGE = 1e6
"""Smallest size that is written with a power of ten."""

_MOST_SMALL = 1e-3
"""Size below which a number is written with a power of ten."""

_MOST_PLACES = 9
"""Most decimals of an interval."""

_MOST_NUMBERS = 12
_CURVE_VALUES = 5
"""Number of values that are stated of a curve."""

_NORMAL_95 = 1.959964
"""Half-width of a 95 % interval in standard errors."""

_LONG = 4
"""Length from which only the largest number of a list is shown."""


@dataclass(frozen=True)
class TimeFormat:
    """Format of times: in s with ``places`` decimals, or as sample numbers."""

    places: int
    has_time: bool

    def moment(self, value: float) -> str:
        """Format a time.

        Example:
            >>> TimeFormat(1, has_time=True).moment(41.32), TimeFormat(0, has_time=False).moment(812.0)
            ('41.3 s', 'sample 812')
        """
        if self.has_time:
            return f"{number(value, self.places)} s"
        return f"sample {number(value, 0)}"

    def interval(self, start: float, end: float) -> str:
        """Format an interval.

        Example:
            >>> TimeFormat(1, has_time=True).interval(12.0, 18.44), TimeFormat(0, has_time=False).interval(3.0, 9.0)
            ('12.0 to 18.4 s', 'sample 3 to 9')
        """
        if self.has_time:
            return f"{number(start, self.places)} to {number(end, self.places)} s"
        return f"sample {number(start, 0)} to {number(end, 0)}"


def clock_of(traces: Traces) -> TimeFormat:
    """Return a format with a resolution of about a thousandth of the recording."""
    known = traces.time[traces.time.isfinite()]
    span = float(known.max() - known.min()) if traces.has_time and len(known) else 0.0
    digits = max(2 - math.floor(math.log10(span)), int(span < 1000.0)) if span > 0 else 1
    return TimeFormat(min(max(digits, 0), 6), traces.has_time)


def measured(value: Number, error: Number | None, unit: str) -> list[str]:
    """Format a parameter with its standard error, to two digits of the error, one line per row of a matrix.

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
        row_errors = errors[i] if i < len(errors) and len(errors[i]) == len(row) else [math.nan] * len(row)
        cells = [digits.cell(v, e) for v, e in zip(row, row_errors, strict=True)]
        rest = len(cells) - _MOST_NUMBERS
        text = ", ".join(cells[:_MOST_NUMBERS])
        if rest > 0:
            text = f"{text}, … {rest} more"
        bare = isinstance(value, (int, float)) and not (digits.power and "±" in text)
        lines.append((text if bare else f"({text})") + digits.factor + (f" {plain(unit)}" if unit else ""))
    more = len(rows) - _MOST_NUMBERS
    return [*lines, f"… {more} more rows"] if more > 0 else lines


@dataclass(frozen=True)
class _Digits:
    """Common power of ten of a list, and the decimals after it."""

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
        """Format a number with its error, without the power of ten."""
        if not math.isfinite(value):
            return "unknown"
        text, scale = number(value / 10.0**self.power, self.places), 10.0**self.power
        return f"{text} ± {error / scale:.{self.places}f}" if math.isfinite(error) and error > 0 else text


def _three_digits(value: float) -> int:
    return max(2 - math.floor(math.log10(value)), 0) if value > 0 else 0


def _rows(value: Number | None) -> Iterator[list[float]]:
    """Yield the rows of a scalar, vector or matrix; None is NaN."""
    if value is None:
        yield [math.nan]
    elif isinstance(value, (int, float)):
        yield [float(value)]
    elif any(isinstance(v, Sequence) for v in value):
        for v in value:
            yield from _rows(v)
    else:
        yield [cell for v in value for row in _rows(v) for cell in row]


def parameter_name(parameter: EffectParameter) -> str:
    """Return a parameter's name in words.

    Example:
        >>> parameter_name(EffectParameter("field_per_ampere", 1.0, None, "µT/A"))
        'field per ampere'
    """
    name = plain(parameter.name)
    curve = re.fullmatch(r"legendre_(\d+)", name)
    return f"amplitude of P{_lowered(curve[1])}" if curve else name.replace("_", " ")


def _lowered(digits: str) -> str:
    return digits.translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def parameter_lines(parameter: EffectParameter, channels: Sequence[str]) -> list[str]:
    """Format a parameter with :func:`measured`; with components other than the channels, one line per number.

    Example:
        >>> parameter_lines(EffectParameter("k", (1.0, 2.0), (0.1, 0.1), "µT", ("x", "y")), ("x", "y"))
        ['(1.00 ± 0.10, 2.00 ± 0.10) µT']
        >>> parameter_lines(
        ...     EffectParameter("jumps", (11.2, -1.2), (4.4, 0.6), "°", ("at 61.1 s", "at 103.2 s")), ("heading",)
        ... )
        ['at 61.1 s: 11.2 ± 4.4 °', 'at 103.2 s: −1.2 ± 0.6 °']
        >>> parameter_lines(EffectParameter("lag", 1.5, None, "s"), ("x",))
        ['1.50 s, standard error not estimated']
    """
    p = parameter
    if not p.components or tuple(p.components) == tuple(channels):
        lines = measured(p.value, p.standard_error, p.unit)
        return lines if _known(p.standard_error) else [*lines[:-1], f"{lines[-1]}, standard error not estimated"]
    each = _listed(p)
    return each if _known(p.standard_error) else [*each, "standard error not estimated"]


def _listed(parameter: EffectParameter) -> list[str]:
    """Format each number of a list with its component name, in common digits and a common power of ten."""
    p = parameter
    (values,) = _rows(p.value)
    errors = next(_rows(p.standard_error)) if isinstance(p.standard_error, Sequence) else [math.nan] * len(values)
    digits = _Digits.of([values], [errors])
    cells = [digits.cell(v, e) for v, e in zip(values, errors, strict=True)]
    tail = digits.factor + (f" {plain(p.unit)}" if p.unit else "")
    sentences = [f"({cell}){tail}" if digits.power and "±" in cell else f"{cell}{tail}" for cell in cells]
    return [f"{plain(component)}: {cell}" for component, cell in zip(p.components, sentences, strict=True)]


def _known(error: Number | None) -> bool:
    """Whether any error is known."""
    return any(math.isfinite(e) for row in _rows(error) for e in row)


def named_lines(parameter: EffectParameter, channels: Sequence[str]) -> list[str]:
    """Return :func:`parameter_lines` with the parameter's name in the first line."""
    first, *rest = parameter_lines(parameter, channels)
    own = parameter.components and tuple(parameter.components) != tuple(channels)
    return [f"{parameter_name(parameter)}{',' if own else ''} {first}", *rest]


def largest(parameter: EffectParameter) -> str:
    """Format a parameter; of a long list only the largest number.

    Example:
        >>> names = ("∂B_x/∂x", "∂B_x/∂y", "∂B_x/∂z", "∂B_z/∂z")
        >>> largest(EffectParameter("gradient", (0.1, 0.2, 0.3, -1.06), (0.6, 0.3, 0.3, 0.25), "µT/m", names))
        'gradient, largest ∂B_z/∂z: −1.06 ± 0.25 µT/m'
    """
    p = parameter
    if len(p.components) < _LONG:
        return f"{parameter_name(p)} {' '.join(measured(p.value, p.standard_error, p.unit))}"
    (sizes,) = ([abs(v) for v in row] for row in _rows(p.value))
    return f"{parameter_name(p)}, largest {_listed(p)[sizes.index(max(sizes))]}"


def curve_lines(curve: Curve) -> list[str]:
    """Return values of a curve with standard errors, at places where the recording has samples.

    The coefficients of a curve are no values of it: outside the samples they can be of any size.

    Example:
        >>> x = torch.linspace(0.0, 2.0, 5)
        >>> value = torch.stack([x, torch.tensor([0.0, 0.0, math.nan, 0.0, 0.0])], -1).sum(-1, keepdim=True)
        >>> curve_lines(Curve("level", "m", x, value, torch.full_like(value, 0.0196), ("rate of level",), "m/s"))[:2]
        ['at level 0 m: 0.000 ± 0.010 m/s', 'at level 0.500 m: 0.500 ± 0.010 m/s']
    """
    seen = curve.value.isfinite().all(-1).nonzero().squeeze(-1)
    chosen = seen[torch.linspace(0, len(seen) - 1, min(_CURVE_VALUES, len(seen))).round().long()].tolist()
    lines = []
    for k in chosen:
        value, error = (tuple(values[k].tolist()) for values in (curve.value, curve.band / _NORMAL_95))
        place = f"{plain(curve.driver)} {size(float(curve.x[k]))} {plain(curve.unit)}".rstrip()
        one = len(value) == 1
        text = measured(value[0] if one else value, error[0] if one else error, curve.value_unit)
        lines.append(f"at {place}: {' '.join(text)}")
    return lines


def at_input(size: SizeAtInput | None) -> str:
    """Format the size of an effect in the unit of the input that moves its rate; empty for an unknown size.

    Example:
        >>> at_input(SizeAtInput("torque", (EffectParameter("friction", 0.0497, 0.0003, "N m"),)))
        'the same as friction 0.04970 ± 0.00030 N m at the input torque'
    """
    if size is None:
        return ""
    return f"the same as {'; '.join(largest(p) for p in size.parameters)} at the input {plain(size.input)}"


def probability(value: float) -> str:
    """Format a p-value to two digits.

    Example:
        >>> probability(0.005), probability(0.3712), probability(2e-7)
        ('p = 0.005', 'p = 0.37', 'p < 0.0001')
    """
    return f"p = {value:.2g}" if value >= 1e-4 else "p < 0.0001"


def evidence(value: float | None, surrogates: int) -> str:
    """Format a p-value; the smallest possible with this number of surrogates is an upper limit. None is unknown.

    Example:
        >>> evidence(0.005, 199), evidence(0.02, 199), evidence(None, 0)
        ('p = 0.005 or less', 'p = 0.02', 'unknown: no p-value was computed')
    """
    if value is None:
        return "unknown: no p-value was computed"
    if not _least(value, surrogates):
        return probability(value)
    return f"{probability(value)} or less"


def _least(value: float, surrogates: int) -> bool:
    return surrogates > 0 and value <= (1.0 + 1e-9) / (1 + surrogates)


def gain(held_out: HeldOut) -> str:
    """Format the gain on held-out data with its interval, to the digits of the interval.

    Example:
        >>> gain(HeldOut(0.3124, (0.2811, 0.3502), 0.9, 0.5, "µT"))
        '+0.312 nats per sample (95 %: 0.281 to 0.350)'
        >>> gain(HeldOut(0.25, (0.004, 0.5), 0.9, 0.5, "µT"))
        '+0.250 nats per sample (95 %: 0.004 to 0.500)'
    """
    value, (low, high) = held_out.log_likelihood_gain, held_out.confidence_interval
    known = math.isfinite(low) and math.isfinite(high)
    places = decimals(0.25 * (high - low)) if known and high > low else 3
    while known and places < _MOST_PLACES and any(end and float(f"{end:.{places}f}") == 0.0 for end in (low, high)):
        places += 1  # an end beyond 0 is not shown as 0
    text = number(value, places)
    signed = text if text.startswith("−") else f"+{text}"
    if not known:
        return f"{signed} nats per sample (unknown interval)"
    return f"{signed} nats per sample (95 %: {number(low, places)} to {number(high, places)})"


def improvement(before: float, after: float, unit: str) -> str:
    """Format a residual before and after.

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
    text = ("{change} less" if less > 0 else "{change} more").format(change=share(abs(less)))
    return f"{sizes} ({text})"


def behind(candidate: CandidateScore) -> str:
    """Format the penalised gap of a candidate to the first, in nats.

    Example:
        >>> behind(CandidateScore("hard_iron_step", (), "", 72.3, 12.0, behind=30.25))
        '30.2'
    """
    return size(candidate.behind) if math.isfinite(candidate.behind) else "not possible"
