"""What the diagnosis asks of a simulation: parameters, a residual, and ports through which physics can be added."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from torch import Tensor

from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["Correction", "Port", "PreparedSimulation", "Simulation"]

Changes = Mapping[str, Tensor]


@dataclass(frozen=True)
class Port:
    """A place in a simulation where an effect adds to a signal.

    Attributes:
        channels: what the signal's components are called.
        unit: of the signal.
        wanders: whether noise that wanders in time may enter here too; the noise model allows for it then.
        pointwise: whether a change of one sample changes the residual of that sample alone.
    """

    channels: tuple[str, ...]
    unit: str
    wanders: bool = False
    pointwise: bool = True


class PreparedSimulation(Protocol):
    """A simulation together with the recording that answers it: N samples, m residual channels, p parameters.

    Attributes:
        name: of the simulation, as ``diagnosis.json`` gives it.
        channels, unit: of the residual.
        parameter_names: of the p parameters.
        prior: what is known of the parameters beforehand; None if nothing.
        recording: the samples in use, in the order of time.
        time: in s; the sample's number where the recording has no time.
        ports: where effects can act.
        independent: for each channel, whether its noise is independent of the error that the ports' signals have; where
            it is not, an effect that follows the signal would seem to be there.
        warnings: sentences about what the recording leaves undetermined.
        state: constants, beside the parameters, that a :class:`Correction` needs; what JSON can hold.
    """

    @property
    def name(self) -> str: ...
    @property
    def channels(self) -> tuple[str, ...]: ...
    @property
    def unit(self) -> str: ...
    @property
    def parameter_names(self) -> tuple[str, ...]: ...
    @property
    def prior(self) -> GaussianPrior | None: ...
    @property
    def recording(self) -> Recording: ...
    @property
    def time(self) -> Float[Tensor, " N"]: ...
    @property
    def ports(self) -> Mapping[str, Port]: ...
    @property
    def independent(self) -> tuple[bool, ...]: ...
    @property
    def warnings(self) -> tuple[str, ...]: ...
    @property
    def state(self) -> Mapping[str, object]: ...

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Float[Tensor, " p"]:
        """A robust guess of the parameters, from the samples in ``rows`` (all, if None).

        Raises:
            ValueError: those samples do not determine them.
        """
        ...

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N m"]:
        """Recording less prediction, with ``changes[port]`` (N, channels of the port) added at the ports."""
        ...

    def signals(self, theta: Float[Tensor, " p"]) -> Mapping[str, Float[Tensor, "N c"]]:
        """What passes through each port: what an effect that depends on the signal is a function of."""
        ...


class Correction(Protocol):
    """The measuring side of a simulation on a new recording: what taking effects off it needs.

    Attributes:
        time: in s.
        ports: those at which an effect belongs to the sensor or system, and not to where it was.
    """

    @property
    def time(self) -> Float[Tensor, " N"]: ...
    @property
    def ports(self) -> Mapping[str, Port]: ...

    def signals(self, theta: Float[Tensor, " p"]) -> Mapping[str, Float[Tensor, "N c"]]:
        """What passes through each port."""
        ...

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> dict[str, Float[Tensor, " N"]]:
        """The corrected columns, with ``changes`` taken off."""
        ...


class Simulation(Protocol):
    """A simulation of a kind of recording.

    Attributes:
        name: as ``diagnosis.json`` gives it.
        columns: names of the columns that the simulation uses itself, which are no drivers of effects.
    """

    @property
    def name(self) -> str: ...
    @property
    def columns(self) -> frozenset[str]: ...

    def prepare(self, recording: Recording) -> PreparedSimulation:
        """The simulation of a recording.

        Raises:
            MissingColumnError: the recording lacks a column.
            ValueError: it cannot be simulated; the message says why.
        """
        ...
