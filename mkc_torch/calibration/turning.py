"""Where a sensor turns, and where it rests: a place where it stays is one direction, however long it stays there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import order_statistic, robust_scale
from mkc_torch.calibration.not_identifiable import NotIdentifiableError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["refuse_at_rest", "thin_at_rest", "turning", "way"]

_PARTS, _WIDEST = 200, 25
"""The way is taken over windows of a hundredth of a recording, and of no more than so many samples to either side."""

_FAR = 9.0
"""A window's way, over a sample's noise and the root of the window's length, from which it is a turn: three times what
noise alone goes, which is the difference of two medians in three channels."""

_ORDERED = 0.2
"""Noise from sample to sample, over the distance from the middle within which nine in ten samples lie, at which they
still come in an order."""

_FEWEST = 20

_SINGLE = 3
"""Of a way, samples to either side of its middle: so many that stand apart together do not move it."""

_BENT = 0.3
"""How far a sensor may turn in so many samples, as an angle in rad, for its way not to cut the corners."""

_AT_REST, _TURNS = 0.1, 0.1
"""Distance from the middle as a share of the field, and share of turning samples, below which a sensor is at rest."""


def turning(points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"] | None:
    """Whether the sensor turns at each sample: a running median goes further than noise takes it.

    Args:
        points: measurements in the order of time, in any unit.

    Returns:
        None where the samples are few or show no order: each is as far from the next as from any other, and hardly one
        turns.

    Example:
        >>> angle = torch.cat([torch.zeros(300), torch.linspace(0.0, 6.0, 300)])
        >>> field = 40.0 * torch.stack([angle.cos(), angle.sin(), torch.zeros(600)], -1)
        >>> field = field + 0.1 * torch.randn(600, 3, generator=torch.Generator().manual_seed(0))
        >>> found = turning(field)
        >>> bool(found[:290].any()), bool(found[320:580].all())
        (False, True)
        >>> turning(field[torch.randperm(600, generator=torch.Generator().manual_seed(0))]) is None
        True
    """
    N = len(points)
    if N < _FEWEST:
        return None
    # what is smooth has no second differences
    noise = robust_scale(points.diff(n=2, dim=0)).square().mean().sqrt() / math.sqrt(6.0)
    half = _half(N)
    middle = _running_median(points, half, half)
    number = torch.arange(N)
    before, after = (number - half).clamp(min=0), (number + half).clamp(max=N - 1)
    # at the ends of the recording there is half of the way to be seen
    far = torch.linalg.vector_norm(middle[after] - middle[before], dim=-1) * (2 * half / (after - before))
    found = far > _FAR * noise / math.sqrt(2 * half + 1)
    return None if bool(noise > _ORDERED * _reach(points)) and int(found.sum()) < _FEWEST else found


def thin_at_rest(
    points: Float[Tensor, "N 3"], turns: Bool[Tensor, " N"] | Literal["find"] | None = "find"
) -> Bool[Tensor, " N"]:
    """Which samples to take, so that a stretch of rest counts as one window of turning does: of it so many, evenly.

    Args:
        points: measurements in the order of time, in any unit.
        turns: what :func:`turning` returns for them; "find" calls it.

    Returns:
        All of them where too few would be left.

    Example:
        >>> angle = torch.cat([torch.zeros(300), torch.linspace(0.0, 6.0, 300)])
        >>> field = 40.0 * torch.stack([angle.cos(), angle.sin(), torch.zeros(600)], -1)
        >>> taken = thin_at_rest(field + 0.1 * torch.randn(600, 3, generator=torch.Generator().manual_seed(0)))
        >>> int(taken[:290].sum()) < 10, bool(taken[310:].all())
        (True, True)
    """
    found = turning(points) if isinstance(turns, str) else turns
    if found is None or not bool(found.any()):
        return torch.ones_like(points[:, 0], dtype=torch.bool)
    _, run, length = torch.unique_consecutive(found, return_inverse=True, return_counts=True)
    place = torch.arange(len(points)) - (length.cumsum(0) - length)[run]
    step = (length // (2 * _half(len(points)) + 1)).clamp(min=1)[run]
    taken = found | (place % step == step // 2)
    return taken if int(taken.sum()) >= _FEWEST else torch.ones_like(taken)


def way(
    points: Float[Tensor, "N 3"], turns: Bool[Tensor, " N"] | Literal["find"] | None = "find"
) -> Float[Tensor, "N 3"] | None:
    """Where the sensor went: a running median of seven samples, which single ones that stand apart do not move.

    Args:
        points: measurements in the order of time, in any unit.
        turns: what :func:`turning` returns for them; "find" calls it.

    Returns:
        None where samples are few, show no order, or are too rare: the sensor turns too far from one to the next.

    Example:
        >>> angle = torch.linspace(0.0, 6.0, 300)
        >>> field = 40.0 * torch.stack([angle.cos(), angle.sin(), torch.zeros(300)], -1)
        >>> went = way(field + 30.0 * (torch.arange(300) % 10 == 0).unsqueeze(-1))
        >>> float((went - field).abs().max()) < 2.0
        True
        >>> way(field[::20]) is None
        True
    """
    turns = turning(points) if isinstance(turns, str) else turns
    if turns is None:
        return None
    middle = _running_median(points, _SINGLE, _SINGLE)
    far = torch.linalg.vector_norm(middle[_SINGLE:] - middle[:-_SINGLE], dim=-1)[turns[_SINGLE:]]
    return None if len(far) == 0 or bool(far.median() > _BENT * _reach(points)) else middle


def refuse_at_rest(points: Float[Tensor, "N 3"], turns: Bool[Tensor, " N"] | None, unit: str) -> None:
    """Refuse a sensor that does not turn: a ball of noise would pass for a small ellipsoid.

    Args:
        points: measurements in the order of time.
        turns: what :func:`turning` says of them.
        unit: of the measurements, for the sentence.

    Raises:
        NotIdentifiableError: the measurements lie close together, and those that follow one another no closer.

    Example:
        >>> rest = 40.0 + torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
        >>> refuse_at_rest(rest, turning(rest), "µT")
        Traceback (most recent call last):
        mkc_torch.calibration.not_identifiable.NotIdentifiableError: Not identifiable: the sensor is at rest, ...
    """
    middle = points.median(0).values
    spread = (points - middle).square().sum(-1).median()
    apart = points.diff(dim=0).square().sum(-1).median()
    close = bool(spread < (_AT_REST * torch.linalg.vector_norm(middle)).square()) and bool(apart > 0.5 * spread)
    if close and (turns is None or float(turns.double().mean()) < _TURNS):
        within = f"{float(spread.sqrt()):.2g} {unit}".rstrip()
        raise NotIdentifiableError(
            f"Not identifiable: the sensor is at rest, half of its measurements stay within {within} of one value. "
            "Turn the sensor through all directions while recording."
        )


def _reach(points: Tensor) -> Tensor:
    """The distance from the middle within which nine in ten samples lie."""
    away = torch.linalg.vector_norm(points - points.median(0).values, dim=-1, keepdim=True)
    return order_statistic(away, None, math.ceil(0.9 * len(points)))


def _running_median(points: Tensor, half: int, more: int) -> Tensor:
    """Of so many samples to either side, and as if the recording went on, mirrored, for so many more at its ends."""
    padded = torch.nn.functional.pad(points.mT, (more, more), mode="reflect")
    return padded.unfold(-1, 2 * half + 1, 1).median(-1).values.mT


def _half(N: int) -> int:
    """Samples of a window to either side of its middle."""
    return min(max(N // _PARTS, 2), _WIDEST)
