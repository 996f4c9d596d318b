"""Effects are added along the process noise, where an open loop is too sensitive for their linear gain."""

import functools
import math

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_process_noise
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.score import basis_of, score
from mkc_torch.diagnosis.search.along_noise import add_along_noise, fitted_along
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.candidate import Candidate
from mkc_torch.diagnosis.search.moves import with_wide_grid
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics, Parameter

SETTINGS = Settings()
FRICTION, COGGING, STEP, SAMPLES, FINE = 15.0, 18.0, 0.01, 900, 20


class Motor(Dynamics):
    """A motor that stops between its cogs, whose simulation has no cogs and no dry friction."""

    states = ("angle", "speed")
    inputs = ("voltage",)
    outputs = ("angle", "speed")
    units = {"angle": "rad", "speed": "rad/s"}
    parameters = {"gain": Parameter(25.0, lower=0.0), "damping": Parameter(1.0, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": p.gain * u.voltage - p.damping * x.speed}


def recorded() -> Recording:
    """Return a recording of the motor, which sticks exactly."""
    generator = torch.Generator().manual_seed(0)
    steps = 2.5 * (2.0 * torch.rand(SAMPLES // 60, generator=generator).double() - 1.0)
    voltage = steps.repeat_interleave(60)
    angle = speed = 0.0
    angles, speeds, h = [], [], STEP / FINE
    for now in voltage.tolist():
        angles.append(angle)
        speeds.append(speed)
        for _ in range(FINE):
            force = 31.0 * now - 1.7 * speed - COGGING * math.sin(8.0 * angle)
            if speed == 0.0:
                speed = h * (force - math.copysign(FRICTION, force)) if abs(force) > FRICTION else 0.0
            else:
                after = speed + h * (force - math.copysign(FRICTION, speed))
                speed = after if after * speed > 0.0 else 0.0
            angle += h * speed
    noise = torch.randn(2, SAMPLES, generator=generator).double()
    table = {"angle": torch.tensor(angles).double() + 0.002 * noise[0]}
    table["speed"] = torch.tensor(speeds).double() + 0.1 * noise[1]
    return Recording({"time": STEP * torch.arange(SAMPLES).double(), "voltage": voltage, **table})


@functools.cache
def searched() -> tuple[BeamSearch, float]:
    """Return a beam of the motor alone, after effects were added along the noise, and its first score."""
    prepared = Motor().prepare(recorded()).with_input_hold({"voltage": "held"})
    alone = fitted(JointModel(prepared), prepared.start())
    names = ("coulomb_friction", "position_periodic_force", "quadratic_drag", "constant_force")
    terms = candidate_terms(prepared, (), [effect for effect in DYNAMICS if effect.id in names])
    beam = BeamSearch(terms, basis_of(alone, len({term.key for term in terms}), {}, SETTINGS), SETTINGS, {})
    beam.keep([Candidate(alone, score(alone, beam.basis, SETTINGS), "")])
    before = beam.best.value
    add_along_noise(beam, with_wide_grid(terms, prepared))
    return beam, before


@pytest.mark.e2e
def test_cogging_is_added_with_its_number_of_periods_and_its_size():
    beam, before = searched()
    cogs = next(term for term in beam.best.fit.model.terms if term.effect.id == "position_periodic_force")
    assert cogs.shape["order"] == 8.0
    number = beam.best.fit.model.terms.index(cogs)
    sine, cosine = beam.best.fit.model.gammas(beam.best.fit.parameters)[number].tolist()
    assert sine == pytest.approx(-COGGING, rel=0.1)
    assert abs(cosine) < 0.1 * COGGING
    assert beam.best.value > before + 1000.0


@pytest.mark.e2e
def test_effects_that_are_not_there_are_not_added():
    beam, _ = searched()
    assert {term.effect.id for term in beam.best.fit.model.terms} == {"coulomb_friction", "position_periodic_force"}


@pytest.mark.e2e
def test_a_model_under_white_noise_alone_has_no_fit_along_noise():
    beam, _ = searched()
    alone = beam.models[()]
    assert has_process_noise(fitted_along(alone.fit, alone.score.noise, {}, SETTINGS.noise))
    white = type(alone.score.noise)(alone.score.noise.sensor)
    assert fitted_along(alone.fit, white, {}, SETTINGS.noise) is None
