"""Comparison of two calibrations, for the terminal and the page."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch.calibration.differences import LEVEL, Difference, Differences
from mkc_torch.report.words.numbers import decimals, in_power, number, power, share, size, with_errors

_NAMED = 3
_ROUNDING = 9


def difference_rows(found: Differences) -> list[tuple[str, str, str, str, str]]:
    """Return rows of name, new value, old value, difference with error, and difference in standard errors.

    Example:
        >>> difference = Difference("offset x", "µT", 12.5, 12.0, 0.25)
        >>> difference_rows(Differences("old", (difference,), 3.26, 100, 0.5, 0.2, 0.3, 0.1, "µT"))
        [('offset x, µT', '12.50', '12.00', '0.50 ± 0.25', '+2.0')]
    """
    return [row for group in _groups(found.numbers) for row in _rows(group)]


def difference_sentences(found: Differences) -> list[str]:
    """State whether two calibrations differ significantly, and how their corrected fields differ.

    Example:
        >>> difference = Difference("offset x", "µT", 12.5, 12.0, 0.25)
        >>> difference_sentences(Differences("old", (difference,), 3.26, 100, 0.5, 0.2, 0.3, 0.1, "µT"))[0].partition(
        ...     ","
        ... )
        ('No significant difference: offset x differs most', ',', ' by +2.0 combined standard errors ...')
    """
    length_max = f"{size(found.length_max)} {found.unit}".rstrip()
    length_rms = f"{size(found.length_rms)} {found.unit}".rstrip()
    # smaller differences are rounding errors
    angle_max, angle_rms = (size(round(angle, _ROUNDING)) for angle in (found.angle_max, found.angle_rms))
    return [
        _verdict(found),
        f"Over the directions of the {found.samples:,} samples in use, the corrected fields differ by at most "
        f"{angle_max}° and {length_max}; {angle_rms}° and {length_rms} rms.",
    ]


def _verdict(found: Differences) -> str:
    if not found.known:
        return "The difference cannot be tested: a calibration has no standard errors."
    if not found.beyond:
        largest = max(found.known, key=lambda difference: abs(difference.in_errors))
        return (
            f"No significant difference: {largest.name} differs most, by {_signed(largest.in_errors)} "
            f"combined standard errors (limit {found.limit:.2f})."
        )
    named = [
        f"{difference.name} by {_signed(difference.in_errors)} combined standard errors"
        for difference in found.beyond[:_NAMED]
    ]
    if len(found.beyond) > _NAMED:
        named.append(f"and {len(found.beyond) - _NAMED} more")
    return (
        f"Significant difference: {', '.join(named)}. In an unchanged sensor, a number exceeds "
        f"{found.limit:.2f} in at most {share(LEVEL)} of cases."
    )


def _groups(numbers: Sequence[Difference]) -> list[list[Difference]]:
    """Group offset and matrix; each has a common power of ten."""
    groups: dict[str, list[Difference]] = {}
    for difference in numbers:
        groups.setdefault(difference.name.split()[0], []).append(difference)
    return list(groups.values())


def _rows(group: Sequence[Difference]) -> list[tuple[str, str, str, str, str]]:
    exponent = power(max(abs(difference.new) for difference in group))
    scale = 10.0**exponent
    rows = []
    for difference in group:
        places = decimals(difference.error / scale)
        unit = in_power(exponent, difference.unit)
        rows.append(
            (
                f"{difference.name}, {unit}" if unit else difference.name,
                number(difference.new / scale, places),
                number(difference.old / scale, places),
                with_errors([difference.new - difference.old], [difference.error], exponent)[0],
                _signed(difference.in_errors),
            )
        )
    return rows


def _signed(value: float) -> str:
    if math.isnan(value):
        return "?"
    text = size(abs(value)) if abs(value) >= 100 else f"{abs(value):.1f}"
    return text if float(f"{value:.1f}") == 0 else f"{'+' if value > 0 else '−'}{text}"
