"""Rows of the summary at the top of the page: fit, noise, findings, size, place, significance and improvement."""

from __future__ import annotations

import math
from collections.abc import Iterator

from mkc_torch._support.typesetting import capital, plain, typeset
from mkc_torch.diagnosis.result import Diagnosis, Finding
from mkc_torch.effects import is_curve
from mkc_torch.report.diagnosis.environment import noise_lines, output_lines
from mkc_torch.report.diagnosis.findings import (
    acts_on,
    curve_values,
    finding_name,
    grade,
    inseparable,
    rivals,
    stated_parameters,
    where,
)
from mkc_torch.report.diagnosis.noise import noise_model, smooth_fit
from mkc_torch.report.diagnosis.numbers import at_input, clock_of, evidence, largest, probability
from mkc_torch.report.diagnosis.unseen import better, diverged, residual_of_all, residuals
from mkc_torch.report.diagnosis.verdict import reasons
from mkc_torch.report.words.numbers import factor, size

Row = tuple[str, tuple[str, ...]]
"""Label and lines of a row; backticks mark code."""


def summary(diagnosis: Diagnosis) -> list[Row]:
    """Return the rows of the summary."""
    d = diagnosis
    follows = output_lines(d)
    rows = [_row("fit", *follows)] if follows else []
    suspected = [_row("suspected", *(typeset(sentence) for sentence in d.suspected))] if d.suspected else []
    if d.verdict == "unfit":
        return [*rows, *([_row("why", *reasons(d))] if d.environment.reasons else []), *suspected]
    noise = _row("noise", *(noise_lines(d) or [f"{capital(noise_model(d.noise))}."]))
    rows = [*_of_findings(d), *rows, noise]
    smooth = "" if d.findings else smooth_fit(d)
    if smooth:
        rows.append(_row("for comparison", f"{capital(smooth)}."))
    return [*rows, *suspected]


def _row(label: str, *lines: str) -> Row:
    return capital(label), lines


def _of_findings(diagnosis: Diagnosis) -> Iterator[Row]:
    d = diagnosis
    if not d.findings:
        if not d.environment.goodness_of_fit:
            yield _row("residual", residual_alone(d))
        yield _row("how sure", *_process_noise_evidence(d), chance(d.p_value, d))
        return
    if len(d.findings) > 1:
        for number, f in enumerate(d.findings, 1):
            yield f"{number} · {capital(finding_name(f))}", tuple(_in_short(f, d))
        together = residual_of_all(d)
        if together:
            yield _row("together", *(f"On held-out data: {change}." for change in together))
        yield _row("how sure", chance(d.findings[0].p_value, d))
        return
    (f,) = d.findings
    text = _sizes(f, 2)
    if text:
        yield _row("how large", f"{text}.")
    yield _row("where", f"{_place(f, d)}.")
    yield _row("how sure", chance(f.p_value, d))
    if f.held_out is None:
        yield _row("how much better", f"Not measured: {_closed(f.held_out_note)}")
        return
    sure = f"{capital(better(f.held_out))}."
    sizes = [f"On held-out data: {residual}." for residual in residuals(f.held_out, d.environment)]
    yield _row("how much better", *sizes, sure, *filter(None, [diverged(f.held_out)]))


def _process_noise_evidence(diagnosis: Diagnosis) -> Iterator[str]:
    """State the evidence for process noise, and that no physics is significant."""
    known = [process for process in diagnosis.environment.process_noise if math.isfinite(process.log_likelihood_gain)]
    if known:
        less = factor(known[0].log_likelihood_gain)
        yield f"A model without this noise of `{plain(known[0].place)}` is less likely by {less}."
        if diagnosis.p_value is not None and diagnosis.p_value > diagnosis.level:
            yield "No physics is significant in addition to it."


def _in_short(finding: Finding, diagnosis: Diagnosis) -> Iterator[str]:
    """Return grade, size, place and significance of one of several findings."""
    f = finding
    rival = f"; not distinguished from: {rivals(f)}" if inseparable(f) else ""
    yield f"{capital(grade(f))}{rival}."
    text = _sizes(f, 1)
    if text:
        yield f"{text}."
    yield f"{_place(f, diagnosis)}."
    sure = evidence(None, 0) if f.p_value is None else probability(f.p_value)
    if f.held_out is None:
        yield f"{sure}; not measured: {_closed(f.held_out_note)}"
        return
    yield f"{sure}; {better(f.held_out)}: {'; '.join(residuals(f.held_out, diagnosis.environment))}."


def _sizes(finding: Finding, most: int) -> str:
    """Format the first parameters; of a curve its values at the first and the last place with samples."""
    if is_curve(finding.effect):
        values = curve_values(finding)
        return "; ".join(dict.fromkeys([*values[:1], *values[-1:]]))
    sizes = (largest(parameter) for parameter in stated_parameters(finding)[:most])
    return "; ".join(filter(None, [*sizes, at_input(finding.at_input)]))


def _closed(sentence: str) -> str:
    return sentence if sentence.endswith(".") else f"{sentence}."


def _place(finding: Finding, diagnosis: Diagnosis) -> str:
    acts = f"; {acts_on(finding)}" if finding.channels else ""
    return f"{capital(where(finding, clock_of(diagnosis.traces)))}{acts}"


def residual_alone(diagnosis: Diagnosis) -> str:
    """Return the residual of the simulation without findings."""
    d = diagnosis
    residual = f"{size(d.baseline.rmse)} {plain(d.traces.unit)}".rstrip()
    return f"{residual}, root mean square on held-out data."


def chance(p_value: float | None, diagnosis: Diagnosis) -> str:
    """Return the p-value in a sentence."""
    d = diagnosis
    if p_value is None:
        return f"{capital(evidence(None, 0))}."
    return f"{evidence(p_value, d.surrogates)}, corrected for {d.candidates_tried:,} candidates (level {d.level:g})."
