"""The score of a model: proper, the likelihood under white noise, and independent of units and of the scale of time."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import fit_with_process_noise
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.score import ScoreBasis, basis_of, highest, is_implausible, score, variance_ratio
from mkc_torch.diagnosis.settings import NoiseSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.horizons import log_likelihood_ahead
from mkc_torch.simulation.dynamics.kalman import OUTLIERS, Flow
from mkc_torch.simulation.dynamics.noise_model import NoiseModel

N, STEP, NOISE = 240, 0.1, 0.02


class Slide(Dynamics):
    """A body that coasts against a spring, with viscous damping."""

    states = ("position", "speed")
    outputs = ("position",)
    parameters = {"stiffness": Parameter(1.0, lower=0.0), "damping": Parameter(0.05, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"position": x.speed, "speed": -p.stiffness * x.position - p.damping * x.speed}


class SlowSlide(Slide):
    """The same body with time in other units."""

    parameters = {"stiffness": Parameter(1e-4, lower=0.0), "damping": Parameter(0.0005, lower=0.0)}


@functools.cache
def slid(seed: int, friction: float = 0.0, jolt: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Times and positions, by semi-implicit steps, with dry friction and white process noise of the speed."""
    rng, fine = np.random.default_rng(seed), 20
    x, v, dt = 1.0, 0.0, STEP / fine
    found = []
    for _ in range(N):
        found.append(x)
        kick = jolt * rng.normal() / math.sqrt(fine)
        for _ in range(fine):
            v += dt * (-x - 0.05 * v - friction * math.tanh(v / 0.01)) + kick * dt
            x += dt * v
    noise = NOISE * rng.normal(size=N)
    return STEP * torch.arange(N, dtype=torch.float64), torch.tensor(np.array(found) + noise)


def recorded(seed: int, *, time: float = 1.0, size: float = 1.0, **options: float) -> Recording:
    clock, position = slid(seed, **options)
    return Recording({"time": time * clock, "position": size * position})


def fits(simulation: Dynamics, recording: Recording) -> tuple[FittedModel, FittedModel]:
    """The simulation alone, and with dry friction, in open loop."""
    prepared = simulation.prepare(recording)
    alone = fitted(JointModel(prepared), prepared.start())
    effect = [effect for effect in CATALOGUE if effect.id == "coulomb_friction"]
    term = candidate_terms(prepared, (), effect)[-2]
    model = alone.model.with_term(term)
    return alone, fitted(model, torch.cat([alone.parameters, alone.parameters.new_zeros(1)]), alone.bound)


@functools.cache
def scored(seed: int, friction: float, time: float = 1.0, size: float = 1.0) -> tuple[float, float]:
    recording = recorded(seed, friction=friction, time=time, size=size)
    both = fits(Slide() if time == 1.0 else SlowSlide(), recording)
    basis = basis_of(both[0], 10, {}, Settings())
    alone, friction_score = (score(fit, basis, Settings()) for fit in both)
    assert alone is not None
    assert friction_score is not None
    return alone.value, friction_score.value


def test_missing_physics_scores_higher_than_process_noise() -> None:
    recording = recorded(0, friction=0.05)
    alone, friction = fits(Slide(), recording)
    basis = basis_of(alone, 10, {}, Settings())
    noisy = fit_with_process_noise(alone, {}, NoiseSettings()).fit
    with_friction = score(friction, basis, Settings())
    assert with_friction is not None
    assert with_friction.value > highest((alone, noisy), basis, Settings()) + 20.0
    assert with_friction.noise.components == ()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_effect_that_is_absent_scores_lower(seed: int) -> None:
    alone, friction = scored(seed, 0.0)
    assert friction < alone


@pytest.mark.parametrize(("time", "size"), [(1.0, 1e3), (1.0, 1e-6), (100.0, 1.0)])
def test_units_and_the_scale_of_time_do_not_change_a_difference(time: float, size: float) -> None:
    usual, other = scored(0, 0.05), scored(0, 0.05, time, size)
    assert other[1] - other[0] == pytest.approx(usual[1] - usual[0], abs=0.2)


def test_white_noise_gives_the_ordinary_likelihood() -> None:
    recording = recorded(4)
    alone, _ = fits(Slide(), recording)
    basis = basis_of(alone, 10, {}, Settings())
    found = score(alone, basis, Settings())
    assert found is not None
    assert found.noise.components == ()
    z = alone.residual.numpy() / found.noise.sensor[0]
    normal = (1.0 - OUTLIERS) * np.exp(-0.5 * z**2) / (math.sqrt(2.0 * math.pi) * found.noise.sensor[0])
    expected = (basis.counts * np.log(normal + OUTLIERS / basis.span)).sum()
    assert found.log_likelihood == pytest.approx(expected, rel=1e-6)
    assert found.by_horizon == (found.by_horizon[0],) * len(basis.horizons)
    assert found.per_sample.sum() == pytest.approx(expected, rel=1e-6)


class Bounded(Slide):
    """The same body with a stiffness at a bound, which is no uncertainty."""

    parameters = {"stiffness": Parameter(1.1, lower=1.09, upper=1.2), "damping": Parameter(0.05, lower=0.0)}


class Uncertain(Slide):
    """The same body, whose stiffness was measured wrong."""

    parameters = {"stiffness": Parameter(1.1, lower=0.0, uncertainty=0.01), "damping": Parameter(0.05, lower=0.0)}


def test_a_parameter_far_from_its_value_costs_half_the_square_of_its_distance() -> None:
    recording = recorded(0, friction=0.05)
    found = []
    for simulation in (Bounded(), Uncertain()):
        alone, friction = fits(simulation, recording)
        basis = replace(basis_of(alone, 10, {}, Settings()), kappa=2.0)
        away = (float(friction.parameters[0]) - 1.1) / 0.01
        scored_fit = score(friction, basis, Settings())
        assert scored_fit is not None
        found.append((scored_fit.given, 2.0 * 0.5 * away**2))
    assert found[0][0] == 0.0
    assert found[1][0] == pytest.approx(found[1][1])
    assert found[1][0] > 20.0


def test_parts_add_up_to_the_score() -> None:
    _, friction = fits(Slide(), recorded(0, friction=0.05))
    basis = basis_of(friction, 10, {}, Settings())
    found = score(friction, basis, Settings())
    assert found is not None
    prices = found.numbers + found.terms + found.disturbances + found.forms + found.given
    assert found.value == pytest.approx(sum(found.by_horizon) / len(found.by_horizon) - prices)
    assert found.numbers == pytest.approx(0.5 * basis.kappa * math.log(N))
    assert found.terms == pytest.approx(math.log(10))
    dearer = score(friction, replace(basis, kappa=2.0 * basis.kappa), Settings())
    assert dearer is not None
    assert dearer.value == pytest.approx(found.value - prices)


def test_the_prices_factor_is_1_under_white_noise_and_larger_under_process_noise() -> None:
    white, noisy = (fits(Slide(), recorded(5, jolt=jolt))[0] for jolt in (0.0, 0.3))
    assert basis_of(white, 10, {}, Settings()).kappa == 1.0
    assert basis_of(noisy, 10, {}, Settings()).kappa > 1.5


def test_the_last_horizon_is_the_free_run() -> None:
    basis = basis_of(fits(Slide(), recorded(5))[0], 10, {}, Settings())
    assert basis.horizons == (1, 4, 16, 256)  # a power of 2 that is longer than the recording


def linear_flow(process: float, seed: int) -> Flow:
    """Draws of an integrator with process noise and sensor noise, along a trajectory that stands still."""
    rng, samples = np.random.default_rng(seed), 400
    states = np.cumsum(np.concatenate([[0.0], process * rng.normal(size=samples - 1)]))
    one = np.ones((samples - 1, 1, 1))
    new = (states + rng.normal(size=samples))[:, None]
    return Flow(
        one, one, np.ones((samples, 1, 1)), new, np.zeros((samples - 1, 1)), np.ones(samples - 1),
        np.ones((samples, 1)), np.ones(1),
    )  # fmt: skip


@pytest.mark.parametrize("process", [0.0, 0.3, 1.0])
def test_the_true_noise_scores_highest_in_the_mean_over_draws(process: float) -> None:
    sizes, span = (0.0, 0.15, 0.3, 0.6, 1.0, 2.0), np.array([100.0])
    noises = [NoiseModel((1.0,), ((0, size, 0.0),) if size else (), (True,)) for size in sizes]
    totals = np.mean(
        [log_likelihood_ahead(linear_flow(process, seed), noises, (1, 4, 16), span)[0].mean(1) for seed in range(20)], 0
    )
    assert sizes[int(totals.argmax())] == process


def test_a_lost_trajectory_has_no_score() -> None:
    alone, _ = fits(Slide(), recorded(0))
    basis = basis_of(alone, 10, {}, Settings())
    lost = replace(alone, parameters=alone.parameters * torch.nan)
    assert score(lost, basis, Settings()) is None
    assert highest((lost, None), basis, Settings()) == -math.inf


def test_an_implausible_size_has_no_score() -> None:
    alone, friction = fits(Slide(), recorded(0, friction=0.05))
    basis = basis_of(alone, 10, {}, Settings())
    smaller = replace(basis, changes=1e-4 * basis.changes)
    assert score(friction, basis, Settings()) is not None
    assert score(friction, smaller, Settings()) is None


@pytest.mark.parametrize(("size", "possible"), [(0.5, True), (3.0, False)])
def test_a_parameter_that_an_effect_takes_out_of_its_bounds_has_no_score(size: float, possible: bool) -> None:
    known = recorded(0)
    wave = torch.linspace(0.0, 30.0, len(known), dtype=torch.float64).sin()
    recording = Recording({**known.columns, "heat": wave})
    prepared = Slide().prepare(recording)
    driver = find_drivers(prepared.recording, Slide().columns, Settings().drivers).drivers
    (effect,) = [effect for effect in CATALOGUE if effect.id == "driver_parameter"]
    (term,) = [term for term in candidate_terms(prepared, driver, [effect]) if term.port == "parameter damping"]
    alone = fitted(JointModel(prepared), prepared.start())
    basis = basis_of(alone, 10, {}, Settings())
    model = JointModel(prepared, [term])
    parameters = torch.cat([alone.parameters, alone.parameters.new_tensor([size])])
    assert is_implausible(replace(alone, model=model, parameters=parameters), basis) is not possible


def test_the_variance_ratio_of_overlapping_sums_is_their_length() -> None:
    values = np.random.default_rng(0).normal(size=40_000)
    assert variance_ratio([values], 16) == pytest.approx(1.0, abs=0.15)
    overlapping = np.convolve(values, np.ones(4), mode="valid")
    assert variance_ratio([overlapping], 64) == pytest.approx(4.0, rel=0.15)
    assert variance_ratio([np.ones(10)], 3) == 1.0


def test_the_price_of_a_number_is_half_the_logarithm_of_the_samples_times_kappa() -> None:
    basis = ScoreBasis((1,), np.ones(1), np.ones((100, 1)), 100, 3.0, 0.0, (0.0,), {}, np.ones(2), np.ones(1))
    assert basis.number == pytest.approx(1.5 * math.log(100))
