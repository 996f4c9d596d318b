import dataclasses

import pytest

from mkc_torch.diagnosis.evidence.residual_noise import RejectedByFit
from mkc_torch.diagnosis.result import EvidenceResult
from mkc_torch.recording.disturbance import RejectedInterval
from mkc_torch.report.diagnosis.verdict import headline, unexplained_place
from tests.diagnosis.factory import make_diagnosis

FINAL, BEFORE = (RejectedInterval(3.0, 4.0),), (RejectedInterval(48.8, 51.8),)


def disturbed(count, **changes):
    evidence = (EvidenceResult("rejected", RejectedByFit(FINAL, BEFORE)),)
    d = make_diagnosis(count, evidence=evidence)
    return dataclasses.replace(d, findings=tuple(dataclasses.replace(f, **changes) for f in d.findings))


def test_the_headline_starts_with_the_rejected_interval():
    assert headline(disturbed(0)).startswith("Disturbed between 48.8 s and 51.8 s: most samples were rejected there.")
    assert "Disturbed" not in headline(make_diagnosis(0, evidence=()))


def test_rejected_intervals_are_not_explained():
    assert unexplained_place(disturbed(0)) == "the intervals of rejected samples"
    assert unexplained_place(make_diagnosis(0, evidence=())) == ""


@pytest.mark.parametrize(("grade", "found"), [("unconfirmed", BEFORE), ("left_out", FINAL), ("small", FINAL)])
def test_rejected_intervals_of_unconfirmed_findings_are_those_before_the_findings(grade, found):
    assert disturbed(1, grade=grade).rejected_intervals == found


def test_notes_and_rejected_intervals_are_in_diagnosis_json():
    pytest.importorskip("jsonschema")
    from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json

    text = diagnosis_to_json(dataclasses.replace(disturbed(0), notes=("Decimal commas were read as points.",)))
    assert '"notes": [' in text
    assert "Decimal commas" in text
    assert '"rejected_intervals": [\n    [48.8, 51.8]\n  ]' in text
