"""Tests of evidence for findings and of the residual, one test per file.

A new test is a file with ``test(case) -> EvidenceResult`` and a line in :data:`TESTS`. Its result appears in the
report, on
the terminal and in ``diagnosis.json`` under ``evidence``, by its id. It does not change the verdict or the findings.
"""

from mkc_torch.diagnosis.evidence import (
    density,
    driver_shift,
    extrapolation,
    held_out_gain,
    intermittency,
    localised,
    onset,
    proxy_driver,
    rejected,
    remaining,
    whiteness,
)
from mkc_torch.diagnosis.evidence.base import EvidenceTest

__all__ = ["TESTS"]

TESTS: tuple[EvidenceTest, ...] = (
    EvidenceTest(held_out_gain.test, ahead=held_out_gain.without_finding, each_finding=True),
    EvidenceTest(onset.test, ahead=onset.of_finding, each_finding=True),
    EvidenceTest(intermittency.test, each_finding=True),
    EvidenceTest(remaining.test, ahead=remaining.within_reach),
    EvidenceTest(localised.test),
    EvidenceTest(rejected.test),
    EvidenceTest(proxy_driver.test, ahead=proxy_driver.goes_on),
    EvidenceTest(driver_shift.test, ahead=driver_shift.of_finding, each_finding=True),
    EvidenceTest(extrapolation.test, ahead=extrapolation.of_finding, each_finding=True),
    EvidenceTest(density.test),
    EvidenceTest(whiteness.test),
)
"""In the order of their warnings."""
