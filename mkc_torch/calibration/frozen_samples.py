"""Samples of a sensor that froze: one value again and again while it turned on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.clipped_samples import clipped_entries
from mkc_torch.calibration.repeats import Repeat, next_place, quietest_noise, repeats, step_of_digits, usual_move
from mkc_torch.calibration.runs import run_ends
from mkc_torch.recording.formats.base import counted
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["FROZEN", "without_frozen"]

FROZEN = "samples of a frozen sensor"

_LEAST = 20
"""Equal samples from which a sensor is looked at. Ten real recordings of six sensors hold three in a row in all axes
at most and nine in one axis; at noise of half a step of the digits, twenty in a row are a chance of 1e-3 an axis."""

_LONGER = 4.0
"""Times the longest usual stretch of equal samples: a log that is written faster than the sensor measures has many."""

_JUMP = 1.5
"""Times the usual move, a hundredth of which is larger, from which what follows is a jump: a sensor that rested goes
on from where it was, one that froze is elsewhere by then."""

_STEPS = 5.0
"""Steps of the digits that a jump has at least."""

_NOISY = 1.0
"""Noise, in steps of the digits, at which equal samples are no rest: twenty-five in a row are a chance of 1e-10."""

_FEWEST_OF_NOISE = 25
_NAMED = 4


def without_frozen(recording: Recording, *names: str) -> Recording:
    """The samples but for those of a sensor, or of one axis of it, that froze while it turned; ``warnings`` names them.

    A sensor at rest whose noise is less than a step of its digits repeats itself too. It goes on from there; one that
    froze jumps to where it has been turned meanwhile; or it repeats itself, where its own noise would not let it, to
    the end, or in one axis while the others go on.

    Args:
        recording: in the order of time, and finite in these columns; ``experiment`` separates runs.
        names: the columns of one sensor.

    Example:
        >>> angle = torch.linspace(0.0, 20.0, 1000)
        >>> x, y = angle.cos(), angle.sin()
        >>> x[300:400], y[300:400] = x[300], y[300]
        >>> without_frozen(Recording({"x": x, "y": y}), "x", "y").warnings
        ('Left out 100 of 1000 samples of a frozen sensor: all of `x`, `y` from sample 301 to 400 (100).',)
    """
    values = recording.stack(*names)
    ends = list(run_ends(recording))
    # at the end of its range an axis repeats itself too, which is another fault
    clipped = clipped_entries(values)
    # a log may be written faster than the sensor measures
    fresh = torch.cat([torch.ones(1, dtype=torch.bool), (values[1:] != values[:-1]).any(-1)])
    everywhere = _frozen(values, ends, recording.time, values, clipped.any(-1), fresh)
    frozen = _mask(len(values), everywhere)
    found = [(f"all of {', '.join(f'`{name}`' for name in names)}", one) for one in everywhere]
    for k, name in enumerate(names):
        others = torch.cat([values[:, :k], values[:, k + 1 :]], -1)
        alone = _frozen(values[:, k : k + 1], ends, recording.time, others, frozen | clipped[:, k], fresh)
        found += [(f"`{name}`", one) for one in alone]
    if not found:
        return recording
    left_out = _mask(len(values), [one for _, one in found])
    found.sort(key=lambda item: item[1].start - item[1].end)
    told = [f"{what} {_where(recording, one)}" for what, one in found[:_NAMED]]
    more = [f"and {counted(len(found) - _NAMED, 'more time')}"] if len(found) > _NAMED else []
    return recording.rows(
        ~left_out, f"Left out {int(left_out.sum())} of {len(recording)} {FROZEN}: {'; '.join([*told, *more])}."
    )


def _frozen(
    values: Float[Tensor, "N k"],
    ends: list[int],
    time: Float[Tensor, " N"] | None,
    turned: Float[Tensor, "N j"],
    known: Bool[Tensor, " N"],
    fresh: Bool[Tensor, " N"],
) -> list[Repeat]:
    """Repeats of the columns that no rest explains.

    Args:
        values: of the columns.
        ends: first rows of the runs but the first.
        time: of the rows.
        turned: the columns that show whether the sensor turned.
        known: rows that are explained already.
        fresh: rows that do not repeat all columns of the one before.
    """
    found = repeats(values, ends, _LEAST)
    free = ~(_mask(len(values), found) | known)
    found = [one for one in found if not bool(known[one.start : one.end].any())]
    if not found or not bool(free.any()):
        return []
    # an axis of its own stays where it is turned about; so long as others do not move, nothing turned
    alone = turned.shape[-1] != values.shape[-1]
    usual = max((one.end - one.start for one in repeats(values[free], [], 1)), default=1)
    move, least = usual_move(values, free), _STEPS * max(step_of_digits(v) for v in values.unbind(-1))
    noisy = any(
        quietest_noise(column[free & fresh]) >= _NOISY * max(step_of_digits(column), 1e-300)
        for column in values.unbind(-1)
    )
    others_move = usual_move(turned, free)
    stuck = []
    for one in found:
        length = one.end - one.start
        if length < _LONGER * usual:
            continue
        seen = turned[one.start : one.end]
        if alone and not float(torch.linalg.vector_norm(seen.amax(0) - seen.amin(0))) > others_move:
            continue
        jumped = _jump(values, one, ends, time) > max(_JUMP * move, least)
        # a sensor that goes on from there may have rested, whatever its noise does elsewhere
        elsewhere = alone or one.end in (*ends, len(values))
        if jumped or (elsewhere and noisy and length >= _FEWEST_OF_NOISE):
            stuck.append(one)
    return stuck


def _jump(values: Tensor, one: Repeat, ends: list[int], time: Tensor | None) -> float:
    """How far what follows is from what was repeated; 0 where nothing follows at once."""
    if time is not None and one.end < len(time):
        pause = float(time[one.end] - time[one.end - 1])
        if not 0.0 <= pause <= 5.0 * float(time.diff().median()):
            return 0.0
    end = next((end for end in ends if end >= one.end), len(values))
    following = next_place(values, one.end, end)
    return 0.0 if following is None else float(torch.linalg.vector_norm(following - values[one.start]))


def _mask(count: int, found: list[Repeat]) -> Bool[Tensor, " N"]:
    rows = torch.zeros(count, dtype=torch.bool)
    for one in found:
        rows[one.start : one.end] = True
    return rows


def _where(recording: Recording, one: Repeat) -> str:
    length = one.end - one.start
    if recording.time is None:
        return f"from sample {one.start + 1} to {one.end} ({length})"
    begin, last = float(recording.time[one.start]), float(recording.time[one.end - 1])
    return f"from {begin:.6g} to {last:.6g} s ({length})"
