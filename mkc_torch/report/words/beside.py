"""A calibration beside an older one in words and figures, the same in the terminal and on a page."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch._words.terms import term
from mkc_torch.calibration.differences import LEVEL, Difference, Differences
from mkc_torch.report.words.numbers import decimals, in_power, number, power, share, size, with_errors

__all__ = ["difference_rows", "difference_sentences"]

_NAMED = 3
_ROUNDING = 9


def difference_rows(found: Differences) -> list[tuple[str, str, str, str, str]]:
    """Lines of a table: what it is, the new and the old value, the difference with its error, and that in errors.

    Example:
        >>> one = Difference("offset x", "µT", 12.5, 12.0, 0.25)
        >>> difference_rows(Differences("old", (one,), 3.26, 100, 0.5, 0.2, 0.3, 0.1, "µT"))
        [('offset x, µT', '12.50', '12.00', '0.50 ± 0.25', '+2.0')]
    """
    return [row for group in _groups(found.numbers) for row in _rows(group)]


def difference_sentences(found: Differences) -> list[str]:
    """Whether the two are the same within errors, and what becomes of the field.

    Example:
        >>> one = Difference("offset x", "µT", 12.5, 12.0, 0.25)
        >>> difference_sentences(Differences("old", (one,), 3.26, 100, 0.5, 0.2, 0.3, 0.1, "µT"))[0].partition(",")
        ('The same within errors: offset x differs most', ',', ' by +2.0 combined standard errors, ...')
    """
    return [
        _verdict(found),
        term(
            "beside.field",
            samples=f"{found.samples:,}",
            # below is rounding, not a difference
            angle_max=size(round(found.angle_max, _ROUNDING)),
            angle_rms=size(round(found.angle_rms, _ROUNDING)),
            length_max=f"{size(found.length_max)} {found.unit}".rstrip(),
            length_rms=f"{size(found.length_rms)} {found.unit}".rstrip(),
        ),
    ]


def _verdict(found: Differences) -> str:
    if not found.known:
        return term("beside.unknown")
    if not found.beyond:
        largest = max(found.known, key=lambda one: abs(one.in_errors))
        return term("beside.same", what=largest.name, errors=_signed(largest.in_errors), limit=f"{found.limit:.2f}")
    named = [term("beside.one", what=one.name, errors=_signed(one.in_errors)) for one in found.beyond[:_NAMED]]
    if len(found.beyond) > _NAMED:
        named.append(term("beside.more", count=len(found.beyond) - _NAMED))
    return term("beside.differs", what=", ".join(named), limit=f"{found.limit:.2f}", level=share(LEVEL))


def _groups(numbers: Sequence[Difference]) -> list[list[Difference]]:
    """The offset, and the matrix: each in one power of ten."""
    groups: dict[str, list[Difference]] = {}
    for one in numbers:
        groups.setdefault(one.name.split()[0], []).append(one)
    return list(groups.values())


def _rows(group: Sequence[Difference]) -> list[tuple[str, str, str, str, str]]:
    exponent = power(max(abs(one.new) for one in group))
    scale = 10.0**exponent
    rows = []
    for one in group:
        places = decimals(one.error / scale)
        unit = in_power(exponent, one.unit)
        rows.append(
            (
                term("table.with_unit", name=one.name, unit=unit) if unit else one.name,
                number(one.new / scale, places),
                number(one.old / scale, places),
                with_errors([one.new - one.old], [one.error], exponent)[0],
                _signed(one.in_errors),
            )
        )
    return rows


def _signed(value: float) -> str:
    if math.isnan(value):
        return "?"
    text = size(abs(value)) if abs(value) >= 100 else f"{abs(value):.1f}"
    return text if float(f"{value:.1f}") == 0 else f"{'+' if value > 0 else '−'}{text}"
