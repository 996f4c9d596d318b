"""Find the runs of a recording: where its time starts again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

_FEWEST = 3
"""Fewest samples of a run."""

_BACK = 10.0
"""Smallest fall of the time at a new run, in median intervals; a smaller fall is jitter."""

_BEGINNING = 0.1
"""First share of a run's duration; the time of a new run falls back into it."""

_OVERLAP = 20
"""Fewest interleaved samples of each of two runs that make them separate wherever the second run starts."""

_MANY = 0.05
"""Largest share of backward steps; with more, the rows are unordered unless nearly every backward step begins a run."""

_NEARLY_ALL = 0.9
"""Share of the backward steps that begin a run, from which many backward steps are those of short runs."""


def restarts(time: Float[np.ndarray, " N"]) -> list[int]:
    """The rows at which a new run begins, without row 0.

    A run begins where the time falls back to near the start of the run before it, or earlier. A run also begins where
    the time falls into the middle of the run before it and the samples of both interleave. A block of rows that fills
    a gap was only written late, and single samples that step back are jitter.

    Args:
        time: in any unit, in the order of the rows; NaN where the time is missing.

    Example:
        >>> restarts(np.concatenate([np.arange(23.0, 43.0), np.arange(22.5, 42.5)]))
        [20]
        >>> restarts(np.array([0.0, 2.0, 1.0, 4.0, 3.0]))
        []
        >>> restarts(np.tile(np.arange(11.0), 6))
        [11, 22, 33, 44, 55]
    """
    rows = np.flatnonzero(np.isfinite(time))
    t = time[rows]
    steps = np.diff(t)
    backward = np.flatnonzero(steps < 0) + 1
    forward = steps[steps > 0]
    if len(backward) == 0 or len(forward) == 0:
        return []
    interval = float(np.median(forward))
    ends = np.append(backward[1:], len(t))
    found: list[int] = []
    start = 0
    for i, end in zip(backward.tolist(), ends.tolist(), strict=True):
        falls = t[i - 1] - t[i] >= _BACK * interval or (t[i] <= t[start] and i - start >= _FEWEST)
        if falls and _begins(t[start:i], t[i:end], interval):
            found.append(i)
            start = i
    if len(backward) > max(_MANY * len(t), 3.0) and len(found) < _NEARLY_ALL * len(backward):
        return []
    return [int(rows[i]) for i in found]


def _begins(before: np.ndarray, after: np.ndarray, interval: float) -> bool:
    """Whether the samples after a step back are a new run."""
    if min(len(before), len(after)) < _FEWEST:
        return False
    high, begin = float(before.max()), float(before[0])
    between = before[(before > after[0]) & (before < after[-1])]
    if not len(between) and begin < after[0] and after[-1] < high:
        return False
    if after[0] <= begin + max(_BEGINNING * (high - begin), _BACK * interval):
        return True
    repeated = float(np.isin(after, before).mean())
    return len(between) >= _OVERLAP and int((after < high).sum()) >= _OVERLAP and repeated < 0.5
