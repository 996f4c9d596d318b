"""Format numbers and calibrations, for the terminal and the page."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch.calibration.result import Calibration, ResidualSpread, RestBias
from mkc_torch.density.tails import percent_with_error
from mkc_torch.recording.disturbance import RejectedInterval

_MOST_DECIMALS = 9
_LEAST, _MOST = 0.01, 1e6
"""Range of sizes that are written without a power of ten."""

_MILLION = math.log(1e6)
"""Gain in nats above which the ratio of the likelihoods is not stated in digits."""

_AS_LIKELY = 0.05
"""Gain in nats below which two models are as likely."""

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def decimals(step: float) -> int:
    """Return the decimals that show two digits of a standard error; 3 if the error is unknown.

    Example:
        >>> decimals(0.083), decimals(12.0), decimals(0.0)
        (3, 0, 3)
    """
    if not (math.isfinite(step) and step > 0):
        return 3
    return min(max(1 - math.floor(math.log10(step)), 0), _MOST_DECIMALS)


def number(value: float, places: int) -> str:
    """Format a number with a true minus sign, without a minus before zero.

    Example:
        >>> number(-1.25, 1), number(-0.01, 1)
        ('−1.2', '0.0')
    """
    text = f"{value:.{places}f}"
    return text.replace("-", "−") if float(text) != 0 else text.lstrip("-")


def power(largest: float) -> int:
    """Return the power of ten, a multiple of three, for numbers of this size; 0 for usual sizes.

    Example:
        >>> power(46.2), power(4.6e-5), power(4.6e31)
        (0, -6, 30)
    """
    if largest == 0 or _LEAST <= largest < _MOST or not math.isfinite(largest):
        return 0
    return 3 * math.floor(math.log10(largest) / 3.0)


def in_power(exponent: int, unit: str) -> str:
    """Format a unit with a power of ten.

    Example:
        >>> in_power(-6, "T"), in_power(0, "µT")
        ('10⁻⁶ T', 'µT')
    """
    return f"10{str(exponent).translate(_RAISED)} {unit}".rstrip() if exponent else unit


def with_errors(values: Sequence[float], errors: Sequence[float], exponent: int = 0) -> list[str]:
    """Format values with standard errors, to two digits of the largest error, in a power of ten.

    Example:
        >>> with_errors((-0.89431, 44.2), (0.085, 0.0925)), with_errors((1.5,), (math.nan,))
        (['−0.894 ± 0.085', '44.200 ± 0.092'], ['1.500'])
        >>> with_errors((1.1984e-05,), (1.1e-08,), -6), with_errors((1.0,), (1e-15,))
        (['11.984 ± 0.011'], ['1.000000000 ± 1.0e-15'])
    """
    return matrix_with_errors([values], [errors], exponent)[0]


def matrix_with_errors(
    matrix: Sequence[Sequence[float]], errors: Sequence[Sequence[float]], exponent: int = 0
) -> list[list[str]]:
    """Format the rows of a matrix with standard errors, to the same digits, in a power of ten."""
    scale = 10.0**exponent
    known = [e for row in errors for e in row if math.isfinite(e)]
    places = decimals(max(known, default=math.nan) / scale)
    return [
        [_with_error(v / scale, e / scale, places) for v, e in zip(row, error, strict=True)]
        for row, error in zip(matrix, errors, strict=True)
    ]


def _with_error(value: float, error: float, places: int) -> str:
    if not math.isfinite(error):
        return number(value, places)
    text = f"{error:.{places}f}"
    return f"{number(value, places)} ± {text if float(text) > 0 or error == 0 else f'{error:.1e}'}"


def size(value: float) -> str:
    """Format a size to three digits.

    Example:
        >>> size(28.62), size(0.2837), size(758.09), size(0.0), size(4.6e31)
        ('28.6', '0.284', '758', '0', '4.60e+31')
    """
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    places = max(2 - math.floor(math.log10(abs(value))), 0)
    return number(value, places) if places <= 6 and abs(value) < 1e9 else f"{value:.2e}"


def listed(values: Sequence[float], errors: Sequence[float], exponent: int = 0) -> str:
    """Format a list of values, to two digits of the largest error, in a power of ten.

    Example:
        >>> listed((1.234, -2.0, 0.5), (0.1, 0.1, 0.1))
        '1.23, −2.00, 0.50'
    """
    scale = 10.0**exponent
    return ", ".join(
        number(v / scale, decimals(max(filter(math.isfinite, errors), default=math.nan) / scale)) for v in values
    )


def factor(log_likelihood_gain: float) -> str:
    """Format a gain of log-likelihood as the ratio of the likelihoods.

    Example:
        >>> factor(0.0), factor(1.3), factor(5.0), factor(311.0)
        ('nothing', 'a factor of 3.7', 'a factor of 150', 'a factor of more than a million')
    """
    if log_likelihood_gain < _AS_LIKELY:
        return "nothing"
    if log_likelihood_gain > _MILLION:
        return "a factor of more than a million"
    return f"a factor of {float(f'{math.exp(log_likelihood_gain):.2g}'):,g}"


def share(value: float) -> str:
    """Format a share in per cent; only exact 0 and 1 are written as 0 % and 100 %.

    Example:
        >>> share(0.0474), share(0.0), share(0.0004), share(0.45), share(0.9985), share(0.9999)
        ('4.7 %', '0 %', '< 0.1 %', '45 %', '99.9 %', '> 99.9 %')
    """
    if 0 < value < 0.001:
        return "< 0.1 %"
    if 0.999 < value < 1:
        return "> 99.9 %"
    return f"{100 * value:.{1 if 0 < value < 0.0995 or 0.99 < value < 1 else 0}f} %"


def change(before: ResidualSpread, after: ResidualSpread, unit: str) -> str:
    """Format the robust residual before and after."""
    return f"{size(before.robust)} → {size(after.robust)} {unit}".rstrip()


def bandwidth(sigma: float) -> str:
    """Format σ; "∞" for a Gaussian."""
    return "∞" if math.isinf(sigma) else f"{sigma:.2f}"


def noise(calibration: Calibration) -> str:
    """Format the noise along the field in the recording's unit: Gaussian, or the share of residuals in the tail.

    To first order, the algebraic residual is twice the relative error of the length.
    """
    c = calibration
    if c.tails is None:
        kind = f"σ = {bandwidth(c.sigma)}"
    elif c.tails.is_gaussian:
        kind = "Gaussian"
    else:
        share = percent_with_error(c.tails.share_beyond, c.tails.share_error)
        kind = f"heavy-tailed: {share} of the residuals beyond three times that (0.27 % if Gaussian)"
    return f"{size(0.5 * c.radius * c.d)} {c.unit} along the field, {kind}"


def when(intervals: Sequence[RejectedInterval], unit: str = "s") -> str:
    """Format intervals of time or of rows; empty if there are none.

    Example:
        >>> when([RejectedInterval(12.13, 15.3)]), when([RejectedInterval(0, 1), RejectedInterval(5, 5.5)])
        ('between 12.1 s and 15.3 s', 'from 0.0 to 1.0 s and from 5.0 to 5.5 s')
        >>> when([RejectedInterval(0, 1), RejectedInterval(5, 5.5), RejectedInterval(9, 9.5), RejectedInterval(20, 24)])
        'in 4 intervals, the longest from 20.0 to 24.0 s'
        >>> when([RejectedInterval(101, 140)], "row")
        'between row 101 and row 140'
    """
    rows = unit == "row"
    ends = [tuple(f"{end:.0f}" if rows else f"{end:.1f}" for end in interval) for interval in intervals]
    if len(intervals) == 1:
        return ("between row {start} and row {end}" if rows else "between {start} s and {end} s").format(
            start=ends[0][0], end=ends[0][1]
        )
    name = "row {start} to {end}" if rows else "{start} to {end} s"
    spans = [name.format(start=start, end=end) for start, end in ends]
    each = [f"from {span}" for span in spans]
    if len(intervals) > 3:
        longest = max(range(len(each)), key=lambda k: intervals[k].end - intervals[k].start)
        return f"in {len(each)} intervals, the longest {each[longest]}"
    return " and ".join(filter(None, [", ".join(each[:-1]), *each[-1:]]))


def rejection(calibration: Calibration) -> str:
    """Return the share of rejected samples and their intervals."""
    c = calibration
    if c.rejected == 0:
        return f"No sample of {c.samples:,} was rejected."
    key = (
        "{share} of the {samples} samples was rejected"
        if c.rejected == 1
        else "{share} of the {samples} samples were rejected"
    )
    text = key.format(share=share(c.rejected_share), samples=f"{c.samples:,}")
    if c.disturbed:
        return f"{text}, mainly {when(c.disturbed, c.disturbed_unit)}."
    return f"{text}, scattered over the recording."


def rest_bias(found: RestBias) -> str:
    """Format a gyroscope's bias from rest."""
    bias = ", ".join(with_errors(found.value, found.standard_error))
    return f"bias ({bias}) rad/s, from {size(found.seconds)} s of rest"


_RESPONSES = {"offset": "offset alone", "offset and scale": "offset and scale", "full matrix": "offset and full matrix"}
"""Keys of the responses of an aided calibration."""


def aided(calibration: Calibration) -> list[str]:
    """Return sentences on an aided calibration; empty for a calibration by the ellipsoid."""
    aid = calibration.aid
    if aid is None:
        return []
    rivals = [
        (
            "{response}: less likely by {nats} nats"
            if value <= 0.0
            else "{response}: more likely by {nats} nats, not significant"
        ).format(response=_RESPONSES[name], nats=f"{abs(value):.0f}")
        for name, value in aid.evidence
        if name != aid.response
    ]
    sentences = [f"By the {aid.by}: {_RESPONSES[aid.response]} ({'; '.join(rivals)})."]
    if math.isinf(aid.constant_error):
        sentences.append(
            f"Heading error: ± {size(aid.heading_error)}° variable, if the axes are the vehicle's. A "
            "constant heading offset cannot be observed."
        )
    else:
        sentences.append(
            f"Heading error: ± {size(aid.heading_error)}° variable, ± {size(aid.constant_error)}° constant."
        )
    # the bias at rest is measured; that of the fit also absorbs errors of the turns, and would contradict it
    if calibration.rest_bias is None and aid.gyro_bias is not None and aid.gyro_bias_se is not None:
        sentences.append(f"Gyroscope bias ({listed(aid.gyro_bias, aid.gyro_bias_se)}) rad/s.")
    return sentences


def headline(calibration: Calibration) -> list[str]:
    """Return the result in three sentences."""
    c = calibration
    exponent = power(c.radius)
    unit = f"× {in_power(exponent, c.unit)}" if exponent else c.unit
    return [
        (
            f"Offset ({listed(c.center, c.center_se, exponent)}) {unit}, semi-axes "
            f"({listed(c.semi_axes, c.semi_axes_se, exponent)}) {unit}."
        ),
        (
            f"The scatter of the field's length is {size(c.after.robust)} {c.unit}; before calibration "
            f"{size(c.before.robust)} {c.unit}."
        ),
        rejection(c),
    ]


def python_code(calibration: Calibration) -> str:
    """Return NumPy code that corrects measurements."""
    c = calibration
    rows = ",\n".join(f"    [{', '.join(f'{v:.8g}' for v in row)}]" for row in c.matrix)
    return (
        f"import numpy as np\n\noffset = np.array([{', '.join(f'{v:.8g}' for v in c.center)}])  # {c.unit}\n"
        f"matrix = np.array([\n{rows},\n])\n\n"
        f"field = (measured - offset) @ matrix.T  # {c.field_unit}, |field| = {size(c.field_strength)}"
    )


def c_code(calibration: Calibration) -> str:
    """Return C code that corrects measurements."""
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
    text = f"{value:.8g}"
    return text + ("f" if "." in text or "e" in text else ".0f")
