"""The sentences of a fleet: what to correct in all recordings, what in some, what in one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from mkc_torch._support.random_effects import Departure, RandomEffects, Trend
from mkc_torch._support.typesetting import capital
from mkc_torch.diagnosis.verdict import NAMED
from mkc_torch.report.fleet.content import START, Fleet, Quantity, Size
from mkc_torch.report.words.numbers import size as three_digits
from mkc_torch.report.words.numbers import with_errors

_MOST_NAMES = 5


def headline(fleet: Fleet) -> str:
    """Return how many recordings have a result, and how many results can be used as they are.

    Example:
        >>> headline(Fleet((), (), {"a": "no such file"}))
        '0 of 1 recordings diagnosed'
    """
    count, done = len(fleet.recordings) + len(fleet.failures), len(fleet.recordings)
    usable = sum(each.answer == "usable" for each in fleet.recordings)
    return f"{done} of {count} recordings {fleet.kind}" + (f", {usable} usable" if done else "")


def conclusions(fleet: Fleet) -> list[str]:
    """Return what follows for the simulation, sentences for each parameter of a finding."""
    return [capital(sentence) for quantity in fleet.quantities for sentence in _of_quantity(fleet, quantity)]


def _of_quantity(fleet: Fleet, quantity: Quantity) -> Iterator[str]:
    found, all_of = quantity.compared, len(fleet.recordings)
    if not found:
        return
    what = quantity.title + (f" (`{quantity.own_name}`)" if quantity.own_name else "")
    if len(found) == 1:
        if all_of > 1:
            yield f"In one recording: {what}, {written(found[0], quantity)} in {_names(fleet, found)}."
        return
    where = f"in all {all_of} recordings" if len(found) == all_of else f"in {len(found)} of {all_of} recordings"
    where += f", unconfirmed in {quantity.unconfirmed}" if quantity.unconfirmed else ""
    if quantity.pooled is None:
        yield f"{what} {where}."
        return
    yield f"{what} {where}: {_pooled(quantity.pooled, quantity.unit)}."
    for each in quantity.departing:
        yield _departure(fleet, quantity, each)
    if quantity.rest is not None:
        yield f"The others: {_pooled(quantity.rest, quantity.unit)}."
    for name, trend in quantity.trends.items():
        yield _trend(fleet, quantity, name, trend)


def _pooled(found: RandomEffects, unit: str) -> str:
    mean = f"{with_errors([found.mean], [found.error])[0]}{_unit(unit)}"
    if found.agree:
        return f"{mean}; the sizes agree within their errors, so that a single size can be used"
    spread = f"{three_digits(found.spread)}{_unit(unit)} (95 % interval {_span(found.spread_low, found.spread_high)})"
    return f"mean {mean}, spread between them {spread}, so that each recording has its own size"


def _departure(fleet: Fleet, quantity: Quantity, each: Departure) -> str:
    own = next(size for size in quantity.sizes if size.recording == each.unit)
    return (
        f"`{fleet.recordings[each.unit].name}` departs from the others: {written(own, quantity)}, "
        f"{abs(each.score):.1f} standard errors from their mean (p = {_p(each.p_value)}, corrected for the number of "
        "recordings)."
    )


def _trend(fleet: Fleet, quantity: Quantity, name: str, trend: Trend) -> str:
    unit = next(each.conditions[name].unit for each in fleet.recordings if name in each.conditions)
    own = f"{quantity.unit or '1'} per {unit or 'unit'}"
    condition = "the time of the recording" if name == START else f"the mean of {name}"
    slope = with_errors([trend.slope], [trend.error])[0]
    return f"It changes with {condition}: {slope} {own} (p = {_p(trend.p_value)})."


def written(size: Size, quantity: Quantity) -> str:
    """Return a size with its standard error and unit."""
    grade = "" if size.grade in NAMED else f" ({size.grade.replace('_', ' ')})"
    return f"{with_errors([size.value], [size.error])[0]}{_unit(quantity.unit)}{grade}"


def _names(fleet: Fleet, sizes: Sequence[Size]) -> str:
    names = [fleet.recordings[size.recording].name for size in sizes]
    return ", ".join(names[:_MOST_NAMES]) + (" and others" if len(names) > _MOST_NAMES else "")


def _span(low: float, high: float) -> str:
    return f"{three_digits(low)} to {three_digits(high)}"


def _p(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "unknown"


def _unit(unit: str) -> str:
    return f" {unit}" if unit else ""
