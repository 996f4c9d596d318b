"""Compare a magnetometer's axes with those of the gyroscope or attitude, and report exchanged axes and signs."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.calibration.aided.misfit import misfit_of_attitude, misfit_of_gyroscope
from mkc_torch.calibration.aided.turns import Turns

if TYPE_CHECKING:
    from jaxtyping import Float, Int

EXPLAINED = 0.08
"""Residual per axis, as a share of the field, below which the recorded axes are right: twice that of 10 % soft iron."""

IMPROVEMENT = 0.5
"""Residual with other axes, as a share of that with the recorded axes, below which the other axes are reported."""

_AXES = "xyz"


class Mounting(NamedTuple):
    """Wrong axes of a magnetometer.

    Attributes:
        sentence: the probable fault.
        recorded: residual per axis with the recorded axes, in the field's unit.
        corrected: residual per axis with the corrected axes, in the field's unit.
    """

    sentence: str
    recorded: float
    corrected: float


def mounting(
    field: Float[Tensor, "N 3"], turns: Turns, stretch: Int[Tensor, " N"], length: float, by: str
) -> Mounting | None:
    """Find exchanged axes or signs of a magnetometer; None if its own axes fit, or if no exchange fits.

    The field must be constant after rotation by the body's turns. Of the 48 exchanges of axes and signs, the exchange
    with the smallest residual is selected.

    Args:
        field: measured field with any constant offset.
        turns: turns of the body.
        stretch: index of each sample's stretch with its own offset, ascending.
        length: length of the field, in its unit.
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
        >>> same = torch.zeros(400, dtype=torch.long)
        >>> turns = Turns(yaw @ lean, same, None, None)
        >>> body = turns.to_frame.mT @ torch.tensor([3.0, 4.0, 12.0]).double()
        >>> mounting(body[:, [1, 0, 2]], turns, same, 13.0, "attitude").sentence
        "The magnetometer's x and y seem exchanged."
    """

    def residual(points: Tensor) -> float:
        if turns.vertical is None:
            return misfit_of_gyroscope(points, turns.to_frame, turns.window, stretch)
        return misfit_of_attitude(points, turns.to_frame, stretch)

    own = residual(field)
    if own < EXPLAINED * length:
        return None
    ways = itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3))
    tried = [(residual(field[:, list(order)] * field.new_tensor(signs)), order, signs) for order, signs in ways]
    # without tilts a rotation about the axis fits equally well: choose the simplest with about the smallest residual
    least = min(trial[0] for trial in tried)
    if not least < IMPROVEMENT * own:
        return None
    plain = [trial for trial in tried if trial[0] <= 1.2 * least]
    best = min(plain, key=lambda trial: (sum(k != j for k, j in enumerate(trial[1])), sum(s < 0 for s in trial[2])))
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
    axes = ", ".join(
        f"{_AXES[k]} is {'minus ' if signs[k] < 0 else ''}{_AXES[order[k]]} of the magnetometer" for k in range(3)
    )
    return f"The magnetometer's axes seem to differ from the {by}'s, of which {axes}."


def without_exchange(response: Float[Tensor, "3 3"], by: str) -> tuple[str, Float[Tensor, "3 3"]]:
    """Remove exchanged axes and signs from a response.

    Returns:
        A sentence about the exchange, empty without an exchange, and the response without it.

    Args:
        response: response from the field in the axes of a gyroscope or attitude to the magnetometer's axes.
        by: "gyroscope" or "attitude", for the sentence.

    Example:
        >>> sentence, rest = without_exchange(
        ...     torch.tensor([[0.1, 9.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 9.0]]), "gyroscope"
        ... )
        >>> sentence, rest[0].tolist()
        ("The magnetometer's x and y seem exchanged.", [9.0, 0.0, 0.0])
    """
    columns = torch.arange(3)
    order = max(itertools.permutations(range(3)), key=lambda rows: float(response[list(rows), columns].abs().sum()))
    chosen = response[list(order)]
    signs = tuple(1.0 if float(v) >= 0.0 else -1.0 for v in chosen.diagonal())
    plain = order == (0, 1, 2) and min(signs) > 0.0
    return "" if plain else _sentence(order, signs, by), chosen * chosen.new_tensor(signs)[:, None]


def nearest_rotation(response: Float[Tensor, "3 3"]) -> tuple[float, Float[Tensor, " 3"]]:
    """Angle in ° and axis of the rotation that is nearest to a matrix.

    Example:
        >>> angle, axis = nearest_rotation(torch.tensor([[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]]).double())
        >>> round(angle), axis.tolist()
        (90, [0.0, 0.0, 1.0])
    """
    left, _, right = torch.linalg.svd(response)
    turn = left @ right
    axis = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = math.degrees(math.atan2(float(torch.linalg.vector_norm(axis)), float(turn.diagonal().sum()) - 1.0))
    return angle, axis / torch.linalg.vector_norm(axis).clamp(min=1e-12)
