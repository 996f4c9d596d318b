"""Tests of evidence: what speaks for and against a finding, and what is left over; one test a file.

A new one is a file with ``test(case) -> Told`` and a line in :data:`TESTS`. What it says then stands in the report, on
the terminal and in ``diagnosis.json``, there under ``evidence`` by its id. It informs: verdict and findings stay.
"""

from mkc_torch.diagnosis.evidence import (
    density,
    driver_shift,
    extrapolation,
    held_out_gain,
    one_stretch,
    onset,
    rejected,
    remaining,
    stand_in,
    switched,
    whiteness,
)
from mkc_torch.diagnosis.evidence.base import EvidenceTest

__all__ = ["TESTS"]

TESTS: tuple[EvidenceTest, ...] = (
    EvidenceTest(held_out_gain.test, ahead=held_out_gain.beside_the_others, each_finding=True),
    EvidenceTest(onset.test, ahead=onset.of_finding, each_finding=True),
    EvidenceTest(switched.test, each_finding=True),
    EvidenceTest(remaining.test, ahead=remaining.within_reach),
    EvidenceTest(one_stretch.test),
    EvidenceTest(rejected.test),
    EvidenceTest(stand_in.test, ahead=stand_in.goes_on),
    EvidenceTest(driver_shift.test, ahead=driver_shift.of_finding, each_finding=True),
    EvidenceTest(extrapolation.test, ahead=extrapolation.of_finding, each_finding=True),
    EvidenceTest(density.test),
    EvidenceTest(whiteness.test),
)
"""In the order of their warnings."""
