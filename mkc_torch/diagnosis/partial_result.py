"""A running diagnosis: what is known so far, and its conversion to a result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mkc_torch.diagnosis.build import DiagnosisInputs, build_diagnosis, with_search_notes
from mkc_torch.diagnosis.evidence import TESTS
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceTest
from mkc_torch.diagnosis.evidence.held_out import Evidence
from mkc_torch.diagnosis.evidence.in_short import in_short
from mkc_torch.diagnosis.evidence.open_loop import OpenLoop, open_loop_evidence, running_unjudged
from mkc_torch.diagnosis.evidence.run import run_tests
from mkc_torch.diagnosis.findings.recordings import offsets_of, runs_of
from mkc_torch.diagnosis.model.drivers import Drivers, find_drivers
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.grid import candidate_terms
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.stepwise import SearchOptions, StepwiseSearch
from mkc_torch.diagnosis.stop import Stop
from mkc_torch.effects.base import Effect
from mkc_torch.simulation.protocol import Simulation

__all__ = ["PartialResult"]


@dataclass
class PartialResult:
    """What is known so far; the arguments are fixed, the rest is filled in step by step.

    Attributes:
        simulation, effects, options: arguments of the diagnosis.
        recordings: names of the recordings that are diagnosed together.
        run_counts: number of runs in each of these recordings.
        baseline: the fit of the simulation without findings; at first before its noise is known.
        fitted: whether the noise is known too.
        search: the search so far.
    """

    simulation: Simulation
    effects: tuple[Effect, ...]
    recordings: tuple[str, ...]
    options: SearchOptions
    run_counts: tuple[int, ...] = ()
    baseline: ProcessNoiseFit | None = None
    fitted: bool = False
    search: StepwiseSearch | None = None
    _candidates: tuple[Drivers, tuple[Term, ...]] | None = field(default=None, repr=False)

    def keep_baseline(self, baseline: ProcessNoiseFit) -> None:
        """Store the simulation's fit."""
        self.baseline = baseline

    def keep_search(self, search: StepwiseSearch) -> None:
        """Store the search so far."""
        self.search = search

    def restart(self) -> PartialResult:
        """Restart with new candidates; earlier results stay until they are replaced."""
        self._candidates = None
        return self

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
            roles = frozenset(role for effect in self.effects for role in effect.roles)
            found = find_drivers(
                prepared.recording, self.simulation.columns, settings.drivers, roles, self.simulation.measured
            )
            self._candidates = found, candidate_terms(prepared, found.drivers, self.effects)
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
        case: EvidenceContext,
        done: Sequence[Any],
        tests: Sequence[EvidenceTest],
        stop: Stop | None = None,
    ) -> Diagnosis:
        """The result, once the precomputed parts of the tests are done."""
        final = search.found[-1].fit if search.found else self.base
        drivers, terms = self.candidates
        whole = DiagnosisInputs(
            self.simulation, drivers, terms, self.fitted_baseline, final, self.options, search.cut, stop
        )
        answers = run_tests(case, done, tests)
        result = with_search_notes(build_diagnosis(whole, answers), search)
        offsets = offsets_of(answers.case.final, self.recordings) if self.recordings else ()
        runs = runs_of(self.base.model.prepared, self.recordings, self.run_counts)
        return replace(
            result, recordings=self.recordings, environment=replace(result.environment, offsets=offsets, runs=runs)
        )
