"""Fitted values far from those that the user gave with an uncertainty."""

from __future__ import annotations

import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.simulation import Parameter
from mkc_torch.simulation.dynamics.unlikely import unlikely_checks
from tests.simulation.dynamics.test_impossible import heater
from tests.simulation.stepped.test_servo import STIFFNESS, Servo, followed


def checks_at(prepared, alone, found):
    number = 1  # of the time constant
    thetas = [prepared.given.clone(), prepared.given.clone()]
    thetas[0][number], thetas[1][number] = alone, found
    return unlikely_checks(prepared, *thetas)


def test_a_value_within_three_standard_deviations_passes():
    prepared = heater(tau=Parameter(60.0, uncertainty=5.0, unit="s"))
    assert checks_at(prepared, 74.0, 74.0) == ()


def test_a_value_without_an_uncertainty_passes():
    assert checks_at(heater(), 6e3, 6e3) == ()


@pytest.mark.parametrize(("with_effects", "advised"), [(62.0, False), (81.0, True)])
def test_a_value_farther_away_is_named_with_what_it_is_with_the_effects(with_effects, advised):
    prepared = heater(tau=Parameter(60.0, uncertainty=5.0, unit="s"))
    (check,) = checks_at(prepared, 80.0, with_effects)
    assert (check.kind, check.parameters, check.start) == ("unlikely value", ("tau",), 60.0)
    assert "ends at 80 without effects; given was 60 s, with a standard deviation of 5" in check.sentence
    assert f"it is {with_effects:.4g}" in check.sentence
    assert ("without letting it be fitted" in check.sentence) == advised


@pytest.mark.parametrize(("factor", "named"), [(7.0, False), (9.0, True), (1 / 7.0, False), (1 / 9.0, True)])
def test_a_positive_number_of_a_simulation_that_steps_is_compared_by_its_factor(factor, named):
    prepared = Servo().prepare(followed())
    theta = torch.tensor([factor * STIFFNESS])
    checks = unlikely_checks(prepared, theta, theta)
    assert [check.parameters for check in checks] == ([("stiffness",)] if named else [])
    assert all("within a factor of 2:" in check.sentence for check in checks)


@pytest.mark.e2e
@pytest.mark.parametrize(("stiffness", "named"), [(STIFFNESS / 15.0, True), (STIFFNESS, False)])
def test_a_servo_far_softer_than_given_is_in_the_diagnosis(stiffness, named):
    checks = diagnose(Servo(), followed(stiffness=stiffness), effects=(), quick=True).checks
    assert [(check.kind, check.parameters) for check in checks] == [("unlikely value", ("stiffness",))] * named
