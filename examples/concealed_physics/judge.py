"""Compare a row with the right answer for its recording."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from examples.blind_proof.statements import StatedCandidate, StatedDiagnosis, stated_diagnosis

if TYPE_CHECKING:
    from examples.concealed_physics.known import Expected, Size


def judged(row: Mapping[str, Any], expected: Expected) -> dict[str, Any]:
    """Judge a row by names, verdict, sizes and residual.

    Args:
        row: row of a diagnosis, from `row.row`.
        expected: the right answer.

    Returns:
        ``right`` and, in ``wrong``, a sentence for each fault.

    Example:
        >>> from examples.concealed_physics.known import Expected
        >>> row = {"verdict": "unfit", "findings": [], "residual_after": {}, "sentences": []}
        >>> judged(row, Expected(verdicts=("adequate",)))
        {'right': False, 'wrong': ['the verdict is unfit, not adequate']}
    """
    stated = stated_diagnosis(row if row["verdict"] else None)
    wrong = []
    if expected.verdicts and stated.verdict not in expected.verdicts:
        wrong.append(f"the verdict is {stated.verdict}, not {' or '.join(expected.verdicts)}")
    if stated.verdict == "failed":
        wrong = [f"no diagnosis: {row.get('failed') or 'no reason given'}"]
    elif not (expected.phrases and _contains(row, expected.phrases)):
        wrong += _wrong_names(stated, expected) + _wrong_sizes(row, expected.sizes)
        wrong += _wrong_residuals(row["residual_after"], expected.residual)
    return {"right": not wrong, "wrong": wrong}


def _contains(row: Mapping[str, Any], words: Sequence[str]) -> bool:
    return any(all(word in sentence for word in words) for sentence in row["sentences"])


def _wrong_names(stated: StatedDiagnosis, expected: Expected) -> list[str]:
    claimed = [finding.named.effect for finding in stated.claims]
    if not expected.names:
        return [f"{', '.join(claimed)} claimed, but no physics is missing"] if claimed else []
    found = ", ".join(claimed) or "nothing"
    wrong = [
        f"{' or '.join(group)} is not claimed but {found}" for group in expected.names if not _is_named(stated, group)
    ]
    accepted = {name for group in expected.names for name in group}
    first = stated.claims[0] if stated.claims else None
    if first and not {first.named.effect, *(other.effect for other in first.others)} & accepted:
        wrong.append(f"{first.named.effect} is claimed first")
    wrong += [f"{name} is claimed" for name in expected.refused if name in claimed]
    named = [finding.named for finding in stated.claims if finding.named.effect in accepted]
    if named and expected.places and not wrong and not any(_is_at(place, expected.places) for place in named):
        wrong += [f"{place.effect} is claimed at {', '.join(sorted(place.at))}" for place in named]
    return wrong


def _is_named(stated: StatedDiagnosis, group: Sequence[str]) -> bool:
    """Whether the effect is claimed, or is among the alternatives that the recording cannot rule out."""
    return any(candidate.effect in group for finding in stated.claims for candidate in (finding.named, *finding.others))


def _is_at(named: StatedCandidate, places: Sequence[str]) -> bool:
    return any(place in channel for place in places for channel in named.at)


def _wrong_sizes(row: Mapping[str, Any], sizes: Sequence[Size]) -> list[str]:
    wrong = []
    for size in sizes:
        value, error = _parameter(row, size)
        if value is None:
            wrong.append(f"no {size.parameter} of {size.effect}")
            continue
        allowed = max(size.within * abs(size.value), size.errors * error)
        if not abs(value - size.value) <= allowed:
            wrong.append(f"{size.parameter} of {size.effect} is {value:.4g}, not {size.value:.4g} +- {allowed:.2g}")
    return wrong


def _parameter(row: Mapping[str, Any], size: Size) -> tuple[float | None, float]:
    """Return a size and its error: of a finding, else of an alternative that the recording cannot rule out."""
    findings = row["findings"]
    others = [other for finding in findings for other in finding["alternatives"] if not other["separable"]]
    for candidate in (*findings, *others):
        for parameter in candidate["parameters"]:
            if candidate["effect"] == size.effect and parameter["name"] == size.parameter:
                error = parameter["standard_error"]
                return float(parameter["value"]), 0.0 if error is None else float(error)
    return None, math.nan


def _wrong_residuals(after: Mapping[str, float | None], most: Mapping[str, float]) -> list[str]:
    wrong = []
    for output, limit in most.items():
        residual = after.get(output)
        if residual is None or not residual <= limit:
            found = "unknown" if residual is None else f"{residual:.4g}"
            wrong.append(f"the residual of {output} is {found}, not at most {limit:.4g}")
    return wrong
