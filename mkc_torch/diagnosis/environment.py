"""What a diagnosis says of how a simulation follows its recording, and of the noise of the world around it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "Curve",
    "DisturbanceEstimate",
    "GoodnessOfFit",
    "Grade",
    "NoiseEnvironment",
    "Offset",
    "ProcessNoise",
    "Run",
    "ShapeCheck",
    "Verdict",
]

Verdict = Literal["unfit", "adequate", "explained", "unexplained"]

Grade = Literal["left out", "real but small", "not confirmed", "nearest in the catalogue"]


@dataclass(frozen=True)
class Curve:
    """The trace of an effect against what drives it, one row a point, one column a channel.

    ``band`` is the half-width of a 95 % interval.
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
    """How well the simulation alone, running freely, follows one output; all sizes in that output's unit.

    Attributes:
        output, unit: which.
        residual: robust size of recording less simulation.
        variation: robust size of the output about its mean; of a length, what readings scattered as widely, and alike
            in all directions, would leave.
        explained: share of the variation's square that the simulation explains; below 0 where it is worse than none.
        noise_floor: size of the sensor's white noise; ``floor_source`` says whether it was "declared", or estimated
            from what is new from one of the "samples" to the next, or from the steps of the recording's numbers,
            "quantisation"; NaN where the sampling is slower than the noise.
        mean_predicts, last_value_predicts: residual of two trivial predictions: the mean, and the sample before.
    """

    output: str
    unit: str
    residual: float
    variation: float
    explained: float
    noise_floor: float
    floor_source: Literal["declared", "samples", "quantisation"]
    mean_predicts: float
    last_value_predicts: float


@dataclass(frozen=True)
class ProcessNoise:
    """Something random and unrecorded that acts on a state's rate, or is added to an output beside its white noise.

    Attributes:
        place: the state or the output; ``at_rate`` says which.
        lasting: s for which it keeps its value, roughly; 0 for one that is new at each sample.
        size, standard_error, unit: its standard deviation.
        nats: by which a model of the noise without it is less likely.
    """

    place: str
    at_rate: bool
    lasting: float
    size: float
    standard_error: float
    unit: str
    nats: float


@dataclass(frozen=True)
class DisturbanceEstimate:
    """The course of a push by all samples, with its 95 % band, and what it depends on.

    Attributes:
        place, at_rate, unit: of the push.
        time, value, band: (N,), in s and in the push's unit; the band is a half-width.
        curves: its mean along each state and input, with its band.
        sentences: whether it is white, and whether it depends on an input or a state, in a control engineer's words.
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
    """Whether the shape that a name claims is the one that the recording shows.

    Attributes:
        free_curve_gain: nats by which a free curve of the same variables at the same place is likelier.
        p_value: of as large a gain where the name is right.
        curve: that free curve, where it is clearly better; else None.
        formula: the formula nearest to it, such as "0.0071 |x|^1.52 sign(x)"; empty where there is none.
    """

    free_curve_gain: float
    p_value: float
    curve: Curve | None = None
    formula: str = ""


@dataclass(frozen=True)
class Offset:
    """The offset of an output in one of several recordings.

    Attributes:
        output, unit: of which output.
        recording, name: number of the recording, from 1, and its name.
        value, standard_error: in the unit; NaN for the error of an offset that is left at 0, which the others are
            counted from, or which the first states or another parameter stand for.
    """

    output: str
    unit: str
    recording: int
    name: str
    value: float
    standard_error: float


@dataclass(frozen=True)
class Run:
    """One of several runs.

    Attributes:
        recording, name: number, from 1, and name of the recording that it is of; 0 and empty for a single recording.
        number: of the run within its recording, from 1; 0 where that recording holds no other.
    """

    recording: int
    name: str
    number: int


@dataclass(frozen=True)
class NoiseEnvironment:
    """What stands beside the findings: whether the simulation follows, and the noise of the world.

    Attributes:
        follows: of each output.
        reasons: why the simulation does not follow, in sentences, the most likely first; empty where it does.
        pushes: strongest first; none where the sensors' white noise is enough.
        input_hold: what each input does between two samples, "held", "linear" or "smooth", whichever is likelier.
        forcing: of each push at a rate.
        starts: from which the first fit was tried.
        offsets: of the outputs in each of several recordings, where they are fitted.
        runs: in the order in which findings give their shares; empty for a single one.
    """

    follows: tuple[GoodnessOfFit, ...] = ()
    reasons: tuple[str, ...] = ()
    pushes: tuple[ProcessNoise, ...] = ()
    input_hold: Mapping[str, str] = field(default_factory=dict)
    forcing: tuple[DisturbanceEstimate, ...] = ()
    starts: int = 1
    offsets: tuple[Offset, ...] = ()
    runs: tuple[Run, ...] = ()
