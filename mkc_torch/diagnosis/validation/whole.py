"""Check a diagnosis of stretches on the whole recording."""

from __future__ import annotations

from dataclasses import replace

from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.validation.check import check
from mkc_torch.diagnosis.validation.result import OutputCheck
from mkc_torch.recording.recording import Recording


def with_whole_recording(result: Diagnosis, whole: Recording | None) -> Diagnosis:
    """Return a diagnosis of stretches with its residuals in the whole recording in a note; failures are warnings.

    Args:
        result: the diagnosis.
        whole: all samples that were given; None if the diagnosis uses them all.
    """
    if whole is None or result.model is None or result.stop is not None:
        return result
    try:
        found = check(result.model, whole)
    except ValueError:  # such as sizes that differ between the recordings
        return result
    residuals = "; ".join(_residual(each, findings=bool(found.findings)) for each in found.outputs)
    note = f"Residuals in {found.predicted} of all {found.samples} samples, predicted in open loop: {residuals}."
    failures = (f"All samples: {each.failure}" for each in found.outputs if each.failure)
    return replace(result, notes=(*result.notes, note), warnings=(*result.warnings, *failures))


def _residual(each: OutputCheck, *, findings: bool) -> str:
    unit = f" {each.unit}" if each.unit else ""
    if not findings:
        return f"`{each.output}` {each.corrected:.3g}{unit}"
    return f"`{each.output}` {each.corrected:.3g}{unit} with the findings, {each.baseline:.3g}{unit} without"
