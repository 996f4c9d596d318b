"""A tank with a loss by the square of its level, which the simulation lacks; integrated by SciPy."""

import functools

import numpy as np
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording
from mkc_torch.diagnosis.io.model import DiagnosedModel, own_parameters
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.validation.training import with_training
from mkc_torch.effects.dynamics import QuadraticDrag
from mkc_torch.simulation import Dynamics, Parameter

DRAIN, DRAG, NOISE = 0.3, 0.15, 0.005


class Tank(Dynamics):
    states = ("level",)
    inputs = ("inflow",)
    parameters = {"drain": Parameter(0.4, lower=0.0, unit="1/s")}
    units = {"level": "m", "inflow": "m/s"}

    def derivative(self, time, x, u, p):
        return {"level": u.inflow - p.drain * x.level}


def tank_recording(seed, *, drag=DRAG, samples=150, noise=NOISE, name="tank"):
    random = np.random.default_rng(seed)
    time = np.arange(samples) / 10.0
    inflow = 0.6 + 0.5 * np.sin(0.7 * time + random.uniform(0.0, 6.0)) + 0.2 * np.sin(2.1 * time)

    def rate(at, level):
        return np.interp(at, time, inflow) - DRAIN * level - drag * level * np.abs(level)

    start = [random.uniform(0.5, 2.0)]
    found = solve_ivp(rate, (0.0, time[-1]), start, t_eval=time, rtol=1e-10, atol=1e-10, max_step=0.1)
    level = found.y[0] + noise * random.standard_normal(samples)
    return Recording({"time": time, "inflow": inflow, "level": level}, name=name)


def two_runs(first, second):
    """Join two recordings as runs of a table, each with its own time."""
    columns = {name: torch.cat([first[name], second[name]]) for name in first.names}
    run = torch.cat([torch.zeros(len(first)), torch.ones(len(second))]).double()
    return Recording({**columns, "experiment": run}, name="runs")


def tank_model(recording, *, findings=True, system=None):
    """Return a model fitted to a recording: with the drag, or the simulation alone."""
    system = Tank() if system is None else system
    prepared = system.prepare(recording)
    alone = fitted(JointModel(prepared), prepared.start())
    terms = [Term(QuadraticDrag(), None, {}, "rate of level")] if findings else []
    gammas = [torch.tensor([DRAG]).double()] if findings else []
    baseline = own_parameters(prepared, alone.parameters)
    theta = torch.cat([torch.tensor([DRAIN]).double(), baseline[1:]]) if findings else baseline
    model = DiagnosedModel(prepared.name, prepared.state, theta, terms, gammas, system)
    return with_training(model, baseline, prepared.state, prepared.whole, prepared.channels)


@functools.cache
def usual_model(*, findings=True):
    return tank_model(tank_recording(0, drag=DRAG if findings else 0.0), findings=findings)
