"""Initial states of the trajectories in a new recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.simulation.ports import Nearby

if TYPE_CHECKING:
    from jaxtyping import Float


class InitialStates(NamedTuple):
    """Initial states of all trajectories, (s,), trajectory after trajectory, and a solution near them."""

    values: Tensor
    near: Nearby | None


@dataclass(frozen=True)
class OwnStates:
    """Which initial states are estimated: a memory of an effect starts equal to a state, or at 0.

    Attributes:
        kept: (f,), indices of the estimated states among all.
        source: (s,), for each initial state the index of its value among the estimated, or f for 0.

    Example:
        >>> own = OwnStates.of(("x", "lagged", "store"), {"lagged": "x", "store": ""}, 2)
        >>> own.all(torch.tensor([3.0, 4.0])).tolist()
        [3.0, 3.0, 0.0, 4.0, 4.0, 0.0]
        >>> own.free(torch.arange(6.0)).tolist()
        [0.0, 3.0]
    """

    kept: Tensor
    source: Tensor

    @classmethod
    def of(cls, states: Sequence[str], starts_as: Mapping[str, str], trajectories: int) -> OwnStates:
        """Return the estimated states of so many trajectories."""
        free = [name for name in states if name not in starts_as]
        kept, source = [], []
        for k in range(trajectories):
            kept += [k * len(states) + number for number, name in enumerate(states) if name in free]
            for name in states:
                like = starts_as.get(name, name)
                source.append(k * len(free) + free.index(like) if like else trajectories * len(free))
        return cls(torch.tensor(kept), torch.tensor(source))

    def free(self, states: Float[Tensor, " s"]) -> Float[Tensor, " f"]:
        """Return the estimated states."""
        return states[self.kept]

    def all(self, free: Float[Tensor, " f"]) -> Float[Tensor, " s"]:
        """Return all initial states."""
        return torch.cat([free, torch.zeros_like(free[:1])])[self.source]
