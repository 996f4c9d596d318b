"""The interface of simulations to the diagnosis: parameters, a residual, and ports at which effects act."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

from torch import Tensor

from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.recording.join_recordings import Clock
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.continuation import CompiledResidual, Meaning
from mkc_torch.simulation.dynamics.observer import Observer
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.own_offsets import OwnOffset
from mkc_torch.simulation.ports import Answer, Changes, Nearby, Port
from mkc_torch.simulation.start_checks import StartCheck

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from typing_extensions import Self

Jacobian = Literal["forward", "reverse twice"]
"""How a fit differentiates a residual: by forward mode, or for many small operations by double reverse mode."""


class ClosedForm(ABC):
    """Base class of prepared simulations in closed form, without states, process noise, or a start of evaluations.

    A derived class provides the other members of :class:`PreparedSimulation`.
    """

    prior: GaussianPrior | None = None
    faults: tuple[str, ...] = ()
    input_hold: Mapping[str, str] = MappingProxyType({})
    own_offsets: tuple[OwnOffset, ...] = ()
    beginnings: int = 0
    jacobian: Jacobian = "forward"
    observer: Observer | None = None
    dynamics: PreparedDynamics | None = None
    recorded: Bool[Tensor, "N m"] | None = None
    checks: tuple[StartCheck, ...] = ()

    @abstractmethod
    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N m"]:
        """The residual, recording minus prediction."""

    def answer(self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None) -> Answer:
        """The residual; see :meth:`PreparedSimulation.answer`."""
        return Answer(self.residual(theta, changes))

    def compiled(self, meaning: Meaning, size: int) -> CompiledResidual | None:
        """None: torch evaluates the closed form."""
        return None

    def prior_given(self, settled: Collection[str]) -> GaussianPrior | None:
        """The prior, which no effect changes."""
        return self.prior

    def observed(self, observer: Observer | None) -> Self:
        """The simulation itself: it has no states to observe."""
        return self

    def open_loop(self) -> Self:
        """The simulation itself: it has no observer."""
        return self

    def with_input_hold(self, hold: Mapping[str, str]) -> Self:
        """The simulation itself: it uses no values between samples."""
        return self

    def with_own_offsets(self, recording: Int[Tensor, " N"], names: Sequence[str]) -> Self:
        """The simulation itself: its outputs have no offsets of single recordings."""
        return self

    def finer(self) -> Self | None:
        """None: there is no step of integration."""
        return None


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
        measured: (N, k), the recorded columns that the residual is computed of.
        recorded: (N, m), False where an output is missing and its residual is that of the nearest recorded sample; None
            where none is missing.
        checks: checks of the simulation's own parameters at the start of the fit.
        faults: sentences about faults of the recording with which no comparison is meaningful; usually empty.
        input_hold: "held", "linear" or "smooth" for each input that is used between samples.
        own_offsets: offsets of the outputs in single recordings, where several are diagnosed together.
        beginnings: number of parameters of single runs and recordings, their offsets and initial states; they are last.
        jacobian: how a fit differentiates the residual.
        observer: the observer that corrects the states at each sample; None in open loop.
        dynamics: the simulation as differential equations, for estimates of process noise; None in closed form.
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
    @property
    def measured(self) -> Float[Tensor, "N k"]: ...
    @property
    def recorded(self) -> Bool[Tensor, "N m"] | None: ...
    @property
    def checks(self) -> tuple[StartCheck, ...]: ...
    @property
    def faults(self) -> tuple[str, ...]: ...
    @property
    def input_hold(self) -> Mapping[str, str]: ...
    @property
    def own_offsets(self) -> tuple[OwnOffset, ...]: ...
    @property
    def beginnings(self) -> int: ...
    @property
    def jacobian(self) -> Jacobian: ...
    @property
    def observer(self) -> Observer | None: ...
    @property
    def dynamics(self) -> PreparedDynamics | None: ...

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

    def compiled(self, meaning: Meaning, size: int) -> CompiledResidual | None:
        """The residual as a function of ``size`` parameters, computed without torch; None where that is impossible.

        Args:
            meaning: maps these parameters to the simulation's own parameters and the changes at its ports.
            size: number of parameters.
        """
        ...

    def prior_given(self, settled: Collection[str]) -> GaussianPrior | None:
        """The prior of the parameters, given effects that are equivalent to clock parameters.

        Args:
            settled: "offset", "rate" or both; these clock parameters are held at 0, so that the effect is complete.
        """
        ...

    def observed(self, observer: Observer | None) -> PreparedSimulation:
        """The simulation with its states corrected by an observer; None for the open loop."""
        ...

    def open_loop(self) -> PreparedSimulation:
        """The simulation without an observer."""
        ...

    def with_input_hold(self, hold: Mapping[str, str]) -> PreparedSimulation:
        """The simulation with other holds of its inputs, by input; unchanged without values between samples."""
        ...

    def with_own_offsets(self, recording: Int[Tensor, " N"], names: Sequence[str]) -> PreparedSimulation:
        """The simulation with an offset of each output in each recording, where the recordings determine it.

        Args:
            recording: number of each sample's recording.
            names: names of the recordings.
        """
        ...

    def finer(self) -> PreparedSimulation | None:
        """The simulation with half the step of integration; None with a fixed step or without steps."""
        ...


class Correction(Protocol):
    """A fitted simulation on a new recording, for removing effects from it.

    Attributes:
        recording: the N samples in use.
        time: (N,), in s.
        ports: ports at which an effect belongs to the sensor or system, and not to the place.
    """

    @property
    def recording(self) -> Recording: ...
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
        measured: columns whose copies drive no effect, because the simulation is compared with them.
        joint_clock: how the times of recordings that are diagnosed together are arranged, see
            :data:`mkc_torch.recording.join_recordings.Clock`.

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
    @property
    def measured(self) -> frozenset[str]: ...
    @property
    def joint_clock(self) -> Clock: ...

    def prepare(self, recording: Recording) -> PreparedSimulation:
        """The simulation together with a recording.

        Raises:
            MissingColumnError: the recording lacks a column.
            ValueError: it cannot be simulated; the message states why.
        """
        ...
