"""Coverage of the sphere by directions, and the information it gives about an ellipsoid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, overload

import torch
from torch import Tensor

from mkc_torch._support.small_factors import symmetric_eigen

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

NEAR_DEGREES = 15.0
"""Largest angle in ° between a covered direction and the nearest sample."""

GAP_DEGREES = 40.0
"""Smallest radius in ° of an empty cap that is reported; a sphere of 30 even samples has smaller caps."""

_GRID = 2000
"""Number of directions on the sphere at which coverage is evaluated."""


@dataclass(frozen=True)
class Gap:
    """An empty cap of directions: its centre, a unit vector in the sensor's axes, and its radius in degrees."""

    direction: tuple[float, float, float]
    degrees: float

    def __str__(self) -> str:
        x, y, z = self.direction
        return f"{nearest_axis(self.direction)} ({x:+.2f}, {y:+.2f}, {z:+.2f}): no sample within {self.degrees:.0f}°"


@dataclass(frozen=True)
class Coverage:
    """How a set of directions covers the sphere.

    Attributes:
        fraction: share of all directions with a sample within 15°.
        gaps: empty caps of more than 40°, largest first.
        information: information about the worst-determined combination of centre and shape, as a share of that of an
            even coverage with as many samples; 1 for even coverage, 0 if it is undetermined.
    """

    fraction: float
    gaps: tuple[Gap, ...]
    information: float


def nearest_axis(direction: tuple[float, float, float]) -> str:
    """Name of the axes along which a direction points, such as "+z" or "-x+y".

    Example:
        >>> nearest_axis((0.1, -0.2, 0.97)), nearest_axis((-0.7, 0.7, 0.1))
        ('+z', '-x+y')
    """
    largest = max(abs(v) for v in direction)
    parts = zip(direction, "xyz", strict=True)
    return "".join(f"{'+' if v > 0 else '-'}{name}" for v, name in parts if abs(v) > 0.6 * largest)


def fibonacci_sphere(count: int) -> Float[Tensor, "count 3"]:
    """Evenly spread unit vectors on a spiral."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1.0 - 2.0 * i / count
    angle = math.pi * (1.0 + math.sqrt(5.0)) * i
    radius = torch.sqrt(1.0 - z * z)
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), z], -1)


def tangents(directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9"]:
    """Derivatives of the norm with respect to centre and shape: the functions u_i and u_i u_j on the sphere."""
    x, y, z = directions.unbind(-1)
    root2 = math.sqrt(2.0)
    return torch.stack([x, y, z, x * x, y * y, z * z, root2 * x * y, root2 * x * z, root2 * y * z], -1)


@lru_cache(maxsize=1)
def _even_information() -> Float[Tensor, "9 9"]:
    """Cholesky factor of the information of an evenly covered sphere."""
    rows = tangents(fibonacci_sphere(20_000))
    return torch.linalg.cholesky(rows.mT @ rows / rows.shape[0])


def least_information(moment: Float[Tensor, "9 9"]) -> tuple[float, Float[Tensor, " 9"]]:
    """Information about the worst-determined combination of centre and shape, and that combination.

    Args:
        moment: mean product of the :func:`tangents`.

    Returns:
        The information as a share of even coverage, and the combination (9,).
    """
    even = _even_information()
    half = torch.linalg.solve_triangular(even, moment.detach().double().cpu(), upper=False)
    relative = torch.linalg.solve_triangular(even, half.mT, upper=False)
    values, vectors = torch.linalg.eigh(relative)
    return float(values[0]), torch.linalg.solve_triangular(even.mT, vectors[:, :1], upper=True).squeeze(-1)


def least_of_each(moments: Float[Tensor, "B 9 9"]) -> tuple[Float[Tensor, " B"], Float[Tensor, "B 9"]]:
    """:func:`least_information` of many moments, on their device."""
    even = _even_information().to(moments)
    to_even = torch.linalg.solve_triangular(even, torch.eye(9, dtype=even.dtype, device=even.device), upper=False)
    values, vectors = symmetric_eigen(to_even @ moments.detach() @ to_even.mT)
    return values[:, 0], vectors[..., 0] @ to_even


class CoverageOfEach(Sequence[Coverage]):
    """Coverage by the directions in use of each of many problems, computed on access."""

    def __init__(self, vectors: Float[Tensor, "B N 3"], used: Bool[Tensor, "B N"]) -> None:
        self._vectors = vectors
        self._used = used

    def __len__(self) -> int:
        return len(self._vectors)

    @overload
    def __getitem__(self, index: int) -> Coverage: ...
    @overload
    def __getitem__(self, index: slice) -> list[Coverage]: ...
    def __getitem__(self, index: int | slice) -> Coverage | list[Coverage]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return coverage(self.directions(index))

    def directions(self, index: int) -> Float[Tensor, "n 3"]:
        """The directions in use of a problem."""
        return self._vectors[index][self._used[index]]

    def information(self) -> Float[Tensor, " B"]:
        """Information of each problem, as of :class:`Coverage`."""
        size = self._vectors.abs().amax(-1, keepdim=True)
        scaled = self._vectors / torch.where(size > 0, size, 1.0)
        length = torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)
        rows = tangents(scaled / torch.where(length > 0, length, 1.0)) * self._used.unsqueeze(-1)
        return least_of_each(rows.mT @ rows / self._used.sum(-1)[:, None, None])[0]


def coverage(directions: Float[Tensor, "N 3"]) -> Coverage:
    """Coverage of the sphere by the directions of vectors; their lengths do not matter.

    Args:
        directions: vectors from the centre, in the sensor's axes, of nonzero length.

    Example:
        >>> round(coverage(fibonacci_sphere(500)).fraction, 2)
        1.0
        >>> half = fibonacci_sphere(500)
        >>> print(coverage(half[half[:, 2] > 0]).gaps[0])
        -z (...): no sample within 8...°
    """
    if directions.shape[0] == 0:
        raise ValueError("Expected at least one direction but got none.")
    vectors = directions.detach().double().cpu()
    # scale first, so that the squares of tiny or huge components stay in range
    vectors = vectors / vectors.abs().amax(-1, keepdim=True)
    unit = vectors / torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    grid = fibonacci_sphere(_GRID)
    nearest = torch.full((_GRID,), -1.0, dtype=torch.float64)
    for part in unit.split(256):  # parts whose products fit into the cache
        nearest = torch.maximum(nearest, (grid @ part.mT).amax(-1))
    angle = torch.rad2deg(torch.acos(nearest.clamp(-1.0, 1.0)))
    rows = tangents(unit)
    information, _ = least_information(rows.mT @ rows / rows.shape[0])
    gaps: list[Gap] = []
    uncovered = angle.clone()
    while float(uncovered.max()) > GAP_DEGREES:
        worst = int(uncovered.argmax())
        x, y, z = grid[worst].tolist()
        gaps.append(Gap((x, y, z), float(uncovered[worst])))
        apart = torch.rad2deg(torch.acos((grid @ grid[worst]).clamp(-1.0, 1.0)))
        uncovered[apart < max(60.0, float(uncovered[worst]))] = 0.0
    return Coverage(
        fraction=float((angle < NEAR_DEGREES).double().mean()), gaps=tuple(gaps), information=max(information, 0.0)
    )
