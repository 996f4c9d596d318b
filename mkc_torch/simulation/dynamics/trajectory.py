"""Trajectories of a differential equation at all grid times at once: collocation, solved by Newton's method.

Between neighbouring grid times the solution obeys the Hermite-Simpson formula (Lobatto IIIA of fourth order, A-stable:
Hairer & Wanner, "Solving Ordinary Differential Equations II", 1996, IV.5). Linearising all of these equations gives an
affine recurrence from each grid time to the next, which is composed in parallel (Blelloch, "Prefix sums and their
applications", 1990). So there is no sequential integration, the last Newton step gives the derivatives by parameters
and inputs, and a guess from measured states makes unstable systems solvable.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch._support.torch_internals import is_wrapped, temporarily_clear_interpreter_stack
from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.simulation.dynamics.recurrence import Recurrence
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

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

Rate = Callable[[Tensor], Tensor]
"""Rate of change of the states at the stations of a grid, (S, n) → (S, n)."""

_DIGITS = 100.0
"""Convergence threshold at least, in units of the machine epsilon."""


@dataclass(frozen=True)
class Grid:
    """Grid times of one or several trajectories, in sequence.

    The rates are evaluated at three stations of each interval: its left end, middle and right end. The interval before
    the start of a trajectory has length 0. A simulation that steps has a station at the left end only.

    Attributes:
        time: (G,), in s.
        begins: (G,), True where a trajectory starts, and for the first time.
        map_step: for a simulation that steps, the length of its step in s, whatever the times of the grid: the states
            follow the map ``x + map_step rate(x)``. None for a differential equation.
    """

    time: Float[Tensor, " G"]
    begins: Bool[Tensor, " G"]
    map_step: float | None = None

    @property
    def step(self) -> Float[Tensor, " G-1"]:
        """Length of each interval in s; 0 before the start of a trajectory."""
        inside = self.time.diff() if self.map_step is None else torch.full_like(self.time[1:], self.map_step)
        return torch.where(self.begins[1:], 0.0, inside)

    @property
    def per_interval(self) -> int:
        """Number of stations of an interval."""
        return 3 if self.map_step is None else 1

    @property
    def stations(self) -> Float[Tensor, " S"]:
        """Times of the stations in s."""
        return self.spread(self.time)

    def spread(self, values: Float[Tensor, G * rest]) -> Float[Tensor, S * rest]:
        """Interpolate values at the grid times to the stations linearly."""
        left, right = values[:-1], values[1:]
        if self.map_step is not None:
            return left
        return torch.stack([left, 0.5 * (left + right), right], 1).flatten(0, 1)

    @property
    def longest(self) -> int:
        """Number of grid times of the longest trajectory."""
        first = self.begins.nonzero().squeeze(-1)
        return int(torch.cat([first, first.new_tensor([len(self.begins)])]).diff().max())


class Jump(Protocol):
    """A jump of the states at grid times, such as an observer's corrections."""

    def applied(self, states: Float[Tensor, "G n"]) -> Float[Tensor, "G n"]:
        """Return the states just after each grid time, from those just before."""
        ...

    def slope(self, states: Float[Tensor, "G n"]) -> Float[Tensor, "G n n"]:
        """Return the derivative of the states after by those before, without a gradient of its own."""
        ...


@dataclass(frozen=True)
class Trajectory:
    """States at the grid times.

    Attributes:
        states: (G, n).
        converged: whether they solve the collocation equations.
        linear: the equations linearised about them; None where not kept.
    """

    states: Float[Tensor, "G n"]
    converged: bool
    linear: Linear | None = None

    @property
    def bare(self) -> Trajectory:
        """The trajectory without its linearisation: small, and independent of the process that found it."""
        return Trajectory(self.states, self.converged)


class Linear:
    """Collocation equations linearised near a trajectory.

    Args:
        renewed: linearises the equations about the trajectory's states.
        recurrence: the linearised equations; None calls ``renewed`` at the first use.
        factor: the linearised equations for NumPy, see :mod:`mkc_torch.simulation.dynamics.compiled`; None without.
    """

    def __init__(
        self, renewed: Callable[[], Recurrence], recurrence: Recurrence | None = None, factor: object | None = None
    ) -> None:
        self.renewed, self.factor = renewed, factor
        self._recurrence = recurrence

    @property
    def recurrence(self) -> Recurrence:
        if self._recurrence is None:
            self._recurrence = self.renewed()
        return self._recurrence


def solve(
    rate: Rate,
    grid: Grid,
    begin: Float[Tensor, "K n"],
    guess: Float[Tensor, "G n"],
    known: Trajectory | None = None,
    jump: Jump | None = None,
) -> Trajectory:
    """Solve for the trajectories with given initial states.

    First derivatives of the states by anything that ``rate`` and ``begin`` depend on are exact, in forward and in
    reverse mode. The guess has no derivative.

    Args:
        rate: rate of change of the states at the stations.
        grid: the grid times of K trajectories.
        begin: (K, n), the initial states.
        guess: (G, n), a guess of all states.
        known: a trajectory nearby that replaces the guess; its linearised equations are used as long as they converge
            quickly.
        jump: jump of the states at each grid time; the trajectory holds the states just before. None for no jump.

    Returns:
        The trajectory; ``converged`` is False where none is found.

    Example:
        A decay at a rate of 2/s:

        >>> time = torch.linspace(0.0, 1.0, 11, dtype=torch.float64)
        >>> grid = Grid(time, time == 0.0)
        >>> begin = torch.ones(1, 1, dtype=torch.float64)
        >>> found = solve(lambda x: -2.0 * x, grid, begin, begin.expand(11, 1))
        >>> bool((found.states[:, 0] - torch.exp(-2.0 * time)).abs().max() < 2e-6), found.converged
        (True, True)
    """
    origin = grid.begins.unsqueeze(-1)
    places = grid.begins.long().cumsum(0) - 1
    states = torch.where(origin, begin.detach()[places], (guess if known is None else known.states).detach())
    at = _Point.of(rate, states, grid, jump)
    linear = None if known is None else known.linear
    fresh, moved_on = linear is None, False
    recurrence = _recurrence(rate, states, grid, jump) if linear is None else linear.recurrence
    converged = False
    settled = max(SETTLED, _DIGITS * torch.finfo(states.dtype).eps)
    norms = [at.norm]
    for _ in range(MOST_STEPS):
        change = recurrence.solved(torch.zeros_like(states), at.left.detach())
        size = float((change / at.scale).abs().max())
        if size < settled:
            converged = True
            break
        after, part = at, 1.0
        if size < torch.inf:
            for _ in range(HALVINGS if fresh else 1):
                after = _Point.of(rate, at.states + part * change, grid, jump)
                if after.norm <= at.norm:
                    break
                part *= 0.5
        if not fresh and not after.norm <= (QUICK if grid.map_step is None else QUICK_MAP) * at.norm:
            recurrence, fresh = _recurrence(rate, at.states, grid, jump), True
            continue
        if after is at or (not after.norm < at.norm and size * part > ROUNDING):
            break
        at, fresh, moved_on = after, False, True
        norms.append(at.norm)
        if len(norms) > STALLED and norms[-1] > 0.5 * norms[-1 - STALLED] and size * part > ROUNDING:
            break
    states, left = at.states, at.left
    transformed = any(is_wrapped(tensor) for tensor in (left, begin))

    def renewed() -> Recurrence:
        # these tensors belong to no transform of the caller, within which this would nest forward mode
        with nullcontext() if transformed else temporarily_clear_interpreter_stack():
            return _recurrence(rate, states, grid, jump)

    if transformed or any(tensor.requires_grad for tensor in (left, begin)):
        # outside of the transform the result is the same, and cheaper
        recurrence = renewed() if linear is None or moved_on else linear.renewed()
    # a further Newton step: it changes the value by rounding only, and has the derivative of the solution
    start = torch.where(origin, begin[places] - states, 0.0)
    return Trajectory(states + recurrence.solved(start, left), converged, Linear(renewed, recurrence))


def linearised_later(
    functions: Callable[[], tuple[Rate, Jump | None]],
    states: Float[Tensor, "G n"],
    grid: Grid,
    factor: object | None = None,
) -> Linear:
    """The equations of a solved trajectory, linearised at the first use.

    Args:
        functions: returns the rate and the jump of :func:`solve`.
        states: (G, n), of the trajectory.
        grid: its grid times.
        factor: the linearised equations for NumPy.
    """

    def renewed() -> Recurrence:
        with temporarily_clear_interpreter_stack():
            rate, jump = functions()
            return _recurrence(rate, states, grid, jump)

    return Linear(renewed, factor=factor)


def marched(
    rate: Rate,
    grid: Grid,
    begin: Float[Tensor, "K n"],
    guess: Float[Tensor, "G n"],
    *,
    stride: int = HORIZON,
    jump: Jump | None = None,
) -> Float[Tensor, "G n"] | None:
    """Improve a poor guess by solving the trajectories over a growing horizon.

    Args:
        rate, grid, begin: as in :func:`solve`.
        guess: (G, n), of all states.
        stride: grid times by which the horizon grows; small strides are slower and more robust.
        jump: as in :func:`solve`.

    Returns:
        The states, (G, n), to a rough tolerance; None where the iteration diverges.
    """
    index = torch.arange(len(guess), device=guess.device)
    first = torch.where(grid.begins, index, 0).cummax(0).values
    place = index - first
    states = torch.where(grid.begins.unsqueeze(-1), begin.detach()[grid.begins.long().cumsum(0) - 1], guess.detach())
    for horizon in range(stride, grid.longest + stride, stride):
        # beyond the horizon the last solved state is held
        states = states[torch.minimum(index, first + horizon - stride)]
        inside = (place <= horizon).unsqueeze(-1)
        for _ in range(MOST_STEPS):
            at = _Point.of(rate, states, grid, jump)
            left = torch.where(inside[1:], at.left.detach(), 0.0)
            change = torch.where(
                inside, _recurrence(rate, states, grid, jump).solved(torch.zeros_like(states), left), 0.0
            )
            size = float((change / at.scale).abs().max())
            if not size < torch.inf:
                return None
            part, norm = 1.0, float((left / at.scale).square().mean())
            for _ in range(HALVINGS):
                after = defect(rate, states + part * change, grid, jump).detach()
                if float((torch.where(inside[1:], after, 0.0) / at.scale).square().mean()) <= norm:
                    break
                part *= 0.5
            states = states + part * change
            if size * part < ROUGHLY:
                break
    return states


@dataclass(frozen=True)
class _Point:
    """An iterate: the states, their defects, the scale of each state, and the mean square of the scaled defects."""

    states: Tensor  # (G, n)
    left: Tensor  # (G-1, n), with derivatives
    scale: Tensor  # (n,)
    norm: float

    @classmethod
    def of(cls, rate: Rate, states: Tensor, grid: Grid, jump: Jump | None) -> _Point:
        scale = states.abs().amax(0)
        scale = scale + 1e-6 * scale.max() + 1e-12
        left = defect(rate, states, grid, jump)
        return cls(states, left, scale, float((left.detach() / scale).square().mean()))


def _ends(f: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    left, middle, right = f.unflatten(0, (-1, 3)).unbind(1)
    return left, middle, right


def _joined(left: Tensor, middle: Tensor, right: Tensor) -> Tensor:
    return torch.stack([left, middle, right], 1).flatten(0, 1)


def stations(rate: Rate, states: Float[Tensor, "G n"], grid: Grid, jump: Jump | None = None) -> Float[Tensor, "S n"]:
    """States at the stations; the midpoint is on the cubic Hermite polynomial through the interval's ends."""
    left, right = _after(states, jump)[:-1], states[1:]
    if grid.map_step is not None:
        return left
    middle = 0.5 * (left + right)
    at_left, _, at_right = _ends(rate(_joined(left, middle, right)))
    return _joined(left, middle + 0.125 * grid.step.unsqueeze(-1) * (at_left - at_right), right)


def defect(rate: Rate, states: Float[Tensor, "G n"], grid: Grid, jump: Jump | None = None) -> Float[Tensor, "G-1 n"]:
    """Defect of Simpson's rule, or of the map, over each interval, (G-1, n); 0 before the start of a trajectory."""
    step = grid.step.unsqueeze(-1)
    at = stations(rate, states, grid, jump)
    gone = torch.where(step > 0, states[1:] - at[:: grid.per_interval], 0.0)
    if grid.map_step is not None:
        return gone - step * rate(at)
    left, middle, right = _ends(rate(at))
    return gone - step * (left + 4.0 * middle + right) / 6.0


def _after(states: Float[Tensor, "G n"], jump: Jump | None) -> Float[Tensor, "G n"]:
    return states if jump is None else jump.applied(states)


def transition_matrices(
    rate: Rate, states: Float[Tensor, "G n"], grid: Grid, jump: Jump | None = None
) -> tuple[Float[Tensor, "G-1 n n"], Float[Tensor, "G-1 n n"]]:
    """Derivatives of the next states by the states just after a grid time, and by the interval's negative defect."""
    n = states.shape[1]
    eye = torch.eye(n, dtype=states.dtype, device=states.device)
    slope = slopes(rate, stations(rate, states, grid, jump).detach(), at_once=grid.map_step is not None)
    h = grid.step.unsqueeze(-1).unsqueeze(-1)
    if grid.map_step is not None:
        return torch.where(h > 0, eye + h * slope, 0.0), eye.expand_as(slope)
    left, middle, right = _ends(slope)
    behind = -eye - h / 6.0 * (left + 4.0 * middle @ (0.5 * eye + 0.125 * h * left))
    ahead = eye - h / 6.0 * (right + 4.0 * middle @ (0.5 * eye - 0.125 * h * right))
    inverse, _ = torch.linalg.inv_ex(ahead)
    return torch.where(h > 0, -inverse @ behind, 0.0), inverse


def _recurrence(rate: Rate, states: Float[Tensor, "G n"], grid: Grid, jump: Jump | None) -> Recurrence:
    carries, inverse = transition_matrices(rate, states, grid, jump)
    if jump is not None:
        carries = carries @ jump.slope(states.detach())[:-1]
    # no interval ends at the first grid time
    carries = torch.cat([torch.zeros_like(carries[:1]), carries])
    return Recurrence.of(carries, inverse, grid.longest)


def slopes(rate: Rate, at: Float[Tensor, "S n"], *, at_once: bool = False) -> Float[Tensor, "S k n"]:
    """Jacobian of the rates by the states of their own station, without a gradient of its own.

    Reverse mode is used outside of function transforms. It is cheaper than forward mode, which propagates the zero
    tangents of every constant. Forward mode is the fallback where the Jacobian is not finite, since reverse mode
    multiplies an infinite slope in the unused branch of ``torch.where`` by 0. ``at_once`` propagates all rows back
    together, for rates of few operations, each of which torch can do for a batch.
    """
    with torch.enable_grad():
        given = at.requires_grad_() if not is_wrapped(at) else at
        rates = rate(given)
        if not is_wrapped(rates):
            n = rates.shape[1]
            if not rates.requires_grad:
                return at.new_zeros(len(at), n, at.shape[1])
            each = torch.eye(n, dtype=at.dtype, device=at.device).unsqueeze(1).expand(n, len(at), n)
            if at_once:
                (found,) = torch.autograd.grad(
                    rates, given, each, is_grads_batched=True, allow_unused=True, materialize_grads=True
                )
                slope = found.movedim(0, 1)
            else:
                rows = [
                    torch.autograd.grad(
                        rates, given, row, retain_graph=k + 1 < n, allow_unused=True, materialize_grads=True
                    )[0]
                    for k, row in enumerate(each)
                ]
                slope = torch.stack(rows, 1)
            if bool(slope.isfinite().all()):
                return slope
    load_forward_mode()
    at = at.detach()

    def along(direction: Tensor) -> Tensor:
        return torch.func.jvp(dual_constants(rate), (at,), (direction.expand_as(at),))[1]

    eye = torch.eye(at.shape[1], dtype=at.dtype, device=at.device)
    return torch.stack([along(direction).detach() for direction in eye], -1)
