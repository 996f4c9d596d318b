"""The state of a stepwise search."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from mkc_torch.diagnosis.decisions import ScoredModel
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.run import SearchResult


@dataclass(frozen=True)
class StepwiseSearch:
    """The stepwise search so far.

    Attributes:
        first: result of the first search.
        found: the findings.
        unconfirmed: the last candidate that held-out blocks did not confirm.
        blocks: the held-out blocks.
        evidence: of the simulation without findings, and after each finding.
        left: candidates that remain to be searched; empty once the search is over.
        refused: candidates that passed the surrogates, but are hardly visible.
        given_up: why the next search failed; empty if it did not.
        cut: whether there was a further finding beyond the limit.
        models: the models that the search scored, in the order in which they were tried.
        column: the column whose other sign or unit explains more than any effect, in a sentence; empty if none does.
        instead: the effects that take the place of fitted numbers far from those given, in sentences; empty if none do.
    """

    first: SearchResult | None
    found: tuple[SearchResult, ...]
    unconfirmed: SearchResult | None
    blocks: HeldOutBlocks
    evidence: tuple[Evidence, ...]
    left: tuple[Term, ...]
    refused: tuple[SearchResult, ...] = ()
    given_up: str = ""
    cut: bool = False
    models: tuple[ScoredModel, ...] = ()
    column: str = ""
    instead: str = ""

    @property
    def pairs(self) -> tuple[tuple[Evidence, Evidence], ...]:
        """Evidence without and with each finding."""
        return tuple(itertools.pairwise(self.evidence))

    @property
    def parts(self) -> tuple[object, ...]:
        """Everything that the next search needs."""
        fits = [located.fit for located in self.found]
        return self.first, *self.found, *fits, *(fit.model for fit in fits), self.blocks, *self.evidence
