"""Delays of one sample: a column that is a row late or early in its table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from mkc_torch.diagnosis.parts import EffectParameter, Finding, Number

_ERRORS = 2.0
"""Standard errors by which a delay of one sample may differ from the step between samples."""

_SHARPNESS = 3.0
"""Standard errors by which a delay of one sample has to differ from 0."""


def rows_late(parameters: Sequence[EffectParameter], step: float) -> int:
    """Return 1 for a complete delay of one sample within its error, -1 if it is early, otherwise 0.

    Args:
        parameters: of an effect; each number of its ``delay`` in s is compared, and its share, if it has one, with 1.
        step: s between two samples.

    Example:
        >>> rows_late([EffectParameter("delay", 0.0507, 0.004, "s")], 0.05)
        1
        >>> rows_late([EffectParameter("delay", 0.0707, 0.004, "s")], 0.05)
        0
    """
    delays = [number for p in parameters if p.name == "delay" for number in _numbers(p)]
    shares = [number for p in parameters if p.name == "share" for number in _numbers(p)]
    for sign in (1, -1):
        if delays and all(_is(delay, sign * step) for delay in delays) and all(_is(share, 1.0) for share in shares):
            return sign
    return 0


def with_row_named(finding: Finding, step: float) -> Finding:
    """Return a finding whose explanation and advice name a delay of one sample; unchanged without such a delay.

    Args:
        finding: of any effect.
        step: s between two samples.
    """
    rows = rows_late(finding.parameters, step)
    if not rows:
        return finding
    name = finding.channels[0] if finding.channels else ""
    how = "late" if rows > 0 else "early"
    if name.startswith("input "):
        column = name.removeprefix("input ")
        explanation = (
            f"The input `{column}` acts one row {how}: its delay is one sample, {step:.4g} s, within its standard "
            "error."
        )
        advice = (
            f"Shift the column `{column}` by one row, or correct the program that applies each row of the input one "
            f"step {how}."
        )
    else:
        explanation = (
            f"The recording is one row {how}: its delay is one sample, {step:.4g} s, within its standard error."
        )
        advice = "Shift the simulated or the recorded columns by one row, or correct the program that wrote them."
    return replace(finding, explanation=explanation, advice=advice)


def _is(number: tuple[float, float], expected: float) -> bool:
    value, error = number
    return abs(value - expected) <= _ERRORS * error and abs(expected) >= _SHARPNESS * error


def _numbers(parameter: EffectParameter) -> list[tuple[float, float]]:
    """Return each number with its standard error, infinite if it is unknown."""
    values = _flat(parameter.value)
    errors = [math.inf] * len(values) if parameter.standard_error is None else _flat(parameter.standard_error)
    return list(zip(values, errors, strict=True))


def _flat(number: Number | None) -> list[float]:
    if isinstance(number, tuple):
        return [value for part in number for value in _flat(part)]
    return [math.inf if number is None else number]
