"""Ports of a simulation, where effects act: the signals there, their changes, and the resulting residual."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Int

Change = Callable[[Tensor], Tensor]
"""The change at a port, (N, c), as a function of the signal there.

At a port with memory, the signal may have the internal states as further components; the change then has their rates as
further channels.
"""

Changes = Mapping[str, Change]


@dataclass(frozen=True)
class FreeChange:
    """A change that does not depend on the signal, which then need not be simulated."""

    of: Change

    def __call__(self, signal: Tensor) -> Tensor:
        return self.of(signal)


@dataclass(frozen=True)
class SignalTimes:
    """The G moments at which a port's signal is simulated, where they are not the recording's samples.

    Attributes:
        time: (G,), in s.
        before, after: (G,), the samples before and after each moment.
        share: (G,), position of the moment between these samples, 0 to 1.
    """

    time: Float[Tensor, " G"]
    before: Int[Tensor, " G"]
    after: Int[Tensor, " G"]
    share: Float[Tensor, " G"]

    def at(self, values: Float[Tensor, N * rest]) -> Float[Tensor, G * rest]:
        """Values of the samples, interpolated to these moments."""
        share = self.share.reshape(-1, *[1] * (values.dim() - 1))
        return torch.lerp(values[self.before], values[self.after], share)


class SignalSizes(NamedTuple):
    """Sizes of values: the typical and the largest absolute value, the lowest and the highest value.

    Example:
        >>> SignalSizes.of(torch.tensor([-3.0, 1.0, 2.0]))
        SignalSizes(typical=2.0, largest=3.0, lowest=-3.0, highest=2.0)
    """

    typical: float
    largest: float
    lowest: float
    highest: float

    @classmethod
    def of(cls, values: Float[Tensor, " N"]) -> SignalSizes:
        """The sizes of these values; the typical absolute value is the median."""
        size = values.abs()
        return cls(*(float(value) for value in (size.median(), size.amax(), values.amin(), values.amax())))


@dataclass(frozen=True)
class Port:
    """A place in a simulation where an effect adds to a signal.

    Attributes:
        channels: names of the changed components.
        unit: unit of the change.
        allows_drift: whether the noise model allows for drift at this port.
        pointwise: whether a change of a sample changes the residual of this sample only.
        kind: an effect is tried at every port of its kind; default the port's name.
        stands_for: another kind of ports, whose effects are tried here too; default none.
        carries: names of the signal's components; default the channels.
        parts: roles of the signal's components, such as ``{"own": "speed", "position": "angle"}``.
        part_units, sizes: units and sizes of the parts.
        clock: moments of the signal; None for the recording's samples.
        run: number of each moment's run; None where the simulation has no runs.
        memory: names of the internal states that an effect here may have, with the state whose initial value each
            takes; empty for the initial value 0.

    Example:
        >>> sensor = Port(("mag_x", "mag_y", "mag_z"), "µT", kind="sensor")
        >>> sensor.at(torch.ones(5, 3)).shape  # at the recording's own samples
        torch.Size([5, 3])
    """

    channels: tuple[str, ...]
    unit: str
    allows_drift: bool = False
    pointwise: bool = True
    kind: str = ""
    stands_for: str = ""
    carries: tuple[str, ...] = ()
    parts: Mapping[str, str] = field(default_factory=dict)
    part_units: Mapping[str, str] = field(default_factory=dict)
    sizes: Mapping[str, SignalSizes] = field(default_factory=dict)
    clock: SignalTimes | None = None
    run: Int[Tensor, " G"] | None = None
    memory: Mapping[str, str] = field(default_factory=dict)

    def in_series(self, name: str) -> bool:
        """Whether effects at this port, named ``name``, act in series, each on the output of the previous effect.

        Effects on an input or an output are in a signal chain, those on a parameter are factors; forces on a rate add
        up.

        Example:
            >>> Port(("u",), "V", kind="input").in_series("input u"), Port(("v",), "m/s²").in_series("rate of v")
            (True, False)
        """
        return (self.kind or name) in ("input", "output", "outputs", "single output", "parameter")

    def at(self, values: Float[Tensor, N * rest]) -> Float[Tensor, G * rest]:
        """Values of the samples, interpolated to the moments of this port's signal."""
        return values if self.clock is None else self.clock.at(values)


class Nearby(Protocol):
    """The start of an evaluation near a known evaluation, such as a trajectory.

    Attributes:
        bare: a copy without derived data that can be recomputed.
    """

    @property
    def bare(self) -> Nearby: ...


class Answer(NamedTuple):
    """The residual of a simulation, and a start for evaluations at parameters nearby.

    Attributes:
        residual: (N, m), recording minus prediction; NaN where the simulation has no solution.
        nearby: the argument ``near`` of :meth:`PreparedSimulation.answer`; None inside of a transform, and for a
            simulation in closed form.
    """

    residual: Float[Tensor, "N m"]
    nearby: Nearby | None = None
