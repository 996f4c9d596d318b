"""Checks of the arguments of a diagnosis."""

import math

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.declared import checked_input_hold, checked_noise
from mkc_torch.simulation import Static
from tests.diagnosis.swing import STEP, Pendulum


@pytest.mark.parametrize(
    ("noise", "error", "words"),
    [
        ({"angel": 0.1}, ValueError, r"got `angel`; they are `angle`, `rate`"),
        ({"angle": 0.0}, ValueError, r"noise\['angle'\]"),
        ({"angle": math.inf}, ValueError, r"noise\['angle'\]"),
        ({"angle": math.nan}, ValueError, r"noise\['angle'\]"),
        ({"angle": "0.1"}, TypeError, r"noise\['angle'\]"),
        (0.1, TypeError, "to be a dict such as"),
    ],
)
def test_invalid_noise_raises(noise, error, words):
    with pytest.raises(error, match=words):
        checked_noise(noise, ("angle", "rate"))


@pytest.mark.parametrize(
    ("between", "error", "words"),
    [
        ({"torque": "stepped"}, ValueError, "`torque` to be one of held, linear, smooth but got 'stepped'"),
        ({"torque": 1}, ValueError, "one of held, linear, smooth"),
        ({"force": "held"}, ValueError, "they are `torque`"),
        ("held", TypeError, "to be a dict such as"),
    ],
)
def test_invalid_input_holds_raise(between, error, words):
    with pytest.raises(error, match=words):
        checked_input_hold(between, ("torque",))


def test_input_holds_of_a_simulation_without_inputs_raise():
    with pytest.raises(ValueError, match="got `torque`; it has none"):
        checked_input_hold({"torque": "held"}, ())


def test_declarations_are_returned_and_optional():
    assert checked_noise({"angle": 1}, ("angle",)) == {"angle": 1.0}
    assert checked_noise(None, ("angle",)) == checked_input_hold(None, ()) == {}


def test_diagnose_checks_the_declarations():
    time = torch.arange(60) / 10.0
    heat = torch.sin(time)
    recording = Recording({"time": time, "temperature": heat, "voltage": 0.5 + heat})
    line = Static(torch.nn.Linear(1, 1), inputs=("temperature",), outputs=("voltage",))
    with pytest.raises(ValueError, match="they are `voltage`"):
        diagnose(line, recording, noise={"temperature": 0.1})
    # a static simulation has no input holds
    with pytest.raises(ValueError, match=r"inputs in the equations of this simulation.*got `temperature`; it has no"):
        diagnose(line, recording, input_hold={"temperature": "held"})


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_a_constant_output_raises_with_its_value(value):
    time = torch.arange(200, dtype=torch.float64) * STEP
    stuck = Recording({"time": time, "angle": torch.full_like(time, value), "torque": time.sin()})
    with pytest.raises(ValueError, match=rf"`angle` is {value:g} in all samples"):
        diagnose(Pendulum(), stuck)


def test_progress_of_another_type_raises():
    time = torch.arange(200, dtype=torch.float64) * STEP
    swinging = Recording({"time": time, "angle": time.cos(), "torque": time.sin()})
    with pytest.raises(TypeError, match=r"`progress`.*got 3"):
        diagnose(Pendulum(), swinging, progress=3)
