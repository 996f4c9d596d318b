"""Build the diagnosis: the verdict, the findings with their evidence, and the notes on the search."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch

from mkc_torch._parallel.deadline import within
from mkc_torch._support.note import notes_of, warnings_of
from mkc_torch.diagnosis.decisions import Decision, ScoredModel, Trail
from mkc_torch.diagnosis.environment import GoodnessOfFit, NoiseEnvironment
from mkc_torch.diagnosis.evidence.remaining import nameless
from mkc_torch.diagnosis.evidence.run import EvidenceReport
from mkc_torch.diagnosis.findings.advice import advice_of
from mkc_torch.diagnosis.findings.alternatives import with_parameters
from mkc_torch.diagnosis.findings.finding import finding_of, separability
from mkc_torch.diagnosis.findings.noise import forcing_of, noise_summary, process_noise_of
from mkc_torch.diagnosis.findings.one_row import with_row_named
from mkc_torch.diagnosis.findings.reasons import reasons_of
from mkc_torch.diagnosis.findings.shape import shape_of
from mkc_torch.diagnosis.findings.warnings import evidence_warnings
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit
from mkc_torch.diagnosis.io.model import DiagnosedModel, model_of, own_parameters
from mkc_torch.diagnosis.model.fit import FittedModel, fitted, within_domain, without_term
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit, estimate_noise, refit_open_loop
from mkc_torch.diagnosis.model.shapes import described
from mkc_torch.diagnosis.model.term import Drivers, Term
from mkc_torch.diagnosis.noise.spectrum import agreed_innovation_gain
from mkc_torch.diagnosis.optional import optional
from mkc_torch.diagnosis.pipeline.counted import corrected_model, left_out_note, scores_of
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.pipeline.search_notes import significance
from mkc_torch.diagnosis.pipeline.traces import traces_of
from mkc_torch.diagnosis.result import CandidateScore, Diagnosis, Finding, Separability, Stop, notices
from mkc_torch.diagnosis.search.estimate import FinalEstimate
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import NamingSettings, NoiseSettings
from mkc_torch.diagnosis.validation.fingerprint import measured_columns
from mkc_torch.diagnosis.validation.predict import with_measured
from mkc_torch.diagnosis.validation.training import with_baseline, with_training
from mkc_torch.diagnosis.verdict import (
    FitAssessment,
    Remainder,
    decisions_on_all,
    reservations_of,
    verdict_of,
)
from mkc_torch.diagnosis.vetoes import VetoContext, counts, decisions_on, grade, is_dropped, is_zero_within_error
from mkc_torch.nonlinear import NoFitError
from mkc_torch.recording.unit_warnings import unit_warnings
from mkc_torch.simulation.dynamics.diverging import divergence_checks
from mkc_torch.simulation.dynamics.impossible import impossible_checks, impossible_values
from mkc_torch.simulation.dynamics.noise import sized_noise
from mkc_torch.simulation.dynamics.unlikely import unlikely_checks
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation
from mkc_torch.simulation.start_checks import StartCheck


def assess_baseline(base: ProcessNoiseFit, declared: Mapping[str, float]) -> tuple[GoodnessOfFit, ...]:
    """Return the goodness of fit of the simulation without findings, by output."""
    free = base.free
    prepared = base.fit.model.prepared if free is None else free.model.prepared
    return goodness_of_fit(prepared, None if free is None else free.residual, declared)


def impossible_rotations(base: ProcessNoiseFit) -> bool:
    """Whether a search is pointless: the recorded rotations are impossible."""
    return bool(base.fit.model.prepared.faults)


def assess(
    base: ProcessNoiseFit, final: FittedModel, declared: Mapping[str, float], noise: NoiseSettings
) -> FitAssessment:
    """Assess the simulation without and with the findings.

    Args:
        base: the fit without findings.
        final: the fit with all findings, under the remaining process noise.
        declared: known standard deviations of the outputs' white noise.
        noise: settings.
    """
    follows = assess_baseline(base, declared)
    left = base.noise if not final.model.terms else estimate_noise(final, declared, noise)
    corrected: tuple[GoodnessOfFit, ...] = ()
    if final.model.terms:
        free = refit_open_loop(final)
        corrected = () if free is None else goodness_of_fit(free.model.prepared, free.residual, declared)
    return FitAssessment(follows, corrected, left, bool(final.model.prepared.faults))


def noise_environment(
    base: ProcessNoiseFit, final: FittedModel, known: FitAssessment, *, unfit: bool
) -> NoiseEnvironment:
    """Return the goodness of fit and the noise for the report."""
    prepared = final.model.prepared.dynamics
    reasons: tuple[str, ...] = ()
    if unfit:
        fits = [base.fit] if base.free is None else [base.fit, base.free]
        reasons = (known.column,) if known.column else reasons_of(fits, known.follows)
    if prepared is None or known.noise is None:
        return NoiseEnvironment(known.follows, reasons, starts=base.starts)
    model, theta = final.model, final.parameters
    noise = sized_noise(prepared, theta[: model.base], model.changes(theta), model.near, known.noise)
    return NoiseEnvironment(
        known.follows,
        reasons,
        process_noise_of(prepared, noise),
        dict(prepared.input_hold),
        () if unfit else forcing_of(final, noise),
        base.starts,
    )


_MOMENT_S = 1.0
"""Time limit in seconds for each optional part of a stopped diagnosis."""


@dataclass(frozen=True)
class DiagnosisInputs:
    """Everything that a diagnosis is built from, except the results of the tests.

    Attributes:
        simulation: as given by the user.
        drivers: the recorded columns that can drive an effect, and warnings about the others.
        terms: the candidates.
        base: the fitted simulation without findings, with its noise.
        final: the fit with all findings, under the remaining process noise.
        options: of the search.
        cut: whether there was a further finding beyond the limit.
        stop: why the search was stopped before its end, and what was not done.
        models: the models that the search scored, in their order.
        column: the column whose other sign or unit explains more than any effect, in a sentence; empty if none does.
        instead: the effects that take the place of fitted numbers far from those given, in sentences.
    """

    simulation: Simulation
    drivers: Drivers
    terms: tuple[Term, ...]
    base: ProcessNoiseFit
    final: FittedModel
    options: SearchOptions
    cut: bool
    stop: Stop | None = None
    models: tuple[ScoredModel, ...] = ()
    column: str = ""
    instead: str = ""

    @property
    def in_short(self) -> bool:
        """Whether slow parts are left out."""
        return self.options.quick or self.stop is not None


def build_diagnosis(whole: DiagnosisInputs, answers: EvidenceReport) -> Diagnosis:
    """Build the diagnosis, with its verdict and advice.

    Args:
        whole: the inputs.
        answers: results of the tests of evidence, and their context.
    """
    case, prepared, options = answers.case, answers.case.prepared, whole.options
    first, final, settings = case.first, case.final, options.settings
    known = _assessment(whole)
    unfit = known.unfit(settings.evidence)
    count = 0 if unfit else len(case.found)
    graded = [_graded(case.found, number, final, whole, answers) for number in range(count)]
    if known.unfit_with([finding.grade for finding, _ in graded], settings.evidence):
        unfit, known, graded = True, replace(known, corrected=()), []
    findings = tuple(finding for finding, decided in graded if not is_dropped(decided))
    without_size = tuple(finding for finding, decided in graded if is_dropped(decided))
    kept = [number for number, (finding, decided) in enumerate(graded) if counts(finding) and not is_dropped(decided)]
    corrected = corrected_model(whole.base.fit, case, kept, limit_s=None if whole.stop is None else _MOMENT_S)
    scores = scores_of(case, corrected)
    diagnosis = Diagnosis(
        recording=prepared.recording.name,
        simulation=prepared.name,
        samples=len(prepared.time),
        level=options.level,
        noise=noise_summary(final, settings.noise),
        candidates_tried=0 if first is None and whole.stop is not None else len(whole.terms),
        surrogates=0 if options.quick else options.surrogates,
        seed=options.seed,
        p_value=_p_value(first, whole),
        verdict="adequate",
        findings=findings,
        baseline=scores[0],
        corrected=scores[1],
        advice=(),
        warnings=(
            *notices(whole.stop, quick=options.quick, too_few=options.too_few),
            *prepared.recording.warnings,
            *unit_warnings(prepared.recording),
            *_unchecked_warnings(prepared),
            *warnings_of(whole.drivers.warnings),
            *_time_warnings(prepared),
            *evidence_warnings(answers),
            *(_no_size(finding) for finding in without_size),
            *(doubt for finding in findings for doubt in finding.doubts),
        ),
        notes=(*prepared.recording.notes, *notes_of(whole.drivers.warnings), *left_out_note(findings)),
        candidates=_candidates(first),
        separability=separability(first) if first else _nothing_to_separate(),
        traces=traces_of(case, whole.drivers, corrected),
        model=_model(whole, corrected.exported),
        checks=(*prepared.checks, *_checks_of_fit(whole)),
        evidence=answers.of_all,
        environment=_environment(whole, known, unfit=unfit),
        quick=options.quick,
        stop=whole.stop,
        too_few=options.too_few,
    )
    left = Remainder(
        tuple(_structure(diagnosis, whole, first, final)),
        # for differential equations the noise model includes the correlation already
        0.0 if known.noise is not None else _lag(diagnosis),
        whole.stop,
        (len(prepared.time), options.settings.search.fewest_samples) if options.too_few else None,
    )
    decided = (
        *(decision for _, decisions in graded for decision in decisions),
        *decisions_on_all(
            known,
            left,
            settings.evidence,
            findings=bool(findings),
            flexible=any(map(is_flexible, final.fit.model.terms)),
        ),
        *reservations_of(diagnosis),
    )
    trail = Trail(whole.models, decided)
    diagnosis = replace(diagnosis, verdict=verdict_of(trail), decisions=trail)
    return replace(diagnosis, advice=advice_of(diagnosis))


def _model(whole: DiagnosisInputs, fit: FittedModel) -> DiagnosedModel:
    """Return the model with what a check compares new recordings with; after a stop, within the limit of a part."""
    model = model_of(fit, whole.simulation)
    base = whole.base.fit if whole.base.free is None else whole.base.free
    prepared = base.model.prepared
    parameters = own_parameters(prepared, base.parameters)
    recording = with_measured(prepared)
    columns = measured_columns(recording, prepared.channels)
    work = partial(with_training, model, parameters, prepared.state, recording, columns)
    bare = with_baseline(model, parameters, prepared.state)
    if whole.stop is not None:
        found = within(_MOMENT_S, work) or bare
    else:
        found = optional("predicting the recording as in a check", work, lambda: bare)
    return found.for_other_recordings()


def is_flexible(term: Term) -> bool:
    """Whether an effect can bend even a wrong simulation near to a recording: a curve, a delay or lag, a general form.

    A second mass or store, which is a general form too, is passive: it has an own state and a share of its own, and
    depends on no component or column by itself. It cannot reverse a sign, and a simulation without it can explain
    little, as that of a motor with a load on a flexible shaft does. Nor can a clock, which is right at the start of
    each run, while the free run loses a long recording.
    """
    effect = term.effect
    late = effect.remembers and not effect.open_loop_only
    return effect.is_curve or late or (effect.is_generalisation and bool(effect.plot_axis or term.columns))


def _structure(
    diagnosis: Diagnosis, whole: DiagnosisInputs, first: SearchResult | None, final: FinalEstimate
) -> Iterator[str]:
    """Yield each kind of structure that the findings leave, in a sentence."""
    d = diagnosis
    if first is not None and first.p_value <= d.level and not d.findings:
        yield f"The strongest candidate does not count as a finding: {significance(first.p_value)}."
    if d.remaining:
        yield f"A smooth trend along {', '.join(d.remaining)} remains."
    if whole.cut:
        yield "There is a further finding beyond the limit."
    if nameless(final.fit):
        yield "A finding is a curve without a name."


def _graded(
    found: Sequence[SearchResult], number: int, final: FinalEstimate, whole: DiagnosisInputs, answers: EvidenceReport
) -> tuple[Finding, tuple[Decision, ...]]:
    """Return a finding with its evidence, shape check and grade, and the decisions on it.

    After an error in its tests the decisions are those of a diagnosis that is cut short.
    """
    quick, settings, count = whole.options.quick, whole.options.settings, len(found)
    finding = replace(finding_of(found[number], final, number, quick=quick), evidence=answers.of_findings[number])
    if number == count - 1 or is_zero_within_error(finding):  # an earlier finding needs another fit
        finding = replace(finding, clearly_better=_clearly_better(answers.case.fits, number, settings.naming))
    finding = with_row_named(finding, float(answers.case.prepared.time.diff().median()))
    in_short = whole.in_short or not any(result.test == "held_out" for result in finding.evidence)
    if not in_short:
        step = f"testing the shape of {finding.effect}, and its alternatives"
        tested = optional(step, partial(_with_shape, finding, found, number, final, whole), lambda: None)
        finding, in_short = (finding, True) if tested is None else (tested, False)
    decided = decisions_on(finding, VetoContext(whole.options.level, number + 1, in_short))
    return replace(finding, grade=grade(decided)), decided


def _with_shape(
    finding: Finding, found: Sequence[SearchResult], number: int, final: FinalEstimate, whole: DiagnosisInputs
) -> Finding:
    """Return a finding with its shape check and the parameters of its alternatives."""
    settings = whole.options.settings
    others = with_parameters(finding.alternatives, found[number], final, number, settings.noise)
    shape = None
    if whole.final.model.prepared.dynamics is not None:
        shape = shape_of(whole.final, number, whole.terms, settings.evidence)
    return replace(finding, shape=shape, alternatives=others)


def _clearly_better(fits: Sequence[FittedModel], number: int, naming: NamingSettings) -> bool:
    """Whether the fit without a finding, with all others, is clearly less likely, with the residual's correlation.

    Schwarz's price and the limit of separability were checked on the recordings of `tests.thresholds.open_loop`, fitted
    in open loop: 24 of 28 hidden effects gain more. Where nothing is hidden, some candidate does in 3 of 4 under a
    disturbance of a state, and in 0 of 6 with a slow error of the sensor. So this gain alone confirms no finding.
    """
    after = fits[-1]
    before = fits[number] if number == len(fits) - 2 else _without(after, number)
    if before is None:
        return False
    numbers = after.model.sizes[number] + len(after.model.terms[number].effect.fitted_shape)
    price = 0.5 * numbers * math.log(len(after.residual)) + naming.separable
    return agreed_innovation_gain(before.residual, after.residual, after.recorded) > price


def _without(fit: FittedModel, number: int) -> FittedModel | None:
    """Return the fit without one of its effects; None if it loses the recording."""
    try:
        start = within_domain(without_term(fit, number))
        return fitted(start.model, start.parameters, start.bound)
    except NoFitError:
        return None


def _unchecked_warnings(prepared: PreparedSimulation) -> list[str]:
    """Return the simulation's warnings on parameters that no check before the search names."""
    checks = [check for check in prepared.checks if check.kind != "at a bound"]
    named = {f"`{name}`" for check in checks for name in check.parameters}
    return [warning for warning in prepared.warnings if not any(name in warning for name in named)]


def _checks_of_fit(whole: DiagnosisInputs) -> tuple[StartCheck, ...]:
    """Return the values of the fit without effects that cannot be or are far from those given, and a divergence."""
    fit = whole.base.fit if whole.base.free is None else whole.base.free
    prepared = fit.model.prepared.dynamics
    if prepared is None:
        return ()
    found = impossible_checks(prepared, impossible_values(prepared, fit.parameters))
    named = {name for check in found for name in check.parameters}
    unlikely = unlikely_checks(prepared, fit.parameters, whole.final.parameters, whole.instead)
    diverging = optional("checking the given values", partial(divergence_checks, prepared), lambda: ())
    return (*diverging, *found, *(check for check in unlikely if named.isdisjoint(check.parameters)))


def _assessment(whole: DiagnosisInputs) -> FitAssessment:
    """Assess the fits; after a stop only as far as the time limit of a part allows."""
    settings, declared = whole.options.settings.noise, whole.options.declared
    work = partial(assess, whole.base, whole.final, declared, settings)

    def bare() -> FitAssessment:
        # the goodness of fit with the findings is unknown, so the verdict cannot be unfit
        follows = () if whole.final.model.terms else assess_baseline(whole.base, declared)
        return FitAssessment(follows, (), None, impossible_rotations(whole.base))

    if whole.stop is not None:
        return within(_MOMENT_S, work) or bare()
    known = optional("assessing the fit with the findings", work, bare)
    return replace(known, column=whole.column)


def _environment(whole: DiagnosisInputs, known: FitAssessment, *, unfit: bool) -> NoiseEnvironment:
    work = partial(noise_environment, whole.base, whole.final, known, unfit=unfit)
    bare = NoiseEnvironment(known.follows, starts=whole.base.starts)
    if whole.stop is not None:
        return within(_MOMENT_S, work) or bare
    return optional("describing the disturbances", work, lambda: bare)


def _p_value(first: SearchResult | None, whole: DiagnosisInputs) -> float | None:
    """The p-value of the strongest candidate; None without surrogates."""
    if whole.options.quick or (first is None and whole.stop is not None):
        return None
    return 1.0 if first is None else first.p_value


def _no_size(finding: Finding) -> str:
    return (
        f"{finding.effect}: {significance(finding.p_value)}, but in the open-loop fit its size is 0 within its "
        "standard error, so it does not count as a finding."
    )


def _lag(diagnosis: Diagnosis) -> float:
    """Return the largest lag at which the residual is correlated; 0 for a white residual."""
    channels = next((result.value for result in diagnosis.evidence if result.test == "whiteness"), None)
    return float(max((channel.lag for channel in channels.values()), default=0)) if channels else 0.0


def _candidates(first: SearchResult | None) -> tuple[CandidateScore, ...]:
    if first is None:
        return ()
    return tuple(
        CandidateScore(
            first.scene.terms[r.number].effect.form_id,
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


def _time_warnings(prepared: PreparedSimulation) -> tuple[str, ...]:
    if prepared.recording.time is not None:
        return ()
    return (
        "The recording has no column `time`: sample numbers replace seconds, and samples are taken as evenly spaced.",
    )
