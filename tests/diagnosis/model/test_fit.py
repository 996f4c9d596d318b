"""Fits of a joint model."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import _finite_start, fitted, within_domain
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation import Dynamics, Parameter

NOISE = 0.002


class Decay(Dynamics):
    states = ("level",)
    parameters = {"rate": Parameter(0.5, lower=0.0)}
    step = 0.05

    def derivative(self, time, x, u, p):
        return {"level": -p.rate * x.level}


def test_the_scale_fits_the_final_residuals():
    """The initial residuals are as wide as the bursts of outliers, and the domain is far wider than both."""
    random, time = np.random.default_rng(0), np.arange(300) * 0.02
    level = np.exp(-0.7 * time) + NOISE * random.standard_normal(300)
    for first in range(20, 300, 60):
        level[first : first + 3] += NOISE * random.uniform(5.0, 50.0, 3) * random.choice([-1.0, 1.0], 3)
    prepared = Decay().prepare(Recording({"time": torch.from_numpy(time), "level": torch.from_numpy(level)}))
    model, bound = JointModel(prepared), torch.tensor([300.0 * NOISE], dtype=torch.float64)
    start = torch.tensor([0.72, 1.0], dtype=torch.float64)
    found = fitted(model, start, bound, graduate=False)
    assert abs(float(found.parameters[0]) - 0.7) < 0.005
    assert 0.5 * NOISE < float(found.d) < 1.5 * NOISE
    again = fitted(model, found.parameters, bound)
    assert abs(again.log_likelihood - found.log_likelihood) < 1.0


def test_a_fit_starts_without_a_nearby_trajectory_that_diverges(monkeypatch):
    """The trajectory may belong to another noise model, with other states."""
    time = np.arange(100) * 0.05
    level = np.exp(-0.7 * time)
    prepared = Decay().prepare(Recording({"time": torch.from_numpy(time), "level": torch.from_numpy(level)}))
    start = torch.tensor([0.7, 1.0], dtype=torch.float64)
    near, whole = prepared.answer(start, {}).nearby, JointModel.residual

    def lost_nearby(model, parameters):
        found = whole(model, parameters)
        return found if model.near is None else torch.full_like(found, torch.nan)

    monkeypatch.setattr(JointModel, "residual", lost_nearby)
    variant, same = _finite_start(JointModel(prepared, (), near), start, fresh=True)
    assert variant.near is None
    assert torch.equal(same, start)
    assert _finite_start(JointModel(prepared, (), near), start, fresh=False)[0].near is near
    # a nearby trajectory with a finite result is kept
    monkeypatch.setattr(JointModel, "residual", whole)
    assert _finite_start(JointModel(prepared, (), near), start, fresh=True)[0].near is near


def test_a_start_beyond_its_domain_is_refitted_on_a_wide_domain():
    random, time = np.random.default_rng(1), np.arange(300) * 0.02
    level = np.exp(-0.7 * time) + NOISE * random.standard_normal(300)
    prepared = Decay().prepare(Recording({"time": torch.from_numpy(time), "level": torch.from_numpy(level)}))
    model = JointModel(prepared)
    near = fitted(model, torch.tensor([0.7, 1.0], dtype=torch.float64), torch.tensor([20.0 * NOISE]).double())
    assert within_domain(near) is near
    far = replace(near, parameters=torch.tensor([3.0, 1.0], dtype=torch.float64))
    with pytest.raises(NoFitError):
        fitted(model, far.parameters, far.bound, graduate=False)
    start = within_domain(far)
    assert torch.equal(start.bound, near.bound)
    torch.testing.assert_close(fitted(model, start.parameters, start.bound, graduate=False).parameters, near.parameters)
    # no fit of this model is within so narrow a domain
    narrow = within_domain(replace(far, bound=torch.tensor([0.5 * NOISE], dtype=torch.float64)))
    assert float(narrow.bound) > 2.0 * NOISE
    torch.testing.assert_close(
        fitted(model, narrow.parameters, narrow.bound, graduate=False).parameters, near.parameters, rtol=0.01, atol=0.0
    )
