"""Candidates that act through a trajectory are compared at fitted shapes, not at those of the grid."""

import functools
from dataclasses import replace

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.search.joint_refits import _leading, _with_fitted_shapes, strongest
from mkc_torch.diagnosis.search.ranking import ModelPrior
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import DYNAMICS
from mkc_torch.recording import Recording
from mkc_torch.simulation import Dynamics, Parameter

STEP, SAMPLES, WIDTH = 0.05, 400, 0.62
NAMES = ("dead_zone", "constant_force", "input_square", "input_delay")


class Fan(Dynamics):
    """A fan whose speed follows its voltage."""

    states = ("speed",)
    inputs = ("voltage",)
    parameters = {"gain": Parameter(3.0, lower=0.0), "damping": Parameter(1.0, lower=0.0)}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        return {"speed": p.gain * u.voltage - p.damping * x.speed}


@functools.cache
def fan_fit():
    """Return the fit of the fan alone to steps of the voltage, of which the first 0.62 V have no effect."""
    generator = torch.Generator().manual_seed(3)
    levels = (0.7 + 0.6 * torch.rand(20, generator=generator)).double()
    levels[3::5] = 0.3
    voltage = levels.repeat_interleave(SAMPLES // 20)
    speed, found, parts = 0.0, [], 20
    for now in voltage.tolist():
        found.append(speed)
        for _ in range(parts):
            speed += STEP / parts * (5.0 * max(now - WIDTH, 0.0) - 1.3 * speed)
    seen = torch.tensor(found, dtype=torch.float64) + 0.01 * torch.randn(SAMPLES, generator=generator).double()
    time = STEP * torch.arange(SAMPLES, dtype=torch.float64)
    prepared = Fan().prepare(Recording({"time": time, "voltage": voltage, "speed": seen}))
    return fitted(JointModel(prepared), prepared.start())


def candidates():
    effects = [effect for effect in DYNAMICS if effect.id in NAMES]
    return candidate_terms(fan_fit().model.prepared, (), effects)


def test_the_gain_of_a_wide_dead_zone_is_that_of_its_fitted_width():
    term = next(term for term in candidates() if term.effect.id == "dead_zone")
    model = fan_fit().model.with_term(term)
    start = torch.cat([fan_fit().parameters, torch.full((1,), 0.5).double()])
    fit = fitted_with_effect(fan_fit(), model, start, graduate=False)
    prefer = ModelPrior(candidates(), fan_fit().model.prepared, Settings().naming)
    (shaped,) = _with_fitted_shapes({term.key: fit}, fan_fit(), prefer, Settings().search).values()
    assert shaped.model.terms[-1].shape["width"] == pytest.approx(WIDTH, rel=0.05)
    assert shaped.log_likelihood > fit.log_likelihood + 100.0


def test_fits_far_behind_keep_their_shapes_and_do_not_lead():
    term = next(term for term in candidates() if term.effect.id == "dead_zone")
    model, prepared = fan_fit().model.with_term(term), fan_fit().model.prepared
    prefer, settings = ModelPrior(candidates(), prepared, Settings().naming), Settings().search
    first = fitted_with_effect(fan_fit(), model, torch.cat([fan_fit().parameters, torch.full((1,), 0.5).double()]))
    far = replace(first, log_likelihood=first.log_likelihood - 1e4)
    fits = _with_fitted_shapes({"first": first, "far": far}, fan_fit(), prefer, settings)
    assert fits["far"] is far
    assert fits["first"] is not first
    (leader,) = _leading([first, far], fan_fit(), prefer, settings)
    assert leader is first
    assert len(_leading([first, replace(first)], fan_fit(), prefer, settings)) == 2


def test_a_wide_dead_zone_leads_over_a_constant_force():
    terms, settings = candidates(), Settings()
    prefer = ModelPrior(terms, fan_fit().model.prepared, settings.naming)
    fits, _ = strongest(fan_fit(), terms, prefer, settings, parts=False)
    assert fits[0].model.terms[-1].effect.id == "dead_zone"
    assert float(fits[0].residual.std()) == pytest.approx(0.01, rel=0.15)
