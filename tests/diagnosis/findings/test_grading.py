"""The grade of a finding."""

import dataclasses

import pytest
import torch

from mkc_torch.diagnosis.environment import ShapeCheck
from mkc_torch.diagnosis.result import EffectParameter, EvidenceResult, Finding, HeldOut
from mkc_torch.diagnosis.vetoes import VETOES, VetoContext, decisions_on, grade, is_dropped, is_zero_within_error

IN_SHORT = VetoContext(in_short=True)
SURE = (EvidenceResult("held_out", (HeldOut(0.3, (0.2, 0.4), 2.0, 1.0, "µT"), "")),)


def grade_of(found, context=VetoContext()):  # noqa: B008 - frozen
    return grade(decisions_on(found, context))


def finding(*numbers):
    parameters = tuple(EffectParameter(f"number {k}", value, error, "") for k, (value, error) in enumerate(numbers))
    return Finding("coupling", (), (), (), None, "", "", parameters, 0.01, (), True, "", evidence=SURE)


@pytest.mark.parametrize(
    ("numbers", "none"),
    [
        (((0.3, 0.1),), False),
        (((0.0, 0.1),), True),
        (((0.0, 0.1), (0.5, 0.1)), False),
        (((0.0, 0.1), (12.0, None)), True),
        (((12.0, None),), False),
        (((torch.tensor([0.1, 0.2]), torch.tensor([0.3, 0.3])),), True),
        (((torch.tensor([0.1, 0.9]), torch.tensor([0.3, 0.3])),), False),
    ],
)
def test_a_size_of_zero_is_unconfirmed_whatever_held_out_blocks_show(numbers, none):
    found = finding(*numbers)
    assert is_zero_within_error(found) is none
    assert grade_of(found) == ("unconfirmed" if none else "left_out")


def test_a_size_with_a_flat_likelihood_is_not_zero():
    """A second store of ten or thirty times the first: the data only exclude a store of size 0."""
    found = dataclasses.replace(finding((8.4, 13.8), (45000.0, None)), clearly_better=True)
    assert not is_zero_within_error(found)
    assert grade_of(found) == "left_out"
    assert grade_of(dataclasses.replace(found, clearly_better=False)) == "unconfirmed"


def test_a_size_that_ended_at_its_bound_of_zero_is_not_confirmed():
    """A conditional estimate at a bound has no standard error, and the noise model alone made the difference."""
    found = dataclasses.replace(finding((0.0, 0.0), (10.0, None)), clearly_better=True)
    assert is_zero_within_error(found)
    assert grade_of(found) == "unconfirmed"
    assert not is_zero_within_error(finding((0.0, 0.0), (2.0, 0.1)))


def test_an_effect_of_unknown_share_and_known_period_is_unconfirmed():
    """A hidden mode of share 0.5 ± 1 and period 0.45 ± 0.07 s."""
    share, period = EffectParameter("share", 0.5, 1.0, ""), EffectParameter("period", 0.45, 0.07, "s", of_shape=True)
    found = dataclasses.replace(finding(), parameters=(share, period))
    assert grade_of(found) == "unconfirmed"
    assert (
        grade_of(dataclasses.replace(found, parameters=(dataclasses.replace(share, value=1.5), period))) == "left_out"
    )


def finding_of_rmse_after(after, **known):
    return (EvidenceResult("held_out", (HeldOut(0.3, (0.2, 0.4), 1.0, after, "rad", **known), "")),)


@pytest.mark.parametrize(("after", "expected"), [(0.9, "left_out"), (0.96, "unconfirmed"), (4.7, "unconfirmed")])
def test_a_size_of_zero_within_its_error_is_confirmed_only_by_a_smaller_held_out_residual(after, expected):
    """The likelihood with the residual's correlation can rise for a residual that grows slowly, or is the same."""
    found = dataclasses.replace(finding((1.3, 5.5), (0.04, None)), clearly_better=True)
    assert grade_of(dataclasses.replace(found, evidence=finding_of_rmse_after(after))) == expected


def test_under_process_noise_a_finding_without_an_open_loop_gain_is_unconfirmed():
    """Process noise predicts one step ahead with any effect."""
    found = dataclasses.replace(finding((1.3, 0.1)), evidence=finding_of_rmse_after(1.01, decides=False))
    assert grade_of(found) == "unconfirmed"
    assert grade_of(dataclasses.replace(found, evidence=finding_of_rmse_after(0.99, decides=False))) == "small"
    assert grade_of(dataclasses.replace(found, clearly_better=True)) == "small"
    (blocks,) = finding_of_rmse_after(0.98, decides=False)
    held = dataclasses.replace(blocks.value[0], log_likelihood_gain=0.002, confidence_interval=(-0.007, 0.011))
    unsure = dataclasses.replace(found, evidence=(EvidenceResult("held_out", (held, "")),))
    assert grade_of(unsure) == "unconfirmed"
    assert grade_of(dataclasses.replace(unsure, clearly_better=True)) == "small"


@pytest.mark.parametrize(("rmse", "after"), [(1.0, "nearest"), (1.92, "nearest"), (2.0, "unconfirmed")])
def test_a_finding_of_another_shape_is_nearest_or_unconfirmed(rmse, after):
    held = HeldOut(0.3, (0.2, 0.4) if rmse < 2.0 else (-0.1, 0.7), 2.0, rmse, "µT")
    found = dataclasses.replace(finding((0.3, 0.1)), evidence=(EvidenceResult("held_out", (held, "")),))
    before = grade_of(found)
    assert before == {1.0: "left_out", 1.92: "small", 2.0: "unconfirmed"}[rmse]
    assert grade_of(dataclasses.replace(found, shape=ShapeCheck(40.0, 0.002, object(), needed=12.0))) == after
    assert grade_of(dataclasses.replace(found, shape=ShapeCheck(0.5, 0.4))) == before


@pytest.mark.parametrize(
    ("gain", "after", "expected"), [(0.1, 0.9, "left_out"), (0.1, 0.97, "unconfirmed"), (-0.01, 0.9, "unconfirmed")]
)
def test_held_out_likelihood_and_residual_confirm_a_finding_whose_gain_interval_includes_zero(gain, after, expected):
    held = HeldOut(gain, (-0.2, 0.3), 1.0, after, "rad")
    found = dataclasses.replace(finding((1.3, 0.1)), evidence=(EvidenceResult("held_out", (held, "")),))
    assert grade_of(found) == expected
    assert grade_of(found, IN_SHORT) == "unconfirmed"  # without surrogates it may be chance


@pytest.mark.parametrize(
    ("changes", "rule", "expected"),
    [
        ({"p_value": 0.2}, "p_value", "unconfirmed"),
        ({"cannot_be": True, "times_plausible": 12.0}, "size_plausible", "unconfirmed"),
        ({"shown_share": 0.04}, "visible", "unconfirmed"),
        ({"shape": ShapeCheck(40.0, 0.002, object(), needed=12.0)}, "shape", "nearest"),
    ],
)
def test_a_single_failed_veto_lowers_the_grade(changes, rule, expected):
    found = dataclasses.replace(finding((0.3, 0.1)), **changes)
    decisions = decisions_on(found)
    assert [decision.rule for decision in decisions if not decision.passed] == [rule]
    assert grade(decisions) == grade(decisions[::-1]) == expected
    assert not is_dropped(decisions)


def test_decisions_are_in_the_order_of_the_vetoes_and_name_the_finding():
    found = dataclasses.replace(finding((0.3, 0.1)), channels=("rate of speed",), times_plausible=0.3, shown_share=0.5)
    decisions = decisions_on(found, VetoContext(number=2))
    order = [veto.__name__ for veto in VETOES]
    assert [order.index(decision.rule) for decision in decisions] == sorted(
        order.index(decision.rule) for decision in decisions
    )
    assert {(decision.subject, decision.finding) for decision in decisions} == {("coupling@speed", 2)}
    assert all(decision.sentence.endswith(".") for decision in decisions)


def test_a_quick_look_confirms_by_sure_held_out_blocks_only():
    sure = dataclasses.replace(finding((0.3, 0.1)), p_value=None)
    assert grade_of(sure, IN_SHORT) == "left_out"
    assert grade_of(dataclasses.replace(sure, evidence=()), IN_SHORT) == "unconfirmed"
    assert grade_of(dataclasses.replace(sure, evidence=())) == "left_out"
    freely = dataclasses.replace(sure, evidence=finding_of_rmse_after(0.5, decides=False))
    assert (grade_of(freely, IN_SHORT), grade_of(freely)) == ("unconfirmed", "left_out")
