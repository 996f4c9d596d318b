"""Recordings of a hovering vehicle in closed loop, whose free run leaves the recording."""

import numpy as np
import torch

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter

STEP = 0.05
"""Sampling time in s."""


class Hover(Dynamics):
    """A vehicle whose thrust is proportional to its command; it falls over without a controller."""

    states, inputs, outputs = ("tilt", "rate"), ("command",), ("tilt", "rate")
    units = {"tilt": "rad", "rate": "rad/s"}
    input_hold = "held"
    parameters = {"gain": Parameter(4.0, lower=0.5), "toppling": Parameter(6.0, lower=0.5)}

    def derivative(self, time, x, u, p):
        return {"tilt": x.rate, "rate": p.toppling * x.tilt + p.gain * u.command}


class WrongSign(Hover):
    """A vehicle whose command acts in the wrong direction."""

    def derivative(self, time, x, u, p):
        return {"tilt": x.rate, "rate": p.toppling * x.tilt - p.gain * u.command}


def hover_recording(seed=0, N=600, *, friction=1.5, toppling=6.6, unrelated=False, noise=0.005):
    """Return a recording of a vehicle that a controller keeps upright, with dry friction, integrated in small steps.

    Args:
        seed: of the disturbances of the command and of the noise.
        N: number of samples.
        friction: deceleration by dry friction in rad/s2.
        toppling: in 1/s2.
        unrelated: whether the outputs are those of a recording with another seed.
        noise: standard deviation in rad and rad/s.
    """
    random = np.random.default_rng(seed)
    aim = np.convolve(random.standard_normal(N + 40), np.ones(20) / 20**0.5, "valid")[:N]
    tilt, rate, parts = 0.1, 0.0, 50
    rows = []
    for k in range(N):
        command = -6.0 * tilt - 2.0 * rate + 1.5 * aim[k]
        rows.append((command, tilt, rate))
        for _ in range(parts):
            force = toppling * tilt + 4.3 * command - friction * np.tanh(rate / 0.02)
            rate += STEP / parts * force
            tilt += STEP / parts * rate
    command, tilt, rate = np.array(rows).T
    if unrelated:
        other = hover_recording(seed + 1, N, noise=0.0)
        tilt, rate = other["tilt"].numpy(), other["rate"].numpy()
    shown = {"tilt": tilt + noise * random.standard_normal(N), "rate": rate + noise * random.standard_normal(N)}
    columns = {"time": STEP * np.arange(N), "command": command, **shown}
    return Recording({name: torch.as_tensor(values.copy()) for name, values in columns.items()})
