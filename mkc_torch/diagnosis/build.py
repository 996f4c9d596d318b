"""A :class:`Diagnosis` from what the searches found and what was told of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch

from mkc_torch._parallel.deadline import within
from mkc_torch.diagnosis.environment import NoiseEnvironment
from mkc_torch.diagnosis.evidence.localised import called
from mkc_torch.diagnosis.evidence.remaining import nameless
from mkc_torch.diagnosis.evidence.run import EvidenceReport
from mkc_torch.diagnosis.findings.advice import advice_of
from mkc_torch.diagnosis.findings.finding import finding_of
from mkc_torch.diagnosis.findings.grading import grade_in_short, grade_of, is_zero_within_error
from mkc_torch.diagnosis.findings.noise import noise_summary
from mkc_torch.diagnosis.findings.separability import separability
from mkc_torch.diagnosis.findings.shape import shape_of
from mkc_torch.diagnosis.io.model import model_of
from mkc_torch.diagnosis.linearised.estimate import FinalEstimate
from mkc_torch.diagnosis.model.drivers import Drivers
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.grid import described
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import CandidateScore, Diagnosis, Finding, Separability, Traces
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.stepwise import SearchOptions, StepwiseSearch
from mkc_torch.diagnosis.stop import Stop, notices
from mkc_torch.diagnosis.verdict import (
    FitAssessment,
    assess,
    assess_baseline,
    lost_from_the_start,
    noise_environment,
    verdict_of,
)
from mkc_torch.recording.unit_warnings import unit_warnings
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation

__all__ = ["DiagnosisInputs", "build_diagnosis", "with_search_notes"]

_MOMENT_S = 1.0
"""Seconds that a part of a stopped diagnosis may take that is of use beside what was found."""

_HINTED = 0.15
"""p-value up to which the strongest candidate is told, though it does not count."""


_DROPPED = ("not confirmed", "nearest in the catalogue")
"""Grades of findings that are left out where their size is 0 within its standard error."""


@dataclass(frozen=True)
class DiagnosisInputs:
    """All that a diagnosis is assembled from beside the answers of the tests.

    Attributes:
        simulation: as it was given.
        drivers: the recorded columns, and what is to be said of them.
        terms: the candidates.
        base: the simulation alone, in the noise of the world.
        final: with all findings, under the pushes that are left.
        asked: for.
        cut: whether there was more to be found than was asked for.
        stop: why the search was stopped before its end, and what was not done.
    """

    simulation: Simulation
    drivers: Drivers
    terms: tuple[Term, ...]
    base: ProcessNoiseFit
    final: FittedModel
    asked: SearchOptions
    cut: bool
    stop: Stop | None = None

    @property
    def in_short(self) -> bool:
        """Whether parts that take long are left out."""
        return self.asked.quick or self.stop is not None


def build_diagnosis(whole: DiagnosisInputs, answers: EvidenceReport) -> Diagnosis:
    """The diagnosis, with advice.

    Args:
        whole: what it is of.
        answers: what the tests of evidence say, of what case.
    """
    case, prepared, asked = answers.case, answers.case.prepared, whole.asked
    first, final, settings = case.first, case.final, asked.settings
    known = _around(whole)
    unfit = known.unfit(settings.evidence)
    tried = [] if unfit else [_finding(case.found, number, final, whole, answers) for number in range(len(case.found))]
    without_size = [one for one in tried if one.grade in _DROPPED and is_zero_within_error(one)]
    findings = tuple(one for one in tried if one not in without_size)
    diagnosis = Diagnosis(
        recording=prepared.recording.name,
        simulation=prepared.name,
        samples=len(prepared.time),
        level=asked.level,
        noise=noise_summary(final, settings.noise),
        candidates_tried=0 if first is None and whole.stop is not None else len(whole.terms),
        surrogates=0 if asked.quick else asked.surrogates,
        seed=asked.seed,
        p_value=_p_value(first, whole),
        verdict="adequate",
        findings=findings,
        baseline=case.spread(case.held_out[0]),
        corrected=case.spread(case.held_out[-1]),
        advice=(),
        warnings=(
            *notices(whole.stop, quick=asked.quick),
            *prepared.recording.warnings,
            *unit_warnings(prepared.recording),
            *prepared.warnings,
            *whole.drivers.warnings,
            *_time_warnings(prepared),
            *answers.warnings,
            *(_no_size(one) for one in without_size),
            *(doubt for one in findings for doubt in one.doubts),
        ),
        candidates=_candidates(first),
        separability=separability(first) if first else _nothing_to_separate(),
        traces=_traces(prepared, whole.drivers, case.base, final),
        model=model_of(final, whole.simulation),
        evidence=answers.of_all,
        world=_world(whole, known, unfit=unfit),
        quick=asked.quick,
        stop=whole.stop,
    )
    there = first is not None and first.p_value <= asked.level and not findings
    structure = there or bool(diagnosis.remaining) or whole.cut or nameless(final.fit)
    # of a trajectory it has been asked for what pushes it
    white = known.noise is not None or _white(diagnosis)
    verdict = verdict_of(known, findings, structure=structure, white=white, settings=settings.evidence)
    if whole.stop is not None and verdict != "unfit":
        verdict = "unexplained"  # nobody knows what the rest of the search would have found
    diagnosis = replace(diagnosis, verdict=verdict)
    return replace(diagnosis, advice=advice_of(diagnosis))


def _finding(
    found: Sequence[SearchResult], number: int, final: FinalEstimate, whole: DiagnosisInputs, answers: EvidenceReport
) -> Finding:
    """A finding, with what the tests say of it, its shape and its grade."""
    quick = whole.asked.quick
    finding = replace(finding_of(found[number], final, number, quick=quick), evidence=answers.of_findings[number])
    if whole.in_short:
        return replace(finding, grade=grade_in_short(finding))
    shape = None
    if isinstance(whole.final.model.prepared, PreparedDynamics):
        shape = shape_of(whole.final, number, whole.terms, whole.asked.settings.evidence)
    grade = grade_of(finding)
    if shape is not None and shape.curve is not None:
        grade = "nearest in the catalogue"
    return replace(finding, grade=grade, shape=shape)


def _around(whole: DiagnosisInputs) -> FitAssessment:
    """What stands around the fits; of a stopped search no more than is known in a moment."""
    settings, declared = whole.asked.settings.noise, whole.asked.declared
    if whole.stop is None:
        return assess(whole.base, whole.final, declared, settings)
    known = within(_MOMENT_S, partial(assess, whole.base, whole.final, declared, settings))
    if known is not None:
        return known
    # how the simulation follows with what was found is not known, so it is not called unfit either
    follows = () if whole.final.model.terms else assess_baseline(whole.base, declared)
    return FitAssessment(follows, (), None, lost_from_the_start(whole.base))


def _world(whole: DiagnosisInputs, known: FitAssessment, *, unfit: bool) -> NoiseEnvironment:
    if whole.stop is None:
        return noise_environment(whole.base, whole.final, known, unfit=unfit)
    world = within(_MOMENT_S, partial(noise_environment, whole.base, whole.final, known, unfit=unfit))
    return NoiseEnvironment(known.follows, starts=whole.base.starts) if world is None else world


def _p_value(first: SearchResult | None, whole: DiagnosisInputs) -> float | None:
    """Of the strongest candidate; None where no noise was drawn."""
    if whole.asked.quick or (first is None and whole.stop is not None):
        return None
    return 1.0 if first is None else first.p_value


def _sure(p_value: float | None) -> str:
    return "it pays its price in likelihood" if p_value is None else f"p = {p_value:.2g} after the whole search"


def _no_size(finding: Finding) -> str:
    return (
        f"{finding.effect}: {_sure(finding.p_value)}, but in the free run its size is 0 within its standard error, so "
        "it does not count as a finding."
    )


def _white(diagnosis: Diagnosis) -> bool:
    """Whether what is left over is white."""
    told = next((said.value for said in diagnosis.evidence if said.test == "whiteness"), None)
    return not told or all(one.lag == 0 for one in told.values())


def with_search_notes(diagnosis: Diagnosis, search: StepwiseSearch) -> Diagnosis:
    """With what the last search found that does not count, and why there was no other."""
    more = [_not_confirmed(search.unconfirmed, quick=diagnosis.quick)] if search.unconfirmed else []
    if diagnosis.verdict == "unexplained" and not search.found and search.first is not None:
        more += _short_of_the_level(search.first, diagnosis.level)
    if search.given_up:
        more.append(f"The search beside what was found was given up. {search.given_up}")
    if search.cut:
        more.append(
            f"There is more structure beside the {len(search.found)} findings, which are as many as were asked for; "
            "ask for more with `max_findings`."
        )
    return replace(diagnosis, warnings=(*diagnosis.warnings, *more))


def _candidates(first: SearchResult | None) -> tuple[CandidateScore, ...]:
    if first is None:
        return ()
    return tuple(
        CandidateScore(
            first.scene.terms[r.number].effect.id,
            first.scene.terms[r.number].columns,
            described(first.scene.terms[r.number].effect, first.scene.terms[r.number].shape),
            r.gain,
            math.sqrt(2.0 * max(r.gain, 0.0)),
            first.scene.terms[r.number].at,
            r.gap,
        )
        for r in first.ranking
    )


def _nothing_to_separate() -> Separability:
    return Separability((), torch.zeros(0, 0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))


def _not_confirmed(located: SearchResult, *, quick: bool) -> str:
    shape = described(located.term.effect, located.term.shape)
    what = f"{called(located.term)} ({shape})" if shape else called(located.term)
    return (
        f"{what}: {_sure(None if quick else located.p_value)}, but it does not predict blocks better that the fit has "
        "not seen, so it does not count as a finding."
    )


def _short_of_the_level(first: SearchResult, level: float) -> list[str]:
    """What would explain what is left best, and how much more of the recording would show it."""
    if not level < first.p_value <= _HINTED or not math.isfinite(first.longer):
        return []
    shape = described(first.term.effect, first.term.shape)
    what = f"{called(first.term)} ({shape})" if shape else called(first.term)
    return [
        f"{what} would explain what is left best, but noise and pushes make as much of it by chance: p = "
        f"{first.p_value:.2g}. A recording about {max(first.longer, 1.1):.2g} times as long would show it, if it is "
        "that."
    ]


def _time_warnings(prepared: PreparedSimulation) -> tuple[str, ...]:
    if prepared.recording.time is not None:
        return ()
    return (
        "The recording has no column `time`: sample numbers stand in for seconds, and samples count as evenly spaced.",
    )


def _traces(prepared: PreparedSimulation, drivers: Drivers, base: FittedModel, final: FinalEstimate) -> Traces:
    shown = {
        name: driver.values[:, k] + driver.reference[k]
        for driver in drivers.drivers
        for k, name in enumerate(driver.columns)
    }
    units = {name: unit for driver in drivers.drivers for name, unit in zip(driver.columns, driver.units, strict=True)}
    return Traces(
        time=prepared.time,
        has_time=prepared.recording.time is not None,
        before=base.residual,
        after=final.fit.residual,
        weight=final.fit.weights,
        channels=prepared.channels,
        unit=prepared.unit,
        drivers=shown,
        driver_units=units,
    )
