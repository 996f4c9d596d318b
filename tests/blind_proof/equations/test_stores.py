"""A second store and a mass on a spring receive the losses of the state, and start in equilibrium with it."""

import numpy as np
import pytest

from examples.blind_proof.equations import flows
from examples.blind_proof.equations.integrate import outputs_of_sizes, simulate
from examples.blind_proof.equations.plant import HiddenTerm, Plant, RunSet

NONE = np.zeros((0, 1))


def integrator():
    """Return a plant whose state is the integral of its input."""
    return Plant("free", ("x",), ("u",), ("x",), {"x": "m"}, {}, {}, lambda x, u, p: u + 0.0 * x, 12)


def run_set(force, begin=0.0, step=0.02):
    return RunSet(step, np.asarray(force, dtype=float)[None, :, None], np.array([[begin]]))


def hidden_store(constant=0.5):
    form = flows.second_store(0, lambda head: head / constant)
    return HiddenTerm("hidden_lag", "", ("rate of x",), 1.0, form, own=1, begin=flows.like(0))


def hidden_mass(omega=20.0, damping=0.05, bend=0.0):
    form = flows.second_mass(0, omega, damping, bend)
    return HiddenTerm("hidden_mode", "", ("rate of x",), 1.0, form, own=2, begin=flows.unstretched(0))


@pytest.mark.parametrize("hidden", [hidden_store(), hidden_mass()])
def test_states_in_equilibrium_stay_constant(hidden):
    found = simulate(integrator(), run_set(np.zeros(50), begin=3.0), hidden, 0.7).outputs
    np.testing.assert_allclose(found, 3.0, atol=1e-12)


@pytest.mark.parametrize("hidden", [hidden_store(), hidden_mass(damping=0.3)])
def test_state_and_store_share_an_impulse_in_the_end(hidden):
    """Both reach the impulse divided by 1 plus the share."""
    force = np.where(np.arange(600) < 20, 1.0, 0.0)
    alone = simulate(integrator(), run_set(force)).outputs[0, -1, 0]
    together = simulate(integrator(), run_set(force), hidden, 0.5).outputs[0, -1, 0]
    assert together == pytest.approx(alone / 1.5, rel=1e-3)


def test_stores_and_masses_receive_what_the_state_loses():
    x, z, size = np.array([[3.0]]), np.array([[1.0]]), np.array([0.25])
    rates, taken = flows.second_store(0, lambda head: head**2)(x, z, NONE, np.zeros((1, 1)), size)
    assert taken.item() == 4.0
    assert rates.item() == -1.0
    rates, inner = flows.second_mass(0, 2.0, 0.5, 0.0)(x, np.array([[0.5], [4.0]]), NONE, np.zeros((1, 1)), size)
    assert inner[:, 0].tolist() == [1.0, -4.0]
    assert rates.item() == 1.0


def test_a_hardening_spring_has_a_larger_force():
    x, z = np.zeros((1, 1)), np.array([[2.0], [0.0]])
    soft, hard = (flows.second_mass(0, 1.0, 0.1, b)(x, z, NONE, x, np.ones(1))[0].item() for b in (0.0, 0.25))
    assert (soft, hard) == (2.0, 4.0)


def test_parallel_sizes_equal_single_sizes():
    sizes = np.array([0.0, 0.3, 1.0])
    there = run_set(np.sin(np.arange(80) * 0.3), begin=2.0)
    for hidden in (hidden_store(), hidden_mass()):
        together = outputs_of_sizes(integrator(), there, hidden, sizes)
        for size, found in zip(sizes, together, strict=True):
            np.testing.assert_allclose(found, simulate(integrator(), there, hidden, float(size)).outputs, rtol=1e-12)


def test_a_small_mass_equals_a_mass_on_a_prescribed_path():
    """To first order in the mass, the path is unchanged."""
    there = run_set(np.sin(np.arange(200) * 0.2) + 0.5)
    omega, damping, small = 15.0, 0.1, 1e-6
    course = simulate(integrator(), there)
    moved = simulate(integrator(), there, hidden_mass(omega, damping), small).states - course.states
    step = there.step / integrator().fine
    pull = flows.swung(course.states[0], step, np.array([omega]), np.array([damping]))[..., 0]
    expected = np.cumsum(0.5 * (pull[1:] + pull[:-1]), 0) * step
    np.testing.assert_allclose(moved[0, 1:] / small, expected, atol=2e-3 * np.abs(expected).max())
