"""Predictions of a new recording, compared with an integration by SciPy."""

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.validation.predict import predict
from mkc_torch.simulation import Dynamics
from tests.diagnosis.validation.tank import DRAG, DRAIN, Tank, tank_model, tank_recording, two_runs, usual_model


def by_scipy(recording, start, *, drag):
    """Integrate the tank from an initial level, interval by interval, at which the inflow has corners."""
    time, inflow = recording["time"].numpy(), recording["inflow"].numpy()

    def rate(at, level):
        return np.interp(at, time, inflow) - DRAIN * level - drag * level * np.abs(level)

    levels = [start]
    for low, high in pairwise(time):
        found = solve_ivp(rate, (low, high), [levels[-1]], rtol=1e-11, atol=1e-12)
        levels.append(float(found.y[0, -1]))
    return np.array(levels)


@pytest.fixture(scope="module")
def prediction():
    return predict(usual_model(), tank_recording(1))


def test_the_prediction_is_the_solution_of_the_differential_equation(prediction):
    level = by_scipy(tank_recording(1), float(prediction.initial[0, 0]), drag=DRAG)
    away = np.abs(prediction.simulated[:, 0].numpy() - level).max()
    assert away < 1e-6 * np.ptp(level)
    assert prediction.accuracy < 1e-6


def test_the_initial_states_are_those_of_the_first_part_alone(prediction):
    """Later samples change nothing."""
    recording = tank_recording(1)
    first = recording["time"] <= prediction.start_seconds
    assert torch.equal(prediction.predicted, ~first)
    level = torch.where(first, recording["level"], recording["level"] + 0.3)
    other = predict(
        usual_model(), Recording({**recording.columns, "level": level}, name="other"), prediction.start_seconds
    )
    assert other.simulated == pytest.approx(prediction.simulated, abs=1e-7)


def test_a_tenth_is_enough_for_a_stable_system_and_no_shorter_part_is_used(prediction):
    assert prediction.start_seconds == pytest.approx(0.1 * 14.9)
    assert predict(usual_model(), tank_recording(1), 3.0).start_seconds == 3.0


class Cart(Dynamics):
    """A mass on a rail: an error of its initial speed grows with time."""

    states = ("position", "speed")
    inputs = ("force",)
    outputs = ("position",)

    def derivative(self, time, x, u, p):
        return {"position": x.speed, "speed": u.force}


def test_the_first_part_grows_where_an_error_of_the_initial_states_does():
    """By the formula for a line's error: at a tenth, the error of the speed exceeds the noise later."""
    time = torch.arange(200).double() / 10.0
    noise = 0.01 * torch.randn(200, generator=torch.Generator().manual_seed(0)).double()
    recording = Recording({"time": time, "force": torch.zeros(200), "position": 0.5 * time + noise})
    model = DiagnosedModel("Cart", {}, torch.zeros(0).double(), (), (), Cart())
    found = predict(model, recording)
    design = np.stack([np.ones(200), time.numpy()], -1)

    def added(seconds):
        first = time.numpy() <= seconds
        covariance = np.linalg.inv(design[first].T @ design[first])
        return np.einsum("ni,ij,nj->n", design[~first], covariance, design[~first]).mean()

    assert added(found.start_seconds) <= 0.25 or found.start_seconds == pytest.approx(0.5 * 19.9)
    assert added(found.start_seconds - 0.1 * 19.9) > 0.25


@pytest.mark.e2e
def test_each_run_has_initial_states_of_its_own():
    runs = two_runs(tank_recording(1), tank_recording(2))
    found = predict(usual_model(), runs)
    assert found.initial.shape == (2, 1)
    for number, seed in enumerate((1, 2)):
        alone = predict(usual_model(), tank_recording(seed), found.start_seconds)
        assert found.simulated[found.run == number] == pytest.approx(alone.simulated, abs=2e-3)


@pytest.mark.e2e
def test_segments_are_those_of_the_fit():
    """A model with restarts is predicted in segments, each from a first part of its own."""
    system = Tank().with_restarts(5.0)
    model = tank_model(tank_recording(0), system=system)
    found = predict(model, tank_recording(1))
    assert model.state["restart_after"] == 5.0
    assert len(found.initial) == 3
    assert not found.predicted[tank_recording(1)["time"] == 5.0].any()
    assert found.start_seconds < 5.0


@pytest.mark.e2e
def test_a_memory_starts_equal_to_its_state():
    """A state in `starts_as` is not estimated; the result is that without the state."""

    class Lagged(Tank):
        states = ("level", "memory", "store")
        outputs = ("level",)
        starts_as = {"memory": "level", "store": ""}

        def derivative(self, time, x, u, p):
            rates = super().derivative(time, x, u, p)
            return {**rates, "memory": x.level - x.memory, "store": x.level - x.store}

    recording, theta = tank_recording(1, drag=0.0), torch.tensor([DRAIN]).double()
    found = predict(DiagnosedModel("Lagged", {}, theta, (), (), Lagged()), recording)
    plain = predict(DiagnosedModel("Tank", {}, theta, (), (), Tank()), recording)
    assert found.initial[0].tolist() == pytest.approx([float(plain.initial[0, 0])] * 2 + [0.0], abs=1e-7)
    assert found.simulated == pytest.approx(plain.simulated, abs=1e-6)


def test_missing_outputs_are_neither_fitted_nor_counted():
    recording = tank_recording(1)
    level = recording["level"].clone()
    level[::3] = torch.nan
    found = predict(usual_model(), Recording({**recording.columns, "level": level}))
    rows = ~level[1:-1].isnan()
    assert len(found.measured) == int(rows.sum()) + int(~level[-1:].isnan().any())
    assert found.measured.isfinite().all()
    full = predict(usual_model(), recording)
    assert abs(float(found.initial) - float(full.initial)) < 0.1


@pytest.mark.parametrize("seconds", [-1.0, 0.0, 14.9, 100.0])
def test_a_start_out_of_range_is_refused(seconds):
    with pytest.raises(ValueError, match=r"less than 14.9 s, the length of the shortest trajectory, but got"):
        predict(usual_model(), tank_recording(1), seconds)


def test_a_run_that_is_too_short_is_refused():
    with pytest.raises(ValueError, match=r"the shortest trajectory has 5 samples, but 5 are needed"):
        predict(usual_model(), tank_recording(1).rows(torch.arange(5)))


def test_the_explained_share_is_that_of_the_predicted_samples(prediction):
    rows = prediction.predicted
    variance = np.var(prediction.measured[rows, 0].numpy())
    left = np.mean(prediction.residual[rows, 0].detach().numpy() ** 2)
    assert prediction.explained == pytest.approx((1.0 - left / variance,))
    constant = dataclasses.replace(prediction, measured=torch.ones_like(prediction.measured))
    assert math.isnan(constant.explained[0])
