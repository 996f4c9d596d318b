"""Labels of points on a page: grouping of neighbours, text, and free position."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_TOGETHER = 12.0
"""Largest distance, in points of the page, at which two points share a label."""

_MOST = 400
"""Outermost points considered, at most."""


class Box(NamedTuple):
    """A rectangle on the page."""

    left: float
    low: float
    right: float
    high: float

    @classmethod
    def around(cls, middle: Sequence[float], half_width: float, half_height: float | None = None) -> Box:
        up = half_width if half_height is None else half_height
        x, y = float(middle[0]), float(middle[1])
        return cls(x - half_width, y - up, x + half_width, y + up)

    @property
    def middle(self) -> tuple[float, float]:
        return 0.5 * (self.left + self.right), 0.5 * (self.low + self.high)

    def overlaps(self, other: Box) -> bool:
        return self.left < other.right and other.left < self.right and self.low < other.high and other.low < self.high


def linked_groups(page: np.ndarray, order: Sequence[int]) -> list[list[int]]:
    """Groups of points connected by short distances (single linkage), in the order of their first point.

    Args:
        page: position of every point, (N, 2).
        order: indices of points, the most important first.
    """
    left, groups = list(order[:_MOST]), []
    while left:
        group = [left.pop(0)]
        for i in group:  # grows during the loop
            near = [j for j in left if float(np.abs(page[i] - page[j]).max()) <= _TOGETHER]
            group += near
            left = [j for j in left if j not in near]
        groups.append(group)
    return groups


def ranges(indices: Sequence[int], most: int = 5) -> str:
    """Indices as text: ``0–3, 7`` for 0, 1, 2, 3, 7; beyond ``most`` parts, the number of the rest."""
    runs: list[list[int]] = []
    for i in sorted(indices):
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    parts = [part for run in runs for part in ([f"{run[0]}–{run[-1]}"] if len(run) > 2 else map(str, run))]
    if len(parts) <= most:
        return ", ".join(parts)
    shown = sum(_size(part) for part in parts[:most])
    return f"{', '.join(parts[:most])} +{len(indices) - shown}"


def _size(part: str) -> int:
    first, _, last = part.partition("–")
    return int(last) - int(first) + 1 if last else 1


def free_place(group: np.ndarray, text: str, size: float, taken: Sequence[Box]) -> Box | None:
    """Free box for a label of points (k, 2): above, below, right or left of them; None if all are taken."""
    half_width, half_height = 0.29 * size * len(text), 0.5 * size
    (left, low), (right, high) = group.min(0), group.max(0)
    middle_x, middle_y, gap = 0.5 * (left + right), 0.5 * (low + high), 4.0
    for middle in (
        (middle_x, high + gap + half_height),
        (middle_x, low - gap - half_height),
        (right + gap + half_width, middle_y),
        (left - gap - half_width, middle_y),
    ):
        box = Box.around(middle, half_width, half_height)
        if not any(box.overlaps(other) for other in taken):
            return box
    return None
