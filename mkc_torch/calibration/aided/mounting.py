"""Whether a magnetometer's axes are those of the gyroscope or the attitude: exchanged ones and signs are named."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.calibration.aided.misfit import left_by_attitude, left_by_gyroscope
from mkc_torch.calibration.aided.turns import Turns

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["Mounting", "exchanged", "mounting", "turned_by"]

EXPLAINED = 0.08
"""Share of the field that may be left in each axis for the axes to be right: twice what soft iron of 10 % leaves."""

HALVES = 0.5
"""Of what is left with the axes as they are, the most that other axes may leave, to be named."""

_AXES = "xyz"


class Mounting(NamedTuple):
    """What is wrong, as a sentence, and what would be left of the field in each axis with it and without."""

    sentence: str
    left: float
    mended: float


def mounting(
    field: Float[Tensor, "N 3"], turns: Turns, stretch: Int[Tensor, " N"], length: float, by: str
) -> Mounting | None:
    """Other axes of a magnetometer that explain how its field turns; None where its own do, or none.

    Of the 48 ways to exchange axes and signs the one is looked for that leaves the least of a field that stands still.

    Args:
        field: measured, of any constant offset.
        turns: of the body.
        stretch: number of each sample's stretch with an offset of its own, ascending.
        length: of the field, in its unit.
        by: "gyroscope" or "attitude", for the sentence.

    Example:
        >>> angle = torch.linspace(0.0, 12.0, 400).double()
        >>> cos, sin, o = angle.cos(), angle.sin(), 0.0 * angle
        >>> lean = torch.stack(
        ...     [
        ...         torch.stack([o + 1, o, o]),
        ...         torch.stack([o, (2 * angle).cos(), -(2 * angle).sin()]),
        ...         torch.stack([o, (2 * angle).sin(), (2 * angle).cos()]),
        ...     ]
        ... ).movedim(-1, 0)
        >>> yaw = torch.stack(
        ...     [torch.stack([cos, -sin, o]), torch.stack([sin, cos, o]), torch.stack([o, o, o + 1])]
        ... ).movedim(-1, 0)
        >>> one = torch.zeros(400, dtype=torch.long)
        >>> turns = Turns(yaw @ lean, one, None, None)
        >>> body = turns.to_frame.mT @ torch.tensor([3.0, 4.0, 12.0]).double()
        >>> mounting(body[:, [1, 0, 2]], turns, one, 13.0, "attitude").sentence
        "The magnetometer's x and y seem exchanged."
    """

    def left(points: Tensor) -> float:
        if turns.vertical is None:
            return left_by_gyroscope(points, turns.to_frame, turns.window, stretch)
        return left_by_attitude(points, turns.to_frame, stretch)

    own = left(field)
    if own < EXPLAINED * length:
        return None
    ways = itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3))
    tried = [(left(field[:, list(order)] * field.new_tensor(signs)), order, signs) for order, signs in ways]
    # a turn about the axis that nothing tilts is as good: the plainest of those that leave about as little
    least = min(one[0] for one in tried)
    if not least < HALVES * own:
        return None
    plain = [one for one in tried if one[0] <= 1.2 * least]
    best = min(plain, key=lambda one: (sum(k != j for k, j in enumerate(one[1])), sum(s < 0 for s in one[2])))
    return Mounting(_sentence(best[1], best[2], by), own, best[0])


def _sentence(order: tuple[int, ...], signs: tuple[float, ...], by: str) -> str:
    moved = [k for k in range(3) if order[k] != k]
    turned = [k for k in range(3) if signs[k] < 0]
    if not moved:
        many = len(turned) > 1
        names = " and ".join(_AXES[k] for k in turned)
        return f"The magnetometer's {names} seem{'' if many else 's'} to have the other sign."
    if len(moved) == 2 and not turned:
        return f"The magnetometer's {' and '.join(_AXES[k] for k in moved)} seem exchanged."
    told = ", ".join(
        f"{_AXES[k]} is {'minus ' if signs[k] < 0 else ''}{_AXES[order[k]]} of the magnetometer" for k in range(3)
    )
    return f"The magnetometer's axes seem to be others than the {by}'s, of which {told}."


def exchanged(response: Float[Tensor, "3 3"], by: str) -> tuple[str, Float[Tensor, "3 3"]]:
    """What a response says of exchanged axes and signs, empty where there are none, and the response without them.

    Args:
        response: from the field in the axes of a gyroscope or an attitude to the magnetometer's.
        by: "gyroscope" or "attitude", for the sentence.

    Example:
        >>> told, rest = exchanged(torch.tensor([[0.1, 9.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 9.0]]), "gyroscope")
        >>> told, rest[0].tolist()
        ("The magnetometer's x and y seem exchanged.", [9.0, 0.0, 0.0])
    """
    columns = torch.arange(3)
    order = max(itertools.permutations(range(3)), key=lambda one: float(response[list(one), columns].abs().sum()))
    chosen = response[list(order)]
    signs = tuple(1.0 if float(v) >= 0.0 else -1.0 for v in chosen.diagonal())
    plain = order == (0, 1, 2) and min(signs) > 0.0
    return "" if plain else _sentence(order, signs, by), chosen * chosen.new_tensor(signs)[:, None]


def turned_by(response: Float[Tensor, "3 3"]) -> tuple[float, Float[Tensor, " 3"]]:
    """Angle in ° and axis of the rotation that is nearest to a matrix.

    Example:
        >>> angle, axis = turned_by(torch.tensor([[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]]).double())
        >>> round(angle), axis.tolist()
        (90, [0.0, 0.0, 1.0])
    """
    left, _, right = torch.linalg.svd(response)
    turn = left @ right
    axis = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = math.degrees(math.atan2(float(torch.linalg.vector_norm(axis)), float(turn.diagonal().sum()) - 1.0))
    return angle, axis / torch.linalg.vector_norm(axis).clamp(min=1e-12)
