"""Find and drop samples of a frozen sensor: a repeated value while the sensor turned."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.clipped_samples import clipped_entries
from mkc_torch.calibration.repeats import Repeat, next_place, quietest_noise, repeats, step_of_digits, usual_move
from mkc_torch.calibration.runs import run_slices
from mkc_torch.recording.formats.base import counted
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

FROZEN = "samples of a frozen sensor"

_LEAST = 20
"""Fewest equal samples in a row that are examined. Ten real recordings of six sensors have at most three in a row in
all axes and nine in a single axis; at noise of half a digital step, twenty in a row have probability 1e-3 per axis."""

_LONGER = 4.0
"""Smallest ratio to the longest usual repeat; a log that is written faster than the sensor samples has many repeats."""

_JUMP = 1.5
"""Smallest ratio of a jump after a repeat to the 99th percentile of usual moves. A sensor that rested continues where
it was; a sensor that froze has moved."""

_STEPS = 5.0
"""Smallest jump, in digital steps."""

_NOISY = 1.0
"""Smallest noise, in digital steps, at which equal samples cannot be a rest: twenty-five in a row have probability
1e-10."""

_FEWEST_OF_NOISE = 25
"""Fewest equal samples in a row of a frozen sensor that is recognised by its noise."""

_NAMED = 4
"""Most repeats that the warning lists."""


def without_frozen(recording: Recording, *names: str) -> Recording:
    """Drop the samples of a sensor, or of an axis of it, that froze while it turned; ``warnings`` lists them.

    A sensor at rest whose noise is less than a digital step repeats its value too, and then continues from that value.
    A frozen sensor jumps to its new orientation; or it repeats a value despite its noise, up to the end or in a single
    axis.

    Args:
        recording: sorted by time and finite in these columns; ``experiment`` separates runs.
        names: the columns of a sensor.

    Example:
        >>> angle = torch.linspace(0.0, 20.0, 1000)
        >>> x, y = angle.cos(), angle.sin()
        >>> x[300:400], y[300:400] = x[300], y[300]
        >>> without_frozen(Recording({"x": x, "y": y}), "x", "y").warnings
        ('Left out 100 of 1000 samples of a frozen sensor: all of `x`, `y` from sample 301 to 400 (100).',)
    """
    values = recording.stack(*names)
    ends = [run.start for run in run_slices(recording)[1:]]
    # a clipped axis repeats its value too, which is another fault
    clipped = clipped_entries(values)
    # a log may be written faster than the sensor samples
    fresh = torch.cat([torch.ones(1, dtype=torch.bool), (values[1:] != values[:-1]).any(-1)])
    everywhere = _frozen(values, ends, recording.time, values, clipped.any(-1), fresh)
    frozen = _mask(len(values), everywhere)
    found = [(f"all of {', '.join(f'`{name}`' for name in names)}", repeat) for repeat in everywhere]
    for k, name in enumerate(names):
        others = torch.cat([values[:, :k], values[:, k + 1 :]], -1)
        alone = _frozen(values[:, k : k + 1], ends, recording.time, others, frozen | clipped[:, k], fresh)
        found += [(f"`{name}`", repeat) for repeat in alone]
    if not found:
        return recording
    left_out = _mask(len(values), [repeat for _, repeat in found])
    found.sort(key=lambda item: item[1].start - item[1].end)
    listed_repeats = [f"{what} {_where(recording, repeat)}" for what, repeat in found[:_NAMED]]
    more = [f"and {counted(len(found) - _NAMED, 'more time')}"] if len(found) > _NAMED else []
    return recording.rows(
        ~left_out,
        f"Left out {int(left_out.sum())} of {len(recording)} {FROZEN}: {'; '.join([*listed_repeats, *more])}.",
    )


def _frozen(
    values: Float[Tensor, "N k"],
    ends: list[int],
    time: Float[Tensor, " N"] | None,
    turned: Float[Tensor, "N j"],
    known: Bool[Tensor, " N"],
    fresh: Bool[Tensor, " N"],
) -> list[Repeat]:
    """Find repeats of the columns that a rest does not explain.

    Args:
        values: values of the columns.
        ends: first rows of all runs except the first.
        time: times of the rows.
        turned: the columns that show whether the sensor turned.
        known: mask of the rows that are explained already.
        fresh: mask of the rows that differ from the row before.
    """
    found = repeats(values, ends, _LEAST)
    free = ~(_mask(len(values), found) | known)
    found = [repeat for repeat in found if not bool(known[repeat.start : repeat.end].any())]
    if not found or not bool(free.any()):
        return []
    # one axis is constant while the sensor turns about it; if the other axes are constant too, nothing turned
    alone = turned.shape[-1] != values.shape[-1]
    usual = max((repeat.end - repeat.start for repeat in repeats(values[free], [], 1)), default=1)
    move, least = usual_move(values, free), _STEPS * max(step_of_digits(v) for v in values.unbind(-1))
    # rows that repeat a value count too: those that differ from the row before flicker between coarse digits
    noisy = any(
        min(quietest_noise(column[free & fresh]), quietest_noise(column[free]))
        >= _NOISY * max(step_of_digits(column), 1e-300)
        for column in values.unbind(-1)
    )
    others_move = usual_move(turned, free)
    stuck = []
    for repeat in found:
        length = repeat.end - repeat.start
        if length < _LONGER * usual:
            continue
        seen = turned[repeat.start : repeat.end]
        if alone and not float(torch.linalg.vector_norm(seen.amax(0) - seen.amin(0))) > others_move:
            continue
        jumped = _jump(values, repeat, ends, time) > max(_JUMP * move, least)
        # a sensor that continues from its value may have rested, whatever its noise elsewhere
        elsewhere = alone or repeat.end in (*ends, len(values))
        if jumped or (elsewhere and noisy and length >= _FEWEST_OF_NOISE):
            stuck.append(repeat)
    return stuck


def _jump(values: Tensor, repeat: Repeat, ends: list[int], time: Tensor | None) -> float:
    """Distance of the following samples from the repeated value; 0 if no sample follows immediately."""
    if time is not None and repeat.end < len(time):
        pause = float(time[repeat.end] - time[repeat.end - 1])
        if not 0.0 <= pause <= 5.0 * float(time.diff().median()):
            return 0.0
    end = next((end for end in ends if end >= repeat.end), len(values))
    following = next_place(values, repeat.end, end)
    return 0.0 if following is None else float(torch.linalg.vector_norm(following - values[repeat.start]))


def _mask(count: int, found: list[Repeat]) -> Bool[Tensor, " N"]:
    rows = torch.zeros(count, dtype=torch.bool)
    for repeat in found:
        rows[repeat.start : repeat.end] = True
    return rows


def _where(recording: Recording, repeat: Repeat) -> str:
    length = repeat.end - repeat.start
    if recording.time is None:
        return f"from sample {repeat.start + 1} to {repeat.end} ({length})"
    begin, last = float(recording.time[repeat.start]), float(recording.time[repeat.end - 1])
    return f"from {begin:.6g} to {last:.6g} s ({length})"
