"""Warnings of a diagnosis about rejected candidates, and about why the search ended."""

from __future__ import annotations

import math
from dataclasses import replace

from mkc_torch.diagnosis.findings.warnings import called
from mkc_torch.diagnosis.model.shapes import described
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.search.run import SearchResult

_HINTED = 0.15
"""p-value up to which the strongest candidate is mentioned although it is not a finding."""

_MENTIONED = 3
"""Largest number of effects that are mentioned though no findings."""


def with_search_notes(diagnosis: Diagnosis, search: StepwiseSearch) -> Diagnosis:
    """Add warnings about rejected candidates, and about why the search ended."""
    more = [_not_confirmed(search.unconfirmed, diagnosis)] if search.unconfirmed else []
    if diagnosis.verdict == "unexplained" and not search.found and search.first is not None:
        more += _short_of_the_level(search.first, diagnosis.level) or _as_good_as_a_disturbance(search.first)
    more += [_refused(refused, diagnosis) for refused in search.refused]
    if search.given_up:
        more.append(
            f"The search for further findings ended early: with {called(search.found[-1].term)} in the model, a "
            "further fit has no finite trajectory. Other physics may be missing too."
        )
    if search.cut:
        more.append(
            f"There is more structure beyond the {len(search.found)} findings, the limit; raise `--max-findings` to "
            "find it (`max_findings` in Python)."
        )
    return replace(diagnosis, warnings=(*diagnosis.warnings, *more))


def significance(p_value: float | None) -> str:
    return "its likelihood gain exceeds its penalty" if p_value is None else f"p = {p_value:.2g} after the whole search"


def _not_confirmed(located: SearchResult, diagnosis: Diagnosis) -> str:
    return (
        f"{_rejected(located, diagnosis)}, but it does not predict held-out blocks better, so it does not count as a "
        "finding."
    )


def _refused(located: SearchResult, diagnosis: Diagnosis) -> str:
    return (
        f"{_rejected(located, diagnosis)}, but it turns the sensor's vector far more than it changes its length, so "
        "its size is not determined and it does not count as a finding."
    )


def _rejected(located: SearchResult, diagnosis: Diagnosis) -> str:
    """Return the name and significance of a candidate, with its port if a finding has the same effect."""
    term = located.term
    place = f" at the {term.port}" if any(f.effect == term.effect.id for f in diagnosis.findings) else ""
    return f"{_with_shape(term)}{place}: {significance(None if diagnosis.quick else located.p_value)}"


def _with_shape(term: Term) -> str:
    """Return the name of a candidate with its shape."""
    shape = described(term.effect, term.shape)
    return f"{called(term)} ({shape})" if shape else called(term)


def _short_of_the_level(first: SearchResult, level: float) -> list[str]:
    """Describe the best candidate above the level, and how long a recording would decide about it."""
    if not level < first.p_value <= _HINTED or not math.isfinite(first.longer):
        return []
    return [
        f"{_with_shape(first.term)} would explain the residual best, but measurement and process noise gain as much by "
        f"chance: p = {first.p_value:.2g}. A recording about {max(first.longer, 1.1):.2g} times as long would decide "
        "whether it is real."
    ]


def _as_good_as_a_disturbance(first: SearchResult) -> list[str]:
    """Describe the effects with which the simulation follows, where a disturbance is as likely."""
    names = list(dict.fromkeys(_with_shape(fit.model.terms[-1]) for fit in first.follow))[:_MENTIONED]
    if not names:
        return []
    return [
        f"{' or '.join(names)} would explain most of the open-loop residual, but in this recording a disturbance "
        f"explains it as well: p = {first.p_value:.2g}. A second recording, diagnosed with this one by `--together`, "
        "would decide: physics repeats, a disturbance does not."
    ]
