"""Whether a sensor's offset changed during the recording: a step, a drift, or a slow rotation of the offset.

An offset that changes by b(t) changes the length of the corrected field by ``u · b(t)``, with u the gradient of the
length. The residual's scores along u are summed over blocks of the recording, less the part that another offset or
matrix would explain, and weighted by each course of b(t). Under the null hypothesis the block sums are independent
with symmetric signs; the significance is that of random sign flips, for the best course of each kind. Scores are
bounded (Huber), so that a few disturbed samples do not decide.

References:
    Hansen, "Tests for parameter instability in regressions with I(1) processes", JBES 10 (1992) 321-335, for sums of
    scores. Canay, Romano, Shaikh, "Randomization tests under an approximate symmetry assumption", Econometrica 85
    (2017) 1013-1030, for the sign flips of a few blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale

if TYPE_CHECKING:
    from jaxtyping import Float

LEVEL = 0.01
"""Probability of a change found in a recording without one, for all kinds together."""

LARGE = 2.0
"""Smallest change that is reported, in robust scales of the length: a smaller change is within the stated scatter."""

_BLOCKS = 32
_FEWEST_BLOCKS = 12
_ROWS = 20
"""Fewest rows of a block."""

_MOST = 20_000
"""Most rows of the test, taken evenly."""

_MOST_SIZED = 5_000
"""Most rows of the estimate of a change's size, taken evenly."""

_HUBER = 2.0
"""Largest score, in robust scales of the residual."""

_EDGE = 0.1
"""Share of the recording before the first and after the last step."""

_FLIPS = 2_000
_STEPS = 33
_ITERATIONS = 6


class OffsetChange(NamedTuple):
    """A change of the offset during a recording.

    Attributes:
        kind: "step", "drift" or "rotation".
        size: length of the change from one extreme to the other, in the unit of the measurement.
        at: time of a step, in s, or its row from 1 if the recording has no time; None for the other kinds.
        p_value: its significance, corrected for the kinds.
    """

    kind: str
    size: float
    at: float | None
    p_value: float


def offset_change(
    points: Float[Tensor, "N 3"],
    place: Float[Tensor, " N"],
    center: Float[Tensor, " 3"],
    matrix: Float[Tensor, "3 3"],
    strength: float,
) -> OffsetChange | None:
    """The change of the offset during a recording; None if it is not significant, or within the residual's scatter.

    Args:
        points: measurements in the order of time, a rest thinned out.
        place: their times in s, or their row numbers.
        center, matrix, strength: the calibration, ``field = matrix @ (measured - center)``.

    Example:
        >>> direction = torch.nn.functional.normalize(torch.randn(900, 3, dtype=torch.float64), dim=-1)
        >>> points = 48.0 * direction
        >>> points[450:, 0] += 9.4
        >>> center = torch.tensor([4.7, 0.0, 0.0], dtype=torch.float64)
        >>> offset_change(points, torch.arange(900.0), center, torch.eye(3, dtype=torch.float64), 48.0)[::2]
        ('step', 450.0)
    """
    every = max(1, math.ceil(len(points) / _MOST))
    rows, place = points[::every].to(torch.float64), place[::every]
    count = min(_BLOCKS, len(rows) // _ROWS)
    if count < _FEWEST_BLOCKS:
        return None
    residual, along, tangents = _linearised(rows, center.to(rows), matrix.to(rows), strength)
    scale = float(robust_scale((residual - residual.median()).unsqueeze(-1)))
    if not scale > 1e-9 * float(torch.linalg.vector_norm(rows - center.to(rows), dim=-1).median()):
        return None
    scores = _BlockScores(residual / scale, along, tangents, count)
    p_value = len(_KINDS) * min(scores.p_values())
    if p_value > LEVEL:
        return None
    step = max(1, math.ceil(len(rows) / _MOST_SIZED))
    sized = [part[::step] for part in (residual, along, tangents)]
    scatter, kind, size, share = min(_sized(kind, *sized) for kind in _KINDS)
    if not size > LARGE * scatter:
        return None
    at = float(place[min(round(share * len(place)), len(place) - 1)]) if kind == "step" else None
    return OffsetChange(kind, size, at, p_value)


def _linearised(rows: Tensor, center: Tensor, matrix: Tensor, strength: float) -> tuple[Tensor, Tensor, Tensor]:
    """Residual of the length in the unit of the measurement (N,), its gradient u (N, 3), and nine tangents (N, 9)."""
    away = rows - center
    field = away @ matrix.mT
    length = torch.linalg.vector_norm(field, dim=-1, keepdim=True)
    direction = field / length.clamp(min=1e-12 * strength)
    size = float(torch.linalg.det(matrix).abs()) ** (-1.0 / 3.0)
    x, y, z = direction.unbind(-1)
    a, b, c = (away / (size * strength)).unbind(-1)
    shape = torch.stack([x * a, y * b, z * c, x * b + y * a, x * c + z * a, y * c + z * b], -1)
    along = size * direction @ matrix
    residual = size * (length.squeeze(-1) - strength)
    return residual, along, torch.cat([along, shape], -1)


class _BlockScores:
    """Sums of the residual's scores along u over blocks of rows, and the part that another calibration explains."""

    def __init__(self, standardised: Tensor, along: Tensor, tangents: Tensor, count: int) -> None:
        rows = len(standardised)
        block = torch.arange(rows) * count // rows
        score = standardised.clamp(-_HUBER, _HUBER).unsqueeze(-1)
        slope = (standardised.abs() < _HUBER).to(score).unsqueeze(-1)

        def sums(values: Tensor) -> Tensor:
            return values.new_zeros(count, values.shape[1]).index_add_(0, block, values)

        products = (slope * along).unsqueeze(-1) * tangents.unsqueeze(-2)
        self.count = count
        self.along = sums(along * score)
        self.tangents = sums(tangents * score)
        self.shared = sums(products.flatten(1)).unflatten(1, (3, 9))
        self.inverse = torch.linalg.pinv((slope * tangents).mT @ tangents, rtol=1e-10, hermitian=True)

    def p_values(self) -> Iterator[float]:
        """Yield the significance of each kind of change by random sign flips of the blocks."""
        generator = torch.Generator().manual_seed(0)
        signs = 2.0 * torch.randint(0, 2, (_FLIPS, self.count), generator=generator).to(self.along) - 1.0
        place = (torch.arange(self.count).to(self.along) + 0.5) / self.count
        for kind in _KINDS:
            best, flipped = 0.0, signs.new_zeros(_FLIPS)
            for courses in _courses(kind, place):
                scores = torch.cat([self._scores(course) for course in courses], -1)
                inverse = torch.linalg.pinv(scores.mT @ scores, rtol=1e-10, hermitian=True)
                total, drawn = scores.sum(0), signs @ scores
                best = max(best, float(total @ inverse @ total))
                flipped = torch.maximum(flipped, (drawn @ inverse * drawn).sum(-1))
            yield float(1 + (flipped >= best).sum()) / (1 + _FLIPS)

    def _scores(self, course: Tensor) -> Tensor:
        """The scores of each block along u times the course, (blocks, 3), less their projection on the tangents."""
        explained = torch.einsum("b,bij->ij", course, self.shared) @ self.inverse
        return course.unsqueeze(-1) * self.along - self.tangents @ explained.mT


_KINDS = ("step", "drift", "rotation")


def _courses(kind: str, place: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Yield the courses of a kind: functions of the place in the recording, from 0 to 1."""
    if kind == "step":
        onsets = place if len(place) <= _BLOCKS else torch.linspace(_EDGE, 1.0 - _EDGE, _STEPS).to(place)
        for onset in onsets[(onsets >= _EDGE) & (onsets <= 1.0 - _EDGE)].tolist():
            yield ((place >= onset).to(place),)
    elif kind == "drift":
        yield (place - 0.5,)
    else:
        for turns in (1.0, 2.0):
            angle = 2.0 * math.pi * turns * place
            yield (angle.cos(), angle.sin())


def _sized(kind: str, residual: Tensor, along: Tensor, tangents: Tensor) -> tuple[float, str, float, float]:
    """Scatter of the residual with the best course of a kind, the kind, the change's size, and the share before it."""
    place = (torch.arange(len(residual)).to(residual) + 0.5) / len(residual)
    found = []
    for courses in _courses(kind, place):
        columns = torch.cat([tangents, *(course.unsqueeze(-1) * along for course in courses)], -1)
        known, scatter = _huber_fit(columns, residual)
        change = known[9:].unflatten(0, (len(courses), 3))
        size = float(torch.linalg.matrix_norm(change, 2)) * (2.0 if kind == "rotation" else 1.0)
        found.append((scatter, kind, size, float((courses[0] == 0).to(place).mean())))
    return min(found)


def _huber_fit(columns: Tensor, residual: Tensor) -> tuple[Tensor, float]:
    """Coefficients by Huber's estimator, and the robust scale of what remains."""
    weight = torch.ones_like(residual)
    coefficients, scatter = columns.new_zeros(columns.shape[1]), 0.0
    for _ in range(_ITERATIONS):
        weighted = weight.unsqueeze(-1) * columns
        normal = torch.linalg.pinv(weighted.mT @ columns, rtol=1e-12, hermitian=True)
        coefficients = normal @ (weighted.mT @ residual)
        left = residual - columns @ coefficients
        scatter = float(robust_scale(left.unsqueeze(-1)))
        if not scatter > 0.0:
            break
        weight = (_HUBER * scatter / left.abs().clamp(min=1e-300)).clamp(max=1.0)
    return coefficients, scatter
