"""A candidate confined to one stretch is reported with its times."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.evidence import residual_noise as rejected
from mkc_torch.diagnosis.evidence.base import EvidenceContext
from mkc_torch.diagnosis.evidence.run import EvidenceReport
from mkc_torch.diagnosis.findings.warnings import evidence_warnings
from mkc_torch.diagnosis.model.term import Driver, Term
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import CATALOGUE

EFFECTS = {effect.id: effect for effect in CATALOGUE}
LOAD = Driver(("load",), "any", torch.zeros(5, 1), torch.zeros(1), ("A",))
PREPARED = SimpleNamespace(time=torch.arange(100) / 10.0)
CASE = EvidenceContext(SimpleNamespace(model=SimpleNamespace(prepared=PREPARED)), None, (), (), None, (), 0, Settings())


def evidence_for(term, stretch):
    case = replace(CASE, first=SimpleNamespace(term=term, stretch=stretch))
    result = rejected.localised_evidence(case)
    return result.value, evidence_warnings(EvidenceReport(case, ((None, result),)))


@pytest.mark.parametrize(
    ("effect", "driver", "name"),
    [("offset_drift", None, "offset_drift"), ("current_field", LOAD, "current_field by load")],
)
def test_a_localised_candidate_is_named_with_its_times(effect, driver, name):
    interval, (warning,) = evidence_for(Term(EFFECTS[effect], driver, {}), (20, 40))
    assert interval == pytest.approx((2.0, 3.9))
    assert warning.startswith(f"From 2.0 to 3.9 s the residual fits {name}")


def test_a_candidate_without_a_stretch_or_no_candidate_has_no_warning():
    assert evidence_for(Term(EFFECTS["offset_drift"], None, {}), None) == (None, ())
    assert rejected.localised_evidence(CASE).value is None
