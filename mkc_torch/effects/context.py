"""What an effect sees of a recording, and the parameters that it tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from mkc_torch.effects.runs import run_numbers

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["Context", "Quantity", "Shape"]

Shape = Mapping[str, float]
"""Numbers that an effect is not linear in, such as its onset or a time constant in s; they are searched, not fitted."""


@dataclass(frozen=True)
class Context:
    """What an effect sees of a recording: N samples, k drivers, c channels of the port it acts on.

    Attributes:
        time: in s.
        drivers: (N, k), in the recording's units, less their means over the recording that was diagnosed.
        units: of the drivers.
        signal: (N, c), what passes through the port.
        signal_unit: the unit of what is added to it.
        channels: names of the components that are added to; of the signal's too, where ``carries`` is empty.
        carries: names of the signal's components, where they are more than what is added to.
        parts: what components of the signal are to each other, such as ``{"own": "speed", "position": "angle"}``.
        part_units: of the parts.
        run: number of each sample's run, where the simulation knows of runs.

    Example:
        >>> import torch
        >>> time = torch.tensor([0.0, 1.0, 2.0, 0.0, 1.0])
        >>> context = Context(time, torch.zeros(5, 1), ("A",), torch.zeros(5, 2), "µT", ("x", "y"))
        >>> context.runs  # one begins where time goes back
        tensor([0, 0, 0, 1, 1])
        >>> context.component("y").shape
        torch.Size([5])
    """

    time: Float[Tensor, " N"]
    drivers: Float[Tensor, "N k"]
    units: tuple[str, ...]
    signal: Float[Tensor, "N c"]
    signal_unit: str
    channels: tuple[str, ...]
    carries: tuple[str, ...] = ()
    parts: Mapping[str, str] = field(default_factory=dict)
    part_units: Mapping[str, str] = field(default_factory=dict)
    run: Int[Tensor, " N"] | None = None

    @property
    def runs(self) -> Int[Tensor, " N"]:
        """Number of each sample's run; where the simulation knows of none, one begins where time goes back."""
        # the points of a curve, which are fewer, are of no run
        known = self.run is not None and len(self.run) == len(self.time)
        return self.run if known and self.run is not None else run_numbers(self.time)

    @property
    def memories(self) -> Float[Tensor, "N k"] | None:
        """The internal states of a port with memory, where a trajectory is being solved for; None elsewhere."""
        known = len(self.carries or self.channels)
        return self.signal[:, known:] if self.signal.shape[1] > known else None

    @property
    def memory(self) -> Float[Tensor, " N"] | None:
        """The first of the :attr:`memories`."""
        return None if self.memories is None else self.memories[:, 0]

    def part(self, name: str) -> Float[Tensor, " N"]:
        """The component of the signal that is this part.

        Raises:
            KeyError: the port has no such part; ``needs`` says which an effect cannot do without.
        """
        return self.component(self.parts[name])

    def component(self, name: str) -> Float[Tensor, " N"]:
        """The component of the signal that is called this."""
        return self.signal[:, (self.carries or self.channels).index(name)]

    def unit_of(self, part: str) -> str:
        """The unit of a part; empty where it is not known."""
        return self.part_units.get(part, "")


class Quantity(NamedTuple):
    """A parameter as a user reads it: it covers ``size`` numbers of γ, in ``unit``.

    Example:
        >>> Quantity("offset_change", 3, "µT")  # of three axes
        Quantity(name='offset_change', size=3, unit='µT')
    """

    name: str
    size: int
    unit: str
