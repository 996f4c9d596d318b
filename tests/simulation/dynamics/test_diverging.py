"""A free run with the user's own values that does not stay finite is located."""

import numpy as np
import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.diverging import divergence_checks
from tests.simulation.stepped.test_servo import Servo, followed

TIME = torch.arange(0.0, 4.0, 0.02, dtype=torch.float64)


class Growing(Dynamics):
    """A quantity that grows by its square: from 1 it is infinite after 1 / rate."""

    states = ("size",)
    parameters = {"rate": Parameter(0.5, unit="1/s")}

    def derivative(self, time, x, u, p):
        return {"size": p.rate * x.size**2}


def stiff_servo():
    return type("Stiff", (Servo,), {"parameters": {"stiffness": Parameter(60e3, lower=0.0, uncertainty=40e3)}})()


def test_equations_without_a_finite_solution_are_named():
    recording = Recording({"time": TIME, "size": torch.ones_like(TIME)})
    (check,) = divergence_checks(Growing().prepare(recording))
    assert (check.kind, check.parameters) == ("diverges", ("size",))
    assert "the free run of `size` is not finite" in check.sentence


def test_the_time_and_a_step_that_is_too_long_are_named():
    recording = followed()
    (check,) = divergence_checks(stiff_servo().prepare(recording))
    assert check.parameters == ("angle",)
    assert "The time step, 0.01 s, may be too long" in check.sentence
    after = float(check.sentence.partition("not finite from ")[2].split(" s")[0])
    assert 0.5 < after < float(recording["time"][-1])


def test_a_finite_run_has_no_check():
    assert divergence_checks(Servo().prepare(followed())) == ()


@pytest.mark.e2e
def test_the_divergence_is_in_the_diagnosis_and_no_force_is_an_input_that_explains_nothing():
    found = diagnose(stiff_servo(), followed(), effects=(), quick=True)
    assert found.checks[0].kind == "diverges"
    assert not any("`moment`" in reason for reason in found.environment.reasons)
    assert np.isfinite(found.baseline.rmse)
