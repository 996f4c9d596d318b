"""Several recordings of one system as one table, whose column ``experiment`` keeps their runs apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from mkc_torch.recording.formats.base import RecordingError, listed
from mkc_torch.recording.given_columns import EXPERIMENT
from mkc_torch.recording.recording import Recording

__all__ = ["Clock", "join_recordings", "joint_name", "recording_names"]

Clock = Literal["own", "restart", "follow"]
"""What the time of a run does beside the run before it: nothing, begin again, or continue after its end."""

_MOST_NAMED = 3
"""Recordings that a joint name lists; more are counted."""

_PAUSE_INTERVALS = 10.0
"""Median sampling intervals between two runs that follow one another, at least."""

_PAUSE_SECONDS = 10.0
"""Seconds between two runs that follow one another, at least: no turn is followed over as long."""


def join_recordings(recordings: Sequence[Recording], clock: Clock = "restart") -> Recording:
    """The rows of several recordings, one after the other, with their runs numbered in the column ``experiment``.

    A run is called by the name of its recording, with its own label behind it where the recording holds several. One
    recording without runs is returned as it is. A clock that is moved is told in ``warnings``.

    Args:
        recordings: of the same columns in the same units, in any order of columns.
        clock: "own" leaves all times as they are; "restart" lets a run that begins after the end of the one before it
            begin at the first sample's time of that one, so that the time falls back from each run to the next;
            "follow" moves a run that begins before the end of the one before it behind that end.

    Raises:
        RecordingError: there is none, or columns, units or labels differ; the message says which.

    Example:
        >>> bench = Recording({"time": torch.tensor([0.0, 0.5]), "speed": torch.zeros(2)}, name="bench")
        >>> road = Recording({"time": torch.tensor([7.0, 7.5]), "speed": torch.ones(2)}, name="road")
        >>> both = join_recordings([bench, road])
        >>> both.name, both.labels["experiment"], both["experiment"].tolist()
        ('bench, road', ('bench', 'road'), [0.0, 0.0, 1.0, 1.0])
        >>> both["time"].tolist()
        [0.0, 0.5, 0.0, 0.5]
    """
    if not recordings:
        raise RecordingError("there is no recording to diagnose; give one at least.")
    names = recording_names(recordings)
    _refuse_differences(recordings, names)
    if len(recordings) == 1 and EXPERIMENT not in recordings[0]:
        return recordings[0]
    parts = [
        (f"{name}/{label}" if EXPERIMENT in one else name, part)
        for name, one in zip(names, recordings, strict=True)
        for label, part in one.experiments().items()
    ]
    times, moved = _times([part for _, part in parts], clock)
    columns = {name: torch.cat([part[name] for _, part in parts]) for name in parts[0][1].names}
    if times is not None:
        columns["time"] = torch.cat(times)
    numbers = [torch.full((len(part),), float(number)) for number, (_, part) in enumerate(parts)]
    first = recordings[0]
    return Recording(
        {**columns, EXPERIMENT: torch.cat(numbers)},
        name=joint_name(names),
        units={name: unit for name, unit in first.units.items() if name != EXPERIMENT},
        warnings=(
            *(f"{name}: {text}" for name, one in zip(names, recordings, strict=True) for text in one.warnings),
            *_moves_told([label for label, _ in parts], moved),
        ),
        labels={
            **{name: labels for name, labels in first.labels.items() if name != EXPERIMENT},
            EXPERIMENT: tuple(label for label, _ in parts),
        },
    )


def joint_name(names: Sequence[str]) -> str:
    """What several recordings are called together.

    Example:
        >>> joint_name(["a", "b"]), joint_name(["a", "b", "c", "d", "e"])
        ('a, b', 'a, b, c and 2 more')
    """
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def recording_names(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """A name for each, no two alike."""
    names: list[str] = []
    for number, one in enumerate(recordings, start=1):
        plain = one.name or f"recording {number}"
        name, count = plain, 1
        while name in names:
            count += 1
            name = f"{plain} ({count})"
        names.append(name)
    return tuple(names)


def _refuse_differences(recordings: Sequence[Recording], names: Sequence[str]) -> None:
    first, own = recordings[0], set(recordings[0].names) - {EXPERIMENT}
    for name, other in zip(names[1:], recordings[1:], strict=True):
        theirs = set(other.names) - {EXPERIMENT}
        lacking = [
            f"{there} has {listed(sorted(columns))}, which {gone} has not"
            for there, gone, columns in ((names[0], name, own - theirs), (name, names[0], theirs - own))
            if columns
        ]
        if lacking:
            raise RecordingError(
                f"{name} and {names[0]} cannot be diagnosed together, for their columns differ: {'; '.join(lacking)}. "
                "Rename columns, or leave out those that only some of the recordings have."
            )
        for column in sorted(own):
            unit, their_unit = first.units[column], other.units[column]
            if unit != their_unit:
                raise RecordingError(
                    f"{name} and {names[0]} cannot be diagnosed together: the column `{column}` is in "
                    f"{their_unit or 'no unit'} in {name} and in {unit or 'no unit'} in {names[0]}. Convert one of "
                    "them."
                )
            if first.labels.get(column) != other.labels.get(column):
                raise RecordingError(
                    f"{name} and {names[0]} cannot be diagnosed together: the numbers of the column `{column}` stand "
                    "for different labels. Write numbers in both."
                )


def _times(parts: Sequence[Recording], clock: Clock) -> tuple[list[Tensor] | None, list[float]]:
    """The times of the runs, and by how many seconds each was moved; None where there is no time."""
    if parts[0].time is None:
        return None, []
    times: list[Tensor] = []
    moved: list[float] = []
    for part in parts:
        time = part["time"]
        by = _moved_by(times[-1], time, clock) if times else 0.0
        times.append(time + by)
        moved.append(by)
    return times, moved


def _moved_by(before: Tensor, time: Tensor, clock: Clock) -> float:
    """Seconds by which a run is moved that comes after another one."""
    known, own = before[before.isfinite()], time[time.isfinite()]
    if clock == "own" or not len(known) or not len(own):
        return 0.0
    begin, end, first = float(known.min()), float(known.max()), float(own.min())
    if clock == "restart":
        return begin - first if first >= end else 0.0
    if first > end:
        return 0.0
    steps = known.sort().values.diff()
    interval = float(steps[steps > 0].median()) if bool((steps > 0).any()) else 0.0
    return end + max(_PAUSE_INTERVALS * interval, _PAUSE_SECONDS) - first


def _moves_told(labels: Sequence[str], moved: Sequence[float]) -> list[str]:
    return [
        f"The time of {label} is counted {abs(by):.6g} s {'later' if by > 0 else 'earlier'} than its clock says, to "
        "keep the runs apart."
        for label, by in zip(labels, moved, strict=False)
        if by
    ]
