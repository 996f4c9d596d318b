"""diagnosis.json: the text of a diagnosis, of the schema "mkc-diagnosis/2", and the check that a file is one.

Files of "mkc-diagnosis/1" can still be checked.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from mkc_torch.diagnosis.environment import ShapeCheck
from mkc_torch.diagnosis.io.environment_json import follows_of, forcing_of, noise_of, of_recordings, remaining_of
from mkc_torch.diagnosis.result import (
    Diagnosis,
    EffectParameter,
    EvidenceResult,
    Finding,
    HeldOut,
    HeldOutScore,
    NoiseSummary,
    Number,
)

__all__ = ["SCHEMA", "SCHEMAS", "DiagnosisFileError", "diagnosis_to_json", "json_schema", "validate"]

SCHEMA = "mkc-diagnosis/2"
"""That of what is written."""

SCHEMAS = ("mkc-diagnosis/1", SCHEMA)
"""Those that can be read."""

Path = tuple[str | int, ...]


class DiagnosisFileError(ValueError):
    """Content that is no diagnosis; the sentence says where and why."""


def diagnosis_to_json(diagnosis: Diagnosis) -> str:
    """The diagnosis as JSON of the schema "mkc-diagnosis/2", checked against it. Needs the ``cli`` extra.

    Numbers round-trip exactly. JSON has no infinity and no NaN: a bandwidth is the string "inf" where the density is
    Gaussian, and a standard error, a bound of an interval or a gap that is not known is null. Any other number that
    is not finite is refused.

    Raises:
        DiagnosisFileError: the diagnosis does not fit the schema.
    """
    d = diagnosis
    content = {
        "schema": SCHEMA,
        "recording": list(d.recordings) or d.recording,
        "simulation": d.simulation,
        "samples": d.samples,
        "level": d.level,
        "p_value": d.p_value,
        "verdict": d.verdict,
        "follows": follows_of(d.world),
        "reasons": d.world.reasons,
        **of_recordings(d.world),
        "noise": _noise(d.noise) | noise_of(d.world),
        "search": {
            "candidates": d.candidates_tried,
            "surrogates": d.surrogates,
            "seed": d.seed,
            "starts": d.world.starts,
            "quick": d.quick,
            "stopped": None if d.stop is None else asdict(d.stop),
        },
        "findings": [_finding(f) for f in d.findings],
        "forcing": forcing_of(d.world),
        "remaining": remaining_of(d),
        "baseline": _spread(d.baseline),
        "corrected": _spread(d.corrected),
        "ceiling": None,
        "advice": d.advice,
        "warnings": d.warnings,
    }
    content = _with_evidence(content, d.evidence, json_schema())
    _refuse_not_finite(content)
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, indent=2)
    validate(json.loads(text))
    # lists of numbers on one line; a text in JSON holds no line end, so none is touched
    return re.sub(r"\[\n\s+([^\[\]{}\"]*?)\n\s+\]", lambda m: "[" + " ".join(m[1].split()) + "]", text) + "\n"


def validate(content: Mapping[str, Any]) -> None:
    """Check the content of a diagnosis.json, as ``json.loads`` gives it, by its own schema. Needs the ``cli`` extra.

    Raises:
        DiagnosisFileError: the content does not fit the schema that it names, or contradicts itself.

    Example:
        >>> validate({"schema": "mkc-diagnosis/1"})
        Traceback (most recent call last):
        mkc_torch.diagnosis.io.diagnosis_json.DiagnosisFileError: this is no diagnosis: ...
    """
    from jsonschema import Draft202012Validator  # here, so that diagnoses need no such package until one is written
    from jsonschema.exceptions import best_match

    _refuse_not_finite(content)
    named = content.get("schema") if isinstance(content, Mapping) else None
    schema = json_schema(named if named in SCHEMAS else SCHEMA)
    error = best_match(Draft202012Validator(schema).iter_errors(content))
    if error is not None:
        message = error.message if len(error.message) <= 200 else error.message[:199] + "…"
        raise DiagnosisFileError(f"this is no diagnosis: {_where(tuple(error.absolute_path))}: {message}.")
    for i, finding in enumerate(content["findings"]):
        for k, parameter in enumerate(finding["parameters"]):
            if not _alike(parameter["value"], parameter["standard_error"]):
                place = _where(("findings", i, "parameters", k, "standard_error"))
                raise DiagnosisFileError(f"this is no diagnosis: {place} has not the shape of the value.")
            if "components" in parameter and len(parameter["components"]) != _count(parameter["value"]):
                place = _where(("findings", i, "parameters", k, "components"))
                raise DiagnosisFileError(f"this is no diagnosis: {place} are not as many as the numbers of the value.")
        for k, (start, end) in enumerate(finding["intervals"]):
            if end < start:
                place = _where(("findings", i, "intervals", k))
                raise DiagnosisFileError(f"this is no diagnosis: {place} ends before it starts.")
    for i, forcing in enumerate(content.get("forcing", ())):
        if not len(forcing["time"]) == len(forcing["value"]) == len(forcing["band"]):
            raise DiagnosisFileError(f"this is no diagnosis: {_where(('forcing', i))} has lists of different lengths.")


@cache
def json_schema(named: str = SCHEMA) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of diagnosis.json, or of one that older files have; a file of this package.

    Example:
        >>> json_schema()["title"], json_schema("mkc-diagnosis/1")["title"]
        ('mkc-diagnosis/2', 'mkc-diagnosis/1')
    """
    edition = named.rpartition("/")[2]
    file = files("mkc_torch.diagnosis.io").joinpath("schema", f"diagnosis_{edition}.schema.json")
    schema: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return schema


def _noise(noise: NoiseSummary) -> dict[str, Any]:
    return {
        "model": noise.model,
        "parameters": dict(noise.parameters),
        "sigma": [_sigma(s) for s in noise.sigma],
        "d": noise.d,
        "bound": noise.bound,
        "description": noise.description,
        **({"units": dict(noise.units)} if noise.units else {}),
        **({"unit": noise.unit} if noise.unit else {}),
        **({"tails": [channel._asdict() for channel in noise.tails]} if noise.tails else {}),
    }


def _spread(spread: HeldOutScore) -> dict[str, Any]:
    return {
        "log_likelihood": spread.log_likelihood,
        "rmse": spread.rmse,
        "sigma": [_sigma(s) for s in spread.sigma],
        "d": spread.d,
    }


def _finding(finding: Finding) -> dict[str, Any]:
    f = finding
    content = {
        "effect": f.effect,
        "grade": f.grade,
        "drivers": f.drivers,
        "channels": f.channels,
        "intervals": f.intervals,
        "onset": f.onset,
        "equation": f.equation,
        "explanation": f.explanation,
        "parameters": [_parameter(p) for p in f.parameters],
        "p_value": f.p_value,
        "shape": None if f.shape is None else _shape(f.shape),
        "alternatives": [
            {
                "effect": a.effect,
                "drivers": a.drivers,
                "log_likelihood_gap": _known(a.log_likelihood_gap),
                "separable": a.separable,
                **({"at": a.at} if a.at else {}),
                **({"told_by": a.distinguishing_state} if a.distinguishing_state else {}),
            }
            for a in f.alternatives
        ],
        "plausible": f.plausible,
        "plausibility": f.plausibility,
        **({} if f.region is None else {"region": asdict(f.region)}),
        **({"experiments": f.experiments} if f.experiments else {}),
        **({"moments": f.moments} if f.moments else {}),
        **({"references": [asdict(one) for one in f.references]} if f.references else {}),
        **({"advice": f.advice} if f.advice else {}),
    }
    return _with_evidence(content, f.evidence, json_schema()["$defs"]["finding"])


def _with_evidence(
    content: Mapping[str, Any], evidence: Sequence[EvidenceResult], schema: Mapping[str, Any]
) -> dict[str, Any]:
    """With what the tests say of it, its keys in the order in which the schema has them."""
    whole = dict(content)
    for told in evidence:
        for key, value in told.keys.items():
            known = whole.get(key)
            whole[key] = {**known, **_json(value)} if isinstance(known, Mapping) else _json(value)
    more = {told.test: _json(told.content) for told in evidence if told.content}
    if more:
        whole["evidence"] = more
    order = {key: place for place, key in enumerate(schema["properties"])}
    return dict(sorted(whole.items(), key=lambda item: order.get(item[0], len(order))))


def _json(value: Any) -> Any:
    """A value of JSON as it is, and results as this file writes them."""
    if isinstance(value, HeldOutScore):
        return _spread(value)
    if isinstance(value, HeldOut):
        return _held_out(value)
    if is_dataclass(value) and not isinstance(value, type):
        return _json(asdict(value))
    if isinstance(value, Mapping):
        return {key: _json(child) for key, child in value.items()}
    return [_json(child) for child in value] if isinstance(value, (list, tuple)) else value


def _shape(shape: ShapeCheck) -> dict[str, Any]:
    return {"free_curve_gain": _known(shape.free_curve_gain), "p_value": shape.p_value, "formula": shape.formula}


def _parameter(parameter: EffectParameter) -> dict[str, Any]:
    p = parameter
    told = {"name": p.name, "value": p.value, "standard_error": _known(p.standard_error), "unit": p.unit}
    return {**told, **({"components": p.components} if p.components else {})}


def _held_out(held_out: HeldOut) -> dict[str, Any]:
    return {
        "log_likelihood_gain": held_out.log_likelihood_gain,
        "confidence_interval": _known(held_out.confidence_interval),
        "rmse_before": held_out.rmse_before,
        "rmse_after": held_out.rmse_after,
        "unit": held_out.unit,
        "outputs": {
            name: {"before": _known(one.before), "after": _known(one.after), "unit": one.unit}
            for name, one in held_out.outputs.items()
        },
        "left": held_out.left,
    }


def _sigma(sigma: float) -> float | str:
    return "inf" if sigma == math.inf else sigma


def _known(value: Number | None) -> Any:
    """The value with None where it is not finite."""
    if isinstance(value, Sequence):
        return [_known(v) for v in value]
    return value if value is not None and math.isfinite(value) else None


def _alike(value: Any, error: Any) -> bool:
    """Whether a standard error has the shape of its value; None has any."""
    if isinstance(value, list) and isinstance(error, list):
        return len(value) == len(error) and all(_alike(v, e) for v, e in zip(value, error, strict=True))
    return error is None or not (isinstance(value, list) or isinstance(error, list))


def _count(value: Any) -> int:
    return len(value) if isinstance(value, list) else 1


def _refuse_not_finite(content: Mapping[str, Any]) -> None:
    for path, value in _leaves(content, ()):
        if isinstance(value, float) and not math.isfinite(value):
            raise DiagnosisFileError(f"this is no diagnosis: {_where(path)} is {value}, which JSON has no number for.")


def _leaves(value: Any, path: Path) -> Iterator[tuple[Path, Any]]:
    if isinstance(value, Mapping):
        for key, child in value.items():
            yield from _leaves(child, (*path, key))
    elif isinstance(value, (list, tuple)):
        for i, child in enumerate(value):
            yield from _leaves(child, (*path, i))
    else:
        yield path, value


def _where(path: Path) -> str:
    return f"`{'.'.join(str(key) for key in path)}`" if path else "the whole"
