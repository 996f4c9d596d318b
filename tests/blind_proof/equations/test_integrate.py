import numpy as np
import pytest
from scipy.integrate import solve_ivp

from examples.blind_proof.draws import generator
from examples.blind_proof.equations.forces import bristles
from examples.blind_proof.equations.integrate import between, outputs_of_sizes, simulate, variation
from examples.blind_proof.equations.plant import HiddenTerm, RunSet
from examples.blind_proof.equations.systems import SYSTEMS

DRAWS = {name: system.draw for name, system in SYSTEMS.items() if name != "servo"}


def shortened(trial, samples=60):
    return RunSet(trial.step, trial.inputs[:, :samples], trial.begin)


@pytest.mark.parametrize("name", DRAWS)
def test_simulate_agrees_with_an_adaptive_method(name):
    setting = DRAWS[name](generator(1, name))
    plant, trial = setting.plant, shortened(setting.trial)
    found = simulate(plant, trial).states[:, :: plant.fine]
    time = trial.step * np.arange(trial.samples)

    def rate(t, x):
        u = np.array([np.interp(t, time, item[:, 0]) for item in trial.inputs])
        return plant.rate(x[:, None], u[:, None], plant.values)[:, 0]

    reference = solve_ivp(rate, (0.0, time[-1]), trial.begin[:, 0], t_eval=time, rtol=1e-9, atol=1e-10,
                       max_step=trial.step)  # fmt: skip
    scale = np.abs(reference.y).max(1, keepdims=True)
    assert np.abs(found[..., 0] - reference.y).max() < 1e-5 * scale.max()


def test_parallel_sizes_equal_single_sizes():
    setting = SYSTEMS["pendulum"].draw(generator(2))
    trial = shortened(setting.trial)
    hidden = HiddenTerm("coulomb_friction", "", ("rate of speed",), 1.0, bristles(1, 0.02, 1.0), own=1)
    sizes = np.array([0.0, 0.1, 0.4])
    together = outputs_of_sizes(setting.plant, trial, hidden, sizes)
    for size, found in zip(sizes, together, strict=True):
        np.testing.assert_allclose(found, simulate(setting.plant, trial, hidden, float(size)).outputs, rtol=1e-12)


def test_a_hidden_effect_of_size_zero_changes_nothing():
    setting = SYSTEMS["pendulum"].draw(generator(3))
    hidden = HiddenTerm("coulomb_friction", "", ("rate of speed",), 1.0, bristles(1, 0.02, 1.0), own=1)
    there = simulate(setting.plant, setting.trial, hidden, 0.0).outputs
    np.testing.assert_array_equal(there, simulate(setting.plant, setting.trial).outputs)


def test_between_interpolates_linearly():
    values = np.arange(12.0).reshape(1, 4, 3) ** 2
    found = between(values, 4)
    np.testing.assert_allclose(found[:, ::4], values)
    np.testing.assert_allclose(found[:, 2], 0.5 * (values[:, 0] + values[:, 1]))
    assert between(np.zeros((0, 5, 2)), 4).shape == (0, 17, 2)


def test_variation_is_exact_for_a_decay_under_a_constant_force():
    count = 101
    jacobian, forcing = np.full((count, 1, 1, 1), -2.0), np.ones((count, 1, 1, 1))
    found = variation(jacobian, forcing, np.zeros((1, 1, 1)), 0.01)[:, 0, 0, 0]
    time = 0.02 * np.arange(len(found))
    np.testing.assert_allclose(found, 0.5 * (1.0 - np.exp(-2.0 * time)), atol=1e-7)
