"""A damped oscillator that is pushed: its flow by the matrix exponential, and recordings whose pushes are known."""

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
    parameters = {  # noqa: RUF012
        "stiffness": Parameter(STIFFNESS, lower=0.0),
        "damping": Parameter(DAMPING, lower=0.0),
    }

    def derivative(self, time, x, u, p):  # noqa: ARG002
        return {"position": x.speed, "speed": -p.stiffness * x.position - p.damping * x.speed}


def oscillator(**attributes):
    """An oscillator with other attributes."""
    return type("Oscillator", (Oscillator,), attributes)()


def theta_of(prepared):
    """The true parameters, with runs that begin at rest."""
    return torch.tensor([STIFFNESS, DAMPING] + [0.0] * prepared.beginnings, dtype=torch.float64)


def held(slope, step):
    """What a step makes of states, and of a push of the last rate that is held: (n, n) and (n, 1)."""
    n = len(slope)
    joined = np.zeros((n + 1, n + 1))
    joined[:n, :n], joined[n - 1, n] = slope, 1.0
    found = expm(joined * step)
    return found[:n, :n], found[:n, n:]


def flow(count, seen=((1.0, 0.0),), runs=1, step=STEP):
    """The oscillator at rest, its speed's rate pushed: so many samples in each of so many runs, and no residual yet."""
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
    """A random push at the samples, (N,), that forgets itself in a time or at once; anew in each run."""
    shock = size * random.standard_normal(len(flow.new))
    value = shock.copy()
    for row, step in enumerate(flow.step):
        if step > 0 and lasting > 0:
            kept = np.exp(-step / lasting)
            value[row + 1] = kept * value[row] + np.sqrt(1.0 - kept**2) * shock[row + 1]
    return value


def pushed(flow, push):
    """States that begin at rest and are pushed from each sample to the next, (N, n)."""
    states = np.zeros((len(flow.new), flow.carried.shape[1]))
    for row in range(len(flow.step)):
        states[row + 1] = flow.carried[row] @ states[row] + flow.pushed[row] @ np.atleast_1d(push[row])
    return states


def answering(flow, states, noise=0.0):
    """The flow with the residual that such states and such a noise leave."""
    return replace(flow, new=np.einsum("nij,nj->ni", flow.seen, states) + noise)


def recorded(flow, runs=1, **columns):
    """A table of columns at a flow's samples."""
    count = len(flow.new) // runs
    step = flow.step[flow.step > 0][0]
    table = {"time": torch.from_numpy(np.tile(np.arange(count) * step, runs))}
    if runs > 1:
        table["experiment"] = torch.arange(runs).repeat_interleave(count)
    return Recording(table | {name: torch.as_tensor(np.ascontiguousarray(one)) for name, one in columns.items()})
