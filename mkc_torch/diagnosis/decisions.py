"""The trail of a diagnosis: the models that were scored, and the decisions on each finding, in their order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mkc_torch.diagnosis.parts import EffectParameter


@dataclass(frozen=True)
class ScoredModel:
    """A model that the search scored.

    Attributes:
        terms: its effects, spelled as ``--suspect`` accepts them, such as "coulomb_friction@speed".
        move: how the search came to it, such as "add coulomb_friction@speed"; empty for the simulation alone.
        score: in nats, comparable between all models of a recording; None where the model was not scored.
        parts: the score's log-likelihood and the prices subtracted from it, by name, in nats.
        noise: the kind of noise that scores best, in words.
        open_loop: RMS of the open-loop residual by output, in its unit; empty where the simulation loses the recording.
        chosen: whether the findings are those of this model.
        suspected: whether the user asked for this model.
        parameters: of each of its effects, for a suspected model.
    """

    terms: tuple[str, ...]
    move: str
    score: float | None
    parts: Mapping[str, float]
    noise: str
    open_loop: Mapping[str, float]
    chosen: bool = False
    suspected: bool = False
    parameters: tuple[tuple[EffectParameter, ...], ...] = ()


@dataclass(frozen=True)
class Decision:
    """A rule applied to a finding, or to the whole diagnosis.

    Attributes:
        rule: its id, such as "p_value" or "held_out_blocks".
        subject: the finding, spelled as ``--suspect`` accepts it; empty for the whole diagnosis.
        value: the number compared; None where it is unknown.
        threshold: the number it is compared with.
        passed: False if the rule lowers the grade of the finding, refuses it, or lowers the verdict.
        sentence: the decision for a reader.
        finding: number of the finding, from 1; 0 for a decision of the search or on the whole diagnosis, whose subject
            is empty.
    """

    rule: str
    subject: str
    value: float | None
    threshold: float
    passed: bool
    sentence: str
    finding: int = 0


@dataclass(frozen=True)
class Trail:
    """The models scored and the decisions made, each in their order."""

    models: tuple[ScoredModel, ...] = ()
    decisions: tuple[Decision, ...] = ()
