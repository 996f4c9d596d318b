"""The collocation of :mod:`mkc_torch.simulation.dynamics.trajectory` on NumPy arrays, and its tangents."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mkc_torch._parallel.deadline import check_deadline
from mkc_torch.simulation.dynamics.compiled.affine import Affine, inverted, multiplied
from mkc_torch.simulation.dynamics.compiled.expressions import Array
from mkc_torch.simulation.dynamics.settings import (
    HALVINGS,
    HORIZON,
    MOST_STEPS,
    QUICK,
    QUICK_MAP,
    ROUGHLY,
    ROUNDING,
    SETTLED,
    STALLED,
)


class JumpFunctions(Protocol):
    """A jump of the states at grid times; see :class:`..trajectory.Jump`."""

    def applied(self, states: Array) -> Array:
        """Return the states just after each grid time, (w, G), from those just before."""
        ...

    def slope(self, states: Array) -> Array:
        """Return the derivative of the states after by those before, (w, w, G)."""
        ...


@dataclass(frozen=True)
class Functions:
    """A differential equation at given parameters, for states at the ends (w, 2, G-1) and in the middle (w, G-1).

    A map, of a simulation that steps, is for states at the left ends (w, 1, G-1), with none in the middle.

    Attributes:
        ends, middle: the rates, in the states' shape.
        ends_slope, middle_slope: derivatives of the rates by the states, (w, w, 2, G-1) and (w, w, G-1).
        jump: jump of the states at the grid times; None for no jump.
    """

    ends: Callable[[Array], Array]
    middle: Callable[[Array], Array]
    ends_slope: Callable[[Array], Array]
    middle_slope: Callable[[Array], Array]
    jump: JumpFunctions | None


@dataclass(frozen=True)
class ArrayGrid:
    """Grid times of trajectories, in sequence.

    Attributes:
        step: (G-1,), length of each interval in s; 0 before the start of a trajectory.
        begins: (G,), True where a trajectory starts.
        longest: number of grid times of the longest trajectory.
        maps: whether the states follow the map ``x + step rate(x)`` instead of a differential equation.
    """

    step: Array
    begins: np.ndarray[tuple[int], np.dtype[np.bool_]]
    longest: int
    maps: bool = False

    @property
    def quick(self) -> float:
        """Share of the defect that a step with old linearised equations may leave."""
        return QUICK_MAP if self.maps else QUICK


@dataclass(frozen=True)
class Factor:
    """Linearised collocation equations, factorised.

    Attributes:
        affine: the recurrence of a small change of the states.
        inverse: derivative of an interval's end by its negative defect, (w, w, G-1); None where it is 1.
    """

    affine: Affine
    inverse: Array | None

    def solved(self, defect: Array) -> Array:
        """Solve for the change of the states, (w, K, G), that cancels defects (w, K, G-1) at fixed initial states."""
        return self.affine.solved(np.concatenate([np.zeros_like(defect[..., :1]), self.cancelled(defect)], -1))

    def cancelled(self, defect: Array) -> Array:
        """The change of each interval's end that cancels its defect, (w, K, G-1), at a fixed start."""
        return -defect if self.inverse is None else -multiplied(self.inverse, defect)


@dataclass(frozen=True)
class LinearisedCollocation:
    """Collocation equations linearised about states.

    Attributes:
        factor: the factorised equations.
        ends, middle: the states at the ends (w, 2, G-1) and in the middle (w, G-1) of each interval.
        behind: derivative of the defects by the states just after the left ends, (w, w, G-1).
        middle_slope: derivative of the rates by the states in the middle, (w, w, G-1).
    """

    factor: Factor
    ends: Array
    middle: Array
    behind: Array
    middle_slope: Array


@dataclass(frozen=True)
class CollocationSolution:
    """A trajectory, (w, G), and the linearised equations of the last Newton step."""

    states: Array
    factor: Factor


@dataclass(frozen=True)
class ParameterSources:
    """Sources of the states' derivatives by some parameters in the linearised equations.

    Attributes:
        parameters: indices of the K parameters.
        source: (w, K, G), of the recurrence ``factor.affine``.
        factor: the linearised equations.
    """

    parameters: list[int]
    source: Array
    factor: Factor


class Collocation(Protocol):
    """The collocation equations at given parameters."""

    def solved(self, guess: Array, factor: Factor | None = None) -> CollocationSolution | None:
        """Solve for the trajectories near a guess (w, G), with its initial states; None where none is found.

        The factor of a trajectory nearby is used as long as it converges quickly.
        """
        ...

    def solved_to(self, states: Array, inside: NDArray[np.bool_]) -> tuple[Array | None, bool]:
        """Solve roughly at the grid times inside; None where it diverges. The second value is whether it converged."""
        ...

    def sources(self, states: Array) -> ParameterSources:
        """The sources of all parameters of the rates and of the observer, at solved states (w, G)."""
        ...


class _Iterate:
    """An iterate: states, defects, the scale of each state, and the mean square of the scaled defects."""

    def __init__(self, functions: Functions, grid: ArrayGrid, states: Array) -> None:
        self.states = states
        self.ends, self.middle, self.defect = _defect(functions, grid, states)
        scale = np.abs(states).max(1, keepdims=True)
        self.scale = scale + 1e-6 * scale.max() + 1e-12
        self.norm = float(np.square(self.defect / self.scale).mean())


def _defect(functions: Functions, grid: ArrayGrid, states: Array) -> tuple[Array, Array, Array]:
    """States at the ends and in the middle of each interval, and the defect of Simpson's rule."""
    h, after = grid.step, states if functions.jump is None else functions.jump.applied(states)
    if grid.maps:
        left = after[:, None, :-1]
        gone = np.where(h > 0, states[:, 1:] - after[:, :-1], 0.0)
        return left, left[:, 0], gone - h * functions.ends(left)[:, 0]
    ends = np.stack([after[:, :-1], states[:, 1:]], 1)
    rates = functions.ends(ends)
    middle = 0.5 * (ends[:, 0] + ends[:, 1]) + 0.125 * h * (rates[:, 0] - rates[:, 1])
    simpson = rates[:, 0] + 4.0 * functions.middle(middle) + rates[:, 1]
    gone = np.where(h > 0, ends[:, 1] - ends[:, 0], 0.0)
    return ends, middle, gone - h / 6.0 * simpson


def linearised(functions: Functions, grid: ArrayGrid, states: Array) -> LinearisedCollocation:
    """Linearise the equations about states (w, G)."""
    return _linearised(functions, grid, _Iterate(functions, grid, states))


def _linearised(functions: Functions, grid: ArrayGrid, at: _Iterate) -> LinearisedCollocation:
    h, eye = grid.step, np.eye(len(at.states))[..., None]
    slope = functions.ends_slope(at.ends)
    left = slope[:, :, 0]
    if grid.maps:
        middle, inverse, behind = left, None, -eye - h * left
        carries = np.where(h > 0, -behind, 0.0)
    else:
        middle, right = functions.middle_slope(at.middle), slope[:, :, 1]
        behind = -eye - h / 6.0 * (left + 4.0 * multiplied(middle, 0.5 * eye + 0.125 * h * left))
        ahead = eye - h / 6.0 * (right + 4.0 * multiplied(middle, 0.5 * eye - 0.125 * h * right))
        inverse = inverted(ahead)
        carries = np.where(h > 0, -multiplied(inverse, behind), 0.0)
    if functions.jump is not None:
        carries = multiplied(carries, functions.jump.slope(at.states)[..., :-1])
    carries = np.concatenate([np.zeros_like(carries[..., :1]), carries], -1)
    return LinearisedCollocation(Factor(Affine.of(carries, grid.longest), inverse), at.ends, at.middle, behind, middle)


def solved(
    functions: Functions, grid: ArrayGrid, guess: Array, factor: Factor | None = None
) -> CollocationSolution | None:
    """Solve for the trajectories near a guess (w, G), with its initial states; None where none is found.

    Same steps as :func:`mkc_torch.simulation.dynamics.trajectory.solve`. The factor of a trajectory nearby is used as
    long as it converges quickly. The caller silences warnings of NumPy.
    """
    at = _Iterate(functions, grid, guess)
    fresh = factor is None
    if factor is None:
        factor = _linearised(functions, grid, at).factor
    norms = [at.norm]
    for _ in range(MOST_STEPS):
        change = factor.solved(at.defect[:, None])[:, 0]
        size = float(np.abs(change / at.scale).max())
        if size < SETTLED:
            return CollocationSolution(at.states + change, factor)
        after, part = at, 1.0
        if size < np.inf:
            for _ in range(HALVINGS if fresh else 1):
                after = _Iterate(functions, grid, at.states + part * change)
                if after.norm <= at.norm:
                    break
                part *= 0.5
        if not fresh and not after.norm <= grid.quick * at.norm:
            factor, fresh = _linearised(functions, grid, at).factor, True
            continue
        if after is at or (not after.norm < at.norm and size * part > ROUNDING):
            break
        at, fresh = after, False
        norms.append(at.norm)
        if len(norms) > STALLED and norms[-1] > 0.5 * norms[-1 - STALLED] and size * part > ROUNDING:
            break
    return None


def marched(collocation: Collocation, grid: ArrayGrid, guess: Array, stride: int = HORIZON) -> Array | None:
    """Improve a poor guess by solving roughly over a growing horizon; None where the iteration diverges.

    As :func:`mkc_torch.simulation.dynamics.trajectory.marched`, but the stride doubles after each success, and is
    divided by 4 after each failure.

    Args:
        collocation: the collocation equations.
        grid: the grid times.
        guess: (w, G), of all states; the initial states of the trajectories are kept.
        stride: grid times by which the horizon grows at least.
    """
    index = np.arange(guess.shape[1])
    first = np.maximum.accumulate(np.where(grid.begins, index, 0))
    place, states, horizon, growth = index - first, guess, 0, stride
    while horizon < grid.longest:
        check_deadline()
        # beyond the horizon the last solved state is held
        held = states[:, np.minimum(index, first + horizon)]
        tried, settled = collocation.solved_to(held, place <= horizon + growth)
        if not settled and growth > stride:
            growth = max(stride, growth // 4)
            continue
        if tried is None:
            return None
        states, horizon = tried, horizon + growth
        growth = 2 * growth if settled else stride
    return states


def solved_to(
    functions: Functions, grid: ArrayGrid, states: Array, inside: NDArray[np.bool_]
) -> tuple[Array | None, bool]:
    """States solved roughly at the grid times inside, None where they diverge; and whether they converged."""
    for _ in range(MOST_STEPS):
        at = _Iterate(functions, grid, states)
        left = np.where(inside[1:], at.defect, 0.0)
        change = np.where(inside, _linearised(functions, grid, at).factor.solved(left[:, None])[:, 0], 0.0)
        size = float(np.abs(change / at.scale).max())
        if not size < np.inf:
            return None, False
        part, norm = 1.0, float(np.square(left / at.scale).mean())
        for _ in range(HALVINGS):
            after = np.where(inside[1:], _defect(functions, grid, states + part * change)[2], 0.0)
            if float(np.square(after / at.scale).mean()) <= norm:
                break
            part *= 0.5
        states = states + part * change
        if size * part < ROUGHLY:
            return states, True
    return states, False


def dense(values: Sequence[Array | float], places: Sequence[tuple[int, int]], shape: tuple[int, ...]) -> Array:
    """Build a matrix for all grid times from its elements that are not 0."""
    found = np.zeros(shape)
    for place, value in zip(places, values, strict=True):
        found[place] = value
    return found
