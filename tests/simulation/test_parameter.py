"""Valid and invalid parameters of simulations."""

import math

import pytest

from mkc_torch.simulation import Parameter, SimulationError
from mkc_torch.simulation.parameter import known_parameters


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"value": "a"},
            TypeError,
            r"`value` to be a number in \(-inf, inf\) but got 'a'; it is what the fit starts from",
        ),
        ({"value": math.nan}, ValueError, "`value` to be in .* but got nan"),
        ({"value": math.inf}, ValueError, "`value` to be in .* but got inf"),
        ({"value": 1.0, "lower": "a"}, TypeError, "`lower` to be a number in .* it is infinite for no bound"),
        ({"value": 1.0, "upper": math.nan}, ValueError, "`upper` to be in .* but got nan"),
        ({"value": 1.0, "lower": 2.0, "upper": 0.0}, ValueError, "`lower` to be at most `upper` but got 2.0 and 0.0"),
        ({"value": -1.0, "lower": 0.1}, ValueError, r"`value` to lie in \[0.1, inf\], its own bounds, but got -1.0"),
        ({"value": 1.0, "unit": 3}, TypeError, "`unit` to be text but got 3; write '1/s' say"),
    ],
)
def test_invalid_parameters_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        Parameter(**arguments)


def test_numbers_become_parameters_and_other_values_are_refused_by_name():
    bounded = Parameter(1.0, lower=0.0)
    assert known_parameters("Line", {"slope": 2, "gain": bounded}) == {"slope": Parameter(2.0), "gain": bounded}
    for value in ("a", None, math.nan, [1.0]):
        with pytest.raises(
            SimulationError, match="Line: its parameter `slope` should be a finite number or a Parameter"
        ):
            known_parameters("Line", {"slope": value})
    with pytest.raises(
        SimulationError, match=r"Line: `parameters` should be names with their values, .* but is \('a',\)"
    ):
        known_parameters("Line", ("a",))
