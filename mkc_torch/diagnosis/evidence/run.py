"""Run the tests of evidence: all of them, or the fast tests of a quick look; expensive parts run ahead."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from mkc_torch._parallel.pool import shared
from mkc_torch.diagnosis.evidence import TESTS
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, EvidenceTest
from mkc_torch.diagnosis.evidence.prediction import held_out_gain_evidence, held_out_gain_result
from mkc_torch.diagnosis.evidence.residual_noise import localised_evidence, rejected_evidence, whiteness_evidence
from mkc_torch.diagnosis.optional import optional
from mkc_torch.diagnosis.search.estimate import FinalEstimate, estimate, rough_estimate


def in_short(*, held_out: bool) -> tuple[EvidenceTest, ...]:
    """Return the fast tests.

    Args:
        held_out: whether findings were scored on held-out blocks.
    """
    blocks = held_out_gain_evidence if held_out else _not_judged
    return (
        EvidenceTest(blocks, each_finding=True),
        EvidenceTest(localised_evidence),
        EvidenceTest(rejected_evidence),
        EvidenceTest(whiteness_evidence),
    )


def _not_judged(_: EvidenceContext) -> EvidenceResult:
    return held_out_gain_result(None, "no held-out blocks in a quick look, or the search was stopped before")


@dataclass(frozen=True)
class EvidenceReport:
    """Results of the tests, and the context with the final parameters.

    Attributes:
        case: the context.
        results: each result with the number of its finding, None for the whole diagnosis; in the order of the tests.
    """

    case: EvidenceContext
    results: tuple[tuple[int | None, EvidenceResult], ...]

    @property
    def of_all(self) -> tuple[EvidenceResult, ...]:
        """Results for the whole diagnosis."""
        return tuple(result for number, result in self.results if number is None)

    @property
    def of_findings(self) -> tuple[tuple[EvidenceResult, ...], ...]:
        """Results for each finding."""
        return tuple(
            tuple(result for number, result in self.results if number == finding)
            for finding in range(len(self.case.found))
        )


def precompute(case: EvidenceContext, tests: Sequence[EvidenceTest] = TESTS) -> list[Callable[[], Any]]:
    """Return independent tasks: the ``ahead`` function of each test, and last the final estimate, which takes
    longest.
    """
    return [*(partial(_ahead, test, case) for test in _long(case, tests)), partial(final_of, case)]


def all_results(case: EvidenceContext, tests: Sequence[EvidenceTest], known: Iterable[object] = ()) -> EvidenceReport:
    """Run the tests, their expensive parts in parallel; ``known`` holds objects that every process has."""
    return results_of_tests(case, shared(precompute(case, tests), known, "test of evidence"), tests)


def results_of_tests(
    case: EvidenceContext, done: Sequence[Any], tests: Sequence[EvidenceTest] = TESTS
) -> EvidenceReport:
    """Run the tests in their order, with the results of :func:`precompute`; a test that fails has no result."""
    *ahead, final = done
    case = replace(case, estimate=final)
    known = dict(zip(_long(case, tests), ahead, strict=True))
    results: list[tuple[int | None, EvidenceResult]] = []
    for test in tests:
        cases = _cases(test, case)
        done_ahead = known.get(test, [None] * len(cases))
        if done_ahead is not None:
            work = partial(_results_of, test, cases, done_ahead)
            results += optional(_step_of(test), work, list)
    return EvidenceReport(case, tuple(results))


def _results_of(
    test: EvidenceTest, cases: Sequence[EvidenceContext], done_ahead: Sequence[Any]
) -> list[tuple[int | None, EvidenceResult]]:
    """Return the results of a test, with the number of their findings."""
    return [
        (case.number if test.each_finding else None, test.test(replace(case, ahead=done)))
        for case, done in zip(cases, done_ahead, strict=True)
    ]


def _step_of(test: EvidenceTest) -> str:
    """Name of a test in a warning."""
    return f"test of evidence: {test.test.__name__.removesuffix('_evidence').replace('_', ' ')}"


def _long(case: EvidenceContext, tests: Sequence[EvidenceTest]) -> list[EvidenceTest]:
    """Return the tests with an ``ahead`` function; first the tests of the whole diagnosis, which take longer."""
    found = [test for test in tests if test.ahead is not None and _cases(test, case)]
    return sorted(found, key=lambda test: not test.each_finding)


def _cases(test: EvidenceTest, case: EvidenceContext) -> list[EvidenceContext]:
    return [replace(case, number=k) for k in range(len(case.found))] if test.each_finding else [case]


def _ahead(test: EvidenceTest, case: EvidenceContext) -> list[Any] | None:
    """Return the results of the expensive part of a test; None if it fails."""
    ahead = test.ahead
    assert ahead is not None
    return optional(_step_of(test), lambda: [ahead(_case) for _case in _cases(test, case)], lambda: None)


def final_of(case: EvidenceContext) -> FinalEstimate:
    """Return the final parameters, with errors no smaller than those over the held-out blocks."""
    error = case.held_out[-1].jackknife
    return optional(
        "standard errors under coloured noise",
        lambda: estimate(case.fit, case.settings.noise).at_least(error),
        lambda: rough_estimate(case.fit, error),
    )
