import dataclasses
import json
import math

import pytest

from examples.blind_proof.aims import THRESHOLDS, Threshold
from examples.blind_proof.key import KeyEffect, KeyParameter, KeyRival
from examples.blind_proof.score import SHARES, Score
from examples.blind_proof.scored_case import scored
from tests.blind_proof.test_key import example_key


def key(name, kind="single", *, effect="hard_iron_step", drivers=(), z=20.0, z_sep=15.0, **more):
    parameters = more.pop("parameters", ())
    rival = KeyRival("driver_offset", ("aux_1",), z_sep)
    truth = KeyEffect(effect, "", drivers, more.pop("withheld", ""), more.pop("onset", None), 1.0, parameters, z, z_sep,
                      rival, (rival,) if z_sep < 6 else ())  # fmt: skip
    effects = () if kind == "empty" else (truth, *more.pop("others", ()))
    return dataclasses.replace(example_key(name), kind=kind, effects=effects)


def finding(effect, drivers=(), onset=None, parameters=(), alternatives=()):
    return {"effect": effect, "drivers": list(drivers), "onset": onset, "parameters": list(parameters),
            "alternatives": list(alternatives)}  # fmt: skip


def answer(*findings, verdict="explained", p_value=0.01):
    return {"verdict": verdict, "p_value": p_value, "findings": list(findings)}


ADEQUATE = answer(verdict="adequate", p_value=0.5)


def score(keys, answers, ratios=(), thresholds=THRESHOLDS):
    return Score("proof", [scored(k, answers.get(k.name), dict(ratios).get(k.name)) for k in keys], thresholds)


def measured(result, name):
    return next(m for m in result.measured if m.threshold.measure == name)


def test_false_alarms_are_claims_that_physics_is_missing():
    keys = [key(name, "empty") for name in "abcdef"]
    answers = {
        "a": ADEQUATE,
        "b": answer(verdict="unexplained"),
        "c": answer(finding("offset_drift")),
        "d": ADEQUATE,
        "f": answer(verdict="unfit"),
    }
    result = score(keys, answers)
    assert (result.shares["false_alarms"].count, result.shares["false_alarms"].total) == (1, 5)
    assert result.failed == ["e"]
    assert len(result.p_values) == 5
    assert result.verdicts == {"unfit": 1, "adequate": 2, "explained": 1, "unexplained": 1, "failed": 1}
    assert result.confusion == {"nothing": {"nothing": 2, "unknown": 1, "offset_drift": 1, "failed": 1, "unfit": 1}}


@pytest.mark.parametrize(("grade", "claimed"), [("left_out", 1), ("small", 1), (None, 1), ("unconfirmed", 0),
                                                ("nearest", 0)])  # fmt: skip
def test_the_grade_decides_whether_a_finding_is_a_claim(grade, claimed):
    reported = answer(finding("hard_iron_step") | {"grade": grade}, verdict="unexplained")
    result = score([key("a"), key("b", "empty")], {"a": reported, "b": reported})
    assert result.shares["named"].count == result.shares["false_alarms"].count == claimed
    assert result.confusion["nothing"] == {"hard_iron_step" if claimed else "unknown": 1}
    assert [b.found.count for b in result.power_z if b.found.total] == [1]


def test_shares_of_right_names_and_drivers_count_detectable_cases_only():
    keys = [
        key("right", effect="current_field", drivers=("current",)),
        key("driver", effect="current_field", drivers=("current",)),
        key("wrong", effect="current_field", drivers=("current",)),
        key("weak", effect="current_field", drivers=("current",), z_sep=4.0),
    ]
    answers = {
        "right": answer(finding("current_field", ["current"])),
        "driver": answer(finding("current_field", ["aux_1"])),
        "wrong": answer(finding("offset_drift")),
        "weak": ADEQUATE,
    }
    result = score(keys, answers)
    assert result.strong == 3
    assert (result.shares["named"].count, result.shares["named"].total) == (2, 3)
    assert (result.shares["driver"].count, result.shares["driver"].total) == (1, 3)


def test_an_inseparable_rival_is_right_and_a_separable_rival_is_wrong():
    keys = [key("below", z_sep=5.0), key("above", z_sep=9.0)]
    answers = {name: answer(finding("driver_offset", ["aux_1"])) for name in ("below", "above")}
    bins = {(b.low, b.high): b.named.count for b in score(keys, answers).power_z_sep}
    assert bins[5.0, 7.0] == 1
    assert bins[7.0, 10.0] == 0


@pytest.mark.parametrize(("named", "right"), [("offset_drift", 1), ("hard_iron_step", 1), ("unknown", 1),
                                              ("current_field", 0), ("cubic_nonlinearity", 0)])  # fmt: skip
def test_a_withheld_driver_is_named_by_its_time_course(named, right):
    result = score([key("a", effect="current_field", withheld="current")], {"a": answer(finding(named))})
    assert result.shares["withheld_named"].count == right
    assert list(result.confusion) == ["current_field, driver withheld"]


def test_any_position_column_is_the_right_driver_of_a_gradient():
    hidden = key("a", effect="field_gradient", drivers=("position_x", "position_y", "position_z"))
    assert score([hidden], {"a": answer(finding("field_gradient", ["position_x"]))}).shares["driver"].count == 1
    assert score([hidden], {"a": answer(finding("field_gradient", []))}).shares["driver"].count == 0


def test_time_as_a_driver_is_ignored():
    assert score([key("a")], {"a": answer(finding("hard_iron_step", ["time"]))}).shares["driver"].count == 1


def test_candidates_and_separable_share_count_inseparable_alternatives():
    other = {"effect": "offset_drift", "drivers": [], "separable": False}
    ruled_out = other | {"separable": True}
    answers = {
        "a": answer(finding("hard_iron_step", alternatives=[ruled_out])),
        "b": answer(finding("hard_iron_step", alternatives=[other, ruled_out])),
    }
    result = score([key("a"), key("b")], answers)
    assert result.shares["separable"].value == 0.5
    assert result.candidates == 1.5


def test_onset_errors_are_infinite_without_an_onset():
    keys = [key("a", onset=10.0), key("b", onset=10.0)]
    result = score(keys, {"a": answer(finding("hard_iron_step", onset=10.4)), "b": answer(finding("hard_iron_step"))})
    assert [case.onset_error for case in result.cases] == pytest.approx([0.4, math.inf])
    assert measured(result, "onsets_near").value == 0.5


def test_onset_coverage_counts_onsets_outside_or_without_an_interval_as_missed():
    keys = [key(name, onset=10.0) for name in "abcd"]
    answers = {
        "a": answer(finding("hard_iron_step", onset=10.4) | {"onset_interval": [9.9, 10.6]}),
        "b": answer(finding("hard_iron_step", onset=10.4) | {"onset_interval": [10.1, 10.6]}),
        "c": answer(finding("hard_iron_step", onset=10.4)),
        "d": answer(finding("offset_drift")),
    }
    result = score(keys, answers)
    assert (result.shares["onset_covered"].count, result.shares["onset_covered"].total) == (1, 3)


def test_coverage_counts_components_within_their_90_per_cent_interval():
    truth = (KeyParameter("offset_change", [1.0, 2.0, 3.0], "µT", True),)
    stated = {"name": "step", "value": [1.0, 2.16, 3.17], "standard_error": [0.1, 0.1, 0.1], "unit": "µT"}
    keys = [key("a", parameters=truth), key("b", parameters=truth)]
    answers = {
        "a": answer(finding("hard_iron_step", parameters=[{**stated, "unit": "s"}, stated])),
        "b": answer(finding("hard_iron_step")),
    }
    result = score(keys, answers)
    assert (result.coverage.count, result.coverage.total) == (2, 3)
    assert result.parameters_missing == 1


def test_parameters_that_are_not_scored_do_not_count():
    truth = (KeyParameter("offset_change", [1.0, 2.0, 3.0], "µT", False),)
    stated = {"name": "step", "value": [0.0] * 3, "standard_error": [0.1] * 3, "unit": "µT"}
    result = score([key("a", parameters=truth)], {"a": answer(finding("hard_iron_step", parameters=[stated]))})
    assert result.coverage.total == 0
    assert not measured(result, "coverage").holds


def test_power_is_counted_in_bins_of_z():
    keys = [key(str(z), z=z, z_sep=z) for z in (2.0, 4.0, 12.0, 14.0, 100.0)]
    answers = dict.fromkeys(("2.0", "4.0", "12.0"), ADEQUATE)
    answers |= {name: answer(finding("hard_iron_step")) for name in ("14.0", "100.0")}
    bins = [(b.named.count, b.named.total) for b in score(keys, answers).power_z]
    assert bins == [(0, 1), (0, 1), (0, 0), (0, 0), (1, 2), (0, 0), (1, 1)]


def test_of_two_hidden_effects_each_is_counted_once():
    second = key("x", effect="offset_drift").effects
    keys = [key(name, "double", others=second) for name in "abc"]
    answers = {
        "a": answer(finding("offset_drift"), finding("hard_iron_step")),
        "b": answer(finding("hard_iron_step"), finding("hard_iron_step")),
        "c": ADEQUATE,
    }
    assert score(keys, answers).doubles == {0: 1, 1: 1, 2: 1}


def key_at(places, effect="coulomb_friction", **more):
    """Return a key whose effect acts at several ports."""
    hidden = key("a", effect=effect, **more)
    return dataclasses.replace(hidden, effects=(dataclasses.replace(hidden.effects[0], at=tuple(places)),))


def test_located_right_counts_effects_with_several_ports():
    reported = finding("coulomb_friction") | {"channels": ["rate of speed"]}
    right, wrong = key_at(["rate of speed", "rate of turn"]), key_at(["rate of turn"])
    assert score([right], {"a": answer(reported)}).shares["at_port"].count == 1
    assert score([wrong], {"a": answer(reported)}).shares["at_port"].count == 0
    assert score([wrong], {"a": answer(reported)}).shares["driver"].total == 0
    assert score([key("a")], {"a": answer(finding("hard_iron_step"))}).shares["at_port"].total == 0


def test_an_inseparable_rival_is_right_at_its_port_only():
    rival = KeyRival("linear_drag", (), 3.0, ("rate of speed",))
    hidden = key_at(["rate of turn"])
    hidden = dataclasses.replace(hidden, effects=(dataclasses.replace(hidden.effects[0], inseparable=(rival,)),))
    for place, right in (("rate of speed", 1), ("rate of lift", 0)):
        result = score([hidden], {"a": answer(finding("linear_drag") | {"channels": [place]})})
        assert (result.shares["named"].count, result.shares["at_port"].count) == (right, right)


def test_thresholds_can_be_replaced():
    thresholds = (Threshold("at_port", 0.5, 1.0, "somewhere"),)
    reported = finding("coulomb_friction") | {"channels": ["rate of turn"]}
    (found,) = score([key_at(["rate of turn"])], {"a": answer(reported)}, thresholds=thresholds).measured
    assert found.holds


def test_the_second_ratio_is_the_median_of_detectable_cases():
    keys = [key("a"), key("b"), key("c"), key("weak", z=3.0, z_sep=3.0)]
    result = score(keys, {}, {"a": 1.0, "b": 1.02, "c": math.inf, "weak": 9.0})
    assert measured(result, "second_ratio").value == pytest.approx(1.02)


def test_an_empty_score_holds_no_threshold_and_is_json():
    result = score([], {})
    assert not any(m.holds for m in result.measured)
    json.dumps(result.numbers(), allow_nan=False)


def test_thresholds_have_unique_measures_and_inclusive_ranges():
    assert len({threshold.measure for threshold in THRESHOLDS}) == len(THRESHOLDS)
    assert all(threshold.measure in SHARES or hasattr(Score, threshold.measure) for threshold in THRESHOLDS)
    inside = Threshold("a", 0.85, 0.95, "")
    assert inside.holds(0.85)
    assert inside.holds(0.95)
    assert not inside.holds(0.96)
    assert not inside.holds(math.nan)
