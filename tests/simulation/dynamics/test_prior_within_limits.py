"""Two finite limits of a parameter are a prior with the moments of a uniform distribution between them."""

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter


def prepared(**parameters):
    class Falling(Dynamics):
        states = ("height", "speed")
        outputs = ("height",)

        def derivative(self, time, x, u, p):
            return {"height": x.speed, "speed": -p.gravity - p.drag * x.speed}

    Falling.parameters = parameters
    time = 0.1 * torch.arange(40, dtype=torch.float64)
    return Falling().prepare(Recording({"time": time, "height": 100.0 - 4.9 * time.square()}))


def test_only_a_parameter_with_two_limits_has_a_prior():
    prior = prepared(gravity=Parameter(9.81, lower=9.7, upper=9.9), drag=Parameter(0.1, lower=0.0)).prior
    assert prior.mean.tolist() == pytest.approx([9.8, 0.0, 0.0, 0.0])
    assert prior.precision.tolist() == pytest.approx([12.0 / 0.04, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("upper", [9.81, torch.inf])
def test_without_a_range_between_two_limits_there_is_no_prior(upper):
    assert prepared(gravity=Parameter(9.81, lower=9.81, upper=upper), drag=Parameter(0.1, lower=0.0)).prior is None
