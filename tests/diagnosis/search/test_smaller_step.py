"""The integration step is halved until the result does not change."""

import math

import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit, at_half_step
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.estimate import with_smaller_step
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects.dynamics import HiddenMode
from mkc_torch.recording import Recording
from mkc_torch.simulation import Dynamics, Parameter

SHARE, PERIOD, DAMPING, INERTIA, LOSS = 0.8, 0.14, 0.03, 0.012, 0.012
STEP, SAMPLES, PARTS = 0.02, 200, 60


class Drive(Dynamics):
    """A motor and its load as a rigid body."""

    states = ("speed",)
    inputs = ("torque",)
    units = {"speed": "rad/s"}
    parameters = {"inertia": Parameter(0.02, lower=1e-4), "damping": Parameter(0.01, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"speed": (u.torque - p.damping * x.speed) / p.inertia}


class GivenStep(Drive):
    step = 0.02


@pytest.fixture(scope="module")
def recording():
    """Return a recording of a motor whose load is on a flexible shaft, integrated at 1/60 of the sampling interval."""
    generator = torch.Generator().manual_seed(1)
    torque = 0.2 * torch.randn(SAMPLES, generator=generator, dtype=torch.float64)
    omega, h = 2.0 * math.pi / PERIOD, STEP / PARTS

    def rates(v, w, s, u):
        force = omega * omega * s + 2.0 * DAMPING * omega * (w - v)
        return (u - LOSS * v) / INERTIA + SHARE * force, -force, w - v

    v = w = s = 0.0
    speeds, torques = [], torque.tolist()
    for k in range(SAMPLES):
        speeds.append(v)
        for part in range(PARTS):
            share = (part + 0.5) / PARTS
            u = (1.0 - share) * torques[k] + share * torques[min(k + 1, SAMPLES - 1)]
            a = rates(v, w, s, u)
            b = rates(v + 0.5 * h * a[0], w + 0.5 * h * a[1], s + 0.5 * h * a[2], u)
            v, w, s = v + h * b[0], w + h * b[1], s + h * b[2]
    speed = torch.tensor(speeds, dtype=torch.float64)
    speed = speed + 0.005 * speed.std() * torch.randn(SAMPLES, generator=generator, dtype=torch.float64)
    return Recording({"time": STEP * torch.arange(SAMPLES).double(), "torque": torque, "speed": speed})


def fit_of(prepared, period=PERIOD):
    port = "resonant rate of speed"
    assert port in prepared.ports
    term = Term(HiddenMode(), None, {"period": period, "damping": DAMPING}, port)
    start = torch.tensor([INERTIA, LOSS, 0.0, SHARE], dtype=torch.float64)
    return fitted(JointModel(prepared, (term,)), start)


def test_the_step_is_halved_while_that_changes_a_size(recording):
    prepared, noise = Drive().prepare(recording), Settings().noise
    assert prepared.parts == 1
    sizes = [float(fit_of(prepared).parameters[-1])]
    while (finer := with_smaller_step(fit_of(prepared), noise)) is not None:
        assert finer.parts == 2 * prepared.parts
        assert len(finer.grid.time) == finer.parts * (SAMPLES - 1) + 1
        prepared = finer
        sizes.append(float(fit_of(prepared).parameters[-1]))
    assert prepared.parts >= 2
    assert abs(sizes[-1] - SHARE) < 0.01
    assert abs(sizes[0] - SHARE) > abs(sizes[-1] - SHARE)


def test_a_step_set_by_the_user_is_kept(recording):
    prepared = GivenStep().prepare(recording)
    assert prepared.finer() is None
    assert with_smaller_step(fit_of(prepared), Settings().noise) is None


def test_the_smallest_step_is_an_eighth_of_the_sampling(recording):
    drive = Drive().prepare(recording)
    assert drive.finer().finer().finer().parts == 8
    assert drive.finer().finer().finer().finer() is None


@pytest.mark.e2e
def test_the_sizes_of_a_flexible_shaft_do_not_depend_on_the_sampling(recording):
    finding = diagnose(Drive(), recording, surrogates=19).findings[0]
    assert finding.effect == "hidden_mode"
    sizes = {p.name: (p.value, p.standard_error) for p in finding.parameters}
    for name, truth in {"share": SHARE, "period": PERIOD, "damping": DAMPING}.items():
        value, error = sizes[name]
        assert abs(value - truth) < max(3.0 * error, 0.01 * truth), name


def test_the_simulation_alone_is_fitted_again_with_half_the_step(recording):
    alone = fitted(JointModel(Drive().prepare(recording)), torch.tensor([INERTIA, LOSS, 0.0], dtype=torch.float64))
    again = at_half_step(ProcessNoiseFit(alone, alone, None))
    assert again.fit is again.free
    assert again.fit.model.prepared.parts == 2 * alone.model.prepared.parts
    torch.testing.assert_close(again.fit.parameters, alone.parameters, rtol=0.05, atol=0.05)
    given = fitted(JointModel(GivenStep().prepare(recording)), alone.parameters)
    assert at_half_step(ProcessNoiseFit(given, given, None)) is None
