"""A damped oscillator with process noise: its exact flow, and recordings with known disturbances."""

from dataclasses import replace

import numpy as np
import torch
from scipy.linalg import expm

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.kalman import Flow

STIFFNESS, DAMPING = 9.0, 0.6
SLOPE = np.array([[0.0, 1.0], [-STIFFNESS, -DAMPING]])
STEP = 0.05


class Oscillator(Dynamics):
    states = ("position", "speed")
    outputs = ("position",)
    parameters = {
        "stiffness": Parameter(STIFFNESS, lower=0.0),
        "damping": Parameter(DAMPING, lower=0.0),
    }

    def derivative(self, time, x, u, p):
        return {"position": x.speed, "speed": -p.stiffness * x.position - p.damping * x.speed}


def oscillator(**attributes):
    """Return an oscillator with other attributes."""
    return type("Oscillator", (Oscillator,), attributes)()


def theta_of(prepared):
    """Return the true parameters; each run starts at 0 with speed 0."""
    return torch.tensor([STIFFNESS, DAMPING] + [0.0] * prepared.beginnings, dtype=torch.float64)


def held(slope, step):
    """Exact transition, (n, n), and response to a constant disturbance of the last rate, (n, 1), over a step."""
    n = len(slope)
    joined = np.zeros((n + 1, n + 1))
    joined[:n, :n], joined[n - 1, n] = slope, 1.0
    found = expm(joined * step)
    return found[:n, :n], found[:n, n:]


def flow(count, seen=((1.0, 0.0),), runs=1, step=STEP):
    """Return the flow of the oscillator at 0 with residual 0, disturbed at the rate of its speed."""
    seen = np.atleast_2d(seen)
    A, B = held(SLOPE, step)
    N = count * runs
    inside = np.arange(1, N) % count > 0
    return Flow(
        np.where(inside[:, None, None], A, 0.0),
        np.where(inside[:, None, None], B, 0.0),
        np.broadcast_to(seen, (N, *seen.shape)).copy(),
        np.zeros((N, len(seen))),
        np.zeros((N - 1, 2)),
        np.where(inside, step, 0.0),
        np.ones((N, len(seen))),
        np.ones(2),
    )


def course(random, flow, lasting, size):
    """Return a random disturbance at the samples, (N,), white or with a time constant, independent in each run."""
    shock = size * random.standard_normal(len(flow.new))
    value = shock.copy()
    for row, step in enumerate(flow.step):
        if step > 0 and lasting > 0:
            kept = np.exp(-step / lasting)
            value[row + 1] = kept * value[row] + np.sqrt(1.0 - kept**2) * shock[row + 1]
    return value


def disturbed_states(flow, disturbance):
    """States that start at 0 under a disturbance that is constant between samples, (N, n)."""
    states = np.zeros((len(flow.new), flow.transition.shape[1]))
    for row in range(len(flow.step)):
        states[row + 1] = flow.transition[row] @ states[row] + flow.noise_input[row] @ np.atleast_1d(disturbance[row])
    return states


def with_residual(flow, states, noise=0.0):
    """Return the flow with the residual of these states and this noise."""
    return replace(flow, new=np.einsum("nij,nj->ni", flow.seen, states) + noise)


def recorded(flow, runs=1, **columns):
    """Return a table of columns at a flow's samples."""
    count = len(flow.new) // runs
    step = flow.step[flow.step > 0][0]
    table = {"time": torch.from_numpy(np.tile(np.arange(count) * step, runs))}
    if runs > 1:
        table["experiment"] = torch.arange(runs).repeat_interleave(count)
    return Recording(table | {name: torch.as_tensor(np.ascontiguousarray(values)) for name, values in columns.items()})
