"""Write and validate diagnosis.json, schema "mkc-diagnosis/3"."""

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
from mkc_torch.diagnosis.io.environment_json import (
    disturbance_json,
    goodness_of_fit_json,
    noise_json,
    recordings_json,
    remaining_json,
)
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

__all__ = ["SCHEMA", "DiagnosisFileError", "diagnosis_to_json", "json_schema", "validate"]

SCHEMA = "mkc-diagnosis/3"
"""Value of the key "schema"."""

Path = tuple[str | int, ...]


class DiagnosisFileError(ValueError):
    """Content that does not fit the schema; the message has the key and the reason."""


def diagnosis_to_json(diagnosis: Diagnosis) -> str:
    """Return the diagnosis as JSON, validated by the schema "mkc-diagnosis/3". Needs the ``cli`` extra.

    Numbers round-trip exactly. JSON has no infinity and no NaN: the bandwidth of a Gaussian is the string "inf"; an
    unknown standard error, interval bound or log-likelihood gap is null.

    Raises:
        DiagnosisFileError: the diagnosis does not fit the schema, or another number is not finite.
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
        "goodness_of_fit": goodness_of_fit_json(d.environment),
        "reasons": d.environment.reasons,
        **recordings_json(d.environment),
        "noise": _noise(d.noise) | noise_json(d.environment),
        "search": {
            "candidates": d.candidates_tried,
            "surrogates": d.surrogates,
            "seed": d.seed,
            "starts": d.environment.starts,
            "quick": d.quick,
            "stopped": None if d.stop is None else asdict(d.stop),
        },
        "findings": [_finding(f) for f in d.findings],
        "disturbance": disturbance_json(d.environment),
        "remaining": remaining_json(d),
        "baseline": _score(d.baseline),
        "corrected": _score(d.corrected),
        "ceiling": None,
        "advice": d.advice,
        "warnings": d.warnings,
        "notes": d.notes,
        "rejected_intervals": d.rejected_intervals,
    }
    content = _with_evidence(content, d.evidence, json_schema())
    _refuse_not_finite(content)
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, indent=2)
    validate(json.loads(text))
    # Put lists of numbers on one line; JSON strings contain no line break, so they stay unchanged.
    return re.sub(r"\[\n\s+([^\[\]{}\"]*?)\n\s+\]", lambda m: "[" + " ".join(m[1].split()) + "]", text) + "\n"


def validate(content: Mapping[str, Any]) -> None:
    """Validate the content of a diagnosis.json, as ``json.loads`` returns it. Needs the ``cli`` extra.

    Raises:
        DiagnosisFileError: the content does not fit the schema, or contradicts itself.

    Example:
        >>> validate({"schema": "mkc-diagnosis/3"})
        Traceback (most recent call last):
        mkc_torch.diagnosis.io.diagnosis_json.DiagnosisFileError: Expected content of schema mkc-diagnosis/3 but ...
    """
    from jsonschema import Draft202012Validator  # imported here: only writing needs jsonschema
    from jsonschema.exceptions import best_match

    _refuse_not_finite(content)
    error = best_match(Draft202012Validator(json_schema()).iter_errors(content))
    if error is not None:
        message = error.message if len(error.message) <= 200 else error.message[:199] + "…"
        raise _invalid(tuple(error.absolute_path), f"is invalid: {message}")
    for i, finding in enumerate(content["findings"]):
        for k, parameter in enumerate(finding["parameters"]):
            if not _alike(parameter["value"], parameter["standard_error"]):
                raise _invalid(("findings", i, "parameters", k, "standard_error"), "differs in shape from `value`")
            if "components" in parameter and len(parameter["components"]) != _count(parameter["value"]):
                raise _invalid(("findings", i, "parameters", k, "components"), "differs in length from `value`")
        for k, (start, end) in enumerate(finding["intervals"]):
            if end < start:
                raise _invalid(("findings", i, "intervals", k), "ends before it starts")
    for i, course in enumerate(content["disturbance"]):
        if not len(course["time"]) == len(course["value"]) == len(course["band"]):
            raise _invalid(("disturbance", i), "has lists of different lengths")


@cache
def json_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of diagnosis.json.

    Example:
        >>> json_schema()["title"]
        'mkc-diagnosis/3'
    """
    file = files("mkc_torch.diagnosis.io").joinpath("schema", "diagnosis_3.schema.json")
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


def _score(score: HeldOutScore) -> dict[str, Any]:
    return {
        "log_likelihood": score.log_likelihood,
        "rmse": score.rmse,
        "sigma": [_sigma(s) for s in score.sigma],
        "d": score.d,
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
                **({"port": a.port} if a.port else {}),
                **({"distinguishing_state": a.distinguishing_state} if a.distinguishing_state else {}),
            }
            for a in f.alternatives
        ],
        "plausible": f.plausible,
        "plausibility": f.plausibility,
        **({} if f.region is None else {"region": asdict(f.region)}),
        **({"experiments": f.experiments} if f.experiments else {}),
        **({"event_times": f.event_times} if f.event_times else {}),
        **({"references": [asdict(reference) for reference in f.references]} if f.references else {}),
        **({"advice": f.advice} if f.advice else {}),
    }
    return _with_evidence(content, f.evidence, json_schema()["$defs"]["finding"])


def _with_evidence(
    content: Mapping[str, Any], evidence: Sequence[EvidenceResult], schema: Mapping[str, Any]
) -> dict[str, Any]:
    """Add the results of the tests of evidence; sort the keys as in the schema."""
    whole = dict(content)
    for result in evidence:
        for key, value in result.keys.items():
            known = whole.get(key)
            whole[key] = {**known, **_json(value)} if isinstance(known, Mapping) else _json(value)
    more = {result.test: _json(result.content) for result in evidence if result.content}
    if more:
        whole["evidence"] = more
    order = {key: position for position, key in enumerate(schema["properties"])}
    return dict(sorted(whole.items(), key=lambda item: order.get(item[0], len(order))))


def _json(value: Any) -> Any:
    """Convert results to JSON values; JSON values are returned unchanged."""
    if isinstance(value, HeldOutScore):
        return _score(value)
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
    content = {"name": p.name, "value": p.value, "standard_error": _known(p.standard_error), "unit": p.unit}
    return {**content, **({"components": p.components} if p.components else {})}


def _held_out(held_out: HeldOut) -> dict[str, Any]:
    return {
        "log_likelihood_gain": held_out.log_likelihood_gain,
        "confidence_interval": _known(held_out.confidence_interval),
        "rmse_before": held_out.rmse_before,
        "rmse_after": held_out.rmse_after,
        "unit": held_out.unit,
        "outputs": {
            name: {"before": _known(sizes.before), "after": _known(sizes.after), "unit": sizes.unit}
            for name, sizes in held_out.outputs.items()
        },
        "diverged_blocks": [asdict(block) for block in held_out.diverged_blocks],
        "blocks": held_out.blocks,
    }


def _sigma(sigma: float) -> float | str:
    return "inf" if sigma == math.inf else sigma


def _known(value: Number | None) -> Any:
    """Replace numbers that are not finite by None."""
    if isinstance(value, Sequence):
        return [_known(v) for v in value]
    return value if value is not None and math.isfinite(value) else None


def _alike(value: Any, error: Any) -> bool:
    """Whether a standard error has the shape of its value; None fits any shape."""
    if isinstance(value, list) and isinstance(error, list):
        return len(value) == len(error) and all(_alike(v, e) for v, e in zip(value, error, strict=True))
    return error is None or not (isinstance(value, list) or isinstance(error, list))


def _count(value: Any) -> int:
    return len(value) if isinstance(value, list) else 1


def _refuse_not_finite(content: Mapping[str, Any]) -> None:
    for path, value in _leaves(content, ()):
        if isinstance(value, float) and not math.isfinite(value):
            raise _invalid(path, f"is {value}; JSON has only finite numbers")


def _leaves(value: Any, path: Path) -> Iterator[tuple[Path, Any]]:
    if isinstance(value, Mapping):
        for key, child in value.items():
            yield from _leaves(child, (*path, key))
    elif isinstance(value, (list, tuple)):
        for i, child in enumerate(value):
            yield from _leaves(child, (*path, i))
    else:
        yield path, value


def _invalid(path: Path, reason: str) -> DiagnosisFileError:
    key = f"`{'.'.join(str(part) for part in path)}`" if path else "the file"
    return DiagnosisFileError(f"Expected content of schema {SCHEMA} but {key} {reason}.")
