"""Tests of evidence: what speaks for and against a finding, and what is left over; one test a file.

A new one is a file with ``test(case) -> EvidenceResult`` and a line in :data:`TESTS`. What it says then stands in the report, on
the terminal and in ``diagnosis.json``, there under ``evidence`` by its id. It informs: verdict and findings stay.
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
    EvidenceTest(held_out_gain.test, ahead=held_out_gain.beside_the_others, each_finding=True),
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
