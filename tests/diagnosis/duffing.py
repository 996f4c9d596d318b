"""Recordings of a chaotic oscillator, which no free run follows."""

import numpy as np
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter

STEP = 0.1
"""Sampling time in s."""


class Duffing(Dynamics):
    """A beam between two magnets that is shaken (Moon & Holmes, J. Sound Vib. 65, 1979)."""

    states, inputs, outputs = ("deflection", "speed"), ("shaking",), ("deflection", "speed")
    units = {"deflection": "m", "speed": "m/s", "shaking": "m/s²"}
    parameters = {
        "pull": Parameter(1.1, lower=0.1),
        "stiffness": Parameter(0.9, lower=0.1),
        "damping": Parameter(0.2, lower=0.0),
    }

    def derivative(self, time, x, u, p):
        force = u.shaking + p.pull * x.deflection - p.stiffness * x.deflection**3 - p.damping * x.speed
        return {"deflection": x.speed, "speed": force}


class PullingBack(Duffing):
    """The same with forces of the wrong sign between beam and magnets."""

    def derivative(self, time, x, u, p):
        force = u.shaking - p.pull * x.deflection + p.stiffness * x.deflection**3 - p.damping * x.speed
        return {"deflection": x.speed, "speed": force}


def duffing_recording(seed=0, N=600, *, friction=0.15, noise=0.02, unrelated=False):
    """Return a recording with dry friction.

    Args:
        seed: of the shaking and the noise.
        N: number of samples.
        friction: deceleration by dry friction in m/s².
        noise: standard deviation in m and m/s.
        unrelated: whether the outputs are smooth random series.
    """
    random = np.random.default_rng(seed)
    time, phase = STEP * np.arange(N), random.uniform(0.0, 6.0)
    shaking = 0.6 * np.cos(1.2 * time + phase)

    def rates(t, x):
        force = np.interp(t, time, shaking) + x[0] - x[0] ** 3 - 0.12 * x[1] - friction * np.tanh(x[1] / 0.02)
        return [x[1], force]

    solved = solve_ivp(rates, (0.0, time[-1]), [0.3, 0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=STEP).y
    if unrelated:
        kernel = np.exp(-0.5 * (np.arange(-15, 16) / 5.0) ** 2)
        solved = np.stack([np.convolve(random.standard_normal(N), kernel, "same") for _ in range(2)])
    deflection, speed = solved + noise * random.standard_normal((2, N))
    columns = {"time": time, "shaking": shaking, "deflection": deflection, "speed": speed}
    return Recording({name: torch.as_tensor(values.copy()) for name, values in columns.items()})
