"""diagnosis.json: writing, its schema, and validation."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from torch import Tensor

from mkc_torch.diagnosis.decisions import Trail
from mkc_torch.diagnosis.environment import DisturbanceEstimate, NoiseEnvironment, ProcessNoise, ShapeCheck
from mkc_torch.diagnosis.io.checks_json import checks_json
from mkc_torch.diagnosis.io.conditions_json import conditions_json
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
from mkc_torch.diagnosis.verdict import conclusion

_MOST_POINTS = 500
"""Largest number of samples of a disturbance that are written."""

_DIGITS = 5
"""Significant digits of a disturbance's values."""
_TIME_DIGITS = 6
"""Decimals of a time in s."""


def goodness_of_fit_json(environment: NoiseEnvironment) -> dict[str, Any]:
    """Return the goodness of fit of each output, by its name.

    Example:
        >>> from mkc_torch.diagnosis.environment import GoodnessOfFit
        >>> fit = GoodnessOfFit("angle", "rad", 0.0049, 0.35, 0.9997, 0.005, "declared", 0.35, 0.02)
        >>> goodness_of_fit_json(NoiseEnvironment(goodness_of_fit=(fit,)))["angle"]["explained"]
        0.9997
    """
    return {
        fit.output: {
            "unit": fit.unit,
            "residual": _finite(fit.residual),
            "variation": _finite(fit.variation),
            "explained": _finite(fit.explained),
            "noise_floor": _finite(fit.noise_floor),
            "floor_source": fit.floor_source,
            "rmse_of_mean": _finite(fit.rmse_of_mean),
            "rmse_of_last_value": _finite(fit.rmse_of_last_value),
        }
        for fit in environment.goodness_of_fit
    }


def noise_json(environment: NoiseEnvironment) -> dict[str, Any]:
    """Return the process noise of states, the drift of outputs, and the input hold: the rest of the key "noise"."""
    return {
        "process": _by_place(process for process in environment.process_noise if process.at_rate),
        "sensor": _by_place(process for process in environment.process_noise if not process.at_rate),
        "input_hold": dict(environment.input_hold),
    }


def _by_place(processes: Iterable[ProcessNoise]) -> dict[str, Any]:
    """Return the strongest process of each state or output, with the weaker ones under "weaker"."""
    found: dict[str, Any] = {}
    for process in processes:
        content = {
            "size": process.size,
            "standard_error": _finite(process.standard_error),
            "unit": process.unit,
            "correlation_time": _finite(process.correlation_time),
            "log_likelihood_gain": _finite(process.log_likelihood_gain),
        }
        if process.place in found:
            found[process.place].setdefault("weaker", []).append(content)
        else:
            found[process.place] = content
    return found


def recordings_json(environment: NoiseEnvironment) -> dict[str, Any]:
    """Return the keys "runs" and "offsets" of several recordings; a key without entries is absent.

    Example:
        >>> from mkc_torch.diagnosis.environment import Offset
        >>> recordings_json(NoiseEnvironment(offsets=(Offset("speed", "m/s", 2, "b.csv", -0.2, 0.001),)))
        {'offsets': [{'output': 'speed', 'unit': 'm/s', 'recording': 2, 'name': 'b.csv', 'value': -0.2, ...}]}
    """
    offsets = [{**asdict(offset), "standard_error": _finite(offset.standard_error)} for offset in environment.offsets]
    runs = [asdict(run) for run in environment.runs]
    return {**({"runs": runs} if runs else {}), **({"offsets": offsets} if offsets else {})}


def disturbance_json(environment: NoiseEnvironment) -> list[dict[str, Any]]:
    """Return each estimated disturbance; a long recording is thinned evenly."""
    return [_course(estimate) for estimate in environment.disturbance]


def _course(estimate: DisturbanceEstimate) -> dict[str, Any]:
    step = max(-(-len(estimate.time) // _MOST_POINTS), 1)
    return {
        "state": estimate.place,
        "at_rate": estimate.at_rate,
        "unit": estimate.unit,
        "time": [round(float(t), _TIME_DIGITS) for t in estimate.time[::step]],
        "value": _rounded(estimate.value[::step]),
        "band": _rounded(estimate.band[::step]),
        "sentences": estimate.sentences,
    }


def _rounded(values: Tensor) -> list[float | None]:
    """Round to ``_DIGITS`` significant digits; None for values that are not finite."""
    return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in values.tolist()]


def remaining_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return whether the residual of the corrected model is white, and if not, its correlation and location."""
    d = diagnosis
    test: Mapping[str, Any] = next((result.content for result in d.evidence if result.test == "whiteness"), {})
    channels = test.get("channels", ())
    coloured = [channel["channel"] for channel in channels if not channel["white"]]
    return {
        "white": not coloured if channels else None,
        "largest_lag": max((channel["lag"] for channel in channels), default=None),
        "unit": test.get("unit", ""),
        "channels": coloured,
        "disturbed_states": list(
            dict.fromkeys(process.place for process in d.environment.process_noise if process.at_rate)
        ),
        "smooth_along": list(d.remaining),
    }


def decisions_json(trail: Trail) -> dict[str, Any]:
    """Return the scored models and the decisions, each in their order.

    Example:
        >>> from mkc_torch.diagnosis.decisions import ScoredModel
        >>> decisions_json(Trail((ScoredModel((), "", 812.5, {"log_likelihood": 812.5}, "white", {}),)))["models"]
        [{'terms': (), 'move': '', 'score': 812.5, 'parts': {'log_likelihood': 812.5}, ...}]
    """
    return {
        "models": [
            {
                "terms": model.terms,
                "move": model.move,
                "score": _known(model.score),
                "parts": {name: _known(value) for name, value in model.parts.items()},
                "noise": model.noise,
                "open_loop": {name: _known(value) for name, value in model.open_loop.items()},
                "chosen": model.chosen,
                "suspected": model.suspected,
                **({"parameters": _of_terms(model.parameters)} if model.parameters else {}),
            }
            for model in trail.models
        ],
        "decisions": [asdict(decision) | {"value": _known(decision.value)} for decision in trail.decisions],
    }


def _of_terms(parameters: Sequence[Sequence[EffectParameter]]) -> list[list[dict[str, Any]]]:
    return [[_parameter(parameter) for parameter in own] for own in parameters]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


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
        "answer": conclusion(d).answer,
        "doubts": conclusion(d).doubts,
        "goodness_of_fit": goodness_of_fit_json(d.environment),
        "before_the_search": [checks_json(check) for check in d.checks],
        "reasons": d.environment.reasons,
        **recordings_json(d.environment),
        "noise": _noise(d.noise) | noise_json(d.environment),
        "search": {
            "candidates": d.candidates_tried,
            "surrogates": d.surrogates,
            "seed": d.seed,
            "starts": d.environment.starts,
            "restart_after": d.environment.restart_after,
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
        **({"suspected": d.suspected} if d.suspected else {}),
        "decisions": decisions_json(d.decisions),
        "notes": d.notes,
        "conditions": conditions_json(d.traces),
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
    sigma, sizes = [_sigma(s) for s in score.sigma], {name: asdict(size) for name, size in score.outputs.items()}
    content = {"log_likelihood": score.log_likelihood, "rmse": score.rmse, "sigma": sigma, "d": score.d}
    return {**content, **({"outputs": sizes} if sizes else {})}


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
        **({} if f.at_input is None else {"at_input": _json(f.at_input)}),
        "p_value": f.p_value,
        "shape": None if f.shape is None else _shape(f.shape),
        "held_out": None,
        "held_out_note": "not measured, because its test ended in an internal error",
        "alternatives": [
            {
                "effect": a.effect,
                "drivers": a.drivers,
                "log_likelihood_gap": _known(a.log_likelihood_gap),
                "separable": a.separable,
                **({"port": a.port} if a.port else {}),
                **({"distinguishing_state": a.distinguishing_state} if a.distinguishing_state else {}),
                **({"parameters": [_parameter(p) for p in a.parameters]} if a.parameters else {}),
            }
            for a in f.alternatives
        ],
        "plausible": f.plausible,
        "plausibility": f.plausibility,
        **({} if f.region is None else {"region": asdict(f.region)}),
        **{key: value for key in ("experiments", "recordings", "event_times", "advice") if (value := getattr(f, key))},
        **({"references": [asdict(reference) for reference in f.references]} if f.references else {}),
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
    if isinstance(value, EffectParameter):
        return _parameter(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {item.name: _json(getattr(value, item.name)) for item in fields(value)}
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
