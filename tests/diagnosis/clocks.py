"""Recordings of a driven mass on a spring whose sensor has a clock of another rate, or whose input is late."""

import numpy as np
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter

STEP = 0.05
"""Sampling time in s."""


class Stage(Dynamics):
    """A mass on a spring with a damper, driven by a force."""

    states, inputs, outputs = ("position", "velocity"), ("force",), ("position",)
    units = {"position": "m", "velocity": "m/s", "force": "N"}
    parameters = {
        "mass": Parameter(1.2, lower=0.1),
        "stiffness": Parameter(6.0, lower=0.0),
        "damping": Parameter(0.8, lower=0.0),
    }

    def derivative(self, time, x, u, p):
        force = u.force - p.stiffness * x.position - p.damping * x.velocity
        return {"position": x.velocity, "velocity": force / p.mass}


def stage_recording(seed, N=800, *, rate=0.0, late=0, noise=0.004):
    """Return a recording of a stage.

    Args:
        seed: of the force and the noise.
        N: number of samples.
        rate: share by which the clock of the sensor runs fast.
        late: samples by which the force acts later than its column shows; negative for earlier.
        noise: standard deviation in m.
    """
    random = np.random.default_rng(seed)
    time = STEP * np.arange(N + 100)
    force = np.convolve(random.standard_normal(len(time)), np.ones(8) / 8**0.5, "same")

    def rates(t, x):
        return [x[1], (np.interp(t, time, force) - 6.6 * x[0] - 0.7 * x[1]) / 1.1]

    solved = solve_ivp(rates, (0.0, time[-1]), [0.1, 0.0], dense_output=True, rtol=1e-8, atol=1e-9, max_step=STEP)
    at = time[50] + STEP * np.arange(N) / (1.0 + rate)
    position = solved.sol(at)[0] + noise * random.standard_normal(N)
    shown = force[50 + late : 50 + late + N]
    columns = {"time": STEP * np.arange(N), "force": shown, "position": position}
    return Recording({name: torch.as_tensor(values) for name, values in columns.items()})
