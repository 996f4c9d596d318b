"""The map of a simulation that steps, such as a simulator of mechanisms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Steps:
    """What is declared of a simulation that steps, instead of found in its equations.

    Its ``derivative`` returns the change of the states over one step, divided by the length of the step.

    Attributes:
        size: length of a step in s.
        positions: state that is a position, to the state that is its speed.
        forces: input that is a force acting along a speed, to this speed; its column is 0 in every recording.
        constants: input that is the change of a constant of the simulation; its column is 0 in every recording.
        followed: inputs that are recorded motion; effects do not act on them, and they are linear between samples.
        rollout: from a state (1, n), inputs (T, u) and the parameters to the states after each of T steps, (T, n),
            without derivatives.
        alone: whether the derivative is that of the steps and nothing else, so that such a rollout is the trajectory.
    """

    size: float
    positions: Mapping[str, str]
    forces: Mapping[str, str]
    constants: tuple[str, ...]
    followed: tuple[str, ...]
    rollout: Callable[[Tensor, Tensor, Any], Tensor]
    alone: bool


def port_of(steps: Steps | None, name: str) -> str:
    """The name of the port at an input; a constant of a simulation that steps has a kind of its own."""
    return f"constant {name}" if steps is not None and name in steps.constants else f"input {name}"
