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
from mkc_torch.diagnosis.search.estimate import FinalEstimate, estimate


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
    return [*(partial(_ahead, test, case) for test in _long(case, tests)), partial(_final, case)]


def all_results(case: EvidenceContext, tests: Sequence[EvidenceTest], known: Iterable[object] = ()) -> EvidenceReport:
    """Run the tests, their expensive parts in parallel; ``known`` holds objects that every process has."""
    return results_of_tests(case, shared(precompute(case, tests), known, "test of evidence"), tests)


def results_of_tests(
    case: EvidenceContext, done: Sequence[Any], tests: Sequence[EvidenceTest] = TESTS
) -> EvidenceReport:
    """Run the tests in their order, with the results of :func:`precompute`."""
    *ahead, final = done
    case = replace(case, estimate=final)
    known = dict(zip(_long(case, tests), ahead, strict=True))
    results: list[tuple[int | None, EvidenceResult]] = []
    for test in tests:
        cases = _cases(test, case)
        for test_case, done_ahead in zip(cases, known.get(test, [None] * len(cases)), strict=True):
            result = test.test(replace(test_case, ahead=done_ahead))
            results.append((test_case.number if test.each_finding else None, result))
    return EvidenceReport(case, tuple(results))


def _long(case: EvidenceContext, tests: Sequence[EvidenceTest]) -> list[EvidenceTest]:
    """Return the tests with an ``ahead`` function; first the tests of the whole diagnosis, which take longer."""
    found = [test for test in tests if test.ahead is not None and _cases(test, case)]
    return sorted(found, key=lambda test: not test.each_finding)


def _cases(test: EvidenceTest, case: EvidenceContext) -> list[EvidenceContext]:
    return [replace(case, number=k) for k in range(len(case.found))] if test.each_finding else [case]


def _ahead(test: EvidenceTest, case: EvidenceContext) -> list[Any]:
    assert test.ahead is not None
    return [test.ahead(_case) for _case in _cases(test, case)]


def _final(case: EvidenceContext) -> FinalEstimate:
    return estimate(case.fit, case.settings.noise).at_least(case.held_out[-1].jackknife)
