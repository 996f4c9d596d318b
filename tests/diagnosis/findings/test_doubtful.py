"""A doubtful diagnosis is reported in the headline, in diagnosis.json and by the exit code."""

import dataclasses
import json

import pytest

from mkc_torch.diagnosis.findings.advice import advice_of
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.verdict import conclusion, rejected_share
from mkc_torch.report.diagnosis.verdict import answer_word, headline
from tests.diagnosis.factory import make_diagnosis


def test_a_confirmed_result_has_no_doubts():
    for findings in (0, 1, 2):
        found = make_diagnosis(findings)
        assert conclusion(found).doubts == ()
        assert "Doubtful" not in headline(found)


@pytest.mark.parametrize(("verdict", "doubt"), [("unfit", "unfit"), ("unexplained", "unexplained")])
def test_the_verdicts_unfit_and_unexplained_are_doubts(verdict, doubt):
    assert conclusion(make_diagnosis(0, verdict=verdict)).doubts == (doubt,)


def test_findings_that_do_not_reduce_the_residual_are_a_doubt_in_the_headline():
    found = make_diagnosis(1)
    worse = dataclasses.replace(found, corrected=dataclasses.replace(found.corrected, rmse=1.2 * found.baseline.rmse))
    assert conclusion(worse).doubts == ("not_better",)
    assert headline(worse).startswith("Doubtful: the findings do not make the residual smaller (")
    assert answer_word(worse) == "look"
    assert json.loads(diagnosis_to_json(worse))["doubts"] == ["not_better"]


def test_a_third_of_rejected_samples_is_a_doubt_in_the_headline():
    found = make_diagnosis(1)
    weight = found.traces.weight.clone()
    weight[: int(0.4 * len(weight))] = 0.1
    much = dataclasses.replace(found, traces=dataclasses.replace(found.traces, weight=weight))
    assert rejected_share(much) >= 0.4
    assert conclusion(much).doubts == ("much_rejected",)
    assert headline(much).startswith("Doubtful: 4")
    assert "of the samples were rejected." in headline(much)


def test_unconfirmed_findings_alone_are_a_doubt():
    found = make_diagnosis(1)
    unconfirmed = dataclasses.replace(found, findings=(dataclasses.replace(found.findings[0], grade="unconfirmed"),))
    assert "unconfirmed" in conclusion(unconfirmed).doubts


def test_the_headline_of_a_quick_look_names_the_skipped_tests():
    found = make_diagnosis(1)
    untested = dataclasses.replace(found.findings[0], grade="unconfirmed", evidence=())
    quick = dataclasses.replace(found, quick=True, verdict="unexplained", p_value=None, findings=(untested,))
    assert headline(quick).startswith("Found, but not tested on held-out blocks:")
    assert "no effect in the catalogue" not in headline(quick)
    (advice,) = advice_of(quick)
    assert "full diagnosis" in advice
    assert {"unexplained", "unconfirmed"} <= set(conclusion(quick).doubts)
