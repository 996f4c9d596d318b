"""A second store and a mass on a spring take up what the state loses, and start in equilibrium with it."""

import numpy as np
import pytest

from examples.blind_proof.equations import flows
from examples.blind_proof.equations.integrate import outputs_of_sizes, simulate
from examples.blind_proof.equations.plant import HiddenTerm, Plant, RunSet

NONE = np.zeros((0, 1))


def free():
    """A state that moves by its input alone."""
    return Plant("free", ("x",), ("u",), ("x",), {"x": "m"}, {}, {}, lambda x, u, p: u + 0.0 * x, 12)


def trial(force, begin=0.0, step=0.02):
    return RunSet(step, np.asarray(force, dtype=float)[None, :, None], np.array([[begin]]))


def store(constant=0.5):
    form = flows.second_store(0, lambda head: head / constant)
    return HiddenTerm("hidden_lag", "", ("rate of x",), 1.0, form, own=1, begin=flows.like(0))


def mass(omega=20.0, damping=0.05, bend=0.0):
    form = flows.second_mass(0, omega, damping, bend)
    return HiddenTerm("hidden_mode", "", ("rate of x",), 1.0, form, own=2, begin=flows.unstretched(0))


@pytest.mark.parametrize("hidden", [store(), mass()])
def test_nothing_moves_that_begins_at_rest(hidden):
    found = simulate(free(), trial(np.zeros(50), begin=3.0), hidden, 0.7).outputs
    np.testing.assert_allclose(found, 3.0, atol=1e-12)


@pytest.mark.parametrize("hidden", [store(), mass(damping=0.3)])
def test_what_goes_in_is_shared_in_the_end(hidden):
    """After a force at the beginning both end alike, at the impulse divided by 1 plus the share."""
    force = np.where(np.arange(600) < 20, 1.0, 0.0)
    alone = simulate(free(), trial(force)).outputs[0, -1, 0]
    together = simulate(free(), trial(force), hidden, 0.5).outputs[0, -1, 0]
    assert together == pytest.approx(alone / 1.5, rel=1e-3)


def test_forms_take_up_what_the_state_gives_off():
    x, z, size = np.array([[3.0]]), np.array([[1.0]]), np.array([0.25])
    rates, taken = flows.second_store(0, lambda head: head**2)(x, z, NONE, np.zeros((1, 1)), size)
    assert taken.item() == 4.0
    assert rates.item() == -1.0
    rates, inner = flows.second_mass(0, 2.0, 0.5, 0.0)(x, np.array([[0.5], [4.0]]), NONE, np.zeros((1, 1)), size)
    assert inner[:, 0].tolist() == [1.0, -4.0]
    assert rates.item() == 1.0


def test_a_spring_hardens():
    x, z = np.zeros((1, 1)), np.array([[2.0], [0.0]])
    soft, hard = (flows.second_mass(0, 1.0, 0.1, b)(x, z, NONE, x, np.ones(1))[0].item() for b in (0.0, 0.25))
    assert (soft, hard) == (2.0, 4.0)


def test_runs_of_several_sizes_begin_alike():
    sizes = np.array([0.0, 0.3, 1.0])
    there = trial(np.sin(np.arange(80) * 0.3), begin=2.0)
    for hidden in (store(), mass()):
        together = outputs_of_sizes(free(), there, hidden, sizes)
        for size, found in zip(sizes, together, strict=True):
            np.testing.assert_allclose(found, simulate(free(), there, hidden, float(size)).outputs, rtol=1e-12)


def test_what_swings_along_a_known_path_is_the_small_mass_of_the_simulation():
    """To first order in the mass the path stays the same."""
    there = trial(np.sin(np.arange(200) * 0.2) + 0.5)
    omega, damping, small = 15.0, 0.1, 1e-6
    course = simulate(free(), there)
    moved = simulate(free(), there, mass(omega, damping), small).states - course.states
    step = there.step / free().fine
    pull = flows.swung(course.states[0], step, np.array([omega]), np.array([damping]))[..., 0]
    expected = np.cumsum(0.5 * (pull[1:] + pull[:-1]), 0) * step
    np.testing.assert_allclose(moved[0, 1:] / small, expected, atol=2e-3 * np.abs(expected).max())
