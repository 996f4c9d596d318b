"""The error about points that do not determine an ellipsoid, with the directions that are not covered."""

from __future__ import annotations

import torch
from torch import Tensor

from mkc_torch.calibration.coverage import Coverage, coverage


class NotIdentifiableError(ValueError):
    """The points do not determine an ellipsoid.

    ``coverage`` lists the missing directions. ``directions`` (K, 3) holds the vectors from which it was computed,
    relative to the best known centre. Both are None if all points are equal.
    """

    def __init__(self, message: str, found: Coverage | None = None, directions: Tensor | None = None) -> None:
        super().__init__(message)
        self.coverage = found
        self.directions = directions


def middle_of(points: Tensor) -> Tensor:
    """The centre of the bounding box of points, (*, 1, 3)."""
    return 0.5 * (points.amax(-2, keepdim=True) + points.amin(-2, keepdim=True))


LESS_NOISE = (
    "All directions are covered, so more turns do not help. Record with less noise: away from motors and wires, more "
    "slowly, or with averaged samples."
)
"""Advice if noise, and not the motion, makes the result uncertain."""


def not_identifiable(
    message: str, vectors: Tensor, *, seen: str = "", covered: str = "Turn the sensor through all directions."
) -> NotIdentifiableError:
    """Make the error, with coverage and missing directions.

    ``seen`` is a sentence about their origin, ``covered`` the advice if no direction is missing.
    """
    flat = vectors.detach().reshape(-1, 3)
    directions = flat[torch.linalg.vector_norm(flat, dim=-1) > 0]
    if len(directions) == 0:
        return NotIdentifiableError(message)
    found = coverage(directions)
    if "Turn the sensor" not in message:
        missing = "; ".join(str(g) for g in found.gaps)
        turn = "Turn the sensor so that the field points there too."
        message += f" Directions not covered: {missing}.{seen} {turn}" if missing else f" {covered}"
    return NotIdentifiableError(message, found, directions)


def equal_points_message(points: Tensor) -> str:
    """The error message for points of which more than half are equal."""
    if bool((points == points[..., :1, :]).all()):
        return "Not identifiable: all points are equal. Turn the sensor through all directions while recording."
    return "Not identifiable: more than half of the points are equal. Turn the sensor through all directions."


def flat_points_message(points: Tensor) -> str:
    """The error message for points whose regressors are linearly dependent."""
    flat = points.reshape(-1, *points.shape[-2:])
    centred = flat - flat.mean(-2, keepdim=True)
    for problem in centred:
        constant = [name for i, name in enumerate("xyz") if not bool(problem[:, i].any())]
        if constant:
            return (
                f"Not identifiable: {' and '.join(constant)} never changes, so the points lie in a plane. "
                "Turn the sensor through all directions, and check that channel."
            )
        _, singular, axes = torch.linalg.svd(problem, full_matrices=False)
        if float(singular[2]) < 1e-6 * float(singular[0]):
            x, y, z = axes[2].tolist()
            return (
                f"Not identifiable: the points lie in a plane with normal ({x:+.2f}, {y:+.2f}, {z:+.2f}), so that "
                "direction is not covered. Turn the sensor about another axis too."
            )
    return (
        "Not identifiable: the points lie on more than one quadric, as points on a few circles or lines do. "
        "Turn the sensor through all directions."
    )
