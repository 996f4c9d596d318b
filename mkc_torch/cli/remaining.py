"""The remaining time of work, estimated by the durations of the items that are done. This file needs no torch."""

from __future__ import annotations

import math
from collections.abc import Callable

_FEWEST = 3
"""Items whose durations have to be known."""

_BELOW = 2.0
"""Standard deviations of the sum of the remaining durations by which the range begins below its expectation."""

_ABOVE = 3.0
"""Standard deviations by which it ends above: durations are skewed, a few fits take many times the others' time."""

_MINUTES = 120.0
"""Seconds from which times are given in minutes."""


class Durations:
    """Durations of similar items that are done one after another.

    Args:
        now: time in s.

    Example:
        >>> durations = Durations(0.0)
        >>> for done, now in ((1, 2.0), (2, 4.0), (3, 6.0)):
        ...     durations.reached(done, now)
        >>> durations.left(5, 10, now=6.0)
        (10.0, 20.0)
    """

    def __init__(self, now: float) -> None:
        self._last, self._done = now, 0
        self._seconds: list[float] = []

    def begin(self, now: float) -> None:
        """Begin another series of items; the time until now is that of no item."""
        self._last, self._done = now, 0

    def reached(self, done: int, now: float) -> None:
        """Store that so many items of the series are done."""
        more = done - self._done
        if more > 0:
            self._seconds += [(now - self._last) / more] * more
            self._last, self._done = now, done

    def left(self, least: int, most: int, now: float) -> tuple[float, float] | None:
        """Return the shortest and the longest remaining time in s; None while fewer than three durations are known.

        Args:
            least, most: numbers of remaining items, the one in progress included.
            now: time in s.
        """
        count = len(self._seconds)
        if count < _FEWEST:
            return None
        mean = sum(self._seconds) / count
        variance = sum((seconds - mean) ** 2 for seconds in self._seconds) / (count - 1)

        def error(items: int) -> float:
            # of the items, and of the mean
            return math.sqrt(variance * (items + items**2 / count))

        since = now - self._last
        shortest = max(least * mean - _BELOW * error(least) - since, 0.0)
        return shortest, max(most * mean + _ABOVE * error(most) - since, mean)


def range_text(shortest: float, longest: float) -> str:
    """Return a range of times, rounded outwards.

    Args:
        shortest, longest: in s.

    Example:
        >>> range_text(31.0, 44.0), range_text(0.2, 7.5), range_text(50.0, 200.0), range_text(150.0, 400.0)
        ('30 to 45 s', 'up to 8 s', '50 s to 4 min', '2 to 7 min')
    """
    (low, unit), (high, other) = _rounded(shortest, math.floor), _rounded(longest, math.ceil)
    if low == 0:
        return f"up to {high} {other}"
    return f"{low} to {high} {other}" if unit == other else f"{low} {unit} to {high} {other}"


def _rounded(seconds: float, rounding: Callable[[float], int]) -> tuple[int, str]:
    """Return a time in whole seconds, from ten on in fives, or in minutes; and its unit."""
    if seconds >= _MINUTES:
        return rounding(seconds / 60.0), "min"
    step = 1 if seconds < 10.0 else 5
    return step * rounding(seconds / step), "s"
