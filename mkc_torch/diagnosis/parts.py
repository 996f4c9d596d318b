"""The parts of a diagnosis: findings with their evidence, and the figures of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

from mkc_torch.density.tails import ChannelTails
from mkc_torch.diagnosis.environment import Curve, Grade, ShapeCheck
from mkc_torch.effects.kinds import Kind

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

Number = float | tuple["Number", ...]


@dataclass(frozen=True)
class EvidenceResult:
    """The result of a test of evidence, for a finding or the whole diagnosis.

    Attributes:
        test: its id.
        value: the result, for further use in Python.
        content: what ``diagnosis.json`` contains as ``evidence.<test>``: JSON, or results of this file.
        keys: the same for tests with keys of their own in the finding or the diagnosis; a mapping is merged into an
            existing object.
    """

    test: str
    value: Any = None
    content: Mapping[str, Any] = field(default_factory=dict)
    keys: Mapping[str, Any] = field(default_factory=dict)


def value_of(evidence: Sequence[EvidenceResult], test: str, default: Any = None) -> Any:
    """Return the result of a test, or the default if the test was not run."""
    return next((result.value for result in evidence if result.test == test), default)


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect.

    ``standard_error`` has the shape of ``value``, with None for an unknown error. ``components`` labels the numbers of
    a list in their order; empty for a single number. ``of_shape`` is True for a number of the effect's shape, such as a
    period, which exists at any size of the effect.
    """

    name: str
    value: Number
    standard_error: Number | None
    unit: str
    components: tuple[str, ...] = ()
    of_shape: bool = False


@dataclass(frozen=True)
class SizeAtInput:
    """The size of an effect on a rate as a change of the input that moves this rate, in the input's unit.

    ``parameters`` are the amplitudes whose unit differs from that at the rate; their errors include those of the
    simulation's own parameters.
    """

    input: str
    parameters: tuple[EffectParameter, ...]


@dataclass(frozen=True)
class Reference:
    """The reference value of a driver in an equation, its mean over the recording: T̄, Ī, x̄."""

    column: str
    value: float
    unit: str


@dataclass(frozen=True)
class ResidualSizes:
    """RMS residuals of one output without and with the findings, in its own unit."""

    before: float
    after: float
    unit: str


@dataclass(frozen=True)
class DivergedBlock:
    """A held-out block in which the open-loop simulation leaves the recording's range.

    ``before`` and ``after``: whether it does so without and with the finding. ``number`` counts the blocks in time,
    from 1.
    """

    number: int
    before: bool
    after: bool


@dataclass(frozen=True)
class HeldOut:
    """Evidence on held-out blocks; the gain in nats per sample, with its 95 % interval.

    ``outputs`` has each output's residuals. ``diverged_blocks`` lists those of the ``blocks`` held-out blocks in which
    an open-loop simulation leaves the recording's range; no mean includes them. ``decides`` is False if noise and
    physics
    were selected together: the blocks can then reject a finding but not confirm it, because process noise predicts one
    step ahead as well.
    """

    log_likelihood_gain: float
    confidence_interval: tuple[float, float]
    rmse_before: float
    rmse_after: float
    unit: str
    outputs: Mapping[str, ResidualSizes] = field(default_factory=dict)
    diverged_blocks: tuple[DivergedBlock, ...] = ()
    blocks: int = 0
    decides: bool = True


@dataclass(frozen=True)
class Extrapolation:
    """A fit to the low values of a driver, tested on the high values: gain in nats per sample, its 95 % interval."""

    log_likelihood_gain: float
    confidence_interval: tuple[float, float]


@dataclass(frozen=True)
class DriverShift:
    """Number of copies of a driver, shifted in time by up to ``reach`` s either way, and number that gain as much."""

    copies: int
    as_good: int
    reach: float


@dataclass(frozen=True)
class Alternative:
    """Another candidate for a finding: by how many nats it is less likely, and whether the recording separates the two.

    ``port`` is where it acts, if the simulation has several places for it. ``recurrence`` states whether it recurs in
    another recording. ``distinguishing_state`` is what to record to distinguish it from the finding, if the recording
    does not. ``parameters`` are its fitted parameters in place of the finding, with those of its shape; empty for an
    alternative that was not fitted to the end, such as a separable one.
    """

    effect: str
    drivers: tuple[str, ...]
    log_likelihood_gap: float
    separable: bool
    port: str = ""
    recurrence: str = ""
    distinguishing_state: str = ""
    parameters: tuple[EffectParameter, ...] = ()


@dataclass(frozen=True)
class Region:
    """A part of a state's range that holds most of a finding's gain, in a smaller share of the time.

    ``kind`` is "below", "above", "near zero" or "far from zero", each by ``bound``, in ``unit``.
    """

    state: str
    unit: str
    kind: str
    bound: float
    share_of_gain: float
    share_of_time: float


@dataclass(frozen=True)
class StateMap:
    """A finding's gain in nats over two states, summed over cells; NaN in cells without samples."""

    states: tuple[str, str]
    units: tuple[str, ...]
    edges: tuple[Float[Tensor, " X"], Float[Tensor, " Y"]]
    nats: Float[Tensor, "X Y"]


@dataclass(frozen=True)
class Finding:
    """A piece of physics that the simulation lacks, or the effect "unknown"; see ``diagnosis.json``.

    ``map`` is for the report; None if it cannot be drawn.
    ``region`` is None if the gain spreads over all states, or if the simulation has no states.
    ``experiments`` has each run's share of the gain; empty for a single run.
    ``recordings`` are the recordings that each have a size of their own; empty for a common size.
    ``event_times`` are the times in s at which an effect with several onsets sets in; the first is its onset.
    ``references`` are the reference values of the drivers in the equation.
    ``advice`` is what to do about the finding; ``recurrence`` states whether it recurs in another recording.
    ``location_specific`` effects belong to the place or the attitude of this recording.
    ``kind`` is the quantity it acts on, such as "temperature"; empty if unknown.
    ``cannot_be`` is True if its size is impossible, see ``plausibility``; ``doubts`` are sentences about numbers of its
    shape at the ends of their ranges.
    ``times_plausible`` is its size as a multiple of the largest plausible size; None if that is unknown.
    ``shown_share`` is the share of the change of a sensor's vector that its compared length shows; None where each
    component is compared.
    ``clearly_better`` is True if the open-loop fit without it, with all others, is clearly less likely, whatever the
    error of its size.
    ``p_value`` is that after the whole search; None in a quick look, which draws no surrogates.
    ``at_input`` has the size in the unit of an input, for an effect on a rate that one input alone moves.
    ``grade`` rates the finding; ``shape`` checks its named shape, None if not checked.
    ``evidence`` has the results of the tests of evidence.
    """

    effect: str
    drivers: tuple[str, ...]
    channels: tuple[str, ...]
    intervals: tuple[tuple[float, float], ...]
    onset: float | None
    equation: str
    explanation: str
    parameters: tuple[EffectParameter, ...]
    p_value: float | None
    alternatives: tuple[Alternative, ...]
    plausible: bool
    plausibility: str
    curve: Curve | None = None
    region: Region | None = None
    experiments: tuple[float, ...] = ()
    recordings: tuple[str, ...] = ()
    map: StateMap | None = None
    event_times: tuple[float, ...] = ()
    references: tuple[Reference, ...] = ()
    advice: str = ""
    recurrence: str = ""
    location_specific: bool = False
    kind: Kind = ""
    cannot_be: bool = False
    doubts: tuple[str, ...] = ()
    times_plausible: float | None = None
    shown_share: float | None = None
    clearly_better: bool = False
    at_input: SizeAtInput | None = None
    grade: Grade = "left_out"
    shape: ShapeCheck | None = None
    evidence: tuple[EvidenceResult, ...] = ()

    @property
    def held_out(self) -> HeldOut | None:
        """The gain on held-out blocks; None if it cannot be measured."""
        return value_of(self.evidence, "held_out", (None, ""))[0]

    @property
    def held_out_note(self) -> str:
        """Why ``held_out`` is None, or what limits it."""
        return value_of(self.evidence, "held_out", (None, ""))[1]

    @property
    def extrapolation(self) -> Extrapolation | None:
        """The gain at high values of its driver; None if that cannot be tested."""
        return value_of(self.evidence, "extrapolation")

    @property
    def driver_shift(self) -> DriverShift | None:
        """How many shifted copies of its driver gain as much; None without a recorded driver."""
        return value_of(self.evidence, "driver_shift")

    @property
    def onset_interval(self) -> tuple[float, float] | None:
        """The 95 % confidence interval of the onset; None without an onset."""
        return value_of(self.evidence, "onset")

    @property
    def comes_and_goes(self) -> bool:
        """Whether a step is intermittent, as if something was switched on and off."""
        return bool(value_of(self.evidence, "switched"))


@dataclass(frozen=True)
class DensityCheck:
    """Distances of a channel's residuals from the density and from a Student-t distribution.

    The distances are Kolmogorov's, between distribution functions. ``allowed`` is the distance that sets of as many
    independent samples exceed with probability ``level``. ``closer`` is True if a Student-t is clearly closer.
    """

    channel: str
    distance: float
    student_distance: float
    degrees_of_freedom: float
    allowed: float
    closer: bool
    level: float = 0.001


@dataclass(frozen=True)
class NoiseSummary:
    """The noise model that effects were tested against.

    ``model`` is one of "white", "ar" and "random_walk"; ``parameters`` names its numbers, ``units`` has the units of
    those that have one. ``bound`` is the half-width of the density's domain, equal for all compared models. ``unit`` is
    that of d and the bound. ``tails`` has the test for heavy tails of each channel, on its effective number of
    independent residuals; empty if the fit of a channel is exact.
    """

    model: Literal["white", "ar", "random_walk"]
    parameters: Mapping[str, Number]
    sigma: tuple[float, ...]
    d: tuple[float, ...]
    bound: tuple[float, ...]
    description: str
    units: Mapping[str, str] = field(default_factory=dict)
    unit: str = ""
    tails: tuple[ChannelTails, ...] = ()


@dataclass(frozen=True)
class OutputSize:
    """Size of an output's residual on held-out blocks: a robust root mean square, in the output's own unit."""

    rmse: float
    unit: str


@dataclass(frozen=True)
class HeldOutScore:
    """A model on held-out blocks: log-likelihood in nats per sample, root mean square over the common inliers.

    ``outputs`` has the size of each output's residual, over the blocks in which no compared model diverges; empty if
    that is unknown.
    """

    log_likelihood: float
    rmse: float
    sigma: tuple[float, ...]
    d: tuple[float, ...]
    outputs: Mapping[str, OutputSize] = field(default_factory=dict)


@dataclass(frozen=True)
class SmoothCorrection:
    """The score of a smooth correction on held-out blocks, and the columns along which structure remains.

    The correction depends on all columns and on time, and replaces the findings; it cannot follow a step, for example.
    """

    reached: HeldOutScore
    columns: tuple[str, ...]


@dataclass(frozen=True)
class CandidateScore:
    """A candidate of the search at its best shape, for the first finding.

    ``log_likelihood_gain`` is that of the linearised model in nats; ``z`` is the root of twice the gain, about the
    number of standard errors. ``port`` is where it acts, if the simulation has several places for it. ``behind`` is the
    distance to the best candidate in nats, after penalties.
    """

    effect: str
    drivers: tuple[str, ...]
    shape: str
    log_likelihood_gain: float
    z: float
    port: str = ""
    behind: float = 0.0


@dataclass(frozen=True)
class Separability:
    """How well the recording separates candidates, whatever was found.

    ``labels`` are ``effect`` or ``effect (driver)``.

    ``share[i, j]`` is the share of candidate i's trace that candidate j cannot explain, once the simulation's own
    parameters have been refitted: 0 means inseparable, 1 orthogonal. ``left[i]`` is the share that remains after the
    refit alone.
    """

    labels: tuple[str, ...]
    share: Float[Tensor, "k k"]
    left: Float[Tensor, " k"]


@dataclass(frozen=True)
class Courses:
    """The recording and both simulations over time, one row per sample in use.

    Attributes:
        recorded: the outputs; NaN where one is missing.
        before: the simulation without findings; in held-out samples that of a fit which has not used them.
        corrected: the same with the findings that count.
        held_out: True for the samples of one fold of the held-out blocks; all False if no blocks are held out.
        run: number of each sample's run, ascending.
        one_step: whether the simulations predict each sample from the samples before it, because no open-loop
            simulation follows the recording.
    """

    recorded: Float[Tensor, "N m"]
    before: Float[Tensor, "N m"]
    corrected: Float[Tensor, "N m"]
    held_out: Bool[Tensor, " N"]
    run: Int[Tensor, " N"]
    one_step: bool = False


@dataclass(frozen=True)
class Traces:
    """The series that the report draws, one row per sample in use.

    ``before`` and ``after`` are residuals without findings and with those that count; ``with_all`` is that with all
    findings, None if all count. ``courses`` is None if the residual is not that of a recorded column, such as the
    length of a magnetometer's field.
    """

    time: Float[Tensor, " N"]
    has_time: bool
    before: Float[Tensor, "N m"]
    after: Float[Tensor, "N m"]
    weight: Float[Tensor, "N m"]
    channels: tuple[str, ...]
    unit: str
    drivers: Mapping[str, Float[Tensor, " N"]] = field(default_factory=dict)
    driver_units: Mapping[str, str] = field(default_factory=dict)
    with_all: Float[Tensor, "N m"] | None = None
    courses: Courses | None = None
