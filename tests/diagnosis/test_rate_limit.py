"""A servo with a largest speed is named, with its speed, among effects that act alike."""

import numpy as np
import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics, Parameter

AT_INPUTS = [effect for effect in DYNAMICS if effect.port == "input" and not effect.roles]


class Flap(Dynamics):
    """A flap that a spring holds at a commanded angle."""

    states, inputs, outputs = ("angle", "speed"), ("command",), ("angle",)
    units = {"angle": "rad", "speed": "rad/s", "command": "rad"}
    parameters = {"stiffness": Parameter(60.0, lower=0.0), "damping": Parameter(9.0, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": p.stiffness * (u.command - x.angle) - p.damping * x.speed}


def commands(kind, time, random):
    if kind == "steps":
        return np.repeat(random.uniform(-0.6, 0.6, 10), len(time) // 10)
    return 0.5 * np.sin(2.0 * np.pi * (0.1 + 0.06 * time) * time)


def recorded(kind, fastest, seed=0):
    """A recording at 50 Hz; the actuator moves no faster than ``fastest``, in rad/s."""
    random, step = np.random.default_rng(seed), 0.002
    time = np.arange(5000) * step
    command = commands(kind, time, random)
    held, angle, speed, seen = command[0], command[0], 0.0, []
    for u in command:
        seen.append(angle)
        held += np.clip(u - held, -fastest * step, fastest * step)
        speed += step * (60.0 * (held - angle) - 9.0 * speed)
        angle += step * speed
    columns = {"time": time, "command": command, "angle": seen + 0.001 * random.standard_normal(len(time))}
    return Recording({name: torch.tensor(values[::10]) for name, values in columns.items()})


@pytest.mark.e2e
@pytest.mark.parametrize(("kind", "fastest"), [("steps", 1.5), ("chirp", 1.0)])
def test_a_largest_speed_is_named_with_its_value(kind, fastest):
    (finding,) = diagnose(Flap(), recorded(kind, fastest), effects=AT_INPUTS, quick=True).findings
    assert finding.effect == "input_rate_limit"
    sizes = {parameter.name: parameter for parameter in finding.parameters}
    assert sizes["rate"].value == pytest.approx(fastest, rel=0.03)
    assert sizes["rate"].unit == "rad/s"
    assert sizes["share"].value == pytest.approx(1.0, abs=0.05)
