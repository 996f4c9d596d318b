"""The interface of simulations to the diagnosis: parameters, a residual, and ports at which effects act."""

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
"""The change at a port, (N, c), as a function of the signal there.

At a port with memory the signal can have more components, the internal states; the change then has more channels, their
rates.
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
    carries: tuple[str, ...] = ()
    parts: Mapping[str, str] = field(default_factory=dict)
    part_units: Mapping[str, str] = field(default_factory=dict)
    sizes: Mapping[str, SignalSizes] = field(default_factory=dict)
    clock: SignalTimes | None = None
    run: Int[Tensor, " G"] | None = None
    memory: Mapping[str, str] = field(default_factory=dict)

    def in_series(self, name: str) -> bool:
        """Whether effects at this port, named ``name``, act in series, each on the output of the previous effect.

        Effects on an input or an output are in a signal chain; forces on a rate add up.

        Example:
            >>> Port(("u",), "V", kind="input").in_series("input u"), Port(("v",), "m/s²").in_series("rate of v")
            (True, False)
        """
        return (self.kind or name) in ("input", "output", "outputs")

    def at(self, values: Float[Tensor, N * rest]) -> Float[Tensor, G * rest]:
        """Values of the samples, interpolated to the moments of this port's signal."""
        return values if self.clock is None else self.clock.at(values)


class Nearby(Protocol):
    """The start of an evaluation near a known evaluation, such as a trajectory.

    Attributes:
        bare: the same without derived data that can be recomputed.
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


class ClosedForm(ABC):
    """A prepared simulation in closed form, which needs no start for its evaluation."""

    @abstractmethod
    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N m"]:
        """The residual, recording minus prediction."""

    def answer(self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None) -> Answer:  # noqa: ARG002
        """The residual; see :meth:`PreparedSimulation.answer`."""
        return Answer(self.residual(theta, changes))


class PreparedSimulation(Protocol):
    """A simulation together with a recording: N samples, m residual channels, p parameters.

    Attributes:
        name: name of the simulation in ``diagnosis.json``.
        channels, unit: names of the residual's channels, and their unit.
        parameter_names: names of the p parameters.
        prior: prior of the parameters; None for no prior.
        bounds: lower and upper bounds of the parameters, (p,) each; None for no bounds.
        recording: the samples in use, in the order of time.
        time: (N,), in s; the number of the sample where the recording has no time.
        ports: name to port, where effects can act.
        independent: for each channel, whether its noise is independent of the error of the ports' signals; where it is
            not, an effect that follows the signal would be a false alarm.
        warnings: sentences about what the recording does not determine.
        state: constants that a :class:`Correction` needs in addition to the parameters; JSON-serialisable.
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
        """A robust start of the parameters, from the samples in ``rows``; None for all samples.

        Raises:
            NoFitError: these samples do not determine the parameters.
        """
        ...

    def answer(self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None) -> Answer:
        """The residual, recording minus prediction, with ``changes[port](signal)`` added to the signals at the ports.

        The result depends only on the arguments.

        Args:
            theta: the parameters.
            changes: the change at each port.
            near: start of the evaluation, from an evaluation at parameters and changes nearby; None for no start.
        """
        ...

    def signals(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None
    ) -> Mapping[str, Float[Tensor, "G k"]]:
        """The signal at each port, for effects that depend on it."""
        ...


@runtime_checkable
class Clocked(Protocol):
    """A prepared simulation with clock parameters, which an effect can be equivalent to."""

    def prior_given(self, settled: Collection[str]) -> GaussianPrior:
        """The prior of the parameters, given effects that are equivalent to clock parameters.

        Args:
            settled: "offset", "rate" or both; these clock parameters are held at 0, so that the effect is complete.
        """
        ...


@runtime_checkable
class Beginning(Protocol):
    """A prepared simulation whose last parameters are the initial states of its runs, after recordings' offsets.

    Attributes:
        beginnings: number of these parameters.
    """

    @property
    def beginnings(self) -> int: ...


class Correction(Protocol):
    """A fitted simulation on a new recording, for removing effects from it.

    Attributes:
        time: (N,), in s.
        ports: ports at which an effect belongs to the sensor or system, and not to the place.
    """

    @property
    def time(self) -> Float[Tensor, " N"]: ...
    @property
    def ports(self) -> Mapping[str, Port]: ...

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> dict[str, Float[Tensor, " N"]]:
        """The corrected columns, with ``changes`` removed."""
        ...


@runtime_checkable
class CorrectableSimulation(Protocol):
    """A simulation whose effects can be removed from new recordings."""

    def correction(self, state: Mapping[str, Any], recording: Recording) -> Correction:
        """The fitted simulation on a new recording.

        Args:
            state: :attr:`PreparedSimulation.state` of the fitted simulation.
            recording: the recording to correct.

        Raises:
            MissingColumnError: the recording lacks a column.
        """
        ...


class Simulation(Protocol):
    """A simulation of a kind of recording, the argument of :func:`mkc_torch.diagnose`.

    :class:`mkc_torch.simulation.Magnetometer` and :class:`mkc_torch.simulation.Paired` are ready to use; a user's own
    simulation derives from :class:`mkc_torch.simulation.Static` or :class:`mkc_torch.simulation.Dynamics`.

    Attributes:
        name: name in ``diagnosis.json``.
        columns: names of the columns that the simulation uses, which do not drive effects.
        joins_experiments: whether all runs of a recording, separated by its column ``experiment``, are fitted jointly;
            otherwise each run is diagnosed separately.

    An optional attribute ``measured`` has the names of the columns that it is compared with: a column that repeats a
    measured column drives no effect.

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
        """The simulation together with a recording.

        Raises:
            MissingColumnError: the recording lacks a column.
            ValueError: it cannot be simulated; the message states why.
        """
        ...


def refuse_no_recording(name: str, value: object) -> None:
    """Refuse a value that is not a recording, with the remedy.

    Raises:
        TypeError: it is a file name, a data frame, or another object.
    """
    advice = "make one, Recording({'time': ..., ...}), or read it, Recording.read('REC.csv')"
    if isinstance(value, (str, os.PathLike)):
        advice = f"read it, Recording.read({os.fspath(value)!r})"
    elif is_frame(value):
        advice = f"make one, Recording({name})"
    refuse_other_type(name, value, Recording, "a Recording", advice)
