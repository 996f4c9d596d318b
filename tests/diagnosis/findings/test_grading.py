"""The grade of a finding."""

import dataclasses

import pytest
import torch

from mkc_torch.diagnosis.environment import ShapeCheck
from mkc_torch.diagnosis.findings.grading import grade_in_short, grade_of, is_zero_within_error, with_shape
from mkc_torch.diagnosis.result import EffectParameter, EvidenceResult, Finding, HeldOut

SURE = (EvidenceResult("held_out", (HeldOut(0.3, (0.2, 0.4), 2.0, 1.0, "µT"), "")),)


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


@pytest.mark.parametrize(("after", "grade"), [(0.9, "left_out"), (0.96, "unconfirmed"), (4.7, "unconfirmed")])
def test_a_size_of_zero_within_its_error_is_confirmed_only_by_a_smaller_held_out_residual(after, grade):
    """The likelihood with the residual's correlation can rise for a residual that grows slowly, or is the same."""
    found = dataclasses.replace(finding((1.3, 5.5), (0.04, None)), clearly_better=True)
    assert grade_of(dataclasses.replace(found, evidence=finding_of_rmse_after(after))) == grade


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


@pytest.mark.parametrize(
    ("before", "after"), [("left_out", "nearest"), ("small", "nearest"), ("unconfirmed", "unconfirmed")]
)
def test_a_finding_of_another_shape_is_nearest_or_unconfirmed(before, after):
    curve = object()
    assert with_shape(before, ShapeCheck(40.0, 0.002, curve)) == after
    assert with_shape(before, ShapeCheck(0.5, 0.4)) == with_shape(before, None) == before


@pytest.mark.parametrize(
    ("gain", "after", "grade"), [(0.1, 0.9, "left_out"), (0.1, 0.97, "unconfirmed"), (-0.01, 0.9, "unconfirmed")]
)
def test_held_out_likelihood_and_residual_confirm_a_finding_whose_gain_interval_includes_zero(gain, after, grade):
    held = HeldOut(gain, (-0.2, 0.3), 1.0, after, "rad")
    found = dataclasses.replace(finding((1.3, 0.1)), evidence=(EvidenceResult("held_out", (held, "")),))
    assert grade_of(found) == grade
    assert grade_in_short(found) == "unconfirmed"  # without surrogates it may be chance
