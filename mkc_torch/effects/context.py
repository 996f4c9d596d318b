"""The inputs of an effect from a recording, and the parameters that it reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from mkc_torch.effects.runs import run_numbers

if TYPE_CHECKING:
    from jaxtyping import Float, Int

SEVERAL = "several"
"""The part of the port of all outputs, where there are several outputs with the same unit."""

Shape = Mapping[str, float]
"""Parameters that an effect is not linear in, such as its onset or a time constant in s; found by a search."""


@dataclass(frozen=True)
class Context:
    """The inputs of an effect from a recording: N samples, k drivers, c channels of the port it acts on.

    Attributes:
        time: in s.
        drivers: (N, k), in the recording's units, less their means over the diagnosed recording.
        units: units of the drivers.
        signal: (N, c), the signal at the port.
        signal_unit: unit of the change.
        channels: names of the changed components; also of the signal's components where ``carries`` is empty.
        carries: names of the signal's components where it has more components than the change.
        parts: roles of the signal's components, such as ``{"own": "speed", "position": "angle"}``.
        part_units: units of the parts.
        run: (N,), number of each sample's run; None where the simulation has no runs.
        driver_means: means that were subtracted from the drivers.
        columns: names of the drivers.

    Example:
        >>> import torch
        >>> time = torch.tensor([0.0, 1.0, 2.0, 0.0, 1.0])
        >>> context = Context(time, torch.zeros(5, 1), ("A",), torch.zeros(5, 2), "µT", ("x", "y"))
        >>> context.runs  # a run begins where time goes back
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
    driver_means: tuple[float, ...] = ()
    columns: tuple[str, ...] = ()

    @property
    def recorded(self) -> Float[Tensor, " N"]:
        """The first driver as it was recorded, with its mean."""
        return self.drivers[:, 0] + (self.driver_means[0] if self.driver_means else 0.0)

    @property
    def runs(self) -> Int[Tensor, " N"]:
        """Number of each sample's run; without runs in the simulation, a run begins where time goes back."""
        # a drawn curve has fewer points, which belong to no run
        known = self.run is not None and len(self.run) == len(self.time)
        return self.run if known and self.run is not None else run_numbers(self.time)

    @property
    def memories(self) -> Float[Tensor, "N k"] | None:
        """The internal states of a port with memory while a trajectory is solved; None elsewhere."""
        known = len(self.carries or self.channels)
        return self.signal[:, known:] if self.signal.shape[1] > known else None

    @property
    def memory(self) -> Float[Tensor, " N"] | None:
        """The first of the :attr:`memories`."""
        return None if self.memories is None else self.memories[:, 0]

    def part(self, name: str) -> Float[Tensor, " N"]:
        """The component of the signal with this role.

        Raises:
            KeyError: the port has no such part; an effect lists the parts it requires in ``needs``.
        """
        return self.component(self.parts[name])

    def component(self, name: str) -> Float[Tensor, " N"]:
        """The component of the signal with this name."""
        return self.signal[:, (self.carries or self.channels).index(name)]

    def unit_of(self, part: str) -> str:
        """The unit of a part; empty if not known."""
        return self.part_units.get(part, "")


class Quantity(NamedTuple):
    """A parameter in a report: ``size`` numbers of γ, in ``unit``.

    Example:
        >>> Quantity("offset_change", 3, "µT")  # of three axes
        Quantity(name='offset_change', size=3, unit='µT')
    """

    name: str
    size: int
    unit: str
