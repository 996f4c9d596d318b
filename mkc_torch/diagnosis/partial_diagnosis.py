"""The result of a diagnosis that was stopped before its end, with a list of what was not done."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from mkc_torch._parallel.deadline import Reason, within
from mkc_torch.diagnosis.evidence.held_out import blocks_of, on_all
from mkc_torch.diagnosis.evidence.in_short import in_short
from mkc_torch.diagnosis.evidence.open_loop import OpenLoop, running_unjudged
from mkc_torch.diagnosis.linearised.estimate import estimate
from mkc_torch.diagnosis.model.grid import within_a_sample
from mkc_torch.diagnosis.model.process_noise import first_samples
from mkc_torch.diagnosis.partial_result import PartialResult
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.stepwise import StepwiseSearch
from mkc_torch.diagnosis.stop import Stop

__all__ = ["cut_short", "error_without_fit"]

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


def cut_short(known: PartialResult, reason: Reason, seconds: float) -> Diagnosis:
    """Return the result of what is known.

    Args:
        known: the partial result; it contains a first fit of the simulation.
        reason, seconds: why and after how many seconds the run was stopped.
    """
    search = known.search if known.search is not None else _not_begun(known)
    leading = _leading(known, search)
    found = (*search.found, *leading)
    judged = len(search.evidence) == len(found) + 1
    if not judged:
        fits = known.base, *(located.fit for located in found)
        search = replace(search, evidence=tuple(on_all(fit) for fit in fits), pairs=())
    search = replace(search, found=found)
    unjudged = partial(running_unjudged, known.base, known.fitted_baseline.free, found)
    free = within(_MOMENT_S, partial(known.open_loop_findings, search) if judged else unjudged)
    if free is None:
        free = OpenLoop(known.base, found, search.evidence)
    case = known.case(search, free)
    final = estimate(case.fit, known.options.settings.noise).at_least(case.held_out[-1].jackknife)
    stop = Stop(reason, seconds, tuple(_not_done(known, search, judged=judged, leading=bool(leading))))
    return known.diagnosis(search, case, [final], in_short(held_out=judged), stop)


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
