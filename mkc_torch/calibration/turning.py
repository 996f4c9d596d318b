"""Detect where a sensor turns and where it rests, so that a rest counts as a single direction."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import order_statistic, robust_scale
from mkc_torch.calibration.not_identifiable import NotIdentifiableError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_PARTS = 200
"""Number of half windows in a recording."""

_WIDEST = 25
"""Most samples of a window to either side of its centre."""

_FAR = 9.0
"""Smallest displacement of a turning window, in multiples of a sample's noise over the root of the window's length;
noise alone, the difference of two medians in three channels, makes a third of it."""

_ORDERED = 0.2
"""Largest noise between samples of an ordered series, as a share of the radius that holds nine in ten samples."""

_FEWEST = 20
"""Fewest samples."""

_SINGLE = 3
"""Samples to either side of the running median of the path; as many adjacent outliers do not change it."""

_BENT = 0.3
"""Largest turn within half a window of the path, in rad; beyond it the running median cuts corners."""

_AT_REST = 0.1
"""Largest distance from the middle, as a share of the field, of a sensor at rest."""

_TURNS = 0.1
"""Largest share of turning samples of a sensor at rest."""


def turning(points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"] | None:
    """Mask of the samples at which the sensor turns: a running median moves further than by noise.

    Args:
        points: measurements in the order of time, in any unit.

    Returns:
        The mask (N,); None if the samples are few or unordered, that is, as far from the next sample as from any other.

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
    # smooth motion has no second differences
    noise = robust_scale(points.diff(n=2, dim=0)).square().mean().sqrt() / math.sqrt(6.0)
    half = _half(N)
    middle = _running_median(points, half, half)
    number = torch.arange(N)
    before, after = (number - half).clamp(min=0), (number + half).clamp(max=N - 1)
    # at the ends of the recording only half of the window exists
    far = torch.linalg.vector_norm(middle[after] - middle[before], dim=-1) * (2 * half / (after - before))
    found = far > _FAR * noise / math.sqrt(2 * half + 1)
    return None if bool(noise > _ORDERED * _reach(points)) and int(found.sum()) < _FEWEST else found


def thin_at_rest(
    points: Float[Tensor, "N 3"], turns: Bool[Tensor, " N"] | Literal["find"] | None = "find"
) -> Bool[Tensor, " N"]:
    """Mask of the samples to use: a rest is thinned evenly to as many samples as a window of turning has.

    Args:
        points: measurements in the order of time, in any unit.
        turns: result of :func:`turning` for them; "find" computes it.

    Returns:
        The mask (N,); all samples if too few would remain.

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
    """The path of the sensor: a running median of seven samples, without single outliers.

    Args:
        points: measurements in the order of time, in any unit.
        turns: result of :func:`turning` for them; "find" computes it.

    Returns:
        The path (N, 3); None if samples are few, unordered, or too sparse for the sensor's turns.

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
    """Reject a sensor that does not turn: its ball of noise would pass for a small ellipsoid.

    Args:
        points: measurements in the order of time.
        turns: result of :func:`turning` for them.
        unit: unit of the measurements, for the message.

    Raises:
        NotIdentifiableError: the measurements are close together, and neighbours in time are no closer than others.

    Example:
        >>> rest = 40.0 + torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
        >>> refuse_at_rest(rest, turning(rest), "µT")
        Traceback (most recent call last):
        mkc_torch.calibration.not_identifiable.NotIdentifiableError: Not identifiable: the sensor is at rest; ...
    """
    middle = points.median(0).values
    spread = (points - middle).square().sum(-1).median()
    apart = points.diff(dim=0).square().sum(-1).median()
    close = bool(spread < (_AT_REST * torch.linalg.vector_norm(middle)).square()) and bool(apart > 0.5 * spread)
    if close and (turns is None or float(turns.double().mean()) < _TURNS):
        within = f"{float(spread.sqrt()):.2g} {unit}".rstrip()
        raise NotIdentifiableError(
            f"Not identifiable: the sensor is at rest; half of its measurements are within {within} of a single value. "
            "Turn the sensor through all directions while recording."
        )


def _reach(points: Tensor) -> Tensor:
    """The radius about the median that holds nine in ten samples."""
    away = torch.linalg.vector_norm(points - points.median(0).values, dim=-1, keepdim=True)
    return order_statistic(away, None, math.ceil(0.9 * len(points)))


def _running_median(points: Tensor, half: int, more: int) -> Tensor:
    """Running median of ``half`` samples to either side; the ends are padded by ``more`` mirrored samples."""
    padded = torch.nn.functional.pad(points.mT, (more, more), mode="reflect")
    return padded.unfold(-1, 2 * half + 1, 1).median(-1).values.mT


def _half(N: int) -> int:
    """Number of samples of a window to either side of its centre."""
    return min(max(N // _PARTS, 2), _WIDEST)
