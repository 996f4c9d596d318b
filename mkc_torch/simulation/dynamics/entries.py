"""Inputs that move several rates, as a force goes through a mass matrix, and the speed that each acts along."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from mkc_torch.effects.kinds import kind_of
from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.surroundings import unit_of
from mkc_torch.simulation.dynamics.trajectory import Grid
from mkc_torch.simulation.dynamics.user_functions import namespace
from mkc_torch.simulation.dynamics.varying import Acting
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.parameter import Parameter
from mkc_torch.simulation.ports import Changes
from mkc_torch.simulation.scattered import scattered

if TYPE_CHECKING:
    from jaxtyping import Float

_FORCES = {"N": "speed", "kN": "speed", "N m": "rotation", "N·m": "rotation", "Nm": "rotation", "mN m": "rotation"}
"""Units of forces and torques, with the kind of the speed that each acts along."""

_MOST = 5000
"""Largest number of assignments of inputs to speeds that is compared; beyond it the order of the states decides."""

_LINEAR = 1e-6
"""Relative change of a gain with its input up to which a rate is linear in the input."""

_ROUNDING = 1e-13
"""Relative error of a computed rate."""

_STEADY = 1e-3
"""Smallest share of its largest value that the gain of an input on its own speed falls to: an inertia is positive."""

_PLACES = 20
"""Number of scattered states of either sign at which gains are computed."""


class Known(Protocol):
    """Equations with their parameters."""

    system: Equations
    known: Mapping[str, Parameter]


class Enterable(Protocol):
    """The part of a prepared system that the gains of its inputs depend on.

    Attributes:
        system: the equations.
        grid: the grid times.
        guess: (G, n), a first guess of the states.
    """

    system: Equations
    grid: Grid
    guess: Float[Tensor, "G n"]

    @property
    def given(self) -> Float[Tensor, " p"]: ...
    def acting(self, theta: Tensor, changes: Changes) -> Acting: ...
    def rate(self, theta: Tensor, changes: Changes, acting: Acting | None = None) -> Callable[[Tensor], Tensor]: ...


def entries(system: Equations, known: Mapping[str, Parameter], kinematic: Mapping[str, str]) -> dict[str, str]:
    """Find the inputs that move several rates in proportion to themselves, and the speed that each acts along.

    A force on a mechanism moves all accelerations through the inverse of the mass matrix. Its own speed is that of its
    unit (N with m/s, N m with rad/s), whose rate it moves with one sign. Of several, it is the choice that makes the
    gains of the inputs on their speeds symmetric, as the inverse of a mass matrix is, and else the first state.

    Args:
        system: the equations; units are those declared, or the defaults of the names.
        known: their parameters.
        kinematic: state whose rate is another state, to that state.

    Returns:
        State by input; inputs that move one rate only, or not in proportion, are left out.

    Source: Siciliano et al., "Robotics" (2009), 7.2: the inertia matrix is symmetric and positive definite.

    Example:
        >>> from mkc_torch.simulation import Dynamics
        >>> class Cart(Dynamics):
        ...     states, inputs = ("x", "angle", "v", "w"), ("force",)
        ...
        ...     def derivative(self, time, x, u, p):
        ...         return {"x": x.v, "angle": x.w, "v": u.force - 0.2 * x.w, "w": -9.8 * x.angle - u.force}
        >>> entries(Cart(), {}, {"x": "v", "angle": "w"})
        {'force': 'v'}
    """
    if system.steps is not None:
        return dict(system.steps.forces)
    gains = _gains(system, known)
    speeds = [state for state in system.states if state in kinematic.values()]
    choices: dict[str, list[str]] = {}
    for name in system.inputs:
        moved = [state for state in system.states if state not in kinematic and _moves(gains, state, name)]
        if len(moved) > 1 and all(bool(gains[state, name].isfinite().all()) for state in moved):
            own = [state for state in moved if _is_steady(gains[state, name])]
            own = [state for state in own if state in speeds] or own
            choices |= {name: _of_unit(own, name, system)} if own else {}
    return _assigned(choices, gains)


def typical_gains(prepared: Enterable, name: str) -> dict[str, float]:
    """The median absolute gain of an input on each rate, which is linear in it, along the guess of the states.

    Args:
        prepared: the system with its recording, in open loop.
        name: of the input.
    """
    typical = gain_of(prepared, name, prepared.given).abs().median(0).values
    return dict(zip(prepared.system.states, typical.tolist(), strict=True))


def gain_of(prepared: Enterable, name: str, theta: Float[Tensor, " p"]) -> Float[Tensor, "S n"]:
    """The gain of an input on each rate, which is linear in it, along the guess of the states.

    Args:
        prepared: the system with its recording, in open loop.
        name: of the input.
        theta: the parameters.
    """
    at, k = prepared.grid.spread(prepared.guess), prepared.system.inputs.index(name)
    acting = prepared.acting(theta, {})
    more = acting._replace(inputs=acting.inputs + torch.eye(acting.inputs.shape[1], dtype=at.dtype)[k])
    once, other = (prepared.rate(theta, {}, now)(at) for now in (acting, more))
    return other - once


def lone_input(prepared: Known, state: str) -> str | None:
    """The only input that moves a rate, if it moves no other rate, and this one in proportion to itself.

    Args:
        prepared: the system.
        state: whose rate it is.

    Returns:
        None without such an input.
    """
    system = prepared.system
    if system.steps is not None:
        return None
    gains = _gains(system, prepared.known)
    moving = [name for name in system.inputs if _moves(gains, state, name)]
    if len(moving) != 1 or any(_moves(gains, other, moving[0]) for other in system.states if other != state):
        return None
    return moving[0] if _is_steady(gains[state, moving[0]]) else None


_Gains = Mapping[tuple[str, str], "Float[Tensor, ' S']"]


def _gains(system: Equations, known: Mapping[str, Parameter]) -> _Gains:
    """Derivatives of the rates by the inputs, by state and input; NaN where a rate is not linear in an input.

    They are taken at scattered states, of which those without finite rates are left out.
    """

    def drawn(count: int) -> Tensor:
        size = scattered(_PLACES, count)
        return torch.cat([size, -size])

    time, states, inputs = drawn(1)[:, 0].abs(), drawn(len(system.states)), drawn(len(system.inputs))
    p = Names(**{name: states.new_tensor(parameter.value or 1.0) for name, parameter in known.items()})

    def rates(values: Tensor) -> Float[Tensor, "S n"]:
        found = system.derivative(time, namespace(system.states, states), namespace(system.inputs, values), p)
        ordered = [found[s] for s in system.states] if isinstance(found, Mapping) else list(found)
        return torch.stack([value + torch.zeros_like(time) for value in ordered], -1)

    plain, gains = rates(inputs), {}
    for k, name in enumerate(system.inputs):
        step = torch.zeros_like(inputs)
        step[:, k] = 1.0
        once, twice = rates(inputs + step) - plain, rates(inputs + 2.0 * step) - plain
        usable = (once + twice).isfinite().all(-1)
        for state, slope, both, at in zip(system.states, once.mT, twice.mT, plain.mT, strict=True):
            rounding = _ROUNDING * at.abs()
            slope = torch.where(slope.abs() > rounding, slope, 0.0)
            bent = ((both - 2.0 * slope).abs() > _LINEAR * slope.abs() + 4.0 * rounding)[usable].any()
            gains[state, name] = torch.where(bent, math.nan, slope)[usable]
    return gains


def _moves(gains: _Gains, state: str, name: str) -> bool:
    """Whether an input moves a rate, in proportion or by another law."""
    return bool((gains[state, name] != 0.0).any())


def _is_steady(gain: Float[Tensor, " S"]) -> bool:
    """Whether a gain keeps its sign and its order of magnitude."""
    size = gain.abs()
    one_sign = bool((gain > 0).all()) or bool((gain < 0).all())
    return one_sign and len(gain) > 0 and float(size.amin()) > _STEADY * float(size.amax())


def _of_unit(states: list[str], name: str, system: Equations) -> list[str]:
    """The states whose unit belongs to that of the input; all where units do not decide."""
    kind = _FORCES.get(unit_of(system, name), "")
    return [state for state in states if kind and kind_of(unit_of(system, state), state) == kind] or states


def _assigned(choices: Mapping[str, Sequence[str]], gains: _Gains) -> dict[str, str]:
    """A different state for each input, with gains that are as symmetric as possible; the first where alike."""
    names = list(choices)
    if math.prod(len(own) for own in choices.values()) > _MOST:
        return {name: own[0] for name, own in choices.items()}
    sets = [own for own in itertools.product(*choices.values()) if len(set(own)) == len(own)]

    def asymmetry(own: Sequence[str]) -> float:
        pairs = itertools.combinations(range(len(names)), 2)
        return sum(float((gains[own[i], names[j]] - gains[own[j], names[i]]).abs().mean()) for i, j in pairs)

    best = min(sets, key=asymmetry, default=())
    return dict(zip(names, best, strict=False))
