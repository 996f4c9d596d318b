"""The goodness of fit and the noise environment that a diagnosis reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

Verdict = Literal["unfit", "adequate", "explained", "unexplained"]

Grade = Literal["left_out", "small", "unconfirmed", "nearest"]


@dataclass(frozen=True)
class Curve:
    """An effect against its driver, one row per point, one column per channel.

    ``band`` is the half-width of a 95 % interval. Both are NaN where a free curve has no samples near.
    """

    driver: str
    unit: str
    x: Float[Tensor, " points"]
    value: Float[Tensor, "points channels"]
    band: Float[Tensor, "points channels"]
    channels: tuple[str, ...]
    value_unit: str


@dataclass(frozen=True)
class GoodnessOfFit:
    """How well the open-loop simulation explains one output; all sizes in that output's unit.

    Attributes:
        output, unit: name and unit of the output.
        residual: robust RMS of the residual.
        variation: robust standard deviation of the output. For the length of a vector, the standard deviation of
            readings that scatter as widely and equally in all directions.
        explained: share of the variation's square that the simulation explains; negative if it is worse than the mean.
        noise_floor: standard deviation of the sensor's white noise; NaN if unknown: the samples do not show it.
        floor_source: "declared" by the user, estimated from differences of the recorded "samples", or from the
            resolution of the recorded numbers, "quantisation".
        rmse_of_mean, rmse_of_last_value: residuals of two trivial predictions: the mean, and the previous sample.
    """

    output: str
    unit: str
    residual: float
    variation: float
    explained: float
    noise_floor: float
    floor_source: Literal["declared", "samples", "quantisation"]
    rmse_of_mean: float
    rmse_of_last_value: float

    @property
    def seen_noise(self) -> float:
        """The noise floor; of rounded samples their resolution, because noise of that size is invisible in them."""
        return self.noise_floor * (12.0**0.5 if self.floor_source == "quantisation" else 1.0)


@dataclass(frozen=True)
class ProcessNoise:
    """An unrecorded random disturbance of a state's rate, or slow noise of an output in addition to its white noise.

    Attributes:
        place: name of the state or output.
        at_rate: True for a state's rate, False for an output.
        correlation_time: in s; 0 for white noise.
        size, standard_error, unit: its standard deviation, with error and unit.
        log_likelihood_gain: in nats, over a noise model without it.
    """

    place: str
    at_rate: bool
    correlation_time: float
    size: float
    standard_error: float
    unit: str
    log_likelihood_gain: float


@dataclass(frozen=True)
class DisturbanceEstimate:
    """The estimated course of a disturbance from all samples, with its 95 % band and its dependences.

    Attributes:
        place, at_rate, unit: of the disturbance.
        time, value, band: (N,), in s and in the disturbance's unit; the band is a half-width.
        curves: the mean of the disturbance against each state and input, with its band.
        sentences: whether it is white, and whether it depends on an input or a state.
    """

    place: str
    at_rate: bool
    unit: str
    time: Float[Tensor, " N"]
    value: Float[Tensor, " N"]
    band: Float[Tensor, " N"]
    curves: tuple[Curve, ...] = ()
    sentences: tuple[str, ...] = ()


@dataclass(frozen=True)
class ShapeCheck:
    """Whether the recording supports the named shape of an effect.

    Attributes:
        free_curve_gain: log-likelihood gain of a free curve of the same variables at the same place, in nats.
        p_value: of that gain if the name is right.
        curve: the free curve if it is clearly better; otherwise None.
        formula: the formula nearest to the curve, such as "0.0071 |x|^1.52 sign(x)"; empty if there is no formula.
        needed: the gain in nats above which the curve is clearly better.
    """

    free_curve_gain: float
    p_value: float
    curve: Curve | None = None
    formula: str = ""
    needed: float = 0.0


@dataclass(frozen=True)
class Offset:
    """The offset of an output in one of several recordings.

    Attributes:
        output, unit: name and unit of the output.
        recording, name: number of the recording, from 1, and its name.
        value, standard_error: in the unit. The error is NaN for an offset that is fixed at 0: the reference of the
            others, or an offset that initial states or another parameter represent.
    """

    output: str
    unit: str
    recording: int
    name: str
    value: float
    standard_error: float


@dataclass(frozen=True)
class Run:
    """A run of a recording.

    Attributes:
        recording, name: number, from 1, and name of its recording; 0 and empty for a single recording.
        number: of the run within its recording, from 1; 0 if that recording has a single run.
    """

    recording: int
    name: str
    number: int


@dataclass(frozen=True)
class NoiseEnvironment:
    """The goodness of fit of a simulation, and the noise around it.

    Attributes:
        goodness_of_fit: of each output.
        reasons: why the fit is poor, in sentences, the most likely reason first; empty for a good fit.
        process_noise: process noise or drift, strongest first; empty if the sensors' white noise is enough.
        input_hold: most likely hold of each input between two samples: "held", "linear" or "smooth".
        disturbance: estimated disturbance of each state's rate.
        starts: number of starting points that the first fit was tried from.
        offsets: fitted offsets of the outputs in each of several recordings.
        runs: in the order in which findings list their shares; empty for a single run.
        restart_after: s after which the simulation is restarted, because its free run leaves the recording; None if it
            is not, or if the simulation itself has restarts.
    """

    goodness_of_fit: tuple[GoodnessOfFit, ...] = ()
    reasons: tuple[str, ...] = ()
    process_noise: tuple[ProcessNoise, ...] = ()
    input_hold: Mapping[str, str] = field(default_factory=dict)
    disturbance: tuple[DisturbanceEstimate, ...] = ()
    starts: int = 1
    offsets: tuple[Offset, ...] = ()
    runs: tuple[Run, ...] = ()
    restart_after: float | None = None
