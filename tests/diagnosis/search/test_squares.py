"""Models are also fitted by least squares where a robust fit takes a stretch that they do not follow for outliers."""

import functools
import math
from dataclasses import replace

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import FittedModel, by_least_squares, fitted, fitted_like, with_own_density
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_process_noise
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.score import basis_of, score
from mkc_torch.diagnosis.search.along_noise import fitted_along
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.move_fits import by_both_estimators, by_squares
from mkc_torch.diagnosis.search.moves import additions, with_wide_grid
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics, Parameter

SETTINGS = Settings()
STEP, SAMPLES, FINE = 0.02, 700, 20
WIDTH, DELAY, NOISE = 0.6, 0.1, 0.001
TRUE = {"thrust": 60.0, "gravity": 80.0, "damping": 1.5}


class Arm(Dynamics):
    """A lever with a propeller, whose simulation has no dead zone and no delay."""

    states = ("angle", "speed")
    inputs = ("voltage",)
    outputs = ("angle",)
    units = {"angle": "rad", "speed": "rad/s", "voltage": "V"}
    parameters = {
        "thrust": Parameter(25.0, lower=0.0),
        "gravity": Parameter(75.0, lower=1.0, unit="1/s^2"),
        "damping": Parameter(1.0, lower=0.0, unit="1/s"),
    }

    def derivative(self, time, x, u, p):
        torque = p.thrust * u.voltage - p.gravity * torch.sin(x.angle) - p.damping * x.speed
        return {"angle": x.speed, "speed": torque}


def recorded() -> Recording:
    """Return a recording of an arm at rest for 8.4 s, and moved by three steps in the last 5.6 s."""
    voltage = [0.78] * 420 + [1.05] * 120 + [0.66] * 80 + [1.45] * 80
    angle, speed = math.asin(TRUE["thrust"] * (voltage[0] - WIDTH) / TRUE["gravity"]), 0.0
    angles, h, late = [], STEP / FINE, round(DELAY / STEP)
    for sample in range(SAMPLES):
        angles.append(angle)
        acting = max(voltage[max(sample - late, 0)] - WIDTH, 0.0)
        for _ in range(FINE):
            torque = TRUE["thrust"] * acting - TRUE["gravity"] * math.sin(angle) - TRUE["damping"] * speed
            speed += h * torque
            angle += h * speed
    noise = NOISE * torch.randn(SAMPLES, generator=torch.Generator().manual_seed(1)).double()
    time = STEP * torch.arange(SAMPLES).double()
    table = {"time": time, "voltage": torch.tensor(voltage).double(), "angle": torch.tensor(angles).double() + noise}
    return Recording(table)


@functools.cache
def alone() -> FittedModel:
    prepared = Arm().prepare(recorded()).with_input_hold({"voltage": "held"})
    return fitted(JointModel(prepared), prepared.start())


@functools.cache
def with_dead_zone() -> FittedModel:
    """Return the robust fit with the dead zone, without the delay."""
    prepared = alone().model.prepared
    terms = candidate_terms(prepared, (), [effect for effect in DYNAMICS if effect.id == "dead_zone"])
    near = min(terms, key=lambda term: abs(term.shape["width"] - WIDTH) + term.shape["softness"])
    model = alone().model.with_term(near)
    true = torch.tensor([*TRUE.values(), float(recorded()["angle"][0]), 0.0, 1.0], dtype=torch.float64)
    return fitted(model, true, alone().bound, graduate=False)


def rms(fit: FittedModel) -> float:
    return float(fit.residual.square().mean().sqrt())


def test_a_robust_fit_follows_the_rest_and_least_squares_the_motion():
    robust = with_dead_zone()
    squares = by_squares(robust, SETTINGS.noise)
    assert robust.rejected_share(SETTINGS.noise) > 0.05
    assert squares is not None
    assert squares.sigma_held
    assert rms(squares) < 0.8 * rms(robust)
    assert float(robust.residual[:400].abs().median()) < float(squares.residual[:400].abs().median())


def test_least_squares_is_the_minimum_of_the_sum_of_squares():
    squares = by_least_squares(with_dead_zone())
    start = squares.parameters.clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(0.5 * squares.model.residual(start).square().sum(), start)
    # the share of the dead zone, the last parameter, is at its bound
    relative = slope[:-1] * squares.parameters[:-1].abs().clamp(min=0.01)
    assert float(relative.abs().max()) < 1e-3 * float(squares.residual.square().sum())


def test_a_fit_that_rejects_few_samples_is_not_repeated():
    good = replace(
        with_dead_zone(), residual=NOISE * torch.randn(SAMPLES, 1, generator=torch.Generator().manual_seed(2))
    )
    good = replace(good, residual=good.residual.double(), d=good.d * 0.0 + NOISE, sigma=good.sigma * 0.0 + 3.0)
    assert by_squares(good, SETTINGS.noise) is None
    assert list(by_both_estimators(good, SETTINGS.noise)) == [good]


def test_the_delay_shows_in_the_linear_gains_of_least_squares():
    """The robust fit rejects the motion, in which alone a delay shows."""
    robust = with_dead_zone()
    squares = by_squares(robust, SETTINGS.noise)
    terms = candidate_terms(robust.model.prepared, (), [effect for effect in DYNAMICS if effect.id == "input_delay"])
    wide = with_wide_grid(terms, robust.model.prepared)
    (of_robust,), (of_squares,) = (additions(fit, wide, SETTINGS.noise) for fit in (robust, squares))
    assert of_squares.gain > 5.0 * of_robust.gain
    assert of_squares.gain > 100.0


def test_a_fit_of_least_squares_keeps_its_estimator_along_an_observer():
    squares = by_least_squares(with_dead_zone())
    own = with_own_density(squares)
    assert own.squares
    assert not own.sigma_held
    torch.testing.assert_close(own.parameters, squares.parameters)
    again = fitted_like(own.model, own.parameters, own)
    assert again.squares
    assert rms(again) <= 1.001 * rms(squares)
    noise = score(own, basis_of(alone(), 1, {}, SETTINGS), SETTINGS).noise
    noisy = fitted_along(own, noise, {}, SETTINGS.noise)
    assert has_process_noise(noisy)
    assert rms(replace(noisy, squares=True).open_loop) <= 1.001 * rms(squares)
    assert rms(replace(noisy, squares=False).open_loop) > 1.2 * rms(squares)


@pytest.mark.e2e
def test_a_dead_zone_and_a_delay_are_found_though_the_arm_rests_most_of_the_time():
    prepared = alone().model.prepared
    names = ("dead_zone", "input_delay", "coulomb_friction")
    terms = candidate_terms(prepared, (), [effect for effect in DYNAMICS if effect.id in names])
    basis = basis_of(alone(), len({term.key for term in terms}), {}, SETTINGS)
    best = BeamSearch(terms, basis, SETTINGS, {}, most_models=10).run(alone())
    found = {term.effect.id: term.shape for term in best.fit.model.terms}
    assert found.keys() == {"dead_zone", "input_delay"}
    # half an interval more where the input is taken to be linear between samples
    assert found["input_delay"]["delay"] == pytest.approx(DELAY, abs=0.6 * STEP)
    assert found["dead_zone"]["width"] == pytest.approx(WIDTH, abs=0.005)
    assert rms(best.fit) < 1.1 * NOISE
