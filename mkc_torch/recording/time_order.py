"""Sort samples by time within each run, with sentences on what was out of order, repeated or missing."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import counted

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_GAP = 10.0
"""Longest interval, in median intervals, that is not a gap."""

_FEW = 0.01
"""Share of dropped samples up to which a note reports them; a warning reports more."""


def note_if_few(sentence: str, lost: int, of: int) -> str:
    """Return a sentence on lost samples: a note for few of them, a warning for more.

    Example:
        >>> type(note_if_few("Dropped 1.", 1, 200)).__name__, type(note_if_few("Dropped 9.", 9, 200)).__name__
        ('Note', 'str')
    """
    return Note(sentence) if lost <= _FEW * of else sentence


def time_order(
    time: Float[np.ndarray, " N"],
    group: Int[np.ndarray, " N"],
    table: Float[np.ndarray, "N k"],
    label: Callable[[int], str],
) -> tuple[Int[np.ndarray, " M"], list[str]]:
    """Return the row indices in the order of runs and times, with one row per time, and sentences on the faults.

    Args:
        time: finite times in s.
        group: index of each sample's run.
        table: the values of all columns, to compare samples with equal times.
        label: returns the name of a run, empty for the only run.

    Example:
        >>> time = np.array([0.0, 0.2, 0.1])
        >>> time_order(time, np.zeros(3, dtype=int), time[:, None], lambda _: "")
        (array([0, 2, 1]), ['The time ran backwards 1 time; the samples were sorted by time.'])
    """
    by_group = np.argsort(group, kind="stable")
    backward = int(((np.diff(time[by_group]) < 0) & (np.diff(group[by_group]) == 0)).sum())
    order = np.lexsort((time, group))  # stable, the last key first
    same_group = np.diff(group[order]) == 0
    first = np.concatenate([[True], ~((np.diff(time[order]) == 0) & same_group)])
    kept = order[first]
    found = []
    if backward:
        found.append(f"The time ran backwards {counted(backward, 'time')}; the samples were sorted by time.")
    if not first.all():
        twin, original = order[~first], kept[np.cumsum(first) - 1][~first]
        a, b = table[twin], table[original]
        differ = int(((a != b) & ~(np.isnan(a) & np.isnan(b))).any(-1).sum())
        dropped = (
            f"Dropped {len(twin)} of {len(time)} samples that repeat the time of an earlier sample, "
            f"{differ} of them with other values."
        )
        found.append(note_if_few(dropped, differ, len(time)))
    return kept, [*found, *_gaps(time[kept], group[kept], label)]


def _gaps(time: np.ndarray, group: np.ndarray, label: Callable[[int], str]) -> list[str]:
    inside = np.diff(group) == 0
    intervals = np.where(inside, np.diff(time), 0.0)
    if not inside.any():
        return []
    median = float(np.median(intervals[inside]))
    count, longest = int((intervals > _GAP * median).sum()), int(np.argmax(intervals))
    if not count:
        return []
    run = label(int(group[longest]))
    where = f" in experiment {run}" if run else ""
    return [
        Note(
            f"The time has {counted(count, 'gap')} of more than {_GAP:g} median intervals ({median:.4g} s); "
            f"the longest, {intervals[longest]:.4g} s, begins at {time[longest]:.10g} s{where}."
        )
    ]
