"""What is known of a running diagnosis, and its result if it is stopped."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Literal

from mkc_torch._parallel.deadline import Reason, within
from mkc_torch._parallel.progress import report_found
from mkc_torch.diagnosis.evidence import TESTS
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceTest
from mkc_torch.diagnosis.evidence.held_out import Evidence, blocks_of, on_all
from mkc_torch.diagnosis.evidence.prediction import OpenLoop, open_loop_evidence, running_unjudged
from mkc_torch.diagnosis.evidence.run import EvidenceReport, all_results, final_of, in_short, results_of_tests
from mkc_torch.diagnosis.findings.noise import offsets_of, runs_of, shared_offsets
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit, first_samples
from mkc_torch.diagnosis.model.shapes import candidates_of, within_a_sample
from mkc_torch.diagnosis.model.term import Drivers, Term, common_parts
from mkc_torch.diagnosis.optional import failure, optional
from mkc_torch.diagnosis.pipeline.build import DiagnosisInputs, build_diagnosis
from mkc_torch.diagnosis.pipeline.prepare import Problem
from mkc_torch.diagnosis.pipeline.search_notes import with_search_notes
from mkc_torch.diagnosis.pipeline.so_far import found_so_far
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.result import Diagnosis, Stop
from mkc_torch.diagnosis.search.moves import with_references
from mkc_torch.diagnosis.search.run import SearchResult


class PartialResult:
    """What is known of a running diagnosis; the stages fill it in.

    Args:
        problem: the input of the diagnosis.

    Attributes:
        options: of the search; a poor fit limits the number of findings.
        baseline: the fit of the simulation without findings; at first before its noise is known.
        fitted: whether the noise is known too.
        search: the search so far.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, self.options = problem, problem.options
        self.simulation, self.effects, self.recordings = problem.simulation, problem.effects, problem.recordings
        self.run_counts = problem.run_counts
        self.baseline: ProcessNoiseFit | None = None
        self.fitted = False
        self.search: StepwiseSearch | None = None
        self._candidates: tuple[Drivers, tuple[Term, ...]] | None = None

    def keep_baseline(self, baseline: ProcessNoiseFit, *, with_noise: bool = False) -> None:
        """Store the simulation's fit; ``with_noise`` once its noise is known."""
        self.baseline, self.fitted = baseline, self.fitted or with_noise

    def restart(self) -> None:
        """Determine new candidates for a new baseline; earlier results stay until they are replaced."""
        self._candidates = None

    def keep_search(self, search: StepwiseSearch) -> None:
        """Store the search so far."""
        self.search = search

    def keep_and_report(self, search: StepwiseSearch) -> None:
        """Store the search so far, and report its findings."""
        self.keep_search(search)
        text = found_so_far(search, self.options.level)
        if text:
            report_found(text)

    def continued(
        self, step: str, work: Callable[[], StepwiseSearch], before: StepwiseSearch | None = None
    ) -> StepwiseSearch:
        """Return the search after a step that keeps its parts; after an internal error the search as far as it is kept.

        Args:
            step: its name in a warning.
            work: the step.
            before: the search before the step; None for the first search, which together with the scores of the
                simulation without findings is needed for any result.
        """
        earlier = self.search if before is None else None  # of another fit of the simulation

        def kept() -> StepwiseSearch:
            assert self.search is not None
            # without a finding there is nothing to continue from
            return self.search if self.search.found else replace(self.search, left=())

        def is_kept() -> bool:
            return self.search is not None and self.search is not earlier and bool(self.search.evidence)

        return optional(step, work, kept, is_kept)

    def improved(self, step: str, work: Callable[[], StepwiseSearch], before: StepwiseSearch) -> StepwiseSearch:
        """Return the search after a step; after an internal error the search and the baseline before the step."""
        state = dict(vars(self))

        def unchanged() -> StepwiseSearch:
            vars(self).update(state)
            return before

        return optional(step, work, unchanged)

    @property
    def tests(self) -> tuple[EvidenceTest, ...]:
        """The tests of evidence to run."""
        return in_short(held_out=self.options.judged) if self.options.quick else TESTS

    @property
    def fitted_baseline(self) -> ProcessNoiseFit:
        """The fitted simulation without findings, with its noise."""
        assert self.baseline is not None
        return self.baseline

    @property
    def base(self) -> FittedModel:
        """The fit of :attr:`fitted_baseline`."""
        return self.fitted_baseline.fit

    @property
    def candidates(self) -> tuple[Drivers, tuple[Term, ...]]:
        """The recorded columns that can drive an effect, and the candidates."""
        if self._candidates is None:
            prepared, settings = self.base.model.prepared.open_loop(), self.options.settings
            drivers, terms = candidates_of(self.simulation, prepared, self.effects, settings.drivers)
            free = self.fitted_baseline.free
            alone = self.base if free is None else free
            self._candidates = drivers, with_references(alone, terms, settings.noise)
        return self._candidates

    def open_loop_findings(self, search: StepwiseSearch) -> OpenLoop:
        """The findings in their open-loop fit if it explains the recording."""
        if not self.options.judged:
            return running_unjudged(self.base, self.fitted_baseline.free, search.found)
        return open_loop_evidence(self.base, self.fitted_baseline.free, search.found, search.evidence, search.blocks)

    def case(self, search: StepwiseSearch, free: OpenLoop | None = None) -> EvidenceContext:
        """The context of the tests of evidence; ``free`` holds the open-loop findings if they are known."""
        free = self.open_loop_findings(search) if free is None else free
        options, drivers = self.options, self.candidates[0].drivers
        held_out: tuple[Evidence, ...] = free.held_out
        return EvidenceContext(
            free.base,
            search.first,
            free.found,
            held_out,
            search.blocks,
            drivers,
            options.seed,
            options.settings,
            pairs=search.pairs,
        )

    def diagnosis(
        self,
        search: StepwiseSearch,
        answers: EvidenceReport,
        stop: Stop | None = None,
    ) -> Diagnosis:
        """The result of the search and of the tests of evidence."""
        final = search.found[-1].fit if search.found else self.base
        drivers, terms = self.candidates
        whole = DiagnosisInputs(
            self.simulation,
            drivers,
            terms,
            self.fitted_baseline,
            final,
            self.options,
            search.cut,
            stop,
            search.models,
            search.column,
            search.instead,
        )
        result = with_search_notes(build_diagnosis(whole, answers), search)
        offsets = offsets_of(answers.case.final, self.recordings) if self.recordings else ()
        runs = runs_of(self.base.model.prepared, self.recordings, self.run_counts)
        advice = result.advice if result.verdict == "unfit" else (*result.advice, *shared_offsets(offsets))
        return replace(
            result,
            advice=advice,
            recordings=self.recordings,
            environment=replace(result.environment, offsets=offsets, runs=runs),
        )


def estimate(known: PartialResult, search: StepwiseSearch) -> EvidenceContext:
    """The fourth stage: the fits with the findings in open loop, which sizes and figures are taken from."""
    stage = "checking what was found"
    known.problem.progress(stage)
    return optional(
        stage,
        lambda: known.case(search),
        lambda: known.case(search, OpenLoop(known.base, search.found, search.evidence)),
    )


def run_tests(known: PartialResult, search: StepwiseSearch, case: EvidenceContext) -> EvidenceReport:
    """The fifth stage: the tests of evidence, and the standard errors of the final parameters."""
    known.problem.progress("running the tests of evidence")
    base = known.base
    parts = common_parts(base.model.prepared.open_loop(), known.candidates[1])
    return all_results(case, known.tests, [known.simulation, base, base.model, *parts, *search.parts])


def build_result(known: PartialResult, search: StepwiseSearch, evidence: EvidenceReport) -> Diagnosis:
    """The sixth stage: the verdict, the findings with their evidence, advice and warnings."""
    known.problem.progress("describing the result")
    return known.diagnosis(search, evidence)


_MOMENT_S = 1.0
"""Time limit in seconds for the open-loop fits of the findings."""


def error_without_fit(reason: Reason, limit: float, where: str) -> BaseException:
    """Return the exception to raise if the simulation's first fit had not ended."""
    if reason == "interrupt":
        return KeyboardInterrupt()
    return TimeoutError(
        f"{where}the time limit of {limit:g} s was over before the simulation's first fit had ended, so nothing is "
        "known. Allow more time, or diagnose a part of the recording."
    )


def after_error(known: PartialResult, step: str, error: Exception, seconds: float) -> Diagnosis:
    """Return the result of what is known after an internal error, with a warning that names the step.

    Args:
        known: the partial result, with the fit of the simulation.
        step: name of the step.
        error: that it ended in.
        seconds: run time.

    Raises:
        Exception: the same error, if what is known cannot be described either.
    """
    try:
        result = cut_short(known, "internal error", seconds)
    except Exception:  # of whatever kind: the first error is the cause, and is the one reported
        raise error from None
    return replace(result, warnings=(*result.warnings, failure(step, error)))


def cut_short(
    known: PartialResult, reason: Reason | Literal["internal error"], seconds: float, limit: float = math.inf
) -> Diagnosis:
    """Return the result of what is known.

    Args:
        known: the partial result.
        reason, seconds: why and after how many seconds the run was stopped.
        limit: the time limit in s.

    Raises:
        TimeoutError, KeyboardInterrupt: the first fit of the simulation had not ended.
    """
    if known.baseline is None:
        assert reason != "internal error"
        raise error_without_fit(reason, limit, known.problem.where)
    known.problem.progress("writing down what is known")
    search = known.search if known.search is not None else _not_begun(known)
    leading = _leading(known, search)
    found = (*search.found, *leading)
    judged = len(search.evidence) == len(found) + 1
    if not judged:
        fits = known.base, *(located.fit for located in found)
        search = replace(search, evidence=tuple(on_all(fit) for fit in fits))
    search = replace(search, found=found)
    unjudged = partial(running_unjudged, known.base, known.fitted_baseline.free, found)
    free = within(_MOMENT_S, partial(known.open_loop_findings, search) if judged else unjudged)
    if free is None:
        free = OpenLoop(known.base, found, search.evidence)
    case = known.case(search, free)
    final = final_of(case)
    stop = Stop(reason, seconds, tuple(_not_done(known, search, judged=judged, leading=bool(leading))))
    return known.diagnosis(search, results_of_tests(case, [final], in_short(held_out=judged)), stop)


def _not_begun(known: PartialResult) -> StepwiseSearch:
    fit, settings = known.base, known.options.settings.confirmation
    blocks = blocks_of(len(fit.residual), 1, settings, first_samples(fit.model.prepared))
    return StepwiseSearch(None, (), None, blocks, (), known.candidates[1])


def _leading(known: PartialResult, search: StepwiseSearch) -> tuple[SearchResult, ...]:
    """The leading candidate of the first search if it passed there and was not yet tested on held-out blocks."""
    first, options = search.first, known.options
    if first is None or search.found or search.unconfirmed or not search.left or options.max_findings == 0:
        return ()
    if first.p_value > options.level or within_a_sample(first.term, first.fit.model.prepared):
        return ()
    return (first,)


def _not_done(known: PartialResult, search: StepwiseSearch, *, judged: bool, leading: bool) -> Iterator[str]:
    """Yield what was left undone, in the order of the diagnosis."""
    if not known.fitted:
        yield "the noise around the simulation's fit"
    if search.first is None:
        yield "the search for effects"
    elif leading:
        yield "the comparison of the leading candidates"
    if not judged:
        yield "the judgement by unseen blocks"
    if search.found and search.left:
        yield "the search for further findings"
    if search.found and known.base.model.prepared.dynamics is not None:
        yield "the test of the shape of what was found"
    yield "the other tests of evidence"
