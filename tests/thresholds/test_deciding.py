"""The numbers that decide are few, documented and in one file; their replay changes the decisions that they make."""

import ast
import inspect
from dataclasses import replace

import pytest

import mkc_torch.diagnosis.search.beam as beam
from mkc_torch.diagnosis import decisions, thresholds, verdict, vetoes
from mkc_torch.diagnosis.decisions import Decision, Trail
from mkc_torch.diagnosis.settings import Settings
from tests.thresholds.deciding import FIELDS, RULES, changed_by_replay, numbers, outcome_of, replayed, scaled


def trail(rule, value, threshold, *, passed):
    return Trail((), (Decision(rule, "", value, threshold, passed, ""),))


def test_at_most_thirty_numbers_decide_and_each_has_a_docstring():
    body = ast.parse(inspect.getsource(thresholds)).body
    places = [number for number, node in enumerate(body) if isinstance(node, ast.Assign)]
    assert len(places) == len(numbers()) <= 30
    for place in places:
        after = body[place + 1]
        assert isinstance(getattr(after, "value", None), ast.Constant), ast.unparse(body[place])


@pytest.mark.parametrize("module", [vetoes, verdict, decisions])
def test_vetoes_and_verdict_have_no_number_of_their_own(module):
    allowed = {0.0, 0.1, 0.5, 1.0, 100.0}  # identities, percent and the digits that are shown
    constants = [node for node in ast.walk(ast.parse(inspect.getsource(module))) if isinstance(node, ast.Constant)]
    assert {node.value for node in constants if isinstance(node.value, float)} <= allowed


def test_a_setting_has_the_number_as_its_default():
    for name, (stage, field) in FIELDS.items():
        assert getattr(getattr(Settings(), stage), field) == numbers()[name]


def test_a_replay_makes_the_decision_again():
    followed = trail("explained_share", 0.4, thresholds.USEFUL, passed=True)
    assert outcome_of(followed) == ("adequate",)
    assert outcome_of(replayed(followed, "USEFUL", 2.0)) == ("unfit",)
    assert replayed(followed, "FOLLOWED", 2.0) == followed
    assert dict(changed_by_replay({"ship": followed}))["USEFUL"] == ["ship"]


def test_the_ratio_of_residuals_is_scaled_by_its_distance_from_one():
    finding = replace(trail("open_loop", 0.97, 0.95, passed=False).decisions[0], subject="lag@y", finding=1)
    (again,) = replayed(Trail((), (finding,)), "SMALL", 0.5).decisions
    assert again.passed
    assert again.threshold == pytest.approx(0.975)


def test_each_rule_has_a_threshold():
    assert {rule.threshold for rule in RULES.values()} <= numbers().keys()


def test_a_scaled_threshold_reaches_its_users_and_is_restored():
    with scaled("WIDTH", 2.0):
        assert beam.WIDTH == thresholds.WIDTH == 12
    assert beam.WIDTH == 6
    with scaled("SEPARABLE", 0.5) as settings:
        assert settings.naming.separable == 2.25
