"""A driven pendulum with an unrecorded disturbance, integrated independently, and fits to it."""

import functools
import math

import numpy as np
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import choose_input_hold, fit_alone
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.first_fit import strong_observer
from mkc_torch.simulation.dynamics.flow import flow_of
from mkc_torch.simulation.dynamics.noise_selection import observer_of
from mkc_torch.simulation.dynamics.observer import Disturbance

STEP, FINE, NOISE = 0.05, 4, 0.004


class Pendulum(Dynamics):
    """``rate' = torque - stiffness sin(angle) - damping rate``, driven by a torque that is held between samples."""

    states = ("angle", "rate")
    inputs = ("torque",)
    outputs = ("angle",)
    units = {"angle": "rad", "rate": "rad/s"}
    parameters = {"stiffness": Parameter(7.0, lower=0.0), "damping": Parameter(0.3, lower=0.0)}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        return {"angle": x.rate, "rate": u.torque - p.stiffness * torch.sin(x.angle) - p.damping * x.rate}


class UpsideDown(Pendulum):
    """The angle is measured from the wrong end: gravity drives it away."""

    def derivative(self, time, x, u, p):
        return {"angle": x.rate, "rate": u.torque + p.stiffness * torch.sin(x.angle) - p.damping * x.rate}


def walk(random, n, samples):
    """Return a random course of variance 1 with a correlation time of that many samples."""
    kept = math.exp(-1.0 / samples) if samples > 0 else 0.0
    course = np.zeros(n)
    for k in range(n):
        course[k] = kept * course[max(k - 1, 0)] + math.sqrt(1.0 - kept**2) * random.standard_normal()
    return course


@functools.cache
def pendulum_recording(disturbance="none", seed=0, N=500, drag=0.0, effect=1.0, late=0):
    """Return a recording and the disturbance of its rate; the disturbance is "none", "white", "slow" or "torque".

    Args:
        disturbance: "white" is independent at each sample, of 0.4 rad/s²; "slow" has a correlation time of 1 s, of
            0.3 rad/s²; "torque" follows the torque.
        seed: seed of the random draws.
        N: number of samples.
        drag: hidden quadratic drag, in 1/rad.
        effect: factor of the torque, -1 for the wrong sign.
        late: delay of the torque in samples.
    """
    random = np.random.default_rng(seed)
    torque = 1.5 * walk(random, N, 12)
    acting = effect * np.concatenate([np.zeros(late), torque])[:N]
    if disturbance == "white":
        added = 0.4 * random.standard_normal(N)
    elif disturbance == "slow":
        added = 0.3 * walk(random, N, 1.0 / STEP)
    else:
        added = np.zeros(N) if disturbance == "none" else 0.4 * np.concatenate([np.zeros(6), torque[:-6]])
    x, h, angle = np.array([0.3, 0.0]), STEP / FINE, np.zeros(N)

    def rate(x, k):
        own = -9.0 * math.sin(x[0]) - 0.15 * x[1] - drag * x[1] * abs(x[1])
        return np.array([x[1], acting[k] + added[k] + own])

    for k in range(N):
        angle[k] = x[0]
        for _ in range(FINE):
            a = rate(x, k)
            b = rate(x + h / 2 * a, k)
            c = rate(x + h / 2 * b, k)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, k))
    columns = {"time": STEP * np.arange(N), "torque": torque, "angle": angle + NOISE * random.standard_normal(N)}
    recording = Recording({name: torch.from_numpy(column) for name, column in columns.items()}, name="swing")
    return recording, torch.from_numpy(added)


def fitted_under_noise(recording, system=Pendulum):
    """Fit a simulation without effects, under its most likely noise."""
    prepared = system().prepare(recording).with_input_hold({"torque": "held"})
    baseline = fit_alone(prepared, {}, NoiseSettings())
    return choose_input_hold(baseline, {}, {"torque": "held"}, NoiseSettings(), lambda _: 0.0)  # the hold is known


@functools.cache
def fitted_pendulum(disturbance="none", seed=0, N=500, drag=0.0):
    """Fit a recording of :func:`pendulum_recording`."""
    return fitted_under_noise(pendulum_recording(disturbance, seed, N, drag)[0])


@functools.cache
def pendulum_at_truth(disturbance="white", seed=0):
    """Return a pendulum of :func:`pendulum_recording` at its true parameters, under the drawn disturbance."""
    prepared = Pendulum().prepare(pendulum_recording(disturbance, seed)[0])
    theta = torch.tensor([9.0, 0.15, 0.3, 0.0], dtype=torch.float64)
    prepared = prepared.observed(strong_observer(prepared, theta, 10.0))
    flow = flow_of(prepared, theta, {}, None)
    size, correlation_time = (0.4, 0.0) if disturbance == "white" else (0.3, 1.0)
    sensor = torch.tensor([NOISE], dtype=torch.float64)
    disturbances = (Disturbance("rate", True, correlation_time, size),)
    observer = observer_of(flow, disturbances, sensor, prepared.disturbable, prepared.channels)
    model = JointModel(prepared.observed(observer))
    residual = model.residual(theta).detach()
    d = residual.std(0)
    return FittedModel(model, theta, d, torch.full_like(d, torch.inf), 20.0 * d, residual, residual * 0 + 1, 0.0, True)


def candidates(fit, effects):
    """Return the candidates for a search at a fit."""
    return candidate_terms(fit.model.prepared.open_loop(), (), effects)
