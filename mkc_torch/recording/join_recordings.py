"""Join several recordings of a system into a table, whose column ``experiment`` numbers their runs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_other_type
from mkc_torch._support.arrays import is_frame
from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import RecordingError, listed
from mkc_torch.recording.given_columns import EXPERIMENT
from mkc_torch.recording.recording import Recording

Clock = Literal["own", "restart", "follow"]
"""How the times of consecutive runs are arranged: unchanged, restarting, or following each other."""

_MOST_NAMED = 3
"""Most recordings that a joint name lists; further recordings are counted."""

_PAUSE_INTERVALS = 10.0
"""Smallest pause between two consecutive runs, in median sampling intervals."""

_PAUSE_SECONDS = 10.0
"""Smallest pause between two consecutive runs, in s; turns are not tracked across such a pause."""


def join_recordings(recordings: Sequence[Recording], clock: Clock = "restart") -> Recording:
    """Concatenate recordings, with their runs numbered in the column ``experiment``.

    The label of a run is the name of its recording, followed by its own label if the recording holds several runs. A
    single recording without runs is returned unchanged. ``warnings`` lists the runs whose times were shifted.

    Args:
        recordings: recordings with the same columns in the same units; the order of columns may differ.
        clock: "own" leaves all times unchanged; "restart" shifts a run that begins after the end of the previous run
            to the start time of that run, so that the time falls back from each run to the next; "follow" shifts a
            run that begins before the end of the previous run to after that end.

    Raises:
        RecordingError: no recordings, or their columns, units or labels differ; the message lists the differences.

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
        raise RecordingError("there is no recording to diagnose; give at least one.")
    names = recording_names(recordings)
    _refuse_differences(recordings, names)
    if len(recordings) == 1 and EXPERIMENT not in recordings[0]:
        return recordings[0]
    parts = [
        (f"{name}/{label}" if EXPERIMENT in recording else name, part)
        for name, recording in zip(names, recordings, strict=True)
        for label, part in recording.experiments().items()
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
            *(
                f"{name}: {text}"
                for name, recording in zip(names, recordings, strict=True)
                for text in recording.warnings
            ),
            *(
                Note(f"{name}: {text}")
                for name, recording in zip(names, recordings, strict=True)
                for text in recording.notes
            ),
            *_shift_warnings([label for label, _ in parts], moved),
        ),
        labels={
            **{name: labels for name, labels in first.labels.items() if name != EXPERIMENT},
            EXPERIMENT: tuple(label for label, _ in parts),
        },
    )


def joint_name(names: Sequence[str]) -> str:
    """The joint name of several recordings.

    Example:
        >>> joint_name(["a", "b"]), joint_name(["a", "b", "c", "d", "e"])
        ('a, b', 'a, b, c and 2 more')
    """
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def recording_names(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """A unique name for each recording."""
    names: list[str] = []
    for number, recording in enumerate(recordings, start=1):
        plain = recording.name or f"recording {number}"
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
                f"{name} and {names[0]} cannot be diagnosed together; their columns differ: {'; '.join(lacking)}. "
                "Rename columns, or leave out those that only some of the recordings have."
            )
        for column in sorted(own):
            unit, their_unit = first.units[column], other.units[column]
            if unit != their_unit:
                raise RecordingError(
                    f"{name} and {names[0]} cannot be diagnosed together: the column `{column}` is in "
                    f"{their_unit or 'no unit'} in {name} and in {unit or 'no unit'} in {names[0]}. Convert one "
                    "of the two."
                )
            if first.labels.get(column) != other.labels.get(column):
                raise RecordingError(
                    f"{name} and {names[0]} cannot be diagnosed together: the numbers of the column `{column}` stand "
                    "for different labels. Write numbers in both."
                )


def _times(parts: Sequence[Recording], clock: Clock) -> tuple[list[Tensor] | None, list[float]]:
    """The times of the runs, and the shift of each in s; None if there is no time."""
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
    """The shift in s of a run that follows another run."""
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


def _shift_warnings(labels: Sequence[str], moved: Sequence[float]) -> list[str]:
    return [
        f"The time of {label} is counted {abs(by):.6g} s {'later' if by > 0 else 'earlier'} than its clock, to "
        "separate the runs."
        for label, by in zip(labels, moved, strict=False)
        if by
    ]


def refuse_no_recording(name: str, value: object) -> None:
    """Refuse a value that is not a recording, with the remedy.

    Raises:
        TypeError: it is a file name, a data frame, or another object.
    """
    advice = "make one, Recording({'time': ..., ...}), or read it, Recording.read('REC.csv')"
    if isinstance(value, (str, os.PathLike)):
        advice = f"read it, Recording.read({os.fspath(value)!r})"
    elif is_frame(value):
        advice = f"make one, Recording({name})"
    refuse_other_type(name, value, Recording, "a Recording", advice)
