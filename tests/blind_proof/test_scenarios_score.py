"""The score of scenarios, of diagnoses made by hand."""

import dataclasses
import json
import math

import pytest

from examples.blind_proof import aims
from examples.blind_proof.key import KeyDisturbance, KeyEffect, KeyRival
from examples.blind_proof.page import held, proof_page, summary
from examples.blind_proof.proof import Proof, Scenario
from examples.blind_proof.score import score_proof
from examples.blind_proof.scored_case import LEAST_DISTURBANCE
from tests.blind_proof.test_key import example_key

SETTINGS = {"proof": "equations_scenarios", "seed": 1, "key_sha256": "0" * 64, "empty": 1, "hidden": 1}


def never_drawn(*_):
    raise AssertionError


SCENARIOS = Proof(
    "equations_scenarios",
    (
        Scenario("white", "white noise", never_drawn, aims.WHITE),
        Scenario("pushed_white", "white force noise", never_drawn, aims.DISTURBED_STATE),
        Scenario("lasting", "one run", never_drawn, aims.LASTING, right="unexplained", share=1.0, apart=True),
        Scenario("useless", "of no use", never_drawn, aims.USELESS, hides=False),
    ),
    empty=60,
    totals=aims.TOTALS,
)


def key(name, scenario="white", *, disturbance=0.0, useless="", kind="empty", effect="backlash", z=20.0, z_sep=15.0):
    rival = KeyRival("dead_zone", (), z_sep)
    truth = KeyEffect(effect, "", (), "", None, 1.0, (), z, z_sep, rival, (), ("input voltage",))
    plain = dataclasses.replace(
        example_key(name), kind="useless" if useless else kind, effects=() if kind == "empty" else (truth,)
    )
    reported = KeyDisturbance("pushed_white", "speed", 0.1, "m/s²·√s", disturbance) if disturbance else None
    return dataclasses.replace(plain, scenario=scenario, disturbance=reported, useless=useless)


def answer(verdict, *findings, driven=None):
    reported = {"verdict": verdict, "findings": list(findings)}
    if driven:
        reported["noise"] = {"process": {driven: {"size": 1.0, "standard_error": 0.1, "unit": "m/s²"}}}
    return reported


def finding(effect, grade="left_out"):
    return {"effect": effect, "grade": grade, "drivers": [], "channels": ["input voltage"], "alternatives": []}


def counts(share):
    return share.count, share.total


def scenario(result, name):
    return next(scenario for scenario in result.scenarios if scenario.name == name)


def aim(scored, measure):
    return next(m for m in scored.measured if m.threshold.measure == measure)


def test_false_alarms_are_confirmed_findings_in_empty_recordings():
    answers = {
        "quiet": answer("adequate"),
        "unconfirmed": answer("unexplained", finding("input_delay", "unconfirmed")),
        "alarm": answer("explained", finding("input_delay")),
        "small": answer("explained", finding("sensor_lag", "small")),
        "old": answer("explained", {"effect": "backlash"}),
        "unfit": answer("unfit"),
    }
    scored = scenario(score_proof(SCENARIOS, [key(name) for name in (*answers, "refused")], answers), "white")
    assert scored.empty == 7
    assert counts(scored.shares["false_alarms"]) == (3, 6)  # the refused one is in its own column alone
    assert scored.alarms == {"input_delay": 1, "sensor_lag": 1, "backlash": 1}
    assert scored.verdicts == {"unfit": 1, "adequate": 1, "explained": 3, "unexplained": 1, "failed": 1}
    assert scored.failed == ["refused"]
    assert counts(scored.shares["adequate"]) == (1, 7)
    assert counts(scored.shares["useful_unfit"]) == (1, 7)
    assert not aim(scored, "false_alarms").holds
    assert not aim(scored, "useful_unfit").holds
    assert scored.shares["false_alarms"].low < 0.5 < scored.shares["false_alarms"].high


def test_disturbed_states_are_located_by_process_noise_or_a_finding():
    answers = {
        "noise": answer("unexplained", driven="speed"),
        "forcing": answer("unexplained") | {"disturbance": [{"state": "speed"}]},
        "finding": answer("unexplained", finding("unknown", "unconfirmed") | {"channels": ["rate of speed"]}),
        "wrong": answer("unexplained", driven="angle"),
        "adequate": answer("adequate", driven="speed"),
        "nowhere": answer("unexplained"),
        "weak": answer("adequate"),
    }
    keys = [
        key(name, "pushed_white", disturbance=LEAST_DISTURBANCE - 0.1 if name == "weak" else 3.0) for name in answers
    ]
    scored = scenario(score_proof(SCENARIOS, keys, answers), "pushed_white")
    assert counts(scored.shares["unexplained_located"]) == (3, 6)
    assert counts(scored.shares["located"]) == (4, 6)
    assert counts(scored.shares["false_alarms"]) == (0, 7)
    assert aim(scored, "unexplained_located").value == 0.5
    assert held(aim(scored, "unexplained_located")) == "not held"
    assert held(aim(scored, "false_alarms")) == "held"
    assert held(aim(scored, "named")) == "not measured"


def test_sensor_disturbances_are_not_counted_as_located_states():
    disturbed = dataclasses.replace(
        key("a", "pushed_white"), disturbance=KeyDisturbance("wander", "sensor", 1.0, "µT", 4.0)
    )
    scored = scenario(score_proof(SCENARIOS, [disturbed], {"a": answer("unexplained")}), "pushed_white")
    assert scored.shares["unexplained_located"].total == 0


def test_useless_simulations_are_right_if_unfit_and_wrong_if_adequate():
    keys = [key(name, "useless", useless="wrong sign" if name < "c" else "another system") for name in "abcd"]
    answers = {"a": answer("unfit"), "b": answer("adequate"), "c": answer("unfit"), "d": None}
    result = score_proof(SCENARIOS, keys, answers)
    scored = scenario(result, "useless")
    assert counts(scored.shares["unfit"]) == (2, 4)
    assert scored.reasons["wrong sign"] == {"unfit": 1, "adequate": 1, "explained": 0, "unexplained": 0, "failed": 0}
    assert scored.reasons["another system"]["failed"] == 1
    assert [m.holds for m in scored.measured if m.threshold.measure in ("unfit", "adequate")] == [False, False]
    assert result.total.empty == 0  # none of them is of use
    good = score_proof(SCENARIOS, keys, dict.fromkeys("abcd", answer("unfit")))
    assert all(m.holds for m in scenario(good, "useless").measured if m.threshold.measure != "empty")


def test_shares_of_named_effects_count_detectable_effects_only():
    answers = {
        "right": answer("explained", finding("backlash")),
        "wrong": answer("explained", finding("dead_zone")),
        "nearest": answer("unexplained", finding("backlash", "nearest")),
        "unsure": answer("unexplained", finding("backlash", "unconfirmed")),
        "unnamed": answer("explained", finding("unknown")),
        "weak": answer("adequate"),
        "unfit": answer("unfit"),
        "close": answer("unfit"),
    }
    sizes = {"weak": {"z": 5.0, "z_sep": 5.0}, "close": {"z_sep": 3.0}}
    keys = [
        key(name, kind="single", disturbance=3.0 if name in ("right", "wrong") else 0.0, **sizes.get(name, {}))
        for name in answers
    ]
    scored = scenario(score_proof(SCENARIOS, keys, answers), "white")
    assert (scored.hidden, scored.strong) == (8, 6)
    assert counts(scored.shares["named"]) == (1, 6)
    assert counts(scored.shares["named_disturbed"]) == (1, 2)
    assert counts(scored.shares["named_undisturbed"]) == (0, 4)
    assert counts(scored.shares["wrong"]) == (1, 6)
    assert counts(scored.shares["nearest"]) == (1, 6)
    assert counts(scored.shares["useful_unfit"]) == (2, 7)  # with z of at least ten, separable from its rivals or not
    assert scored.shares["false_alarms"].total == 0


def test_an_effect_outside_the_catalogue_is_wrong_only_with_a_confirmed_name():
    answers = {
        "claimed": answer("explained", finding("dead_zone")),
        "own": answer("explained", finding("vibration")),
        "unknown": answer("explained", finding("unknown")),
        "nearest": answer("unexplained", finding("dead_zone", "nearest")),
        "unseen": answer("adequate"),
        "weak": answer("explained", finding("dead_zone")),
    }
    keys = [key(n, kind="outside", effect="vibration", z=4.0 if n == "weak" else 15.0) for n in answers]
    result = score_proof(SCENARIOS, keys, answers)
    assert counts(scenario(result, "white").shares["outside_wrong"]) == (1, 5)
    assert counts(scenario(result, "white").shares["outside_nearest"]) == (3, 5)
    assert scenario(result, "white").strong == 0
    assert held(aim(result.total, "outside_wrong")) == "not held"


def with_rival(effect):
    rival = {"effect": "dead_zone", "drivers": [], "channels": [], "separable": False}
    return finding(effect) | {"alternatives": [rival]}


def test_wrong_single_names_in_one_run_are_counted_apart():
    answers = {
        "alone": answer("explained", finding("backlash")),
        "rival": answer("explained", with_rival("backlash")),
        "open": answer("unexplained"),
        "unnamed": answer("explained", finding("unknown")),
        "adequate": answer("adequate"),
        "refused": None,
        "right": answer("explained", finding("backlash")),
        "mistaken": answer("explained", finding("dead_zone")),
    }
    keys = [
        key(n, "lasting", disturbance=3.0, kind="single" if n in ("right", "mistaken") else "empty") for n in answers
    ]
    result = score_proof(SCENARIOS, keys, answers)
    scored = scenario(result, "lasting")
    assert counts(scored.shares["alone"]) == (2, 7)  # "alone" and "mistaken"
    assert counts(scored.shares["undecided"]) == (2, 8)  # "rival" and "open"
    assert held(aim(scored, "alone")) == "not held"
    assert (scored.scenario.apart, scored.scenario.right) == (True, "unexplained")
    assert (result.total.empty, result.total.hidden) == (0, 0)
    pytest.importorskip("jinja2")
    page, text = proof_page(result, {}, SETTINGS), summary(result, {}, SETTINGS)
    for words in ("a single wrong name", "undecided", "(2 of 7; 3.7-71.0 %)"):
        assert words in page
        assert words in text
    quiet = score_proof(SCENARIOS, [key("a")], {"a": answer("adequate")})
    assert "undecided" not in proof_page(quiet, {}, SETTINGS)


def test_a_reported_drift_of_the_right_sensor_counts():
    slow = {"noise": {"sensor": {"height": {"size": 1.0, "standard_error": 0.1}}}}
    answers = {
        "reported": answer("unexplained") | slow,
        "not": answer("unexplained", driven="speed"),
        "small": answer("adequate"),
    }
    keys = [
        dataclasses.replace(
            key(name), disturbance=KeyDisturbance("slow_sensor", "sensor", 1.0, "m", 1.5 if name == "small" else 4.0)
        )
        for name in answers
    ]
    assert counts(scenario(score_proof(SCENARIOS, keys, answers), "white").shares["sensor_reported"]) == (1, 2)


@pytest.mark.parametrize(("share", "asked", "hidden"), [(1 / 3, None, 20), (1.0, None, 60), (1.0, 6, 6), (1 / 3, 6, 6)])
def test_the_number_of_recordings_with_hidden_physics_follows_share_and_argument(share, asked, hidden):
    assert Scenario("white", "", never_drawn, (), share=share).hidden(60, asked) == hidden
    assert Scenario("useless", "", never_drawn, (), hides=False).hidden(60, asked) == 0


def all_kinds():
    keys = [
        key("a"),
        key("b", "pushed_white", disturbance=3.0),
        key("c", "useless", useless="wrong <sign>"),
        key("d", kind="single"),
    ]
    answers = {"a": answer("adequate"), "b": answer("unexplained", driven="speed"), "c": answer("unfit")}
    return score_proof(SCENARIOS, keys, answers)


def test_the_total_excludes_useless_scenarios():
    result = all_kinds()
    assert [w.name for w in result.scenarios] == ["white", "pushed_white", "useless"]
    assert (result.total.empty, result.total.hidden) == (2, 1)
    assert [m.threshold for m in result.total.measured] == list(aims.TOTALS)


def test_the_score_is_json_with_a_row_for_each_case():
    numbers = all_kinds().numbers()
    assert json.loads(json.dumps(numbers, allow_nan=False)) == numbers
    assert [case["verdict"] for case in numbers["cases"]] == ["adequate", "unexplained", "unfit", "failed"]
    assert numbers["cases"][1]["disturbance"]["at"] == numbers["cases"][1]["driven"] == "speed"
    assert numbers["scenarios"][1]["holds"]["unexplained_located"] is True
    assert numbers["scenarios"][0]["holds"]["named"] is False
    assert numbers["scenarios"][1]["holds"]["named"] is None


def test_each_scenario_is_a_row_of_the_page_and_of_the_summary():
    pytest.importorskip("jinja2")
    result = all_kinds()  # the strong one that failed was not named
    page, text = proof_page(result, {}, SETTINGS), summary(result, {}, SETTINGS)
    for name in ("white", "pushed_white", "useless", "all useful"):
        assert f'<th scope="row">{name}</th>' in page
        assert f"| {name} |" in text
    assert "wrong &lt;sign&gt;" in page
    for words in ("held", "not held", "too few", "not measured", "at most 7 % false alarms"):
        assert words in page
        assert words in text
    assert "100.0 % (1 of 1; 2.5-100.0 %)" in page
    assert "<script" not in page


def test_only_scenarios_with_a_key_are_scored():
    result = score_proof(SCENARIOS, [], {})
    assert result.scenarios == ()
    assert math.isnan(result.total.shares["false_alarms"].value)
