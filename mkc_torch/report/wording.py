"""Results in words and figures, the same in the terminal and on a page."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch.calibration import Calibration, Spread
from mkc_torch.disturbance import Interval

_MOST_DECIMALS = 6


def decimals(step: float) -> int:
    """Decimals that show two digits of a standard error, or three where it is not known.

    Example:
        >>> decimals(0.083), decimals(12.0), decimals(0.0)
        (3, 0, 3)
    """
    if not (math.isfinite(step) and step > 0):
        return 3
    return min(max(1 - math.floor(math.log10(step)), 0), _MOST_DECIMALS)


def number(value: float, places: int) -> str:
    """A number with a true minus sign, and no minus before a zero.

    Example:
        >>> number(-1.25, 1), number(-0.01, 1)
        ('−1.2', '0.0')
    """
    text = f"{value:.{places}f}"
    return text.replace("-", "−") if float(text) != 0 else text.lstrip("-")


def with_error(value: float, error: float) -> str:
    """A value with its standard error, to the digits that the error leaves.

    Example:
        >>> with_error(-0.89431, 0.085), with_error(1.5, math.nan)
        ('−0.894 ± 0.085', '1.500')
    """
    places = decimals(error)
    if not math.isfinite(error):
        return number(value, places)
    return f"{number(value, places)} ± {error:.{places}f}"


def size(value: float) -> str:
    """A size to three digits.

    Example:
        >>> size(28.62), size(0.2837), size(758.09), size(0.0)
        ('28.6', '0.284', '758', '0')
    """
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    places = max(2 - math.floor(math.log10(abs(value))), 0)
    return number(value, places) if places <= 6 else f"{value:.2e}"


def listed(values: Sequence[float], errors: Sequence[float]) -> str:
    """Values side by side, to the digits their errors leave.

    Example:
        >>> listed((1.234, -2.0, 0.5), (0.1, 0.1, 0.1))
        '1.23, −2.00, 0.50'
    """
    return ", ".join(number(v, decimals(e)) for v, e in zip(values, errors, strict=True))


def share(value: float) -> str:
    """A share in per cent.

    Example:
        >>> share(0.0474), share(0.0), share(0.0004), share(0.45)
        ('4.7 %', '0 %', '< 0.1 %', '45 %')
    """
    if 0 < value < 0.001:
        return "< 0.1 %"
    return f"{100 * value:.{0 if value == 0 or value >= 0.0995 else 1}f} %"


def change(before: Spread, after: Spread, unit: str) -> str:
    """The robust residual before and after."""
    return f"{size(before.robust)} → {size(after.robust)} {unit}".rstrip()


def bandwidth(sigma: float) -> str:
    """σ, "∞" where the density is Gaussian."""
    return "∞" if math.isinf(sigma) else f"{sigma:.2f}"


def when(intervals: Sequence[Interval]) -> str:
    """Intervals of time as one phrase; empty where there are none.

    Example:
        >>> when([Interval(12.13, 15.3)])
        'between 12.1 s and 15.3 s'
        >>> when([Interval(0, 1), Interval(5, 5.5), Interval(9, 9.5), Interval(20, 24)])
        'in 4 intervals, the longest from 20.0 s to 24.0 s'
    """
    if not intervals:
        return ""
    if len(intervals) <= 3:
        each = [f"between {i.start:.1f} s and {i.end:.1f} s" for i in intervals]
        return ", ".join(each[:-1]) + (" and " if len(each) > 1 else "") + each[-1]
    longest = max(intervals, key=lambda i: i.end - i.start)
    return f"in {len(intervals)} intervals, the longest from {longest.start:.1f} s to {longest.end:.1f} s"


def rejection(calibration: Calibration) -> str:
    """What was rejected, and when, as a sentence.

    The samples that stand in no interval are few, or scattered; "most" or "many" says so.
    """
    c = calibration
    if c.rejected == 0:
        return f"None of the {c.samples:,} samples was rejected."
    told = f"{share(c.rejected_share)} of the {c.samples:,} samples {'was' if c.rejected == 1 else 'were'} rejected"
    return f"{told}, mainly {when(c.disturbed)}." if c.disturbed else f"{told}, scattered over the recording."


def headline(calibration: Calibration) -> list[str]:
    """The result in three sentences."""
    c = calibration
    return [
        f"Offset ({listed(c.center, c.center_se)}) {c.unit}, semi-axes {listed(c.semi_axes, c.semi_axes_se)} {c.unit}.",
        f"The length of the field scatters by {size(c.after.robust)} {c.unit}; before, by {size(c.before.robust)} "
        f"{c.unit}.",
        rejection(c),
    ]


def python_code(calibration: Calibration) -> str:
    """Lines that correct measurements, for pasting into a program with numpy."""
    c = calibration
    rows = ",\n".join(f"    [{', '.join(f'{v:.9g}' for v in row)}]" for row in c.matrix)
    return (
        f"import numpy as np\n\noffset = np.array([{', '.join(f'{v:.9g}' for v in c.center)}])  # {c.unit}\n"
        f"matrix = np.array([\n{rows},\n])\n\n"
        f"field = (measured - offset) @ matrix.T  # {c.field_unit}, |field| = {size(c.field_strength)}"
    )


def c_code(calibration: Calibration) -> str:
    """The same for C."""
    c = calibration
    rows = ",\n".join("    {" + ", ".join(_c_number(v) for v in row) + "}" for row in c.matrix)
    offset = ", ".join(_c_number(v) for v in c.center)
    return (
        f"static const float mag_offset[3] = {{{offset}}}; /* {c.unit} */\n"
        f"static const float mag_matrix[3][3] = {{\n{rows}\n}};\n\n"
        f"/* field[i] in {c.field_unit} */\n"
        "for (int i = 0; i < 3; i++) {\n    field[i] = 0.0f;\n    for (int j = 0; j < 3; j++)\n"
        "        field[i] += mag_matrix[i][j] * (measured[j] - mag_offset[j]);\n}"
    )


def _c_number(value: float) -> str:
    text = f"{value:.9g}"
    return text + ("f" if "." in text or "e" in text else ".0f")
