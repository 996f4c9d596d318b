"""Process noise has its declared spectrum and size, and acts on the rate of one state only."""

import dataclasses

import numpy as np
import pytest

from examples.blind_proof.draws import generator
from examples.blind_proof.equations.disturbances import (
    GUSTS,
    KINDS,
    LASTING,
    OVER_NOISE,
    SLOW,
    DisturbedErrors,
    draw_disturbance,
    gusts,
    responses,
    slow,
    white,
)
from examples.blind_proof.equations.errors import draw_errors
from examples.blind_proof.equations.integrate import SystemScene, simulate
from examples.blind_proof.equations.oracle import range_of, tangents
from examples.blind_proof.equations.plant import RunSet
from examples.blind_proof.equations.systems import SYSTEMS

STEP, FINE = 0.05, 8


def run_set(samples, runs=2):
    return RunSet(STEP, np.zeros((0, samples, runs)), np.zeros((1, runs)))


def scene_of(system, seed=3):
    setting = SYSTEMS[system].draw(generator(seed, system))
    scene = SystemScene(setting.plant, setting.trial, simulate(setting.plant, setting.trial))
    return scene, draw_errors(generator(seed, system, "noise"), scene.course.outputs)


def test_white_force_noise_is_independent_and_its_integral_does_not_depend_on_the_fine_step():
    values = white(generator(1), run_set(501, 40), FINE).fine
    count = values.size
    lags = [(values[k:] * values[:-k]).mean() / values.var() for k in (1, 2, 8)]
    assert np.abs(lags).max() < 4.0 / np.sqrt(count)
    power = (np.abs(np.fft.rfft(values, axis=0)[1:]) ** 2).mean(1) * STEP / FINE / len(values)
    thirds = [part.mean() for part in np.array_split(power, 3)]
    np.testing.assert_allclose(thirds, 1.0, rtol=0.03)
    for fine in (2, 16):
        steps = white(generator(1), run_set(501, 40), fine).fine.reshape(500, fine, 40).sum(1) * STEP / fine
        assert steps.var() / STEP == pytest.approx(1.0, rel=0.03)


def test_a_slow_disturbance_decorrelates_exponentially():
    many = slow(generator(2), run_set(200, 4000), 2)  # the correlation over an ensemble
    constant = many.words["correlation time"]
    assert SLOW[0] <= constant / (199 * STEP) <= SLOW[1]
    values = many.fine[::2]
    assert values.var() == pytest.approx(1.0, abs=0.03)
    for lag in (1, 10, 40):
        found = (values[lag:] * values[:-lag]).mean()
        assert found == pytest.approx(np.exp(-lag * STEP / constant), abs=0.03)
        assert many.covariance[0, 0, lag] == pytest.approx(np.exp(-lag * STEP / constant))


def test_a_lasting_disturbance_decorrelates_within_about_a_run():
    many = KINDS["lasting_push_runs"](generator(2), run_set(100, 4000), 1)
    constant = many.words["correlation time"]
    assert LASTING[0] <= constant / (99 * STEP) <= LASTING[1]
    found = (many.fine[60:] * many.fine[:-60]).mean()
    assert found == pytest.approx(np.exp(-60 * STEP / constant), abs=0.04)


def test_gusts_are_level_in_some_stretches_and_absent_in_others():
    values = gusts(generator(3), run_set(401, 50), FINE).fine
    assert not np.diff(values.reshape(400, FINE, 50), axis=1).any()
    calm = (values == 0.0).mean(0)
    assert (calm > 0.2).all()
    assert (calm < 1.0).all()
    levels = [len(set(run) - {0.0}) for run in values.T]
    assert max(levels) <= GUSTS[1]
    assert min(levels) >= 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("system", ["pendulum", "cart_pole", "thermal"])
def test_a_disturbance_is_in_the_rate_of_its_state_and_vanishes_at_size_0(system, kind):
    scene, errors = scene_of(system)
    plant = scene.plant
    disturbance = draw_disturbance(generator(4, kind), kind, scene, errors)
    others = [plant.row(name) for name in plant.states if name != disturbance.state]
    assert not disturbance.rates[others].any()
    assert disturbance.rates[plant.row(disturbance.state)].any()
    assert disturbance.state not in plant.speeds
    still = simulate(plant, scene.trial, disturbance=0.0 * disturbance.rates)
    np.testing.assert_array_equal(still.states, scene.course.states)
    # in the first fine step nothing but that state has moved to first order
    first = simulate(plant, scene.trial, disturbance=disturbance.rates).states[:, 1] - scene.course.states[:, 1]
    step = scene.trial.step / plant.fine
    np.testing.assert_allclose(
        first[plant.row(disturbance.state)], step * disturbance.rates[plant.row(disturbance.state), 0], rtol=0.2
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_residual_of_a_disturbance_in_the_fitted_run_is_that_of_the_key(kind):
    scene, errors = scene_of("tanks")
    disturbance = draw_disturbance(generator(5, kind), kind, scene, errors)
    moved = simulate(scene.plant, scene.trial, disturbance=disturbance.rates).outputs - scene.course.outputs
    free = [np.sqrt(np.square(item / d).mean()) for item, d in zip(moved, errors.deviations, strict=True)]
    assert OVER_NOISE[0] <= disturbance.over_noise <= OVER_NOISE[1]
    plain = dataclasses.replace(errors, correlation=0.0)
    if errors.correlation == 0.0:
        assert max(free) == pytest.approx(disturbance.free_over_noise)
    basis = range_of(tangents(scene, plain, rivals=False).known)
    white_moved = plain.whitened(moved)
    left = (white_moved - basis @ (basis.T @ white_moved)).reshape(len(moved), -1)
    if errors.correlation == 0.0:
        assert np.sqrt(np.square(left).mean(1)).max() == pytest.approx(disturbance.over_noise)


@pytest.mark.parametrize("system", ["pendulum", "tanks", "projectile"])
def test_responses_are_those_of_the_true_system(system):
    scene, _ = scene_of(system)
    plant, state = scene.plant, next(name for name in scene.plant.states if name not in scene.plant.speeds)
    disturbance = slow(generator(6), scene.trial, plant.fine)
    size = 1e-4 * max(scene.pace(state), scene.largest(state) / scene.length)
    rates = size * disturbance.at(plant, state)
    means = rates[plant.row(state)].reshape(-1, plant.fine, scene.trial.runs).mean(1)
    linear = np.einsum("mtrk,kr->mtr", responses(scene, state), means)
    true = simulate(plant, scene.trial, disturbance=rates).outputs - scene.course.outputs
    np.testing.assert_allclose(linear, true, atol=0.02 * np.abs(true).max())


@pytest.mark.e2e
def test_traces_similar_to_the_disturbance_have_less_weight():
    """Whitened draws of measurement plus process noise have variance 1 on average."""
    scene, errors = scene_of("tanks")
    errors = dataclasses.replace(errors, correlation=0.0, family="gaussian")
    disturbance = draw_disturbance(generator(7), "pushed_slowly", scene, errors)
    weighing = DisturbedErrors(scene, errors, disturbance)
    moved = simulate(scene.plant, scene.trial, disturbance=disturbance.rates).outputs - scene.course.outputs
    assert np.square(weighing.whitened(moved)).sum() < 0.5 * np.square(errors.whitened(moved)).sum()
    draws = generator(8)
    squares = []
    for _ in range(20):
        again = slow(draws, scene.trial, scene.plant.fine)
        if not squares:
            covariance = disturbance.size**2 * again.covariance
            weighing = DisturbedErrors(scene, errors, dataclasses.replace(disturbance, covariance=covariance))
        rates = disturbance.size * again.at(scene.plant, disturbance.state)
        noise = np.reshape(errors.deviations, (-1, 1, 1)) * np.random.default_rng(len(squares)).standard_normal(
            moved.shape
        )
        total = simulate(scene.plant, scene.trial, disturbance=rates).outputs - scene.course.outputs + noise
        squares.append(np.square(weighing.whitened(total)).mean())
    assert np.mean(squares) == pytest.approx(1.0, abs=0.15)
