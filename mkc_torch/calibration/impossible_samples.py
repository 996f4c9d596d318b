"""Find and drop impossible samples: codes for missing values, and numbers corrupted in transmission."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch._support.order_statistic import order_statistic
from mkc_torch.calibration.turning import thin_at_rest
from mkc_torch.recording.formats.base import counted
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_APART = 20.0
"""Smallest ratio of an impossible sample's distance from the middle to that of all others. A magnetic disturbance also
has samples between, before and after its maximum."""

_TURNED = 4.0
"""Largest change by turning, in multiples of the median measurement; a turn by 180° is two."""

_MOST = 0.25
"""Largest share of impossible samples."""

_NAMED = 4
"""Most values that the warning lists."""


def without_impossible(recording: Recording, *names: str) -> Recording:
    """Drop samples whose values are far from all others; ``warnings`` lists them.

    Args:
        recording: sorted by time if there is a time, and finite in these columns.
        names: the columns of a sensor.

    Example:
        >>> import torch
        >>> angle = torch.linspace(0.0, 6.0, 30)
        >>> x = angle.cos()
        >>> x[3] = x[20] = 32767.0
        >>> recording = Recording({"time": torch.arange(30.0), "x": x, "y": angle.sin()})
        >>> without_impossible(recording, "x", "y").warnings
        ('Left out 2 of 30 samples that no field explains: `x` is 32767 2 times, first at 3 s.',)
    """
    points = recording.stack(*names)
    middle = points.median(0).values
    # the largest component, because the square of a number can overflow
    away = (points - middle).abs()
    near = _TURNED * float(middle.abs().max())
    if float(away.max()) <= near:
        return recording
    limit = max(_limit(away.amax(-1), thin_at_rest(points)), near)
    kept = away.amax(-1) <= limit
    if bool(kept.all()):
        return recording
    found = list(_found(recording, away > limit, names))
    more = [f"and {len(found) - _NAMED} more values"] if len(found) > _NAMED else []
    left_out = int((~kept).sum())
    return recording.rows(
        kept,
        f"Left out {left_out} of {len(recording)} samples that no field explains: "
        f"{'; '.join([*found[:_NAMED], *more])}.",
    )


def _limit(away: Float[Tensor, " N"], taken: Bool[Tensor, " N"]) -> float:
    """The distance at which the first wide gap among the outer samples begins."""
    outer = away[taken].unsqueeze(-1)
    begin = order_statistic(outer, None, math.ceil((1.0 - _MOST) * len(outer)))
    ordered = away[away >= begin].sort().values
    gaps = ((ordered[1:] > _APART * ordered[:-1]) & (ordered[:-1] > 0)).nonzero().flatten()
    return float(ordered[gaps[0]]) if len(gaps) > 0 else math.inf


def _found(recording: Recording, far: Bool[Tensor, "N k"], names: tuple[str, ...]) -> Iterator[str]:
    for column, name in enumerate(names):
        values, index = recording[name][far[:, column]].unique(return_inverse=True)
        rows = far[:, column].nonzero().flatten()
        for number, value in enumerate(values.tolist()):
            at = rows[index == number]
            first = f"sample {int(at[0]) + 1}" if recording.time is None else f"{float(recording.time[at[0]]):.6g} s"
            times = "" if len(at) == 1 else f" {counted(len(at), 'time')}, first"
            yield f"`{name}` is {value:.6g}{times} at {first}"
