"""The delay of an input by a profile of the likelihood."""

import functools
import math
from dataclasses import replace

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms, shape_fitted, with_profiled_shape
from mkc_torch.diagnosis.search.estimate import estimate
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics, Parameter

STEP, DELAYED, NOISE = 0.02, 8, 0.002


class Cart(Dynamics):
    states = ("place", "speed")
    inputs = ("force",)
    outputs = ("place",)
    units = {"place": "m", "speed": "m/s"}
    parameters = {"gain": Parameter(1.0, lower=0.0), "spring": Parameter(1.0, lower=0.0)}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        return {"place": x.speed, "speed": p.gain * u.force - p.spring * x.place - 0.5 * x.speed}


@functools.cache
def fit_without_delay(noise=NOISE):
    """Return the fit of a cart that responds 0.16 s late to steps of its force, without the delay."""
    generator = torch.Generator().manual_seed(0)
    N = 600
    force = torch.randn(N // 10, generator=generator, dtype=torch.float64).repeat_interleave(10)
    late = torch.cat([force[:1].expand(DELAYED), force[:-DELAYED]])
    place, speed, places = 0.0, 0.0, []
    for now in late.tolist():
        places.append(place)
        for _ in range(20):
            speed += STEP / 20 * (now - 2.0 * place - 0.5 * speed)
            place += STEP / 20 * speed
    noise = noise * torch.randn(N, generator=generator, dtype=torch.float64)
    time = STEP * torch.arange(N, dtype=torch.float64)
    recording = Recording({"time": time, "force": force, "place": torch.tensor(places).double() + noise})
    prepared = Cart().prepare(recording)
    return fitted(JointModel(prepared), prepared.start())


def with_effect(name, noise=NOISE, **shape):
    """Return the fit with an effect, at this shape."""
    effect, alone = next(effect for effect in DYNAMICS if effect.id == name), fit_without_delay(noise)
    term = candidate_terms(alone.model.prepared, (), (effect,))[0]
    model = alone.model.with_term(replace(term, shape={**term.shape, **shape}))
    return fitted(model, torch.cat([alone.parameters, alone.parameters.new_tensor([0.5])]), alone.bound)


@pytest.mark.parametrize("start", [0.06, 0.0999])
def test_the_profile_finds_a_delay_beyond_a_local_maximum(start):
    stuck = shape_fitted(with_effect("input_delay", delay=start))
    assert abs(stuck.model.terms[-1].shape["delay"] - DELAYED * STEP) > STEP
    found = with_profiled_shape(stuck)
    assert found.model.terms[-1].shape["delay"] == pytest.approx(DELAYED * STEP, abs=0.5 * STEP)
    assert float(found.parameters[-1]) == pytest.approx(1.0, abs=0.05)
    assert float(found.residual.square().mean().sqrt()) == pytest.approx(NOISE, rel=0.15)


def test_a_fit_without_a_delay_is_unchanged_by_the_profile():
    fit = with_effect("dead_zone")
    assert with_profiled_shape(fit) is fit


def delay_and_error(noise):
    """Return the fit with the delay, and the delay's standard error."""
    fit = with_profiled_shape(shape_fitted(with_effect("input_delay", noise, delay=0.15)))
    (errors,) = estimate(fit, NoiseSettings()).shape_errors
    return fit, errors["delay"]


def test_the_error_of_a_delay_in_weak_noise_is_the_sampling_resolution():
    fit, error = delay_and_error(NOISE)
    assert error == pytest.approx(STEP / math.sqrt(12.0), rel=0.1)
    assert abs(fit.model.terms[-1].shape["delay"] - DELAYED * STEP) < 2.0 * error


def test_the_error_of_a_delay_in_strong_noise_grows_with_the_noise():
    """The variance within a sample interval is constant; the remainder grows with the noise."""
    within = STEP**2 / 12.0
    (weak, strong) = (delay_and_error(noise)[1] for noise in (0.05, 0.1))
    assert weak > STEP
    assert math.sqrt((strong**2 - within) / (weak**2 - within)) == pytest.approx(2.0, rel=0.1)
