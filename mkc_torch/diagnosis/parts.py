"""What a diagnosis is made of: findings with their evidence, and the figures a report draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

from mkc_torch.density.tails import ChannelTails
from mkc_torch.diagnosis.environment import Curve, Grade, ShapeCheck
from mkc_torch.effects.kinds import Kind

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "Alternative",
    "CandidateScore",
    "DensityCheck",
    "DriverShift",
    "EffectParameter",
    "EvidenceResult",
    "Extrapolation",
    "Finding",
    "HeldOut",
    "HeldOutScore",
    "NoiseSummary",
    "Reference",
    "Region",
    "ResidualSizes",
    "Row",
    "Separability",
    "SmoothCorrection",
    "StateMap",
    "Table",
    "Traces",
    "value_of",
]

Number = float | tuple["Number", ...]


@dataclass(frozen=True)
class Row:
    """A line of facts, on the terminal too or not; one labelled "driven by" goes on where the driver is named."""

    label: str
    text: str
    in_terminal: bool = True


@dataclass(frozen=True)
class Table:
    """A table of the report, its first column a heading of each row; ``note`` says how to read it."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class EvidenceResult:
    """What a test of evidence says of a finding or of the whole diagnosis: report, terminal and JSON loop over it.

    Its texts have effects by their ids, and numbers as Python prints them.

    Attributes:
        test: its id.
        value: the result, for what goes on with it in Python.
        content: what ``diagnosis.json`` has of it, as ``evidence.<test>``: JSON, or results of this file.
        keys: the same for a test that is older than ``evidence``, whose keys have places of their own in the finding
            or the diagnosis; a mapping is added to the object that is there.
        warnings: sentences.
        rows: facts.
        table: of the report.
    """

    test: str
    value: Any = None
    content: Mapping[str, Any] = field(default_factory=dict)
    keys: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    rows: tuple[Row, ...] = ()
    table: Table | None = None


def value_of(evidence: Sequence[EvidenceResult], test: str, default: Any = None) -> Any:
    """The result of a test; the default where it was not asked."""
    return next((said.value for said in evidence if said.test == test), default)


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect; ``standard_error`` has the shape of ``value`` and None where it is not known.

    ``components`` says what each number of a list is, in their order; empty for a single number.
    """

    name: str
    value: Number
    standard_error: Number | None
    unit: str
    components: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reference:
    """The value of a driver's column, its mean over the recording, that an equation counts from: T̄, Ī, x̄."""

    column: str
    value: float
    unit: str


@dataclass(frozen=True)
class ResidualSizes:
    """Residuals of one output before and after, in its own unit."""

    before: float
    after: float
    unit: str


@dataclass(frozen=True)
class HeldOut:
    """Evidence on blocks that the fit has not seen; the gain in nats per sample, with its 95 % interval.

    ``outputs`` has each output's residuals; ``left`` says of which blocks the free run leaves the recording's range,
    which enter no mean, and is empty where none does. Where noise and physics were chosen together the blocks can speak
    against a finding but do not decide: one step ahead any process noise predicts as well.
    """

    log_likelihood_gain: float
    confidence_interval: tuple[float, float]
    rmse_before: float
    rmse_after: float
    unit: str
    outputs: Mapping[str, ResidualSizes] = field(default_factory=dict)
    left: str = ""
    decides: bool = True


@dataclass(frozen=True)
class Extrapolation:
    """A fit to the low values of a driver, judged on the high ones: gain in nats per sample, its 95 % interval."""

    log_likelihood_gain: float
    confidence_interval: tuple[float, float]


@dataclass(frozen=True)
class DriverShift:
    """Copies of a driver shifted in time, earlier and later by up to ``reach`` s, and how many gain as much."""

    copies: int
    as_good: int
    reach: float


@dataclass(frozen=True)
class Alternative:
    """Another candidate for a finding: how much less likely it is, in nats, and whether the data tell them apart.

    ``at`` is where it acts, of several places that a simulation has for it; ``recurrence`` what becomes of it in another
    recording; ``distinguishing_state`` what to record to tell it from the finding, where the data do not.
    """

    effect: str
    drivers: tuple[str, ...]
    log_likelihood_gap: float
    separable: bool
    at: str = ""
    recurrence: str = ""
    distinguishing_state: str = ""


@dataclass(frozen=True)
class Region:
    """A part of a state's range in which most of a finding's gain arises, in less of the time.

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
    """A finding's gain in nats over two states: sums over cells, NaN where the recording never was."""

    states: tuple[str, str]
    units: tuple[str, ...]
    edges: tuple[Float[Tensor, " X"], Float[Tensor, " Y"]]
    nats: Float[Tensor, "X Y"]


@dataclass(frozen=True)
class Finding:
    """A piece of physics that the simulation lacks, or the effect "unknown"; see ``diagnosis.json``.

    ``map`` is for the report; None where it cannot be drawn. ``region``
    is None where the gain arises all over the states, or where the simulation has none; ``experiments`` has each run's
    share of the gain, and is empty for a single run.
    ``moments`` are those at which an effect sets in that does so several times, the first of them its onset.
    ``references`` are what the equation counts its drivers from, ``advice`` what to do about it, ``recurrence`` what becomes
    of it in another recording; one that is ``location_specific`` belongs to the place or the attitude of this recording.
    ``kind`` is what kind of quantity it acts on, such as "temperature"; empty where that is not known.
    ``cannot_be`` says that its size cannot be right, see ``plausibility``; ``doubts`` are sentences on numbers of its
    shape at the ends of their ranges.
    ``p_value`` is that after the whole search; None in a quick look, which draws no noise.
    ``grade`` is what it is worth, ``shape`` whether its name's shape is the recording's; None where that is not asked.
    ``evidence`` is what the tests say that are asked of each finding.
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
    map: StateMap | None = None
    moments: tuple[float, ...] = ()
    references: tuple[Reference, ...] = ()
    advice: str = ""
    recurrence: str = ""
    location_specific: bool = False
    kind: Kind = ""
    cannot_be: bool = False
    doubts: tuple[str, ...] = ()
    grade: Grade = "left out"
    shape: ShapeCheck | None = None
    evidence: tuple[EvidenceResult, ...] = ()

    @property
    def held_out(self) -> HeldOut | None:
        """The gain on blocks that the fit has not seen; None where it cannot be measured."""
        return value_of(self.evidence, "held_out", (None, ""))[0]

    @property
    def held_out_note(self) -> str:
        """Why ``held_out`` is None, or what to know about it."""
        return value_of(self.evidence, "held_out", (None, ""))[1]

    @property
    def extrapolation(self) -> Extrapolation | None:
        """How well it holds where its driver is high; None where that cannot be told."""
        return value_of(self.evidence, "extrapolation")

    @property
    def driver_shift(self) -> DriverShift | None:
        """How many shifted copies of its driver gain as much; None where no driver was recorded."""
        return value_of(self.evidence, "driver_shift")

    @property
    def onset_interval(self) -> tuple[float, float] | None:
        """What holds the onset with 95 % confidence; None where there is none."""
        return value_of(self.evidence, "onset")

    @property
    def comes_and_goes(self) -> bool:
        """Whether a step is as if something was switched on and off."""
        return bool(value_of(self.evidence, "switched"))


@dataclass(frozen=True)
class DensityCheck:
    """How far the density of a channel's residuals is from their distribution, and how far a Student-t is.

    The distances are Kolmogorov's, between distribution functions; ``allowed`` is what one set in a thousand exceeds of
    as many independent samples as the channel tells of. ``closer`` says that a Student-t is clearly the better one.
    """

    channel: str
    distance: float
    student_distance: float
    degrees_of_freedom: float
    allowed: float
    closer: bool


@dataclass(frozen=True)
class NoiseSummary:
    """The noise that structure was tested against.

    ``model`` is one of "white", "ar" and "random_walk"; ``parameters`` names its numbers, ``units`` those that have
    a unit; ``bound`` is the half-width of the density's domain, one for all models compared. ``unit`` is that of d and
    the bound. ``tails`` has the test for heavy tails of each channel, on as many residuals as are independent; empty
    where the fit of a channel is exact.
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
class HeldOutScore:
    """A model on held-out blocks: log-likelihood in nats per sample, root mean square over the common inliers."""

    log_likelihood: float
    rmse: float
    sigma: tuple[float, ...]
    d: tuple[float, ...]


@dataclass(frozen=True)
class SmoothCorrection:
    """What a smooth correction reaches on held-out blocks, and the columns along which it shows that something remains.

    The correction is by all columns and by time, instead of the findings; a step, say, goes beyond it.
    """

    reached: HeldOutScore
    columns: tuple[str, ...]


@dataclass(frozen=True)
class CandidateScore:
    """One candidate of the search at its best shape, for the first finding.

    ``log_likelihood_gain`` is that of the linearised model in nats; ``z`` the root of twice that, roughly the number
    of standard errors. ``at`` is where it acts, of several places that a simulation has for it; ``behind`` how many
    nats it is behind the first one, once its numbers and its handicap are paid for.
    """

    effect: str
    drivers: tuple[str, ...]
    shape: str
    log_likelihood_gain: float
    z: float
    at: str = ""
    behind: float = 0.0


@dataclass(frozen=True)
class Separability:
    """How well candidates could be told apart on this recording, whatever was found.

    ``labels`` are ``effect`` or ``effect (driver)``.

    ``share[i, j]`` is the share of candidate i's trace that candidate j cannot take over, once the simulation's own
    parameters have been refitted: 0 means inseparable, 1 means at right angles. ``left[i]`` is the share that survives
    the refit alone.
    """

    labels: tuple[str, ...]
    share: Float[Tensor, "k k"]
    left: Float[Tensor, " k"]


@dataclass(frozen=True)
class Traces:
    """What the report draws: one row a sample that was used."""

    time: Float[Tensor, " N"]
    has_time: bool
    before: Float[Tensor, "N m"]
    after: Float[Tensor, "N m"]
    weight: Float[Tensor, "N m"]
    channels: tuple[str, ...]
    unit: str
    drivers: Mapping[str, Float[Tensor, " N"]] = field(default_factory=dict)
    driver_units: Mapping[str, str] = field(default_factory=dict)
