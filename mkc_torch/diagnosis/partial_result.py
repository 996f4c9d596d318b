"""A diagnosis under way: what is known of it so far, and how it becomes a result."""

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
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit, open_loop
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.stepwise import SearchOptions, StepwiseSearch
from mkc_torch.diagnosis.stop import Stop
from mkc_torch.effects.base import Effect
from mkc_torch.simulation.protocol import Simulation

__all__ = ["PartialResult"]


@dataclass
class PartialResult:
    """What is known so far; what is asked for stays as it is, the rest is filled in step by step.

    Attributes:
        simulation, effects, recordings, asked: what was asked, the names of recordings that are diagnosed together.
        run_counts: runs that each of these recordings holds.
        world: the fit of the simulation alone; at first before its noise is known.
        fitted: whether the noise is known too.
        search: what was found.
    """

    simulation: Simulation
    effects: tuple[Effect, ...]
    recordings: tuple[str, ...]
    asked: SearchOptions
    run_counts: tuple[int, ...] = ()
    world: ProcessNoiseFit | None = None
    fitted: bool = False
    search: StepwiseSearch | None = None
    _candidates: tuple[Drivers, tuple[Term, ...]] | None = field(default=None, repr=False)

    def keep_world(self, world: ProcessNoiseFit) -> None:
        """Remember the simulation's fit."""
        self.world = world

    def keep_search(self, search: StepwiseSearch) -> None:
        """Remember what was found."""
        self.search = search

    def anew(self) -> PartialResult:
        """The same from the beginning; what is known stays until it is known anew."""
        self._candidates = None
        return self

    @property
    def tests(self) -> tuple[EvidenceTest, ...]:
        """The tests of evidence."""
        return in_short(held_out=self.asked.judged) if self.asked.quick else TESTS

    @property
    def alone(self) -> ProcessNoiseFit:
        """The simulation alone, which has been fitted."""
        assert self.world is not None
        return self.world

    @property
    def base(self) -> FittedModel:
        """Its fit."""
        return self.alone.fit

    @property
    def candidates(self) -> tuple[Drivers, tuple[Term, ...]]:
        """The recorded columns that can drive an effect, and what is tried."""
        if self._candidates is None:
            prepared, settings = open_loop(self.base.model.prepared), self.asked.settings
            roles = frozenset(role for effect in self.effects for role in effect.roles)
            measured: frozenset[str] = getattr(self.simulation, "measured", frozenset())
            found = find_drivers(prepared.recording, self.simulation.columns, settings.drivers, roles, measured)
            self._candidates = found, candidate_terms(prepared, found.drivers, self.effects)
        return self._candidates

    def running_freely(self, search: StepwiseSearch) -> OpenLoop:
        """What was found, as a free run where that follows the recording."""
        if not self.asked.judged:
            return running_unjudged(self.base, self.alone.free, search.found)
        return open_loop_evidence(self.base, self.alone.free, search.found, search.evidence, search.blocks)

    def case(self, search: StepwiseSearch, free: OpenLoop | None = None) -> EvidenceContext:
        """What tests of evidence look at; ``free`` is what was found, where that is known."""
        free = self.running_freely(search) if free is None else free
        asked, drivers = self.asked, self.candidates[0].drivers
        held_out: tuple[Evidence, ...] = free.held_out
        return EvidenceContext(
            free.base,
            search.first,
            free.found,
            held_out,
            search.blocks,
            drivers,
            asked.seed,
            asked.settings,
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
        """The result, once the parts of the tests that go ahead are done."""
        final = search.found[-1].fit if search.found else self.base
        drivers, terms = self.candidates
        whole = DiagnosisInputs(self.simulation, drivers, terms, self.alone, final, self.asked, search.cut, stop)
        answers = run_tests(case, done, tests)
        told = with_search_notes(build_diagnosis(whole, answers), search)
        offsets = offsets_of(answers.case.final, self.recordings) if self.recordings else ()
        runs = runs_of(self.base.model.prepared, self.recordings, self.run_counts)
        return replace(told, recordings=self.recordings, world=replace(told.world, offsets=offsets, runs=runs))
