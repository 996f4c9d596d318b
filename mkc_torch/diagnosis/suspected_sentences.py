"""Sentences that compare the sets of effects that the user suspects with what the search found."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from mkc_torch._support.unit_text import sized
from mkc_torch.diagnosis.decisions import ScoredModel, Trail
from mkc_torch.effects import is_curve

_SAME = 0.05
"""Difference of two scores in nats below which they are printed as equal."""


def suspected_sentences(trail: Trail, units: Mapping[str, str], *, findings: bool) -> tuple[str, ...]:
    """Return a sentence for each suspected model.

    Args:
        trail: the scored models.
        units: of the outputs, by name.
        findings: whether the diagnosis has findings; without findings the simulation alone is compared.

    Example:
        >>> alone = ScoredModel((), "", 800.0, {}, "white", {"speed": 0.3})
        >>> drag = ScoredModel(("drag@speed",), "suspected", 812.3, {}, "white", {"speed": 0.0139}, suspected=True)
        >>> suspected_sentences(Trail((alone, drag)), {"speed": "m/s"}, findings=False)
        ('The suspected drag@speed scores 12.3 more than the simulation alone; it leaves 0.0139 m/s.',)
    """
    found = next((model for model in trail.models if model.chosen), None) if findings else None
    alone = next((model for model in trail.models if not model.terms), None)
    other = alone if found is None else found
    name = "the simulation alone" if found is None else "the findings"
    return tuple(" ".join(_sentences(model, other, name, units)) for model in trail.models if model.suspected)


def _sentences(model: ScoredModel, other: ScoredModel | None, name: str, units: Mapping[str, str]) -> Iterator[str]:
    subject = f"The suspected {' + '.join(model.terms)}"
    if model.score is None:
        yield f"{subject} has no score: no fit with it follows the recording."
        return
    yield f"{subject} {_comparison(model.score, model, other, name)}{_left(model, units)}."
    sizes = [
        f"{' '.join([parameter.name.replace('_', ' '), sized(parameter.value, parameter.unit)])} of {term}"
        for term, parameters in zip(model.terms, model.parameters, strict=False)
        for parameter in parameters
        if isinstance(parameter.value, float) and math.isfinite(parameter.value) and not _of_curve(term)
    ]
    if sizes:
        yield f"Its sizes: {', '.join(sizes)}."


def _comparison(score: float, model: ScoredModel, other: ScoredModel | None, name: str) -> str:
    if other is None or other.score is None:
        return f"scores {score:.1f}, and {name} has no score"
    difference = score - other.score
    if sorted(model.terms) == sorted(other.terms) and abs(difference) < 0.5:
        return "is what was found"
    if abs(difference) < _SAME:
        return f"scores as much as {name}"
    return f"scores {_difference(abs(difference))} {'more' if difference > 0.0 else 'less'} than {name}"


def _of_curve(term: str) -> bool:
    """Whether a term is a curve: its coefficients are no values of it."""
    return is_curve(term.partition("@")[0])


def _difference(value: float) -> str:
    return f"{value:.3g}" if value < 100.0 else f"{value:.0f}"


def _left(model: ScoredModel, units: Mapping[str, str]) -> str:
    """Return the open-loop residual of each output, as the second half of a sentence."""
    left = {name: value for name, value in model.open_loop.items() if math.isfinite(value)}
    if not left:
        return "; its open-loop simulation loses the recording"
    texts = [f"{value:.3g} {units.get(name, '')}".strip() for name, value in left.items()]
    if len(texts) > 1:
        texts = [f"{text} of {name}" for name, text in zip(left, texts, strict=True)]
    return f"; it leaves {', '.join(texts)}"
