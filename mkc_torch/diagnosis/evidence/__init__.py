"""Tests of evidence for findings and of the residual, one subject per file.

A new test is a function ``evidence(case) -> EvidenceResult`` and a line in :data:`TESTS`. It returns data, which
``diagnosis.json`` contains under ``evidence``, by the test's id. Its warnings are worded in
:mod:`mkc_torch.diagnosis.findings.warnings`, its lines in the report and on the terminal in
:mod:`mkc_torch.report.diagnosis.evidence`. It does not change the verdict or the findings.
"""

from mkc_torch.diagnosis.evidence.base import EvidenceTest
from mkc_torch.diagnosis.evidence.common_cause import goes_on, proxy_driver_evidence
from mkc_torch.diagnosis.evidence.prediction import (
    extrapolation_evidence,
    extrapolation_of_finding,
    held_out_gain_evidence,
    without_finding,
)
from mkc_torch.diagnosis.evidence.remaining import remaining_evidence, within_reach
from mkc_torch.diagnosis.evidence.residual_noise import (
    density_evidence,
    localised_evidence,
    rejected_evidence,
    whiteness_evidence,
)
from mkc_torch.diagnosis.evidence.timing import (
    driver_shift_evidence,
    driver_shift_of_finding,
    intermittency_evidence,
    onset_evidence,
    onset_of_finding,
)

__all__ = ["TESTS"]

TESTS: tuple[EvidenceTest, ...] = (
    EvidenceTest(held_out_gain_evidence, ahead=without_finding, each_finding=True),
    EvidenceTest(onset_evidence, ahead=onset_of_finding, each_finding=True),
    EvidenceTest(intermittency_evidence, each_finding=True),
    EvidenceTest(remaining_evidence, ahead=within_reach),
    EvidenceTest(localised_evidence),
    EvidenceTest(rejected_evidence),
    EvidenceTest(proxy_driver_evidence, ahead=goes_on),
    EvidenceTest(driver_shift_evidence, ahead=driver_shift_of_finding, each_finding=True),
    EvidenceTest(extrapolation_evidence, ahead=extrapolation_of_finding, each_finding=True),
    EvidenceTest(density_evidence),
    EvidenceTest(whiteness_evidence),
)
"""In the order of their warnings."""
