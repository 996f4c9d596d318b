"""What the diagnosis asks of a simulation: parameters, a residual, and ports through which physics can be added."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_other_type
from mkc_torch._support.arrays import is_frame
from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

__all__ = [
    "Answer",
    "Beginning",
    "Change",
    "Changes",
    "Clocked",
    "ClosedForm",
    "CorrectableSimulation",
    "Correction",
    "FreeChange",
    "Nearby",
    "Port",
    "PreparedSimulation",
    "SignalSizes",
    "SignalTimes",
    "Simulation",
    "refuse_no_recording",
]

Change = Callable[[Tensor], Tensor]
"""What effects add at a port, (N, c), as a function of the signal that passes through it.

At a port with memory a signal can have more components, the internal states; what is added then has more channels,
their rates.
"""

Changes = Mapping[str, Change]


@dataclass(frozen=True)
class FreeChange:
    """A change that is the same whatever passes through the port: nobody needs to simulate the signal for it."""

    of: Change

    def __call__(self, signal: Tensor) -> Tensor:
        return self.of(signal)


@dataclass(frozen=True)
class SignalTimes:
    """The moments at which a port's signal is simulated, G of them, where they are not the recording's samples.

    Attributes:
        time: (G,) in s.
        before, after: (G,), the samples that a moment lies between.
        share: (G,), how far it is from the one to the other, 0 to 1.
    """

    time: Float[Tensor, " G"]
    before: Int[Tensor, " G"]
    after: Int[Tensor, " G"]
    share: Float[Tensor, " G"]

    def at(self, values: Float[Tensor, N * rest]) -> Float[Tensor, G * rest]:
        """Values of the samples, at these moments."""
        share = self.share.reshape(-1, *[1] * (values.dim() - 1))
        return torch.lerp(values[self.before], values[self.after], share)


class SignalSizes(NamedTuple):
    """How large values are: a typical and the largest absolute one, and the lowest and the highest.

    Example:
        >>> SignalSizes.of(torch.tensor([-3.0, 1.0, 2.0]))
        Sizes(typical=2.0, largest=3.0, lowest=-3.0, highest=2.0)
    """

    typical: float
    largest: float
    lowest: float
    highest: float

    @classmethod
    def of(cls, values: Float[Tensor, " N"]) -> SignalSizes:
        """Of these values; the typical one is the median."""
        size = values.abs()
        return cls(*(float(one) for one in (size.median(), size.amax(), values.amin(), values.amax())))


@dataclass(frozen=True)
class Port:
    """A place in a simulation where an effect adds to a signal.

    Attributes:
        channels: what the components are called that are added to.
        unit: of what is added.
        wanders: whether noise that wanders in time may enter here too; the noise model allows for it then.
        pointwise: whether a change of one sample changes the residual of that sample alone.
        kind: an effect is tried at every port of its kind; default the port's own name.
        carries: the components of the signal that passes; default the channels.
        parts: what components of the signal are to each other, such as ``{"own": "speed", "position": "angle"}``.
        part_units, sizes: of the parts.
        clock: when; None for the recording's samples.
        run: number of each moment's run; None where the simulation knows of no runs.
        memory: names of the internal states that an effect here may bring, and the state whose first value each begins
            with; empty for 0.

    Example:
        >>> sensor = Port(("mag_x", "mag_y", "mag_z"), "µT", kind="sensor")
        >>> sensor.at(torch.ones(5, 3)).shape  # at the recording's own samples
        torch.Size([5, 3])
    """

    channels: tuple[str, ...]
    unit: str
    wanders: bool = False
    pointwise: bool = True
    kind: str = ""
    carries: tuple[str, ...] = ()
    parts: Mapping[str, str] = field(default_factory=dict)
    part_units: Mapping[str, str] = field(default_factory=dict)
    sizes: Mapping[str, SignalSizes] = field(default_factory=dict)
    clock: SignalTimes | None = None
    run: Int[Tensor, " G"] | None = None
    memory: Mapping[str, str] = field(default_factory=dict)

    def in_series(self, name: str) -> bool:
        """Whether effects at this port, called ``name``, act in series, each on the output of the one before.

        Effects on an input or an output are parts of one signal chain; forces on a rate add up.

        Example:
            >>> Port(("u",), "V", kind="input").in_series("input u"), Port(("v",), "m/s²").in_series("rate of v")
            (True, False)
        """
        return (self.kind or name) in ("input", "output", "outputs")

    def at(self, values: Float[Tensor, N * rest]) -> Float[Tensor, G * rest]:
        """Values of the samples, at the moments of this port's signal."""
        return values if self.clock is None else self.clock.at(values)


class Nearby(Protocol):
    """What a simulation begins an answer with that is near one it has found, such as a trajectory.

    Attributes:
        bare: the same without what can be computed from it again.
    """

    @property
    def bare(self) -> Nearby: ...


class Answer(NamedTuple):
    """The residual of a simulation, and what one at parameters nearby can begin with.

    Attributes:
        residual: (N, m), recording less prediction; NaN where the simulation has no answer.
        nearby: what :meth:`PreparedSimulation.answer` takes as ``near``; None where there is nothing, as inside of a
            transform, or for a simulation in closed form.
    """

    residual: Float[Tensor, "N m"]
    nearby: Nearby | None = None


class ClosedForm(ABC):
    """A prepared simulation that is a formula: it needs nothing to begin with."""

    @abstractmethod
    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N m"]:
        """Recording less prediction."""

    def answer(self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None) -> Answer:  # noqa: ARG002
        """The residual; see :meth:`PreparedSimulation.answer`."""
        return Answer(self.residual(theta, changes))


class PreparedSimulation(Protocol):
    """A simulation together with the recording that answers it: N samples, m residual channels, p parameters.

    Attributes:
        name: of the simulation, as ``diagnosis.json`` gives it.
        channels, unit: of the residual.
        parameter_names: of the p parameters.
        prior: what is known of the parameters beforehand; None if nothing.
        bounds: least and greatest values of the parameters, (p,) each; None if all are free.
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
    def bounds(self) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]] | None: ...
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
            NoFitError: those samples do not determine them.
        """
        ...

    def answer(self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None) -> Answer:
        """Recording less prediction, with ``changes[port](signal)`` added to what passes through the ports.

        It depends on its arguments alone.

        Args:
            theta: the parameters.
            changes: what effects add at each port.
            near: of an answer to parameters and changes nearby, from which this one is found; None for none.
        """
        ...

    def signals(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None
    ) -> Mapping[str, Float[Tensor, "G k"]]:
        """What passes through each port: what an effect that depends on the signal is a function of."""
        ...


@runtime_checkable
class Clocked(Protocol):
    """A prepared simulation with clocks of its own among its parameters, where an effect can be the same thing."""

    def prior_beside(self, settled: Collection[str]) -> GaussianPrior:
        """What is known of the parameters beside effects that settle a part of the clocks.

        Args:
            settled: "offset", "rate" or both; it is held, so that the effect has all of it.
        """
        ...


@runtime_checkable
class Beginning(Protocol):
    """A prepared simulation whose last parameters are the states that its runs begin in, behind recordings' offsets.

    Attributes:
        beginnings: how many.
    """

    @property
    def beginnings(self) -> int: ...


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

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> dict[str, Float[Tensor, " N"]]:
        """The corrected columns, with ``changes`` taken off."""
        ...


@runtime_checkable
class CorrectableSimulation(Protocol):
    """A simulation whose effects can be taken off new recordings."""

    def correction(self, state: Mapping[str, Any], recording: Recording) -> Correction:
        """The measuring side on a new recording.

        Args:
            state: :attr:`PreparedSimulation.state` of the one that was fitted.
            recording: to correct.

        Raises:
            MissingColumnError: the recording lacks a column.
        """
        ...


class Simulation(Protocol):
    """A simulation of a kind of recording: what :func:`mkc_torch.diagnose` takes.

    :class:`mkc_torch.simulation.Magnetometer` and :class:`mkc_torch.simulation.Paired` are some as they are; a user's
    own derives from :class:`mkc_torch.simulation.Static` or :class:`mkc_torch.simulation.Dynamics`.

    Attributes:
        name: as ``diagnosis.json`` gives it.
        columns: names of the columns that the simulation uses itself, which are no drivers of effects.
        joins_experiments: whether one fit takes all runs of a recording together, told apart by its column
            ``experiment``; where it does not, each run is diagnosed by itself.

    It may also have ``measured``, the names of the columns that it is compared with: a column that repeats one of these
    drives no effect.

    Example:
        >>> from mkc_torch.simulation import Static
        >>> class Thermistor(Static):
        ...     inputs, outputs, parameters = ("temperature",), ("voltage",), {"slope": 0.01}
        ...
        ...     def output(self, time, u, p):
        ...         return {"voltage": p.slope * u.temperature}
        >>> simulation: Simulation = Thermistor()
        >>> simulation.name, simulation.joins_experiments
        ('Thermistor', False)
    """

    @property
    def name(self) -> str: ...
    @property
    def columns(self) -> frozenset[str]: ...
    @property
    def joins_experiments(self) -> bool: ...

    def prepare(self, recording: Recording) -> PreparedSimulation:
        """The simulation of a recording.

        Raises:
            MissingColumnError: the recording lacks a column.
            ValueError: it cannot be simulated; the message says why.
        """
        ...


def refuse_no_recording(name: str, value: object) -> None:
    """Refuse what is no recording, and say how to get one.

    Raises:
        TypeError: a file's name, columns, or something else.
    """
    advice = "make one, Recording({'time': ..., ...}), or read it, Recording.read('REC.csv')"
    if isinstance(value, (str, os.PathLike)):
        advice = f"read it, Recording.read({os.fspath(value)!r})"
    elif is_frame(value):
        advice = f"make one, Recording({name})"
    refuse_other_type(name, value, Recording, "a Recording", advice)
