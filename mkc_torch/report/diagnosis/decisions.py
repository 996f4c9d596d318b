"""How a diagnosis was decided: the scored models, and the decisions on the findings and on the whole diagnosis."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from mkc_torch._support.typesetting import typeset
from mkc_torch.diagnosis.decisions import ScoredModel, Trail
from mkc_torch.diagnosis.result import Diagnosis, Extrapolation
from mkc_torch.report.diagnosis.findings import finding_name
from mkc_torch.report.diagnosis.numbers import gain
from mkc_torch.report.words.numbers import number, size

_FAR = 1000
"""Gain in nats per sample beyond which only this limit is stated."""

_LOG_LIKELIHOOD = "log_likelihood"
"""Part of a score that is no price."""

_RULES: Mapping[str, str] = MappingProxyType(
    {
        "p_value": "p-value at most the level",
        "held_out_blocks": "gain on held-out blocks",
        "open_loop": "open-loop residual not larger",
        "size_beyond_error": "size beyond its standard error",
        "size_plausible": "size plausible",
        "shape": "no free curve clearly better",
        "visible": "visible in the compared length",
        "residual_reduction": "reduces the residual",
        "enough_samples": "enough samples for a test",
        "explained_share": "explained share of the variation",
        "each_output": "explained share of each output",
        "simulation_explains_more": "correction at most the simulation",
        "white_residual": "residual white",
        "disturbed_state": "no unrecorded disturbance",
        "drifting_output": "no unexplained drift of an output",
        "structure_left": "no structure left",
        "above_declared_noise": "residual at the declared noise",
        "above_estimated_noise": "residual near the noise of the samples",
        "stopped": "search completed",
        "few_rejected": "few rejected samples",
        "smaller_residual": "residual smaller with the findings",
    }
)
"""A rule as the property that passes it."""


@dataclass(frozen=True)
class ModelRow:
    """Cells of a scored model; ``mark`` is "chosen", "suspected" or both."""

    terms: str
    move: str
    score: str
    log_likelihood: str
    prices: str
    noise: str
    open_loop: str
    mark: str


@dataclass(frozen=True)
class DecisionRow:
    """Cells of a decision."""

    subject: str
    rule: str
    value: str
    threshold: str
    passed: bool
    sentence: str


@dataclass(frozen=True)
class GainRow:
    """Cells of a finding: its gain on held-out blocks and at high values, and that of a free curve in its place."""

    name: str
    held_out: str
    high_values: str
    free_curve: str


def is_empty(diagnosis: Diagnosis) -> bool:
    """Whether there is nothing to show."""
    trail = diagnosis.decisions
    return not trail.models and not trail.decisions and not gain_rows(diagnosis)


def gain_rows(diagnosis: Diagnosis) -> list[GainRow]:
    """Return the gains of each finding; empty if none is known."""
    rows = [
        GainRow(
            finding_name(finding),
            "not measured" if finding.held_out is None else gain(finding.held_out),
            "not tested" if finding.extrapolation is None else typeset(_at_high_values(finding.extrapolation)),
            "not tested" if finding.shape is None else f"{size(finding.shape.free_curve_gain)} nats",
        )
        for finding in diagnosis.findings
    ]
    return rows if any(f.held_out is not None or f.shape is not None for f in diagnosis.findings) else []


def model_rows(trail: Trail) -> list[ModelRow]:
    """Return the scored models in their order, with scores relative to the best.

    Example:
        >>> alone = ScoredModel((), "", 800.0, {"log_likelihood": 803.5, "parameters": 3.5}, "white", {"speed": 0.3})
        >>> drag = ScoredModel(("drag@speed",), "add drag@speed", 812.5, {}, "white", {}, chosen=True)
        >>> first, second = model_rows(Trail((alone, drag)))
        >>> first.terms, first.score, first.log_likelihood, first.prices, first.open_loop, second.mark
        ('the simulation alone', '−12.5', '803.5', 'parameters 3.5', 'speed 0.300', 'chosen')
    """
    best = max((model.score for model in trail.models if _known(model.score)), default=math.nan)  # type: ignore[type-var]
    return [_model_row(model, float(best)) for model in trail.models]  # type: ignore[arg-type]


def _model_row(model: ScoredModel, best: float) -> ModelRow:
    prices = [f"{name.replace('_', ' ')} {_nats(value)}" for name, value in model.parts.items()]
    kept = [price for name, price in zip(model.parts, prices, strict=True) if name != _LOG_LIKELIHOOD]
    marks = [word for word, marked in (("chosen", model.chosen), ("suspected", model.suspected)) if marked]
    return ModelRow(
        typeset(" + ".join(model.terms)) or "the simulation alone",
        typeset(model.move),
        "not scored" if model.score is None else _nats(model.score - best),
        _nats(model.parts.get(_LOG_LIKELIHOOD)),
        typeset(", ".join(kept)),
        typeset(model.noise),
        typeset(", ".join(f"{name} {size(value)}" for name, value in model.open_loop.items() if _known(value)))
        or ("" if model.score is None else "loses the recording"),
        ", ".join(marks),
    )


def decision_rows(trail: Trail) -> list[DecisionRow]:
    """Return the decisions in their order.

    Example:
        >>> from mkc_torch.diagnosis.decisions import Decision
        >>> (row,) = decision_rows(Trail((), (Decision("p_value", "drag@speed", 0.01, 0.05, True, "p = 0.01."),)))
        >>> row.subject, row.rule, row.value, row.threshold
        ('drag@speed', 'p-value at most the level', '0.01', '0.05')
    """
    return [
        DecisionRow(
            typeset(decision.subject) or "the whole diagnosis",
            _RULES.get(decision.rule, typeset(decision.rule.replace("_", " "))),
            _plain(decision.value),
            _plain(decision.threshold),
            decision.passed,
            typeset(decision.sentence),
        )
        for decision in trail.decisions
    ]


def _at_high_values(extrapolation: Extrapolation) -> str:
    """Format the gain with its interval, to two digits of its standard error.

    Example:
        >>> _at_high_values(Extrapolation(-0.0212, (-0.12, 0.09)))
        '-0.021 nats per sample (95 %: -0.120 to 0.090)'
        >>> _at_high_values(Extrapolation(3e6, (4.0, 9e6)))
        'more than +1000 nats per sample'
    """
    if abs(extrapolation.log_likelihood_gain) > _FAR:
        return f"{'more than +' if extrapolation.log_likelihood_gain > 0.0 else 'less than -'}{_FAR} nats per sample"
    low, high = extrapolation.confidence_interval
    places = max(1 - math.floor(math.log10(0.25 * (high - low))), 0) if high > low else 3
    gain, low, high = (round(value, places) + 0.0 for value in (extrapolation.log_likelihood_gain, low, high))
    return f"{gain:+.{places}f} nats per sample (95 %: {low:.{places}f} to {high:.{places}f})"


def _known(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _nats(value: float | None) -> str:
    return number(value, 1) if value is not None and math.isfinite(value) else "–"


def _plain(value: float | None) -> str:
    """Format a compared number to three digits."""
    return f"{value:.3g}".replace("-", "−") if value is not None and math.isfinite(value) else "–"
