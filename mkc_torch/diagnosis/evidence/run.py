"""What all tests of evidence say, once nothing more is searched; what takes long of them goes ahead, in parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from mkc_torch.diagnosis.evidence import TESTS
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, EvidenceTest
from mkc_torch.diagnosis.linearised.estimate import FinalEstimate, estimate

__all__ = ["EvidenceReport", "precompute", "run_tests"]


@dataclass(frozen=True)
class EvidenceReport:
    """What the tests say of the whole diagnosis and of each finding, and the case with the final parameters."""

    case: EvidenceContext
    of_all: tuple[EvidenceResult, ...]
    of_findings: tuple[tuple[EvidenceResult, ...], ...]
    warnings: tuple[str, ...]


def precompute(case: EvidenceContext, tests: Sequence[EvidenceTest] = TESTS) -> list[Callable[[], Any]]:
    """Works that need nothing of one another: what goes ahead of each test, and the final parameters.

    The last one takes longest.
    """
    return [*(partial(_ahead, test, case) for test in _long(case, tests)), partial(_final, case)]


def run_tests(case: EvidenceContext, done: Sequence[Any], tests: Sequence[EvidenceTest] = TESTS) -> EvidenceReport:
    """What the tests say, in their order, once the parts are done."""
    *ahead, final = done
    case = replace(case, estimate=final)
    known = dict(zip(_long(case, tests), ahead, strict=True))
    of_all: list[EvidenceResult] = []
    of_findings: list[list[EvidenceResult]] = [[] for _ in case.found]
    warnings: list[str] = []
    for test in tests:
        cases = _cases(test, case)
        for test_case, done_ahead in zip(cases, known.get(test, [None] * len(cases)), strict=True):
            said = test.test(replace(test_case, ahead=done_ahead))
            (of_findings[test_case.number] if test.each_finding else of_all).append(said)
            warnings += said.warnings
    return EvidenceReport(case, tuple(of_all), tuple(tuple(said) for said in of_findings), tuple(warnings))


def _long(case: EvidenceContext, tests: Sequence[EvidenceTest]) -> list[EvidenceTest]:
    """Those with something to go ahead; what is asked of the whole diagnosis takes longer than what is of a finding."""
    asked = [test for test in tests if test.ahead is not None and _cases(test, case)]
    return sorted(asked, key=lambda test: not test.each_finding)


def _cases(test: EvidenceTest, case: EvidenceContext) -> list[EvidenceContext]:
    return [replace(case, number=k) for k in range(len(case.found))] if test.each_finding else [case]


def _ahead(test: EvidenceTest, case: EvidenceContext) -> list[Any]:
    assert test.ahead is not None
    return [test.ahead(_case) for _case in _cases(test, case)]


def _final(case: EvidenceContext) -> FinalEstimate:
    return estimate(case.fit, case.settings.noise).at_least(case.held_out[-1].jackknife)
