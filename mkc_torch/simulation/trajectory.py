"""Trajectories of a differential equation at all their moments at once: collocation, solved by Newton's method.

Between neighbouring moments the solution obeys the Hermite-Simpson formula (Lobatto IIIA of fourth order, A-stable:
Hairer & Wanner, "Solving Ordinary Differential Equations II", 1996, IV.5). All of these equations are linearised
together; what is left is an affine recurrence from one moment to the next, which is composed by doubling (Blelloch,
"Prefix sums and their applications", 1990). So nothing is stepped through one by one, derivatives with respect to
parameters and inputs come with the last step, and a guess from measured states keeps unstable systems in reach.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["Grid", "Rate", "Recurrence", "Trajectory", "solve"]

Rate = Callable[[Tensor], Tensor]
"""Of change of the states, (S, n) → (S, n), at the stations of a grid."""

_MOST_STEPS = 30
_SETTLED = 1e-9
_HALVINGS = 6
_QUICK = 0.01
_NEAR = 1e-6


@dataclass(frozen=True)
class Grid:
    """Moments in their order, of one or several trajectories that follow one another.

    The differential equation is looked at in three stations of each interval between neighbours: its left end, its
    middle and its right end. Where a trajectory begins, the interval before it counts for nothing.

    Attributes:
        time: (G,) in s.
        begins: (G,), where a trajectory begins; True for the first moment.
    """

    time: Float[Tensor, " G"]
    begins: Bool[Tensor, " G"]

    @property
    def step(self) -> Float[Tensor, " G-1"]:
        """Length of each interval in s; 0 before the beginning of a trajectory."""
        return torch.where(self.begins[1:], 0.0, self.time.diff())

    @property
    def stations(self) -> Float[Tensor, " 3G-3"]:
        """Their times in s."""
        return self.spread(self.time)

    def spread(self, values: Float[Tensor, G * rest]) -> Float[Tensor, "3G-3 *rest"]:
        """Values at the moments as values at the stations, with the mean in the middle."""
        left, right = values[:-1], values[1:]
        return torch.stack([left, 0.5 * (left + right), right], 1).flatten(0, 1)

    @property
    def longest(self) -> int:
        """Number of moments of the longest trajectory."""
        first = self.begins.nonzero().squeeze(-1)
        return int(torch.cat([first, first.new_tensor([len(self.begins)])]).diff().max())


@dataclass(frozen=True)
class Trajectory:
    """States at the moments of a grid.

    Attributes:
        states: (G, n).
        stations: (3G-3, n), the states there.
        converged: whether they solve the equations.
        recurrence: the equations, linearised there.
    """

    states: Float[Tensor, "G n"]
    stations: Float[Tensor, "3G-3 n"]
    converged: bool
    recurrence: Recurrence


def solve(
    rate: Rate,
    grid: Grid,
    begin: Float[Tensor, "K n"],
    guess: Float[Tensor, "G n"],
    known: Recurrence | None = None,
) -> Trajectory:
    """The trajectories that begin in given states.

    Derivatives of the states with respect to whatever ``rate`` and ``begin`` depend on are exact in first order, in
    forward and in reverse mode; the guess has no derivative.

    Args:
        rate: of change of the states at the stations.
        grid: its K trajectories.
        begin: their first states.
        guess: of all states.
        known: the linearisation of a trajectory nearby; it serves as long as it brings the equations to rest quickly.

    Example:
        A decay at a rate of 2/s:

        >>> time = torch.linspace(0.0, 1.0, 11, dtype=torch.float64)
        >>> grid = Grid(time, time == 0.0)
        >>> begin = torch.ones(1, 1, dtype=torch.float64)
        >>> found = solve(lambda x: -2.0 * x, grid, begin, begin.expand(11, 1))
        >>> bool((found.states[:, 0] - torch.exp(-2.0 * time)).abs().max() < 2e-6), found.converged
        (True, True)
    """
    step = grid.step.unsqueeze(-1)
    origin = grid.begins.unsqueeze(-1)
    places = grid.begins.long().cumsum(0) - 1
    states = torch.where(origin, begin.detach()[places], guess.detach())
    at = _Point.of(rate, states, step)
    fresh = known is None
    recurrence = _recurrence(rate, states, step, grid) if known is None else known
    converged, far = False, not fresh
    for _ in range(_MOST_STEPS):
        change = recurrence.solved(torch.zeros_like(states), at.defect)
        size = float((change / at.scale).abs().max())
        if size < _SETTLED:
            converged = True
            break
        moved = at
        part = 1.0
        if size < torch.inf:
            for _ in range(_HALVINGS if fresh else 1):
                moved = _Point.of(rate, at.states + part * change, step)
                if moved.norm <= at.norm:
                    break
                part *= 0.5
        if not fresh and not moved.norm <= _QUICK * at.norm:
            recurrence, fresh, far = _recurrence(rate, at.states, step, grid), True, False
            continue
        if not moved.norm < torch.inf or moved is at:
            break
        at, fresh, far = moved, False, far or size * part > _NEAR
    states = at.states
    # one more step, whose value is that of rounding and whose derivative is that of the solution
    defect = _defect(rate, states, step)
    if far and (torch._C._functorch.is_functorch_wrapped_tensor(defect) or defect.requires_grad):
        recurrence = _recurrence(rate, states, step, grid)
    start = torch.where(origin, begin[places] - states, 0.0)
    states = states + recurrence.solved(start, defect)
    return Trajectory(states, _stations(rate, states, step), converged, recurrence)


@dataclass(frozen=True)
class _Point:
    """States on the way to a solution: what they lack of the equations, in size, and the scale of each state."""

    states: Tensor  # (G, n)
    defect: Tensor  # (G-1, n)
    scale: Tensor  # (n,)
    norm: float

    @classmethod
    def of(cls, rate: Rate, states: Tensor, step: Tensor) -> _Point:
        scale = states.abs().amax(0)
        scale = scale + 1e-6 * scale.max() + 1e-12
        defect = _defect(rate, states, step).detach()
        return cls(states, defect, scale, float((defect / scale).square().mean()))


def _ends(f: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    left, middle, right = f.unflatten(0, (-1, 3)).unbind(1)
    return left, middle, right


def _joined(left: Tensor, middle: Tensor, right: Tensor) -> Tensor:
    return torch.stack([left, middle, right], 1).flatten(0, 1)


def _stations(rate: Rate, states: Float[Tensor, "G n"], step: Float[Tensor, "G-1 1"]) -> Float[Tensor, "3G-3 n"]:
    """States at the stations: in the middle of an interval those of the cubic through its ends."""
    left, right = states[:-1], states[1:]
    middle = 0.5 * (left + right)
    at_left, _, at_right = _ends(rate(_joined(left, middle, right)))
    return _joined(left, middle + 0.125 * step * (at_left - at_right), right)


def _defect(rate: Rate, states: Float[Tensor, "G n"], step: Float[Tensor, "G-1 1"]) -> Float[Tensor, "G-1 n"]:
    """What the ends of each interval lack of Simpson's rule; 0 before the beginning of a trajectory."""
    left, middle, right = _ends(rate(_stations(rate, states, step)))
    jump = torch.where(step > 0, states[1:] - states[:-1], 0.0)
    return jump - step / 6.0 * (left + 4.0 * middle + right)


@dataclass(frozen=True)
class Recurrence:
    """The recurrence ``δ[k+1] = A[k] δ[k] − B[k] D[k]``: products of A over 1, 2, 4 … intervals, and B."""

    products: tuple[Tensor, ...]
    inverse: Tensor

    def solved(self, start: Float[Tensor, "G n"], defect: Float[Tensor, "G-1 n"]) -> Float[Tensor, "G n"]:
        pushed = torch.einsum("kij,kj->ki", self.inverse, defect)
        values = start - torch.cat([torch.zeros_like(pushed[:1]), pushed])
        shift = 1
        for product in self.products:
            carried = torch.einsum("kij,kj->ki", product, values[:-shift])
            values = torch.cat([values[:shift], values[shift:] + carried])
            shift *= 2
        return values


def _recurrence(rate: Rate, states: Float[Tensor, "G n"], step: Float[Tensor, "G-1 1"], grid: Grid) -> Recurrence:
    n = states.shape[1]
    eye = torch.eye(n, dtype=states.dtype, device=states.device)
    at = _stations(rate, states, step).detach()

    def along(direction: Tensor) -> Tensor:
        return torch.func.jvp(rate, (at,), (direction.expand_as(at),))[1]

    slope = torch.stack([along(direction).detach() for direction in eye], -1)
    left, middle, right = _ends(slope)
    h = step.unsqueeze(-1)
    behind = -eye - h / 6.0 * (left + 4.0 * middle @ (0.5 * eye + 0.125 * h * left))
    ahead = eye - h / 6.0 * (right + 4.0 * middle @ (0.5 * eye - 0.125 * h * right))
    inverse, _ = torch.linalg.inv_ex(ahead)
    carries = torch.where(h > 0, -inverse @ behind, 0.0)
    # the first moment has none before it
    carries = torch.cat([torch.zeros_like(carries[:1]), carries])
    products, shift = [], 1
    while shift < grid.longest:
        products.append(carries[shift:])
        carries = torch.cat([carries[:shift], carries[shift:] @ carries[:-shift]])
        shift *= 2
    return Recurrence(tuple(products), inverse)
