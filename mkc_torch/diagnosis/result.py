"""The result of a diagnosis: verdict, findings, the figures of a report, and its table in a notebook."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from torch import Tensor, nn

from mkc_torch._parallel.deadline import Reason
from mkc_torch._support.html_table import html_table
from mkc_torch._support.initial_values import InitialValues
from mkc_torch._support.typesetting import plain, typeset
from mkc_torch.diagnosis.decisions import Trail
from mkc_torch.diagnosis.environment import NoiseEnvironment, Verdict
from mkc_torch.diagnosis.parts import (
    Alternative,
    CandidateScore,
    DensityCheck,
    DivergedBlock,
    DriverShift,
    EffectParameter,
    EvidenceResult,
    Extrapolation,
    Finding,
    HeldOut,
    HeldOutScore,
    NoiseSummary,
    Number,
    Reference,
    Region,
    ResidualSizes,
    Separability,
    SmoothCorrection,
    StateMap,
    Traces,
    value_of,
)
from mkc_torch.diagnosis.plot.accessor import DiagnosisPlot
from mkc_torch.diagnosis.suspected_sentences import suspected_sentences
from mkc_torch.effects import words_of
from mkc_torch.recording.disturbance import RejectedInterval
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.start_checks import StartCheck

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "UNFINISHED",
    "VERDICT_SENTENCES",
    "Alternative",
    "CandidateScore",
    "CorrectingModel",
    "DensityCheck",
    "Diagnosis",
    "DivergedBlock",
    "DriverShift",
    "EffectParameter",
    "EvidenceResult",
    "Extrapolation",
    "Finding",
    "HeldOut",
    "HeldOutScore",
    "NoiseSummary",
    "Number",
    "Reference",
    "Region",
    "ResidualSizes",
    "Separability",
    "SmoothCorrection",
    "StateMap",
    "Stop",
    "Traces",
    "as_html",
    "notices",
]

_QUICK = (
    "Quick look: no p-values, false-alarm rate not controlled. Left out: the test against chance, fits from further "
    "starts, slow tests of evidence, and the states and runs in which an effect gains; for differential "
    "equations also unseen blocks, shapes and further findings. Leave out --quick (in Python quick=True) to have all."
)


@dataclass(frozen=True)
class Stop:
    """Why a diagnosis was stopped before its end, and what was not done.

    Attributes:
        reason: "time limit", "interrupt" or "internal error".
        seconds: run time until the stop.
        not_done: the missing parts, as nouns.
    """

    reason: Reason | Literal["internal error"]
    seconds: float
    not_done: tuple[str, ...]

    def __str__(self) -> str:
        how = "" if self.reason == "time limit" else f"by an {self.reason} "
        left = "; ".join(self.not_done)
        return f"Stopped {how}after {self.seconds:.0f} s: the search was not finished; not done: {left}."


_TOO_FEW = (
    "The samples are too few for a test of missing physics: these are the fit, the residual and the strongest "
    "candidates, without p-values. Record longer, or add runs; short runs in one file are counted together."
)


def notices(stop: Stop | None, *, quick: bool, too_few: bool = False) -> tuple[str, ...]:
    """Return the sentences.

    Example:
        >>> notices(Stop("time limit", 60.2, ("the search for effects",)), quick=False)
        ('Stopped after 60 s: the search was not finished; not done: the search for effects.',)
    """
    left_out = (_TOO_FEW,) if too_few else (_QUICK,) if quick else ()
    return (*(() if stop is None else (str(stop),)), *left_out)


class CorrectingModel(InitialValues):
    """A simulation's sensor or system with the findings in it; see :class:`mkc_torch.diagnosis.DiagnosedModel`."""

    theta: nn.Parameter

    @abstractmethod
    def correct(self, recording: Recording) -> tuple[dict[str, Float[Tensor, " N"]], tuple[str, ...]]:
        """Return the corrected columns of a recording, and sentences about findings that do not transfer to it."""

    @abstractmethod
    def to_json(self) -> str:
        """Return the text of model.json."""

    @abstractmethod
    def to_python(self, module: str | None = None, folder: Path | None = None) -> str:
        """Return the simulation with the findings as Python source."""

    @abstractmethod
    def to_mjcf(self) -> tuple[str, tuple[str, ...]]:
        """Return a MuJoCo model's file with the findings, and the findings that it cannot express."""

    @abstractmethod
    def mjcf_changes(self) -> str:
        """Return what :meth:`to_mjcf` changes in a MuJoCo model's file, as a unified diff."""


VERDICT_SENTENCES: dict[Verdict, str] = {
    "unfit": "The simulation does not fit the recording.",
    "adequate": "The recording shows no missing physics.",
    "explained": "The findings explain the residual of the simulation.",
    "unexplained": "The residual has structure that no effect in the catalogue explains.",
}

UNFINISHED = "The search was stopped; more physics may be missing."
"""Headline of a search that was stopped."""


def as_html(
    recording: str,
    simulation: str,
    verdict: Verdict,
    findings: Sequence[Finding],
    sentences: Sequence[str],
    *,
    stop: Stop | None = None,
) -> str:
    """Return the table with sentences below it: why the search was stopped, if it was; then advice and warnings."""
    names = f"{plain(recording) or 'recording'} against {plain(simulation)}"
    heads = ("", "grade", "p", "on unseen data")
    rows = [_row(finding) for finding in findings]
    first = VERDICT_SENTENCES[verdict] if stop is None else UNFINISHED
    below = [first, *(typeset(sentence) for sentence in sentences)]
    for finding in findings:
        below = [text.replace(finding.effect, words_of(finding.effect, finding.kind)) for text in below]
    return html_table(names, heads, rows, below)


def _row(f: Finding) -> tuple[str, ...]:
    drivers = f" ({', '.join(plain(name) for name in f.drivers)})" if f.drivers else ""
    held = f.held_out
    change = "" if held is None else f"{held.rmse_before:.3g} → {held.rmse_after:.3g} {plain(held.unit)}".rstrip()
    return (
        words_of(f.effect, f.kind) + drivers,
        f.grade.replace("_", " "),
        "" if f.p_value is None else f"{f.p_value:.2g}",
        change,
    )


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of a recording, or of several together: the content of ``diagnosis.json`` and its report.

    Attributes:
        recording, simulation: names.
        samples: number of samples in use.
        level: rate of false alarms.
        noise: the noise model that effects were tested against.
        candidates_tried, surrogates, seed: the size of the search.
        p_value: of the strongest candidate after the whole search; None in a quick look, and if the search was stopped
            before it was known.
        verdict: "unfit", "adequate", "explained" or "unexplained".
        findings: strongest first.
        baseline, corrected: scores of the simulation without findings, and with those that count, on held-out blocks.
        advice: what to do or to record next, in sentences that name effects by their ids.
        warnings: sentences of the same form.
        notes: how the recording was read, a sentence each.
        candidates: the candidates of the search, best first.
        separability: of the leading candidates.
        traces: the residuals.
        model: the simulation's sensor or system with the findings in it; None if there is nothing to apply.
        evidence: results of the tests of evidence of the whole diagnosis.
        environment: goodness of fit of the simulation, and the noise environment.
        recordings: names of the recordings that were diagnosed together; empty for a single recording.
        quick: True for a quick look, which draws no surrogates: no p-values, and an unknown rate of false alarms.
        stop: why the search was stopped before its end, and what was not done; None if it was not stopped.
        too_few: True if the samples are too few for a test; then candidates are ranked, and none is a finding.
        checks: checks of the simulation's own parameters before the search.
        decisions: the models that were scored, and the decisions that findings, grades and verdict follow from.

    Example:
        >>> import torch
        >>> from mkc_torch import Recording, diagnose
        >>> from mkc_torch.simulation import Static
        >>> time = torch.arange(100) / 10.0
        >>> noise = 0.01 * torch.randn(100, generator=torch.Generator().manual_seed(0))
        >>> heat = torch.sin(time)
        >>> recording = Recording({"time": time, "temperature": heat, "voltage": 0.5 + 2.0 * heat + noise})
        >>> line = Static(torch.nn.Linear(1, 1), inputs=("temperature",), outputs=("voltage",))
        >>> result = diagnose(line, recording, effects=(), surrogates=19)
        >>> result.simulation, result.verdict, result.findings, round(result.baseline.rmse, 2)
        ('Linear', 'adequate', (), 0.01)
    """

    recording: str
    simulation: str
    samples: int
    level: float
    noise: NoiseSummary
    candidates_tried: int
    surrogates: int
    seed: int
    p_value: float | None
    verdict: Verdict
    findings: tuple[Finding, ...]
    baseline: HeldOutScore
    corrected: HeldOutScore
    advice: tuple[str, ...]
    warnings: tuple[str, ...]
    candidates: tuple[CandidateScore, ...]
    separability: Separability
    traces: Traces
    model: CorrectingModel | None = field(default=None, repr=False, compare=False)
    evidence: tuple[EvidenceResult, ...] = ()
    environment: NoiseEnvironment = field(default_factory=NoiseEnvironment)
    recordings: tuple[str, ...] = ()
    quick: bool = False
    stop: Stop | None = None
    notes: tuple[str, ...] = ()
    decisions: Trail = field(default_factory=Trail)
    checks: tuple[StartCheck, ...] = ()
    too_few: bool = False

    def __repr__(self) -> str:
        found = ", ".join(finding.effect for finding in self.findings) or "nothing found"
        return f"Diagnosis({self.recording!r} against {self.simulation!r}: {self.verdict}; {found})"

    def _repr_html_(self) -> str:
        sentences = (*self.advice, *self.warnings, *self.notes)
        return as_html(self.recording, self.simulation, self.verdict, self.findings, sentences, stop=self.stop)

    @property
    def plot(self) -> DiagnosisPlot:
        """The figures of the report as axes of matplotlib, such as ``diagnosis.plot.residual()``."""
        return DiagnosisPlot(self.traces, self.findings, self.candidates, self.separability, self.environment)

    @property
    def suspected(self) -> tuple[str, ...]:
        """A sentence for each suspected set of effects: its score next to that of the findings, and its residual."""
        units = {fit.output: fit.unit for fit in self.environment.goodness_of_fit}
        return suspected_sentences(self.decisions, units, findings=bool(self.findings))

    @property
    def ceiling(self) -> HeldOutScore | None:
        """The score of a smooth correction instead of the findings, for comparison; None if it was not computed."""
        smooth: SmoothCorrection | None = value_of(self.evidence, "remaining")
        return None if smooth is None else smooth.reached

    @property
    def remaining(self) -> tuple[str, ...]:
        """Columns along which smooth structure remains after the findings."""
        smooth: SmoothCorrection | None = value_of(self.evidence, "remaining")
        return () if smooth is None else smooth.columns

    @property
    def rejected_intervals(self) -> tuple[RejectedInterval, ...]:
        """Intervals in which most samples were rejected, such as a disturbance of the measurement.

        If no finding is confirmed, these are the intervals of the simulation without findings.
        """
        rejected = value_of(self.evidence, "rejected")
        if rejected is None:
            return ()
        confirmed = any(finding.grade != "unconfirmed" for finding in self.findings)
        return rejected.final if confirmed else rejected.before or rejected.final

    @property
    def density_checks(self) -> tuple[DensityCheck, ...]:
        """How well the density describes each channel."""
        return value_of(self.evidence, "density", ())
