"""The result of checking a model on a recording."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

from mkc_torch.diagnosis.validation.blocks import Ratio

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

SCHEMA = "mkc-check/1"

Verdict = Literal["holds", "does not hold", "used in the fit"]


@dataclass(frozen=True)
class OutputCheck:
    """The check of an output. Root mean squares (RMSE) are of the predicted samples, in ``unit``.

    Attributes:
        output, unit: name and unit.
        baseline: RMSE of the simulation without the findings.
        corrected: RMSE of the simulation with the findings.
        training: RMSE of the simulation with the findings in the diagnosed recording, predicted in the same way.
        ratio: corrected over baseline, with its 95 % interval.
        growth: corrected over training, with its 95 % interval.
        explained: share of the output's variance that the simulation with the findings explains in the predicted
            samples; nan for a magnetometer.
        claimed: whether the findings make the residual of this output clearly smaller in the diagnosed recording.
        failure: why the model does not hold in this output; empty if it does.
    """

    output: str
    unit: str
    baseline: float
    corrected: float
    training: float
    ratio: Ratio
    growth: Ratio
    explained: float
    claimed: bool
    failure: str


@dataclass(frozen=True)
class CheckTraces:
    """The series of a check: (N,) samples, m outputs.

    Attributes:
        time: in s.
        run: number of each sample's run.
        predicted: False where the initial states were estimated.
        measured, baseline, corrected: (N, m); a missing output is nan.
    """

    time: Float[Tensor, " N"]
    run: Int[Tensor, " N"]
    predicted: Bool[Tensor, " N"]
    measured: Float[Tensor, "N m"]
    baseline: Float[Tensor, "N m"]
    corrected: Float[Tensor, "N m"]


@dataclass(frozen=True)
class RecordingCheck:
    """A model's check on a recording: the result of :func:`mkc_torch.diagnosis.check`.

    Attributes:
        recording, simulation: names.
        samples, predicted: number of samples in use, and of those that were predicted.
        start_seconds: s from the start of each trajectory that the initial states were estimated from; None for a
            simulation without states.
        segment_seconds: length of the segments that restart, with which the model was fitted; None for whole runs.
        findings: ids of the model's effects.
        outputs: the check of each output.
        used_in_fit: whether a run of the recording was used in the fit.
        accuracy: change of the simulated outputs by half the step of integration, as a share of an output's range.
        initial: (K, n), the initial states of the corrected simulation; None for a simulation without states.
        warnings: sentences to consider.
        traces: the series.
    """

    recording: str
    simulation: str
    samples: int
    predicted: int
    start_seconds: float | None
    segment_seconds: float | None
    findings: tuple[str, ...]
    outputs: tuple[OutputCheck, ...]
    used_in_fit: bool
    accuracy: float
    initial: Float[Tensor, "K n"] | None = field(repr=False, compare=False)
    warnings: tuple[str, ...]
    traces: CheckTraces = field(repr=False, compare=False)

    @property
    def verdict(self) -> Verdict:
        """ "holds", "does not hold", or "used in the fit"."""
        if self.used_in_fit:
            return "used in the fit"
        return "does not hold" if any(each.failure for each in self.outputs) else "holds"

    @property
    def holds(self) -> bool:
        """Whether the model holds on this recording, which no fit has used."""
        return self.verdict == "holds"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the verdict is not "holds", in sentences."""
        if self.used_in_fit:
            return ("This recording was used in the fit, so it tests nothing; check a recording that no fit has used.",)
        return tuple(each.failure for each in self.outputs if each.failure)

    def __repr__(self) -> str:
        return f"RecordingCheck({self.recording!r} against {self.simulation!r}: {self.verdict})"

    def to_json(self) -> str:
        """Return the check as JSON of the schema "mkc-check/1"; a number that is not finite is null."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"

    def to_dict(self) -> dict[str, Any]:
        """Return the content of :meth:`to_json` as values of JSON."""
        return {
            "schema": SCHEMA,
            "recording": self.recording,
            "simulation": self.simulation,
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "findings": list(self.findings),
            "samples": self.samples,
            "predicted": self.predicted,
            "start_seconds": self.start_seconds,
            "segment_seconds": self.segment_seconds,
            "used_in_fit": self.used_in_fit,
            "accuracy": _finite(self.accuracy),
            "outputs": {each.output: _output(each) for each in self.outputs},
            "warnings": list(self.warnings),
        }


def _output(each: OutputCheck) -> dict[str, Any]:
    return {
        "unit": each.unit,
        "rmse_baseline": _finite(each.baseline),
        "rmse_corrected": _finite(each.corrected),
        "rmse_training": _finite(each.training),
        "ratio": _finite(each.ratio.value),
        "ratio_interval": [_finite(each.ratio.low), _finite(each.ratio.high)],
        "growth": _finite(each.growth.value),
        "growth_interval": [_finite(each.growth.low), _finite(each.growth.high)],
        "explained": _finite(each.explained),
        "claimed": each.claimed,
        "failure": each.failure,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
