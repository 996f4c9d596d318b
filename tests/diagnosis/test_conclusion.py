"""Statements that follow from a trail of decisions never contradict each other."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.diagnosis.decisions import Decision, Trail
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.diagnosis.verdict import (
    EXPLAINS_MORE,
    UNFIT,
    FitAssessment,
    Remainder,
    conclusion,
    conclusion_of,
    decisions_on_all,
    doubted_signs,
    failed_rules,
    grades_of,
    is_near_noise,
    verdict_of,
)
from mkc_torch.diagnosis.vetoes import VETOES
from tests.diagnosis.factory import make_diagnosis, make_goodness_of_fit

ON_ALL = (
    UNFIT, "each_output", EXPLAINS_MORE, "white_residual", "disturbed_state", "drifting_output", "structure_left",
    "above_declared_noise", "above_estimated_noise", "stopped", "few_rejected", "smaller_residual",
)  # fmt: skip
ON_FINDING = tuple(veto.__name__ for veto in VETOES)
SIGNS = "The simulation explains 12 %, the correction 71 %: check signs and units first."


def decision(rule, *, passed=True, finding=0, sentence=""):
    return Decision(rule, "drag@speed" if finding else "", 1.0, 0.5, passed, sentence, finding)


@st.composite
def trails(draw):
    """A trail in any order, mostly of passed rules, with rejected candidates of the search in between."""
    passed = st.sampled_from((True, True, True, True, False))
    decisions = [decision(rule, passed=draw(passed)) for rule in draw(st.sets(st.sampled_from(ON_ALL)))]
    for number in range(1, draw(st.integers(0, 3)) + 1):
        rules = draw(st.sets(st.sampled_from(ON_FINDING), min_size=1))
        decisions += [decision(rule, passed=draw(passed), finding=number) for rule in rules]
    searched = Decision("p_value", "backlash@speed", 0.6, 0.05, False, "")
    decisions += [searched] * draw(st.integers(0, 2))
    return Trail(decisions=tuple(draw(st.permutations(decisions))))


@settings(max_examples=400, deadline=None)
@given(trail=trails())
def test_no_trail_gives_two_statements_that_contradict(trail):
    found, failed = conclusion_of(trail), failed_rules(trail)
    doubts, advice = set(found.doubts), found.first_advice()
    assert found == conclusion_of(Trail(decisions=trail.decisions[::-1]))
    # the verdict and its doubt, exit status and answer
    assert (found.verdict == "unfit") == ("unfit" in doubts) == (UNFIT in failed)
    assert found.verdict == "unexplained" or "unexplained" not in doubts
    assert (found.answer == "unusable") == (found.verdict == "unfit")
    assert (found.answer == "usable") == (not doubts)
    if found.verdict == "unexplained" and "unexplained" not in doubts:
        # only a disturbance or a drift remains, and the residual is near the noise
        assert set(failed) - {"few_rejected", "smaller_residual"} in ({"disturbed_state"}, {"drifting_output"})
        assert is_near_noise(trail)
    assert found.doubtful == (found.answer != "usable") == bool(doubts)
    if found.verdict in ("adequate", "explained"):
        assert doubts <= {"not_better", "much_rejected"}
        assert not set(failed) - {"few_rejected", "smaller_residual"}
    # the verdict and the grades
    assert found.verdict not in ("unfit", "adequate") or found.grades == ()
    if found.verdict == "explained":
        assert found.grades
        assert set(found.grades) <= {"left_out", "small"}
    # the advice
    assert ("can be used" in advice) == (found.verdict == "adequate" and not doubts and not found.stopped)
    assert ("before the simulation is used" in advice) == (found.verdict == "adequate" and bool(doubts))
    assert ("Do not rely" in advice) == (found.verdict == "unfit" and not found.stopped)
    assert not doubted_signs(trail) or found.verdict == "unexplained"


@given(trail=trails(), rule=st.sampled_from(ON_ALL))
def test_a_failed_rule_never_improves_the_verdict(trail, rule):
    better = ("unfit", "unexplained", "explained", "adequate")
    others = tuple(d for d in trail.decisions if d.rule != rule)
    before, after = (Trail(decisions=(*others, decision(rule, passed=passed))) for passed in (True, False))
    assert better.index(verdict_of(after)) <= better.index(verdict_of(before))


def remaining(*rules, near=True, grade=""):
    """Return the trail of a finding, or of none, after which these rules fail."""
    on_finding = {"left_out": (), "unconfirmed": ("open_loop",)}
    named = [decision("p_value", finding=1), *(decision(r, passed=False, finding=1) for r in on_finding.get(grade, ()))]
    whole = [decision(rule, passed=False) for rule in rules]
    return Trail(decisions=(*(named if grade else ()), *whole, decision("above_estimated_noise", passed=near)))


def test_a_disturbance_that_remains_near_the_noise_is_usable_with_named_findings_and_a_drift_without():
    for rule, grade in (("disturbed_state", "left_out"), ("drifting_output", "")):
        found = conclusion_of(remaining(rule, grade=grade))
        assert (found.verdict, found.answer, found.doubts) == ("unexplained", "usable", ())
        assert conclusion_of(remaining(rule, grade=grade, near=False)).answer == "look"
        assert conclusion_of(remaining(rule, "structure_left", grade=grade)).answer == "look"
        unknown = Trail(decisions=remaining(rule, grade=grade).decisions[:-1])
        assert conclusion_of(unknown).answer == "look"
    assert conclusion_of(remaining("disturbed_state")).answer == "look"
    assert conclusion_of(remaining("disturbed_state", grade="unconfirmed")).answer == "look"
    assert conclusion_of(remaining(UNFIT)).answer == "unusable"
    assert conclusion_of(remaining()).answer == "usable"


@pytest.mark.parametrize("failed", [(), ("few_rejected",), ("structure_left",), (UNFIT,)])
def test_a_diagnosis_comes_to_the_conclusion_of_its_trail(failed):
    trail = Trail(decisions=tuple(decision(rule, passed=rule not in failed) for rule in ON_ALL[:10]))
    reserved = Trail(decisions=tuple(decision(rule, passed=False) for rule in failed if rule == "few_rejected"))
    whole = Trail(decisions=(*trail.decisions, *reserved.decisions))
    made = make_diagnosis(0, samples=50, verdict=verdict_of(whole), decisions=whole)
    assert conclusion(made) == conclusion_of(whole)


def test_a_candidate_of_size_zero_is_no_finding():
    dropped = (decision("p_value", finding=1), decision("size_beyond_error", passed=False, finding=1))
    kept = (decision("p_value", finding=2), decision("residual_reduction", passed=False, finding=2))
    assert grades_of(Trail(decisions=dropped)) == ()
    assert verdict_of(Trail(decisions=dropped)) == "adequate"
    assert grades_of(Trail(decisions=(*dropped, *kept))) == ("small",)
    assert verdict_of(Trail(decisions=(*dropped, *kept))) == "explained"


def shares(alone, corrected, *, flexible=True, **changes):
    """Return the trail of a finding with these explained shares without and with it."""
    fits = [(make_goodness_of_fit(explained=share),) for share in (alone, corrected)]
    limits = EvidenceSettings(**changes)
    on_all = decisions_on_all(FitAssessment(*fits, None), Remainder(), limits, findings=True, flexible=flexible)
    return Trail(decisions=(decision("p_value", finding=1), *on_all))


@pytest.mark.parametrize(
    ("alone", "corrected", "verdict"),
    [
        (0.12, 0.83, "unexplained"),
        (0.49, 0.99, "unexplained"),
        (0.51, 0.99, "explained"),
        (-3.0, 0.99, "unexplained"),
        (0.0, 0.0, "unfit"),
        (0.12, 0.2, "unfit"),
    ],
)
def test_a_correction_that_explains_more_than_the_simulation_is_unexplained(alone, corrected, verdict):
    trail = shares(alone, corrected)
    found = conclusion_of(trail)
    assert found.verdict == verdict
    if verdict == "unexplained":
        assert found.first_advice() == doubted_signs(trail) != ""
        assert found.first_advice().endswith("check signs and units first.")
    assert conclusion_of(shares(alone, corrected, correction=1e9)).check == "" or alone <= 0.0
    assert conclusion_of(shares(alone, corrected, flexible=False)).verdict == (
        "unfit" if verdict == "unfit" else "explained"
    )


def test_the_shares_of_simulation_and_correction_are_stated():
    assert doubted_signs(shares(0.12, 0.83)) == SIGNS
    both = Trail(decisions=(*shares(0.12, 0.83).decisions, decision("structure_left", passed=False)))
    assert (doubted_signs(both), conclusion_of(both).first_advice()) == ("", SIGNS)


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("reasons", [False, True])
def test_the_first_advice_on_a_stopped_search_is_to_complete_it(quick, reasons):
    found = conclusion_of(Trail(decisions=(decision("stopped", passed=False),)))
    assert found.verdict == "unexplained"
    assert found.first_advice(quick=quick, reasons=reasons).startswith("Complete the search")
